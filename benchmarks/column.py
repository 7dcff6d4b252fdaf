"""The sand column in mpm-env, and variants of it: other materials, plane strain, f64, batches.

    python -m benchmarks.column --n 20 --tend 0.01 --kernels xla

Prints the JSON lines of benchmarks/job.py.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks import job
from mpm_env import Fidelity, Scene, SceneConfig, State, advance, build, initial, scripted
from mpm_env.scene_config import resolve

STRIDE = 20  # substeps in a rigid step, which is one call of the compiled program
MATERIALS: dict[str, Any] = {  # a name is a shipped material
    "sand": {"model": "sand", "E": job.E, "nu": job.NU, "rho": job.RHO, "friction_deg": job.PHI_DEG},
    "snow": "snow_packed",
    "elastic": "rubber",
}
KERNELS = ("auto", "native", "xla")
NOT_HERE = 3  # exit status for a variant that this version or machine does not have


def column(
    n: int, *, material: str = "sand", dimension: int = 3, precision: str = "f32", kernels: str = "auto", room: int = 1
) -> Scene:
    """The column as a scene, in a box with sides `room` times as long. Raises ValueError for what cannot be had."""
    reach, height = room * job.WIDTH / 2, room * job.HEIGHT
    half, dt = job.SIDE / 2, job.DT_PER_CELL * job.SIDE / n
    fill = {"shape": "box", "lower": [-half, -half, 0.0], "upper": [half, half, job.SIDE]}
    data = {
        "name": "column",
        "box": {"lower": [-reach, -reach, 0.0], "upper": [reach, reach, height]},
        "feature": job.SIDE,
        "gravity": [0.0, 0.0, -job.GRAVITY],
        "duration": 1.0,
        "walls": {"z_lower": {"kind": "separate", "friction": job.FLOOR_FRICTION}},
        "grains": [{"material": MATERIALS[material], "fill": [fill]}],
    }
    resolve(data, Path())
    numerics = {"cells": n, "dimension": dimension, "precision": precision, "mpm_dt": dt, "rigid_dt": STRIDE * dt}
    return build(SceneConfig(**data), Fidelity(**numerics, kernels=kernels))


def kernels_here() -> tuple[list[str], list[str]]:
    """The kernels that this version and machine have, quickest first, and a sentence on each that is missing."""
    found, missing = [], []
    for name in ("native", "xla"):
        try:
            column(4, kernels=name)
        except ValueError as error:
            missing.append(f"{name} kernels: {error}")
        else:
            found.append(name)
    return found, missing


def at_rest(scene: Scene) -> State:
    """The column at t = 0, grains on the lattice itself: seeding jitters them, other codes do not."""
    state = initial(scene, jax.random.key(0))
    x = np.array(state.grains.x)
    x[:, np.asarray(state.grains.m) > 0] = (scene.fills[0][0].sites - scene.grid.origin).T
    return replace(state, grains=replace(state.grains, x=jax.device_put(x, state.grains.x.sharding)))


def program(scene: Scene, envs: int = 1, batching: str = "map") -> tuple[Callable[[State], State], State]:
    """One rigid step, compiled, and the state to start from; both of `envs` columns if there are more than one."""

    def step(state: State) -> State:
        return advance(scene, state, scripted(scene, 0, 1))[0]

    start = at_rest(scene)
    if envs == 1:
        return jax.jit(step), start
    many = jax.device_put(jax.tree.map(lambda leaf: jnp.repeat(leaf[None], envs, axis=0), start), jax.devices()[0])
    return jax.jit(partial(lax.map, step) if batching == "map" else jax.vmap(step)), many


def run(a: argparse.Namespace) -> None:
    """Measure the variant asked for. Raises ValueError where it cannot be had."""
    kind = {key: getattr(a, key) for key in ("material", "dimension", "precision", "kernels", "room")}
    scene = column(a.n, **kind)
    step, start = program(scene, a.envs, a.batching)
    now = start

    def reset() -> None:
        nonlocal now
        now = start

    def advance_by(substeps: int) -> None:
        nonlocal now
        for _ in range(substeps // STRIDE):
            now = step(now)
        jax.block_until_ready(now)

    def look() -> tuple[np.ndarray, np.ndarray]:
        if np.any(now.health):
            raise SystemExit(f"The run is unwell: health {np.asarray(now.health)}.")
        p = now.grains if a.envs == 1 else jax.tree.map(lambda leaf: leaf[0], now.grains)
        here = np.asarray(p.m) > 0
        v = np.asarray(p.v) if a.dimension == 3 else np.asarray(p.v)[[0, 0, 1]] * [[1], [0], [1]]
        return np.asarray(scene.world(p.x)).T[here], v.T[here]

    facts = {
        "code": f"mpm-env {a.kernels}",
        "material": a.material,
        "dimension": a.dimension,
        "precision": a.precision,
        "room": a.room,
        "nodes": scene.grid.nodes,
        "envs": a.envs,
        "batching": a.batching,
        "cores": a.cores,
    }
    grains = int(np.count_nonzero(np.asarray(start.grains.m)))
    job.measure(a, facts, dt=scene.mpm_dt, grains=grains, reset=reset, advance=advance_by, look=look, stride=STRIDE)


def main() -> None:
    """Print the records of the variant asked for."""
    parser = job.parser("The sand column in mpm-env; one JSON line per repetition.")
    parser.add_argument("--kernels", default="auto", choices=KERNELS)
    parser.add_argument("--material", default="sand", choices=tuple(MATERIALS))
    parser.add_argument("--dimension", type=int, default=3, choices=(2, 3))
    parser.add_argument("--precision", default="f32", choices=("f32", "f64"))
    parser.add_argument("--room", type=int, default=1, help="times as long as usual: the sides of the box around it")
    parser.add_argument("--envs", type=int, default=1, help="columns in one compiled program")
    parser.add_argument("--batching", default="map", choices=("map", "vmap"))
    parser.add_argument("--cores", type=int, default=1)
    a = parser.parse_args()
    job.pin(a.cores)
    jax.config.update("jax_enable_x64", a.precision == "f64")
    try:
        run(a)
    except ValueError as error:
        print(error, file=sys.stderr)
        sys.exit(NOT_HERE)


if __name__ == "__main__":
    main()
