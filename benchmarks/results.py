"""Where results are kept: one small JSON file per suite, with machine, versions, commit and date."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks import machine

FOLDER = Path(__file__).resolve().parent / "results"


def write(suite: str, content: dict[str, Any]) -> None:
    """Keep a suite's results in place of its former ones."""
    FOLDER.mkdir(exist_ok=True)
    path = FOLDER / f"{suite}.json"
    path.write_text(json.dumps({"about": machine.about()} | content, indent=1) + "\n")
    print(f"wrote {path.relative_to(machine.ROOT)}")


def read(suite: str) -> dict[str, Any] | None:
    """A suite's results, or None where it has not run."""
    path = FOLDER / f"{suite}.json"
    return json.loads(path.read_text()) if path.exists() else None
