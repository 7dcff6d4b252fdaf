"""What a scene does hangs neither on which way nor on where it lies: mirrors, shifts, moving frames, far away.

python -m benchmarks.validation.symmetry [--quick]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import case, job, part
from benchmarks.case import Case, at_most
from benchmarks.validation.blocks import GRAVITY, alive, block, box, example, go, lattice, longest_step
from benchmarks.validation.motion import turning
from mpm_env import Fidelity, SceneConfig, advance, build, initial, scripted
from mpm_env.mpm.types import MARGIN
from mpm_env.scene_config import resolve

ACROSS = 8  # cells across a column that collapses
ROOM = 5 * ACROSS  # cells, both ways, of the box around it
DX = 0.025  # m
STEPS = 400  # one fall time and a bit: the column is a cell from half its height
SHIFT = np.array([[5.0], [0.0]])  # cells
SPEED = 1.0  # m/s, of a frame that moves
FAR, FAR_STEPS = 1000.0, 50  # m, rigid steps

Sites = Callable[[np.ndarray], np.ndarray]
CHANGES: dict[str, tuple[Sites, Sites]] = {  # sites (2, n) in cells -> there, and back
    "mirrored": ((mirror := lambda x: np.stack([ROOM - x[0], x[1]])), mirror),
    "shifted": (lambda x: x + SHIFT, lambda x: x - SHIFT),
    "with axes swapped": ((swap := lambda x: x[::-1]), swap),
}


def collapsed(there: Sites, dtype: str, *, gravity: tuple[float, float] = (0.0, -GRAVITY)) -> np.ndarray:
    """Grains (2, n), in cells from the corner, of a column off the middle that collapsed, changed at the start."""
    with jax.enable_x64(dtype == "float64"):
        grid, material = box((ROOM, ROOM), DX), example("sand", dtype, E=1e6, rho=1500.0)
        sites = lattice((3.0, 0.0), (2 * ACROSS, 2 * ACROSS), 0.5)
        sites = sites + np.random.default_rng(0).uniform(-0.05, 0.05, sites.shape)
        p = block(grid, material, there(sites) * DX, volume=DX**2 / 4, dtype=dtype)
        q = go(grid, material, p, dt=0.6 * longest_step(grid, material), steps=STEPS, gravity=gravity)
        return np.asarray(q.x, np.float64)[:, alive(q)] / DX - MARGIN


def changed(name: str, dtype: str = "float64") -> float:
    """Largest way (cells) between a column's grains and those of one changed in the way named, changed back."""
    there, back = CHANGES[name]
    gravity = (0.0, -GRAVITY) if name != "with axes swapped" else (-GRAVITY, 0.0)
    off = back(collapsed(there, dtype, gravity=gravity)) - collapsed(lambda x: x, dtype)
    return float(np.abs(off).max())


def carried(steps: int) -> tuple[float, float]:
    """A turning block in a frame that moves: largest change of velocities over SPEED, and of positions over a metre."""
    with jax.enable_x64(True):
        grid, material, p = turning(2, 5.0, "float64")
        dt = 0.6 * longest_step(grid, material)
        out = []
        for U in (0.0, SPEED):
            frame = np.array([[U], [0.0]])
            q = go(grid, material, replace(p, v=p.v + jnp.asarray(frame)), dt=dt, steps=steps)
            v, x = (np.asarray(a)[:, alive(q)] for a in (q.v, q.x))
            out.append((v - frame, x - frame * dt * steps))
    (v0, x0), (v1, x1) = out
    return float(np.abs(v1 - v0).max() / SPEED), float(np.hypot(*(x1 - x0)).max())


def placed(x: float) -> np.ndarray:
    """Grains (d, n) in m, from the grid's origin, of a scene that stands x m from the world's, after FAR_STEPS."""
    fill = {"shape": "box", "lower": [x, -0.1, x], "upper": [x + 0.2, 0.1, x + 0.2]}
    data: dict[str, Any] = {
        "name": "column",
        "box": {"lower": [x, -0.1, x], "upper": [x + 1.0, 0.1, x + 0.5]},
        "feature": 0.2,
        "plane_strain": True,
        "duration": 1.0,
        "walls": {"z_lower": {"kind": "separate", "friction": 0.5}},
        "grains": [{"material": "dry_sand", "fill": [fill]}],
    }
    resolve(data, Path())
    scene = build(SceneConfig(**data), Fidelity(cells=8))
    step = jax.jit(lambda state: advance(scene, state, scripted(scene, 0, 1))[0])
    state = jax.jit(partial(initial, scene))(jax.random.key(0))
    for _ in range(FAR_STEPS):
        state = step(state)
    return np.asarray(state.grains.x)[:, np.asarray(state.grains.m) > 0]


def measure(quick: bool) -> dict[str, Any]:
    """All cases; they are small, so quick changes nothing."""
    job.pin(1)
    cases = []

    def asked(name: str, why: str, bound: float, told: str, off: Callable[[], float]) -> None:
        began = time.process_time()
        value = off()
        cases.extend(case.say([Case(name, why, 0, at_most(bound), value, told, time.process_time() - began)]))

    told = f"{ACROSS} cells across, {STEPS} substeps"
    for name in CHANGES:
        asked(f"collapse {name}: largest way off, cells", "symmetry", 1e-11, f"{told}, f64", partial(changed, name))
    why, told = "Galilei", "12 cells across, f64"
    asked("turning block in a moving frame: velocities of a step, off", why, 1e-13, told, lambda: carried(1)[0])
    asked("the same after 100 steps and 1.4 cells: places, off, m", why, 1e-3, told, lambda: carried(100)[1])
    told = f"{FAR:g} m away, 8 cells across, {FAR_STEPS} rigid steps, f32"
    asked("scene far from the world's origin: off, m", "translation", 0, told, lambda: far(FAR))
    return {"cases": cases}


def far(x: float) -> float:
    """Largest difference (m) between grains of a scene at the world's origin and of one x m away."""
    return float(np.abs(placed(x) - placed(0.0)).max())


if __name__ == "__main__":
    part.main("validation_symmetry", measure, __doc__)
