"""What one core of this machine can do at best, and how much of it a substep needs: the two sides of a roofline."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks.clock import cpu_seconds, significant
from benchmarks.column import column
from benchmarks.gpu import WHOLE, in_chunks_of, inside
from mpm_env import initial
from mpm_env.mpm import substep

SQUARE = 1500  # rows of the matrices multiplied
ONE_EACH = {  # operations of floating-point arithmetic for every number that comes out, roots and logarithms as one
    *("add", "sub", "mul", "div", "neg", "max", "min", "abs", "square", "sqrt", "rsqrt", "integer_pow", "pow"),
    *("exp", "log", "expm1", "log1p", "sin", "cos", "tan", "tanh", "logistic", "floor", "round", "clamp"),
}
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


def best(looks: list[dict[str, float]]) -> dict[str, float]:
    """The most of each number: memory is shared, so that one look at a busy machine may see half of what it can do."""
    return {key: max(look[key] for look in looks) for key in looks[0]}


def operations(jaxpr: Any) -> float:
    """Floating-point operations of a jaxpr, what is in a loop as often as the loop runs.

    XLA's own count takes a loop's body once. Of branches the one with most of them; loops of unknown length count once.
    """
    total = 0.0
    for eqn in jaxpr.eqns:
        name, parts = eqn.primitive.name, [operations(sub) for sub in inside(eqn)]
        if name.startswith("scatter"):
            total += _floats(eqn.invars[2]) if name != "scatter" else 0
        elif name == "cond":
            total += max(parts)
        elif name in ("reduce_sum", "reduce_max", "reduce_min", "cumsum"):
            total += _floats(eqn.invars[0])
        elif parts:
            total += sum(parts) * eqn.params.get("length", 1)
        elif name == "dot_general":
            ((over, _), _), left = eqn.params["dimension_numbers"], eqn.invars[0].aval.shape
            total += 2 * _floats(eqn.outvars[0]) * math.prod(left[axis] for axis in over)
        elif name in ONE_EACH:
            total += _floats(eqn.outvars[0])
    return total


def _floats(v: Any) -> int:
    return math.prod(v.aval.shape) if np.issubdtype(v.aval.dtype, np.floating) else 0


def substep_needs(n: int = 20) -> dict[str, float]:
    """Floating-point operations per grain and substep on plain XLA, and bytes of state read and written once."""
    scene = column(n, kernels="xla")
    shapes: Any = jax.eval_shape(partial(initial, scene), jax.random.key(0))
    gravity = np.asarray(scene.gravity, scene.dtype)

    def step(state: Any) -> Any:
        beds = scene.beds(state.materials)
        return substep.substep(scene.grid, beds, state.grains, scene.mpm_dt, gravity, kernels="xla")[0]

    with in_chunks_of(WHOLE):
        done = operations(jax.make_jaxpr(step)(shapes).jaxpr)
    state = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes.grains))
    return {
        "operations_per_grain": significant(done / scene.slots, 3),
        "state_bytes_per_grain": significant(state / scene.slots, 3),
    }
