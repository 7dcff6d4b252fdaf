"""Elastic bars that ring: how fast and how long, one round on itself and one held at an end.

    python -m benchmarks.validation.bars [--quick]

Without sideways strain (nu = 0) a bar in plane strain is one in a single dimension, to the bit.
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
from benchmarks.case import Case, within
from benchmarks.coupling.fits import exponent
from benchmarks.validation import PLOTS
from benchmarks.validation.blocks import block, box, example
from benchmarks.validation.periodic import FIRST, Round
from mpm_env.mpm.materials import Material
from mpm_env.mpm.substep import Bed, substep
from mpm_env.mpm.types import Grid, Particles
from mpm_env.plot import Series, plot

LENGTH, E, RHO = 25.0, 100.0, 1.0  # m, Pa, kg/m^3: sound runs at 10 m/s
SOUND = np.sqrt(E / RHO)  # m/s
SPEED = 1e-3  # m/s, largest at the start: strains of 1e-4, where every law is Hooke's
COURANT = 0.2
CELLS = (16, 32, 64)
WAVE = "wave equation"


class Kind(NamedTuple):
    """How a bar is held, and what is asked of it."""

    name: str
    wave: float  # 1/m, of its mode, a sine
    per_cell: int  # grains along it
    periods: int
    order: float  # of convergence, in theory
    why: str
    off: float  # of the pitch, relative, with 32 cells
    orders: case.Band

    @property
    def pitch(self) -> float:
        """Angular frequency of the closed form, rad/s."""
        return float(self.wave * SOUND)


KINDS = {
    "round": Kind("bar round on itself", 2 * np.pi / LENGTH, 4, 10, 2.0, "splines", 6e-3, (1.8, 2.2)),
    "held": Kind(
        "bar held at an end", np.pi / (2 * LENGTH), 2, 5, 1.0, "a wall half a cell off", 8e-3, case.at_least(0.9)
    ),
}


class Ringing(NamedTuple):
    """What was heard of a bar."""

    pitch: float  # rad/s
    kept: float  # of the energy, at the end
    off: float  # of the pitch from the closed form's, relative
    cpu_s: float


@partial(jax.jit, static_argnums=(0, 1, 2))
def heard(
    grid: Grid, cells: int | None, steps: int, material: Material, p: Particles, dt: Array, mode: Array, affine: Array
) -> Array:
    """The mode's share (steps,) of the velocity after each substep; the bar is round where it has `cells`."""
    ends = Round(grid, cells) if cells else None

    def one(p: Particles, _: None) -> tuple[Particles, Array]:
        p, _carry = substep(grid, (Bed(material, 0, p.count),), p, dt, jnp.zeros(2, p.x.dtype), ends)
        p = replace(p, C=p.C * affine)
        return p, jnp.sum(p.m * p.v[0] * mode)

    return lax.scan(one, p, length=steps)[1]


def ring(name: str, cells: int, *, affine: float = 1.0, stiffer: float = 1.0, dtype: str = "float64") -> Ringing:
    """A bar of KINDS of so many cells; affine = 0 is PIC, `stiffer` its modulus over E: negative controls."""
    kind, dx = KINDS[name], LENGTH / cells
    first = FIRST if name == "round" else 0
    grid = box((cells + 2 * FIRST if name == "round" else round(1.25 * cells), 4), dx)
    n = kind.per_cell * cells
    along = (np.arange(n) + 0.5) * LENGTH / n
    sites, shape = np.stack([along + first * dx, np.full(n, 2 * dx)]), np.sin(kind.wave * along)
    with jax.enable_x64(dtype == "float64"):
        material = example("elastic", dtype, E=E * stiffer, nu=0.0, rho=RHO)
        p = block(grid, material, sites, volume=dx * LENGTH / n, v=SPEED * np.stack([shape, 0 * shape]), dtype=dtype)
        dt = COURANT * dx / SOUND
        steps = round(kind.periods * 2 * np.pi / kind.pitch / dt)
        mode = jnp.asarray(np.pad(shape, (0, p.count - n)), dtype)
        args = (material, p, jnp.asarray(dt, dtype), mode, jnp.asarray(affine, dtype))
        program = heard.lower(grid, cells if name == "round" else None, steps, *args).compile()
        began = time.process_time()
        q = np.asarray(program(*args), np.float64)
        cpu = time.process_time() - began
    sung = pitch(q, dt)
    return Ringing(sung, energy_kept(q, kind.periods), sung / kind.pitch - 1, cpu)


def pitch(q: np.ndarray, dt: float) -> float:
    """Angular frequency in rad/s of a decaying oscillation, from when it crosses zero; nan if it does not ring."""
    before = np.flatnonzero(np.signbit(q[1:]) != np.signbit(q[:-1]))
    if len(before) < 2:
        return float("nan")
    crossing = before + q[before] / (q[before] - q[before + 1])
    return float(np.pi * (len(before) - 1) / (crossing[-1] - crossing[0]) / dt)


def energy_kept(q: np.ndarray, periods: int) -> float:
    """Energy of the last period over that of the first, from velocities, taken to so many periods."""
    n = len(q) // periods
    ratio = np.square(q[-n:]).sum() / np.square(q[:n]).sum()
    return float(ratio ** (periods / (periods - 1)))


def sweep(name: str) -> tuple[dict[int, Ringing], float]:
    """A kind of bar over CELLS, and the order of convergence of its pitch."""
    runs = {n: ring(name, n) for n in CELLS}
    return runs, exponent(LENGTH / np.array(CELLS), np.array([abs(r.off) for r in runs.values()]))


def cases(name: str, runs: dict[int, Ringing], order: float) -> list[Case]:
    """What is asked of a kind of bar."""
    kind, middle, cpu = KINDS[name], runs[32], sum(r.cpu_s for r in runs.values())
    told, over = "32 cells, Courant 0.2, f64", f"{', '.join(map(str, CELLS))} cells, f64"
    kept, close = f"energy kept in {kind.periods} periods", within(kind.pitch, kind.off)
    return [
        Case(f"{kind.name}: pitch, rad/s", WAVE, kind.pitch, close, middle.pitch, told, middle.cpu_s),
        Case(f"{kind.name}: order of the pitch", kind.why, kind.order, kind.orders, order, over, cpu),
        Case(f"{kind.name}: {kept}", WAVE, 1, (0.9, 1), middle.kept, told, middle.cpu_s),
    ]


def measure(quick: bool) -> dict[str, Any]:
    """Both bars; they take no time, so quick changes nothing."""
    job.pin(1)
    told: list[dict[str, Any]] = []
    cell, series = 1 / np.array(CELLS), []
    for k, name in enumerate(KINDS):
        runs, order = sweep(name)
        told += case.say(cases(name, runs, order))
        line = abs(runs[32].off) * (32 * cell) ** KINDS[name].order
        points = [abs(r.off) for r in runs.values()]
        series += [Series(KINDS[name].name, cell, points, colour=k), Series("", cell, line, True, k)]
    about = ("Elastic bars; lines of second and first order", "cell / length", "pitch off the closed form, relative")
    plot(PLOTS / "bars.png", *about, series, log=True)
    return {"cases": told}


if __name__ == "__main__":
    part.main("validation_bars", measure, __doc__)
