"""What motion keeps: mass, momentum, angular momentum with its affine part; free fall; the energy of a rigid turn.

python -m benchmarks.validation.motion [--quick]
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks import case, job, part
from benchmarks.case import Case, at_most
from benchmarks.validation.blocks import (
    GRAVITY,
    alive,
    balance,
    block,
    box,
    example,
    go,
    lattice,
    longest_step,
    spinning,
)
from mpm_env.mpm.budgets import Budgets, total
from mpm_env.mpm.materials import Material
from mpm_env.mpm.types import MARGIN, Grid, Particles, Wall

APIC = "Jiang et al. 2015"
OMEGA = 5.0  # rad/s
STEPS = 1000
BLOCKS = {
    2: (box((24, 24), 1 / 12), lattice((0.5, 0.5), (24, 24), 1 / 24)),  # 1 m wide, three slots of a chunk stay empty
    3: (box((16, 16, 16), 1 / 16), lattice((0.375, 0.375, 0.375), (8, 8, 8), 1 / 32)),
}


def turning(d: int, omega: float, dtype: str = "float32") -> tuple[Grid, Material, Particles]:
    """An elastic block that turns about its centre, at omega rad/s, far from any wall."""
    grid, sites = BLOCKS[d]
    material = example("elastic", dtype)
    v, C = spinning(sites, omega)
    volume = (grid.cell_size / 2) ** d
    return grid, material, block(grid, material, sites, volume=volume, v=v, C=C, dtype=dtype)


class Kept(NamedTuple):
    """What a turning block had before and after, and how far that is off."""

    before: Budgets
    after: Budgets
    mass: float  # of the mass
    momentum: float  # over M omega R
    angular: float  # of the angular momentum
    cpu_s: float


def kept(d: int, *, affine: float = 1.0, dtype: str = "float32") -> Kept:
    """STEPS of a turning block; affine = 0 forgets the affine part: PIC, the negative control."""
    with jax.enable_x64(dtype == "float64"):
        grid, material, p = turning(d, OMEGA, dtype)
        dt = 0.6 * longest_step(grid, material)
        go(grid, material, p, dt=dt, steps=0)  # compiles
        began = time.process_time()
        q = go(grid, material, p, dt=dt, steps=STEPS, affine=affine)
        cpu = time.process_time() - began
    before, after = balance(grid, material, p), balance(grid, material, q)
    scale = before.mass * OMEGA * np.ptp(BLOCKS[d][1][0]) / 2
    return Kept(
        before,
        after,
        float(abs(after.mass / before.mass - 1)),
        float(np.abs(after.momentum - before.momentum).max() / scale),
        float(np.abs(after.angular_momentum - before.angular_momentum).max() / before.angular_momentum[2]),
        cpu,
    )


def fallen(name: str, steps: int, dt: float) -> tuple[np.ndarray, float]:
    """How far (2, n) m a block of a material fell, and how far symplectic Euler falls."""
    grid, material = box((12, 70), 0.1), example(name)
    p = block(grid, material, lattice((0.4, 6.0), (8, 8), 0.05), volume=0.05**2)
    q = go(grid, material, p, dt=dt, steps=steps, gravity=(0.0, -GRAVITY))
    return np.asarray(q.x, np.float64) - np.asarray(p.x, np.float64), GRAVITY * dt**2 * steps * (steps + 1) / 2


def turned(seconds: float) -> tuple[Grid, Material, Particles, Particles]:
    """The block before and after it turned at one rad/s."""
    grid, material, p = turning(2, 1.0)
    dt = 0.6 * longest_step(grid, material)
    return grid, material, p, go(grid, material, p, dt=dt, steps=round(seconds / dt))


# A box of 0.6 x 0.4 m, open on the left and right, closed below and above.
OPEN = box((12, 8), 0.05, lower=Wall("stick"), other=Wall("open"))
OPEN = replace(OPEN, walls=(OPEN.walls[0], (Wall("stick"), Wall("slip"))))
PLANES = (MARGIN * OPEN.cell_size, (MARGIN + OPEN.cells[0]) * OPEN.cell_size)


def sand_moving(v: tuple[float, float]) -> tuple[Material, Particles]:
    """Sand in the middle of the open box, all at v m/s."""
    material, spacing = example("sand"), OPEN.cell_size / 2
    sites = lattice((0.1, 0.05), (16, 12), spacing)
    return material, block(OPEN, material, sites, volume=spacing**2, v=np.array(v))


def leaving() -> list[Case]:
    """Mass of sand that leaves through an open side."""
    began = time.process_time()
    material, p = sand_moving((3.0, 0.0))
    dt, start, gone = 0.6 * longest_step(OPEN, material), total(np.asarray(p.m)), 0.0
    for _ in range(12):
        q = go(OPEN, material, p, dt=dt, steps=40, gravity=(0.0, -GRAVITY))
        gone += total(np.asarray(p.m)[alive(p) & ~alive(q)])
        p = q
    off = float(abs((total(np.asarray(p.m)) + gone) / start - 1))
    told = f"{gone / start:.0%} left, f32"
    return [Case("sand that leaves: mass off the ledger", "counting", 0, at_most(1e-14), off, told, _since(began))]


def conserved() -> list[Case]:
    """Budgets of turning blocks."""
    out = []
    for d, told in {2: "plane strain", 3: "3-D"}.items():
        k = kept(d)
        for name, value, bound in (
            ("mass, off", k.mass, 1e-6),
            ("momentum, off / M omega R", k.momentum, 1e-6),
            ("angular momentum, off", k.angular, 1e-5),
        ):
            resolution = f"{STEPS} steps, {told}, f32"
            out.append(Case(f"turning block: {name}", APIC, 0, at_most(bound), value, resolution, k.cpu_s))
    return out


def fall() -> list[Case]:
    """Free fall."""
    began, steps, dt = time.process_time(), 1000, 1e-3
    way, law = fallen("sand", steps, dt)
    off = float(np.abs(way[1] / -law - 1).max())
    told = f"{steps * dt:g} s in {steps} steps, f32"
    return [Case("free fall: off symplectic Euler's", "closed form", 0, at_most(1e-5), off, told, _since(began))]


def turn(seconds: float) -> list[Case]:
    """The energy of a rigid turn."""
    began = time.process_time()
    grid, material, p, q = turned(seconds)
    loss = float(1 - balance(grid, material, q).kinetic / balance(grid, material, p).kinetic)
    told = f"{seconds:g} s at 1 rad/s, 12 cells, f32"
    return [Case("turning block: kinetic energy lost", "rigid motion", 0, at_most(1e-3), loss, told, _since(began))]


def _since(began: float) -> float:
    return time.process_time() - began


def measure(quick: bool) -> dict[str, Any]:
    """All cases; a shorter turn where it should be quick."""
    job.pin(1)
    return {"cases": case.say([*conserved(), *fall(), *turn(2.0 if quick else 20.0), *leaving()])}


if __name__ == "__main__":
    part.main("validation_motion", measure, __doc__)
