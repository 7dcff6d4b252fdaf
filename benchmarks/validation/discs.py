"""Discs: two elastic ones that meet and part again, and one that spins.

python -m benchmarks.validation.discs [--quick]
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from benchmarks import case, job, part
from benchmarks.case import Case, at_most, within
from benchmarks.validation import PLOTS
from benchmarks.validation.blocks import alive, balance, block, box, example, go, lattice, longest_step, spinning
from mpm_env.mpm.budgets import Budgets, budgets
from mpm_env.mpm.materials import Material
from mpm_env.mpm.substep import Bed, substep
from mpm_env.mpm.types import Grid, Particles
from mpm_env.plot import Series, plot

RADIUS, E, RHO = 0.2, 1000.0, 1000.0  # m, Pa, kg/m^3: sound runs at 1.16 m/s
LOW, HIGH = 0.2, 0.8  # m, both coordinates of their centres
SPEED = 0.1  # m/s, along both axes, towards each other
TOUCH = ((HIGH - LOW) * np.sqrt(2) - 2 * RADIUS) / (2 * np.sqrt(2) * SPEED)  # s, when their edges meet: 1.58579
SECONDS = 3.2
ROOM = 0.1  # m, around the square in which they meet
COURANT = 0.2  # of the runs that REBOUND is from; at 0.8 more comes back (0.885, 0.902, 0.901), at 0.1 less
FELT = 0.01  # of the kinetic energy: discs that have lost so much have met
CELLS = (20, 40, 80)  # to a metre
# Speeds of rebound that an independent MPM code found with APIC at these cells, of neo-Hookean discs.
REBOUND = {20: 0.818, 40: 0.881, 80: 0.908}
TWO, ANOTHER = "Sulsky et al. 1994", "another MPM code (unpublished)"

OMEGA, ACROSS = 10.0, 16  # rad/s of a disc that spins, and cells across it
SECONDS_SPUN = 10.0  # 16 turns; what rings at the start has died
SPUN: dict[str, dict[str, float]] = {"elastic": {}, "sand": {"E": 1e6, "rho": 1550.0, "cohesion": 1e5}}  # it holds
# Centrifugal stress has a trace of half rho omega^2 R^2 in the plane, in the mean, whatever the law: by the virial
# theorem. Plane strain of E = 1 MPa, nu = 0.3 answers with so much volume.
GROWTH = 1550 * OMEGA**2 * RADIUS**2 / 2 * (1 + 0.3) * (1 - 2 * 0.3) / 1e6


class Meeting(NamedTuple):
    """What two discs did."""

    t: np.ndarray  # (steps,) s
    kinetic: np.ndarray  # (steps,) over the first
    energy: np.ndarray  # (steps,) all of it, over the first
    stand_off: float  # cells between their edges when they meet
    rebound: float  # speed of their centres at the end, over the first
    momentum: float  # largest of both together, over that of one
    cpu_s: float

    @property
    def rise(self) -> float:
        """Largest rise of all energy from any of its earlier values, over the first."""
        return float((self.energy - np.minimum.accumulate(self.energy)).max())


@partial(jax.jit, static_argnums=(0, 1))
def observed(
    grid: Grid, steps: int, material: Material, p: Particles, dt: Array, affine: Array
) -> tuple[Particles, Budgets]:
    """The grains at the end, and their budgets (steps,) after each substep."""
    beds, nothing = (Bed(material, 0, p.count),), jnp.zeros(2, p.x.dtype)

    def one(p: Particles, _: None) -> tuple[Particles, Budgets]:
        p, _carry = substep(grid, beds, p, dt, nothing)
        p = replace(p, C=p.C * affine)
        return p, budgets(grid, beds, p, nothing)

    return lax.scan(one, p, length=steps)


def meet(cells: int, *, affine: float = 1.0, dtype: str = "float64") -> Meeting:
    """Two discs with so many cells to a metre; affine = 0 is PIC, the negative control."""
    dx = 1 / cells
    grid = box((round((1 + 2 * ROOM) * cells),) * 2, dx)
    sites = lattice((ROOM, ROOM), (2 * cells, 2 * cells), dx / 2)
    first, second = (sites[:, np.hypot(*(sites - ROOM - c)) < RADIUS] for c in (LOW, HIGH))
    one, sites = first.shape[1], np.concatenate([first, second], axis=1)
    v = SPEED * np.where(np.arange(sites.shape[1]) < one, 1, -1) * np.ones((2, 1))
    with jax.enable_x64(dtype == "float64"):
        material = example("elastic", dtype, E=E, nu=0.3, rho=RHO)
        p = block(grid, material, sites, volume=dx**2 / 4, v=v, dtype=dtype)
        dt = COURANT * dx / float(material.wave_speed())
        args = (material, p, jnp.asarray(dt, dtype), jnp.asarray(affine, dtype))
        program = observed.lower(grid, round(SECONDS / dt), *args).compile()
        began = time.process_time()
        p, b = jax.block_until_ready(program(*args))
        cpu = time.process_time() - began
        v, b = np.asarray(p.v), Budgets(*(np.asarray(a) for a in b))
    kinetic, scale = b.kinetic / b.kinetic[0], b.mass[0] / 2 * SPEED
    # Velocities are those between two positions: the mean of both sides belongs to the elastic energy between them.
    energy = (b.elastic[:-1] + (b.kinetic[:-1] + b.kinetic[1:]) / 2) / b.kinetic[0]
    gap = (TOUCH - dt * (1 + np.argmax(kinetic < 1 - FELT))) * 2 * np.sqrt(2) * SPEED / dx
    back = (v[:, one : sites.shape[1]].mean() - v[:, :one].mean()) / (2 * SPEED)
    t, momentum = dt * (1 + np.arange(len(kinetic))), float(np.abs(b.momentum).max() / scale)
    return Meeting(t, kinetic, energy, float(gap), float(back), momentum, cpu)


class Spun(NamedTuple):
    """What became of a disc that turned."""

    growth: float  # of its volume
    turns: float  # share of its angular velocity that is left
    cpu_s: float


def spin(name: str, seconds: float, *, affine: float = 1.0) -> Spun:
    """A disc of a material of SPUN that turns at OMEGA; affine = 0 is PIC, the negative control."""
    dx = 2 * RADIUS / ACROSS
    grid = box((2 * ACROSS, 2 * ACROSS), dx)
    sites = lattice((ACROSS * dx / 2,) * 2, (2 * ACROSS, 2 * ACROSS), dx / 2)
    sites = sites[:, np.hypot(*(sites - ACROSS * dx)) < RADIUS]
    material = example(name, **SPUN[name])
    v, C = spinning(sites, OMEGA)
    p = block(grid, material, sites, volume=dx**2 / 4, v=v, C=C)
    dt = 0.6 * longest_step(grid, material)
    go(grid, material, p, dt=dt, steps=0)  # compiles
    began = time.process_time()
    q = go(grid, material, p, dt=dt, steps=round(seconds / dt), affine=affine)
    cpu = time.process_time() - began
    xx, yy, zz, xy = np.asarray(q.e, np.float64)[:, alive(q)] + np.array([[1], [1], [1], [0]])
    growth = np.sqrt((xx * yy - xy**2) * zz).mean() - 1
    now, then = (balance(grid, material, a).angular_momentum[2] for a in (q, p))
    return Spun(float(growth), float(now / then), cpu)


def met(cells: int, m: Meeting) -> list[Case]:
    """What is asked of two discs."""
    kept = (f"{cells} cells to 1 m, Courant {COURANT:g}, f64", m.cpu_s)
    back = (REBOUND[cells] - 0.04, REBOUND[cells] + 0.04)
    return [
        Case("two discs: gap when they meet, cells", TWO, 0, (0.8, 2), m.stand_off, *kept),
        Case("two discs: speed of rebound", ANOTHER, REBOUND[cells], back, m.rebound, *kept),
        Case("two discs: rise of all energy", "dissipation", 0, at_most(1e-3), m.rise, *kept),
        Case("two discs: momentum, off", "symmetry", 0, at_most(1e-11), m.momentum, *kept),
    ]


def measure(quick: bool) -> dict[str, Any]:
    """All discs; the finest only where it need not be quick."""
    job.pin(1)
    runs = {n: meet(n) for n in (CELLS[:2] if quick else CELLS)}
    cases = [one for n, m in runs.items() for one in met(n, m)]
    for name in SPUN:
        s = spin(name, SECONDS_SPUN)
        kept = (f"{SECONDS_SPUN:g} s at {OMEGA:g} rad/s, {ACROSS} cells, f32", s.cpu_s)
        title = f"spinning disc of {name}: volume grown"
        cases.append(Case(title, "virial theorem", GROWTH, within(GROWTH, 0.1), s.growth, *kept))
    curves = [Series(f"{n} cells to 1 m", m.t, m.kinetic, True, k) for k, (n, m) in enumerate(runs.items())]
    total = [Series("", m.t[:-1], m.energy, True, k) for k, m in enumerate(runs.values())]
    touch = Series("edges meet", [TOUCH, TOUCH], [0, 1], True, 7)
    about = ("Two discs meet: kinetic and all energy", "time, s", "over the first")
    plot(PLOTS / "discs.png", *about, [*curves, *total, touch], names="below")
    return {"cases": case.say(cases)}


if __name__ == "__main__":
    part.main("validation_discs", measure, __doc__)
