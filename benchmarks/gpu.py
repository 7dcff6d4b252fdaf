"""The plan for a GPU, counted from the program's shapes, and the run that will check it.

    python -m benchmarks.gpu            # on a GPU: times both formulations, writes results/gpu.json
    python -m benchmarks.gpu --plan     # anywhere: rewrites the table of docs/gpu.md

The counts are a model: an operation that XLA cannot fuse into its neighbours (scatter, gather, reduction, product,
solve, barrier) is a launch that reads its operands and writes its results once; everything else rides along for free.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks import machine, results
from benchmarks.clock import ROUNDS, significant, spread
from benchmarks.column import STRIDE, column, program
from mpm_env import Scene, advance, initial, scripted
from mpm_env.mpm import substep

DOC = machine.ROOT / "docs" / "gpu.md"
BEGIN, END = "<!-- table by python -m benchmarks.gpu --plan -->\n", "<!-- end of table -->\n"
LAUNCHED = {  # operations that are a kernel, or a library call, of their own
    *("gather", "dot_general", "sort", "cumsum", "reduce_sum", "reduce_max", "reduce_min", "reduce_or", "reduce_and"),
    *("argmin", "argmax", "optimization_barrier", "dynamic_update_slice", "cholesky", "lu", "triangular_solve"),
}
WHOLE = 2**30  # grains in a chunk: all of them
FORMULATIONS = {"chunks of 512, as on a CPU": 512, "all grains at once": WHOLE}


@dataclass(frozen=True)
class Cost:
    """What a program asks of a device."""

    launches: float = 0
    bytes: float = 0
    largest: float = 0  # bytes that the hungriest launch reads and writes

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.launches + other.launches, self.bytes + other.bytes, max(self.largest, other.largest))

    def times(self, count: int) -> Cost:
        """The same, in a loop."""
        return Cost(self.launches * count, self.bytes * count, self.largest)


def cost(jaxpr: Any) -> Cost:
    """The cost of a jaxpr, loops unrolled as often as they run. Loops of unknown length count once."""
    total = Cost()
    for eqn in jaxpr.eqns:
        inner = [cost(sub) for sub in inside(eqn)]
        if eqn.primitive.name == "cond":  # the dearer branch
            total += max(inner, key=lambda branch: branch.bytes)
        elif inner and not eqn.primitive.name.startswith("scatter"):
            total += sum(inner, Cost()).times(eqn.params.get("length", 1))
        else:
            total += _launch(eqn)
    return total


def inside(eqn: Any) -> Iterator[Any]:
    """The jaxprs that an equation calls."""
    for value in eqn.params.values():
        for item in value if isinstance(value, tuple | list) else (value,):
            if hasattr(item, "jaxpr"):
                yield item.jaxpr
            elif hasattr(item, "eqns"):
                yield item


def _launch(eqn: Any) -> Cost:
    """One equation: nothing if it fuses with its neighbours."""
    name = eqn.primitive.name
    read, written = sum(map(_bytes, eqn.invars)), sum(map(_bytes, eqn.outvars))
    if name.startswith("scatter"):  # operand, indices, updates: nodes are read and written where grains are
        indices, updates = (_bytes(v) for v in eqn.invars[1:3])
        return _once(indices + 3 * updates)
    if name == "gather":
        return _once(_bytes(eqn.invars[1]) + 2 * written)
    if name == "dynamic_update_slice":  # in place
        return _once(2 * _bytes(eqn.invars[1]))
    return _once(read + written) if name in LAUNCHED else Cost()


def _once(size: float) -> Cost:
    return Cost(1, size, size)


def _bytes(v: Any) -> int:
    shape, dtype = getattr(v.aval, "shape", ()), getattr(v.aval, "dtype", None)
    return 0 if dtype is None else int(np.prod(shape)) * getattr(dtype, "itemsize", 4)


@contextmanager
def in_chunks_of(grains: int) -> Iterator[None]:
    """Programs traced inside walk so many grains at a time, whatever the backend would choose."""
    usual, substep.chunk_of = substep.chunk_of, lambda p: min(grains, p.count)
    try:
        yield
    finally:
        substep.chunk_of = usual


def substep_cost(scene: Scene, envs: int = 1) -> Cost:
    """The cost of one substep of so many environments side by side."""
    shapes = jax.eval_shape(partial(initial, scene), jax.random.key(0))
    if envs > 1:
        shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct((envs, *a.shape), a.dtype), shapes)

    def step(state: Any) -> Any:
        beds = scene.beds(state.materials)
        return substep.substep(scene.grid, beds, state.grains, scene.mpm_dt, gravity, kernels="xla")[0]

    gravity = np.asarray(scene.gravity, scene.dtype)
    return cost(jax.make_jaxpr(step if envs == 1 else jax.vmap(step))(shapes).jaxpr)


def state_bytes(scene: Scene) -> int:
    """Bytes of one environment's state, bodies included."""
    shapes = jax.eval_shape(partial(initial, scene), jax.random.key(0))
    sizes = jax.eval_shape(lambda s: jax.tree.map(jax.numpy.asarray, s), shapes)
    return sum(int(np.prod(a.shape)) * a.dtype.itemsize for a in jax.tree.leaves(sizes))


def lowered(scene: Scene) -> str:
    """The text of one rigid step's program for CUDA; no GPU is needed to make it."""
    shapes = jax.eval_shape(partial(initial, scene), jax.random.key(0))
    run = jax.jit(lambda state: advance(scene, state, scripted(scene, 0, 1))[0])
    return run.trace(shapes).lower(lowering_platforms=("cuda",)).as_text()


def plan() -> str:
    """The table of docs/gpu.md."""
    lines = [
        "| environments x grains | formulation | launches per substep | MB moved per substep | bytes per grain |"
        " memory per environment, MB |",
        "|---|---|---|---|---|---|",
    ]
    for n, envs in ((6, 1), (6, 256), (20, 1), (32, 1)):
        scene = column(n, kernels="xla")
        for name, chunk in FORMULATIONS.items():
            with in_chunks_of(chunk):
                c = substep_cost(scene, envs)
            grains = envs * scene.slots
            memory = (2 * state_bytes(scene) + 8 * scene.grid.nodes * 4 + c.largest / envs) / 1e6
            cells = (f"{c.launches:.0f}", f"{c.bytes / 1e6:.3g}", f"{c.bytes / grains:.0f}", f"{memory:.3g}")
            lines.append(f"| {envs} x {scene.slots} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def rates(step: Callable[[Any], Any], state: Any, grains: int) -> dict[str, float]:
    """Million grain-substeps per second of wall time: on a GPU, CPU time says nothing."""
    jax.block_until_ready(step(state))
    seconds = []
    for _ in range(ROUNDS):
        now, begin = state, time.perf_counter()
        for _ in range(10):
            now = step(now)
        jax.block_until_ready(now)
        seconds.append(time.perf_counter() - begin)
    return spread([grains * STRIDE * 10 / s / 1e6 for s in seconds])


def measured(jobs: dict[str, tuple[int, int]]) -> dict[str, Any]:
    """Each job, (cells a side, environments), in each formulation on the device at hand."""
    rows: dict[str, Any] = {}
    for name, (n, envs) in jobs.items():
        scene = column(n, kernels="xla")
        for formulation, chunk in FORMULATIONS.items():
            with in_chunks_of(chunk):
                step, state = program(scene, envs, "vmap")
                c = substep_cost(scene, envs)
                rate = rates(step, state, 8 * n**3 * envs)
            stats = jax.devices()[0].memory_stats() or {}
            rows[f"{name}, {formulation}"] = {
                "Mpss": rate,
                "launches": c.launches,
                "bytes": c.bytes,
                "gb_per_s_if_the_model_holds": significant(c.bytes * rate["median"] / (8 * n**3 * envs) / 1e3, 3),
                "peak_mb_so_far": round(stats.get("peak_bytes_in_use", 0) / 1e6),
            }
            print(f"{name}, {formulation}: {rate['median']} M/s", flush=True)
    return rows


JOBS = {
    "64k grains": (20, 1),
    "262k grains": (32, 1),
    "1M grains": (50, 1),
    "64 x 2k": (6, 64),
    "1024 x 2k": (6, 1024),
    "256 x 4k": (8, 256),
}


def main() -> None:
    """Measure on a GPU, or write the plan."""
    parser = argparse.ArgumentParser(description="Plan and run for a GPU.")
    parser.add_argument("--plan", action="store_true", help="rewrite the table of docs/gpu.md; needs no GPU")
    a = parser.parse_args()
    if a.plan:
        before, _, rest = DOC.read_text().partition(BEGIN)
        DOC.write_text(before + BEGIN + plan() + END + rest.partition(END)[2])
        return
    if jax.default_backend() != "gpu":
        raise SystemExit(f"JAX runs on {jax.default_backend()} here: install mpm-env[cuda13] on a machine with a GPU.")
    content = {"device": jax.devices()[0].device_kind, "rows": measured(JOBS)}
    results.write("gpu", content)


if __name__ == "__main__":
    main()
