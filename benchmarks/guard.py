"""A guard against getting slower: a whole substep against a plain kernel of numpy, in the same run, as a ratio.

    python -m benchmarks.guard            # status 1 if the ratio is 25 % worse than the one kept; kept by the first run
    python -m benchmarks.guard --keep     # keep this run's ratio, since it is meant to be another

The plain kernel scatters and gathers eight numbers per grain through one node, so it is bound by the same caches and
memory; it has nothing of this package in it. On another machine the ratio is another: keep one there first.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from benchmarks import job, machine, results
from benchmarks.clock import in_turns, significant
from benchmarks.column import column, kernels_here, program

CELLS = 16  # a side: 32 768 grains
ROUNDS = 11
WORSE = 1.25
PASSES = 100  # of the plain kernel: about as long as a rigid step


def plain(scene: Any, x: np.ndarray) -> Callable[[], None]:
    """Weighted sums to the nearest node and back, PASSES times."""
    cell = np.floor(x / scene.grid.cell_size).astype(np.int64)
    node = np.ravel_multi_index(tuple(cell), scene.grid.shape)
    values = np.random.default_rng(0).random((8, len(node))).astype(np.float32)

    def run() -> None:
        for _ in range(PASSES):
            for row in values:
                sums = np.bincount(node, weights=row, minlength=scene.grid.nodes)
                row += 1e-6 * sums[node].astype(np.float32)
            np.log1p(np.abs(values))

    return run


def ratio(kernels: str) -> float:
    """CPU time of a rigid step over that of the plain kernel, the least of each: what disturbs only ever adds."""
    scene = column(CELLS, kernels=kernels)
    step, state = program(scene)
    for _ in range(20):
        state = step(state)
    jobs = {
        "step": lambda: jax.block_until_ready(step(state)),
        "plain": plain(scene, np.asarray(state.grains.x)),
    }
    times = in_turns(jobs, ROUNDS)
    return significant(min(times["step"]) / min(times["plain"]), 3)


def main() -> None:
    """Measure, then keep or compare."""
    parser = argparse.ArgumentParser(description="Fails when a substep has become slower.")
    parser.add_argument("--keep", action="store_true", help="keep this run's ratios as the ones to compare with")
    a = parser.parse_args()
    job.pin(1)
    found, missing = kernels_here()
    print(*missing, sep="\n")
    now = {kernels: ratio(kernels) for kernels in found}
    kept = results.read("guard")
    if a.keep or kept is None:
        results.write("guard", {"ratios": now})
        return
    if kept["about"]["cpu"] != machine.about()["cpu"]:
        print(f"The ratios kept are of another processor, {kept['about']['cpu']}: keep your own with --keep.")
    slow = False
    for kernels, new in now.items():
        before = kept["ratios"].get(kernels)
        if before is None:
            print(f"{kernels}: {new:.3g} times the plain kernel, none kept to compare with")
            continue
        slow |= new > WORSE * before
        word = "slower" if new > WORSE * before else "fine"
        print(f"{kernels}: {new:.3g} times the plain kernel, kept {before:.3g}: {word}")
    sys.exit(1 if slow else 0)


if __name__ == "__main__":
    main()
