"""Time as this folder measures it: CPU seconds of the process, medians of rounds, rivals taking turns."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

ROUNDS = 5  # a median of fewer says little


def cpu_seconds(job: Callable[[], Any]) -> float:
    """CPU seconds of this process while `job` runs; it returns only when its work is done."""
    start = time.process_time()
    job()
    return time.process_time() - start


def in_turns(jobs: dict[str, Callable[[], Any]], rounds: int = ROUNDS) -> dict[str, list[float]]:
    """CPU seconds of each job in each round. One unmeasured round compiles; then the jobs take turns.

    What slows the machine for a while so slows all of them, and their ratios stay.
    """
    for job in jobs.values():
        job()
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            times[name].append(cpu_seconds(job))
    return times


def spread(values: Sequence[float], digits: int = 4) -> dict[str, float]:
    """Median, least and most."""
    return {
        name: significant(value, digits)
        for name, value in (("median", statistics.median(values)), ("min", min(values)), ("max", max(values)))
    }


def significant(value: float, digits: int = 4) -> float:
    """Rounded to so many digits that count."""
    return float(f"{value:.{digits}g}")
