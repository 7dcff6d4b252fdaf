"""The sand column as a job for any code: its numbers, how it is timed, and the JSON line that is printed.

A 0.2 m cube of sand, n cells a side, eight grains per cell on a lattice, collapses on a rough floor. This file needs
numpy only, since the codes in benchmarks/peers run in environments of their own.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SIDE, WIDTH, HEIGHT = 0.2, 0.8, 0.3  # m, of the cube and of the box around it
E, NU, RHO, PHI_DEG = 1e6, 0.3, 1500.0, 35.0  # Pa, -, kg/m^3, degrees (triaxial fit)
FLOOR_FRICTION, GRAVITY = 0.5, 9.81
DT_PER_CELL = 0.01  # s/m: Courant number 0.3


def parser(about: str) -> argparse.ArgumentParser:
    """The options that every code takes."""
    p = argparse.ArgumentParser(description=about)
    p.add_argument("--n", type=int, default=20, help="cells along the cube's side, even")
    p.add_argument("--tend", type=float, default=0.01, help="s simulated in each repetition")
    p.add_argument("--reps", type=int, default=1)
    return p


def lattice(n: int) -> np.ndarray:
    """Grain positions (8 n^3, 3) m; the cube stands on z = 0, its axis at the origin."""
    axis = (np.arange(2 * n) + 0.5) * SIDE / (2 * n)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid - [SIDE / 2, SIDE / 2, 0]


def heap(x: np.ndarray, v: np.ndarray) -> dict[str, float]:
    """Whether it is the same job: 99th percentiles of radius and height, mean height (m), and speed (m/s)."""
    x, v = np.asarray(x, np.float64), np.asarray(v, np.float64)
    return {
        "r99": round(float(np.quantile(np.hypot(x[:, 0], x[:, 1]), 0.99)), 4),
        "z99": round(float(np.quantile(x[:, 2], 0.99)), 4),
        "zcom": round(float(x[:, 2].mean()), 5),
        "vrms": round(float(np.sqrt((v**2).sum(axis=1).mean())), 5),
    }


def measure(
    a: argparse.Namespace,
    facts: dict[str, Any],
    *,
    dt: float,
    grains: int,
    reset: Callable[[], None],
    advance: Callable[[int], None],
    look: Callable[[], tuple[np.ndarray, np.ndarray]],
    stride: int = 1,
) -> None:
    """Time the job and print a line per repetition, each from t = 0.

    advance(k) makes k substeps, a multiple of `stride`, and returns when they are done; look() gives positions and
    velocities (n, 3) of one column. `grains` counts all that move, in all columns of a batch.
    """
    substeps = max(round(a.tend / dt / stride), 1) * stride
    reset()
    advance(stride)
    first = {"t_first": round(age(), 2), "t_first_cpu": round(time.process_time(), 2)}
    for _ in range(a.reps):
        reset()
        wall, cpu = time.perf_counter(), time.process_time()
        advance(substeps)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        done, t = grains * substeps / 1e6, substeps * dt
        record = facts | {
            "n": a.n,
            "grains": grains,
            "dt": round(dt, 9),
            "substeps": substeps,
            "t_sim": round(t, 6),
            "wall": round(wall, 4),
            "cpu": round(cpu, 4),
            "Mpss_cpu": round(done / cpu, 4),
            "Mpss": round(done / wall, 4),
            "cpu_per_sim_s": round(cpu / t, 3),
            **first,
            "rss_mb": peak_mb(),
            **heap(*look()),
        }
        print(json.dumps(record), flush=True)


def age() -> float:
    """Seconds since this process was started, imports and all."""
    ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")


def peak_mb() -> float:
    """The most memory this process has held so far, MB."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def pin(cores: int) -> None:
    """Keep this process on the first `cores` cores it may use. Call before JAX starts, which counts them once."""
    allowed = sorted(os.sched_getaffinity(0))
    if not 1 <= cores <= len(allowed):
        raise ValueError(f"This process may use {len(allowed)} cores, got cores = {cores}: ask for fewer.")
    os.sched_setaffinity(0, set(allowed[:cores]))
