"""On what, and with what, something was measured."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

# What a result depends on.
MEASURED = ("mpm_env", "coupling", "configs", "benchmarks", ":!benchmarks/results")
ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("mpm-env", "jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx")


def about() -> dict[str, str | int | float]:
    """Machine, versions, commit and date, for the head of a result."""
    return {
        "cpu": _line("/proc/cpuinfo", "model name") or platform.processor() or platform.machine(),
        "cores": os.cpu_count() or 1,
        "ram_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "vectors": " ".join(w for w in ("avx2", "avx512f") if w in (_line("/proc/cpuinfo", "flags") or "").split()),
        "python": platform.python_version(),
        "versions": ", ".join(f"{name} {_version(name)}" for name in PACKAGES),
        "commit": commit(),
        "date": date.today().isoformat(),
    }


def commit() -> str:
    """The checkout's commit, with a word where files differ from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", *MEASURED)
    return (git("rev-parse", "--short", "HEAD") or "unknown") + (" with changes" if changed else "")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "?"


def _line(file: str, key: str) -> str | None:
    """What the first line that starts with `key` says after its colon."""
    try:
        lines = Path(file).read_text().splitlines()
    except OSError:
        return None
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), None)
