"""Where a step's time goes: each stage alone, on grains as they are in the middle of a dig and of a collapse.

    python -m benchmarks.stages [--quick]

CPU time on one core. Stages of the continuum are in ns per grain and substep, those of the rigid side in us per rigid
step. They take turns, so that their ratios hold on a busy machine. "rest" is the whole rigid step less the stages that
could be timed alone: the exchange with the bodies, and the health check.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from benchmarks import job, limits, results
from benchmarks.clock import ROUNDS, cpu_seconds, in_turns, significant
from benchmarks.column import STRIDE, column, kernels_here, program
from benchmarks.coupled import digging
from coupling import bodies
from mpm_env import Drive, Scene, State, initial, rigid_step, scripted
from mpm_env.log import Recorder
from mpm_env.mpm import sorting, substep, transfer
from mpm_env.mpm.types import Particles
from mpm_env.view import View, no_reactions, write_frame

CALLS = 10  # of a rigid step in one measurement
REPEAT = 20  # times a stage runs inside one call of its compiled program
DIG_AT = 1.0  # s: the bucket is in the bed


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NoStress:
    """A material without stress, to time the gather without one."""

    history_start: ClassVar[tuple[float, ...]] = (0.0,)

    def update(self, e: Array, history: Array) -> tuple[Array, Array, Array]:
        """Nothing to answer."""
        return e, history, e


def repeated(stage: Callable[[Particles], Particles], p: Particles) -> Callable[[], Any]:
    """A stage run REPEAT times, each on what the one before left, as one compiled call."""
    run = jax.jit(lambda p: lax.fori_loop(0, REPEAT, lambda _, p: stage(p), p))
    return lambda: jax.block_until_ready(run(p))


def touched(p: Particles, out: Array) -> Particles:
    """The grains, made to depend on a result, so that the loop must compute it each time."""
    return replace(p, C=p.C.at[0, 0, 0].add(0 * out.reshape(-1)[-1]))


def sorted_by_cell(scene: Scene, p: Particles) -> Particles:
    """All grains in the order of their cells, whether or not the step would sort them now."""
    return sorting.by_cell(sorting.cells(scene.grid, p, scene.spans), p)


def continuum(scene: Scene, state: State, kernels: str) -> dict[str, Callable[[], Any]]:
    """The stages of a substep without bodies, and the substep itself."""
    grid, dt, p = scene.grid, scene.mpm_dt, state.grains
    (bed,) = scene.beds(state.materials)
    gravity, nobody = jnp.asarray(scene.gravity, scene.dtype), jnp.zeros((0,), jnp.int32)
    to_nodes = partial(substep.to_nodes, grid, dt=dt, gravity=gravity, watched=nobody, kernels=kernels)
    nodes = jax.jit(to_nodes)(p)
    stages = {
        "whole substep": lambda p: substep.substep(grid, (bed,), p, dt, gravity, kernels=kernels)[0],
        "p2g and grid": lambda p: touched(p, to_nodes(p)),
        "g2p and material": lambda p: substep.move(grid, bed, p, nodes, dt, kernels),
        "sort, if it were done": partial(sorted_by_cell, scene),
    }
    if kernels == "xla":
        bare = bed._replace(material=NoStress())
        stages["p2g"] = lambda p: touched(p, transfer.p2g(grid, p, dt, substep.chunk_of(p)))
        stages["g2p"] = lambda p: substep.move(grid, bare, p, nodes, dt, kernels)
    return {name: repeated(stage, p) for name, stage in stages.items()}


def rigid(scene: Scene, state: State, whole: Callable[[State, Drive], State], drive: Drive) -> dict[str, Any]:
    """The whole rigid step, its grains without the bodies, and MJX without the grains."""
    alone, bare, b = replace(scene, bodies=None), replace(state, rigid=None), scene.bodies

    def mjx(d: Any, drive: Drive) -> Any:
        d = d.replace(ctrl=drive.control)
        d, stance = bodies.open_step(b, d, bodies.drift(b, d, drive.position, drive.quaternion))
        d = bodies.close_step(b, d, jnp.zeros_like(d.qvel) + 0 * jnp.sum(stance.M))
        return bodies.refresh(b, bodies.place(d, drive.position, drive.quaternion))

    def times(run: Callable[[Any, Drive], Any], start: Any) -> Callable[[], Any]:
        return lambda: jax.block_until_ready([run(start, drive) for _ in range(CALLS)])

    return {
        "whole": times(whole, state),
        "grains": times(jax.jit(partial(rigid_step, alone)), bare),
        "mjx": times(jax.jit(mjx), state.rigid),
    }


def log_seconds(scene: Scene, state: State, frames: int = 10) -> float:
    """CPU seconds to write a frame to a recording."""
    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(
            Path(folder) / "run.rrd",
            recipe={"scene": scene.config.name},
            model=scene.bodies.model if scene.bodies else None,
            box=(scene.config.box.lower, scene.config.box.upper),
        )
        with recorder:
            view, still = View.of(scene, state), no_reactions(scene)
            write = partial(write_frame, recorder, reactions=still, quantity="speed", scalars={})

            def frame(step: int) -> None:
                write(replace(view, time=float(step)), step=step)

            frame(0)
            return median(cpu_seconds(partial(frame, step)) for step in range(1, frames + 1))


def dig(kernels: str, quick: bool) -> tuple[Scene, State, Callable[[State, Drive], State], Drive]:
    """The digging scene with the bucket in the bed, its compiled rigid step, and what drives the next one."""
    scene = digging(kernels, quick)
    whole = jax.jit(partial(rigid_step, scene))
    state = initial(scene, jax.random.key(0))
    every = scripted(scene, 0, round(DIG_AT / scene.rigid_dt) + 1)
    *drives, after = (Drive(*rows) for rows in zip(*map(np.asarray, every), strict=True))
    for drive in drives:
        state = whole(state, drive)
    return scene, state, whole, after


def collapse(kernels: str, quick: bool) -> tuple[Scene, State]:
    """The column on its way down."""
    scene = column(10 if quick else 20, kernels=kernels)
    step, state = program(scene)
    for _ in range(round(0.05 / scene.mpm_dt / STRIDE)):
        state = step(state)
    return scene, state


def in_numbers(times: dict[str, list[float]], per: float) -> dict[str, float]:
    """Medians, in units of `per` seconds."""
    return {name: significant(median(values) / per, 3) for name, values in times.items()}


def parts(stages: dict[str, float]) -> dict[str, float]:
    """With the stages that come out as differences."""
    if "p2g" in stages:
        stages["grid"] = significant(stages["p2g and grid"] - stages["p2g"], 3)
        stages["material"] = significant(stages["g2p and material"] - stages["g2p"], 3)
    return stages


def measured(kernels: str, quick: bool) -> dict[str, Any]:
    """Both scenes with these kernels."""
    rounds = 3 if quick else ROUNDS
    scene, state = collapse(kernels, quick)
    column_times = in_turns(continuum(scene, state, kernels), rounds)
    out = {"column": {"grains": scene.slots} | parts(in_numbers(column_times, 1e-9 * REPEAT * scene.slots))}
    scene, state, whole, drive = dig(kernels, quick)
    times = in_turns(continuum(scene, state, kernels), rounds)
    out["dig"] = {"grains": scene.slots} | parts(in_numbers(times, 1e-9 * REPEAT * scene.slots))
    step = in_numbers(in_turns(rigid(scene, state, whole, drive), rounds), 1e-6 * CALLS)
    rest = step["whole"] - step["grains"] - step["mjx"]
    out["dig, rigid step"] = step | {
        "rest": significant(rest, 3),
        "substeps": scene.mpm_per_rigid,
        "share on top of grains": significant(step["whole"] / step["grains"] - 1, 3),
        "a frame of the log": significant(log_seconds(scene, state) * 1e6, 3),
    }
    return out


def main() -> None:
    """Time all stages and write results/stages.json."""
    parser = argparse.ArgumentParser(description="Time by stage.")
    parser.add_argument("--quick", action="store_true", help="smaller scenes, three rounds")
    a = parser.parse_args()
    job.pin(1)
    found, missing = kernels_here()
    content = {
        "quick": a.quick,
        "kernels": {kernels: measured(kernels, a.quick) for kernels in found},
        "left_out": missing,
    }
    results.write("stages", content | {"limits": limits.core() | limits.substep_needs()})


if __name__ == "__main__":
    main()
