"""What bodies cost on top of the grains of the dig scene: alone, and in a batch of environments.

    python -m benchmarks.coupling.cost [--quick]

CPU seconds of whole rigid steps with the bucket in the bed, against the same grains' substeps without any body, in
turns. A batch is mapped, as the environments do it, or vmapped.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from benchmarks import results
from benchmarks.clock import ROUNDS, in_turns, significant, spread
from benchmarks.coupled import DIG_STEPS, Run, digging
from mpm_env import Drive, Scene, State, advance, scripted, sim

BATCH = 64
AT = 1.0  # s: the bucket is in the bed
STEPS = 25  # rigid steps of a call


def with_bodies(scene: Scene, drives: Drive, state: State) -> State:
    """Rigid steps as users run them."""
    return advance(scene, state, drives)[0]


def without(scene: Scene, drives: Drive, state: State) -> State:
    """The same substeps of the grains, which no body meets."""
    return lax.fori_loop(0, len(drives.control), lambda _, s: replace(s, grains=sim._run_grains(scene, s)), state)


def batched(one: Callable[[State], State], way: str) -> Callable[[State], State]:
    """A step of many states."""
    return {"alone": one, "map": partial(lax.map, one), "vmap": jax.vmap(one)}[way]


def measured(fidelity: str, envs: int) -> dict[str, Any]:
    """Share on top of the grains (median, least and most of the rounds), by way of batching."""
    run = Run(digging("auto", fidelity), DIG_STEPS)
    for _ in range(round(AT / run.per_call)):
        run.call()
    scene, state = run.scene, run.state
    drives = scripted(scene, run.steps, STEPS)
    copies = jax.tree.map(lambda a: jnp.stack([a] * envs), state)
    rows: dict[str, Any] = {"grains": scene.slots, "substeps": scene.mpm_per_rigid}
    for way in ("alone", "map", "vmap"):
        start = state if way == "alone" else copies
        jobs = {
            step.__name__: partial(_done, jax.jit(batched(partial(step, scene, drives), way)), start)
            for step in (with_bodies, without)
        }
        times = in_turns(jobs, ROUNDS)
        shares = [a / b - 1 for a, b in zip(times["with_bodies"], times["without"], strict=True)]
        count = STEPS * (1 if way == "alone" else envs)
        least = min(times["with_bodies"]) / count
        rows[way] = {"share": spread(shares, 3), "ms_per_rigid_step": significant(1e3 * least, 3)}
    return rows


def _done(program: Callable[[State], State], state: State) -> None:
    jax.block_until_ready(program(state))


def main() -> None:
    """Measure and write results/coupling_cost.json."""
    parser = argparse.ArgumentParser(description="What bodies cost, alone and in a batch.")
    parser.add_argument("--quick", action="store_true", help="draft only, a batch of 8")
    a = parser.parse_args()
    envs = 8 if a.quick else BATCH
    rows = {f: measured(f, envs) for f in (("draft",) if a.quick else ("draft", "standard"))}
    results.write("coupling_cost", {"quick": a.quick, "envs": envs, "dig": rows})


if __name__ == "__main__":
    main()
