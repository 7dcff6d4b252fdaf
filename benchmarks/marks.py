"""Tables and numbers as the report writes them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A table in Markdown."""
    lines = [tuple(head), *([str(cell) for cell in row] for row in rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def brief(value: dict[str, float] | float | None) -> str:
    """A spread as median [least, most]; a dash for nothing."""
    if value is None:
        return "-"
    if isinstance(value, dict):
        return f"{value['median']:.3g} [{value['min']:.3g}, {value['max']:.3g}]"
    return f"{value:.3g}"
