"""What one core of this machine can do at best, and how much of it a substep needs: the two sides of a roofline."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks.clock import cpu_seconds, significant
from benchmarks.column import column
from benchmarks.gpu import WHOLE, in_chunks_of
from mpm_env import initial
from mpm_env.mpm import substep

SQUARE = 1500  # rows of the matrices multiplied
STREAM = 2**26  # numbers in the arrays added: far more than any cache holds


def core() -> dict[str, float]:
    """The most operations and bytes per second seen on one core: a matrix product, and a sum of two long arrays."""
    a, b = (np.ones((SQUARE, SQUARE), np.float32) for _ in range(2))
    product = np.empty_like(a)
    x, y = (np.ones(STREAM, np.float32) for _ in range(2))
    times = {
        "flops": 2 * SQUARE**3 / min(cpu_seconds(partial(np.matmul, a, b, out=product)) for _ in range(5)),
        "bytes": 3 * 4 * STREAM / min(cpu_seconds(partial(np.add, x, y, out=y)) for _ in range(5)),
    }
    return {"gflop_per_s": significant(times["flops"] / 1e9, 3), "gb_per_s": significant(times["bytes"] / 1e9, 3)}


def substep_needs(n: int = 8) -> dict[str, float]:
    """Floating point operations per grain and substep, as XLA counts them, and bytes of state read and written once."""
    scene = column(n, kernels="xla")
    shapes: Any = jax.eval_shape(partial(initial, scene), jax.random.key(0))
    gravity = np.asarray(scene.gravity, scene.dtype)

    def step(state: Any) -> Any:
        beds = scene.beds(state.materials)
        return substep.substep(scene.grid, beds, state.grains, scene.mpm_dt, gravity, kernels="xla")[0]

    with in_chunks_of(WHOLE):
        flops = jax.jit(step).lower(shapes).cost_analysis()["flops"]
    state = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes.grains))
    return {
        "flops_per_grain": significant(flops / scene.slots, 3),
        "state_bytes_per_grain": significant(state / scene.slots, 3),
    }
