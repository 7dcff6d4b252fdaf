"""A manufactured solution: a ring that twists to and fro, driven by the body force that makes its motion exact.

    python -m benchmarks.validation.vortex [--quick]

The generalised vortex of Brannon, Kamojjala & Sadeghirad, Establishing credibility of particle methods through
verification testing, Particles 2011: a point of the ring stays at its radius R and turns by an angle
alpha(R, t) = A sin(pi t) h(R), with h and its slope nil at both edges, which therefore need no traction. The force per
mass b = a - div P / rho0 is derived by JAX from the solver's own material, so it fits any elastic law. It acts on
grains, before each substep.
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
from benchmarks.case import Case, at_least, at_most
from benchmarks.coupling.fits import exponent
from benchmarks.validation import PLOTS
from benchmarks.validation.blocks import block, box, example, lattice
from mpm_env.mpm.linalg3 import matrix_rows
from mpm_env.mpm.materials import Material
from mpm_env.mpm.materials.protocol import p_wave_speed
from mpm_env.mpm.substep import Bed, substep
from mpm_env.mpm.types import Grid, Particles
from mpm_env.plot import Series, plot

INNER, OUTER = 0.75, 1.25  # m
E, NU, RHO = 1000.0, 0.3, 1000.0
SECONDS = 0.5  # a quarter of the way to and fro: it ends turned the furthest
COURANT = 0.2
ROOM = 4  # cells around the ring
PER_SIDE = 4  # grains along a cell
CELLS = (8, 16, 32, 64)  # to a metre
SOURCE = "manufactured solution"
GENTLE = 0.1  # rad
# Solids of the same moduli with Hencky's energy and with the fixed corotated one, snow that never yields.
LAWS: dict[str, dict[str, float]] = {"elastic": {}, "snow": {"theta_c": 0.9, "theta_s": 9.0, "xi": 0.0, "Jp_min": 0.5}}
NAMES = {"elastic": "Hencky", "snow": "fixed corotated"}
# Law and amplitude (rad) -> least order. Twisted by 1 rad the ring is sheared by 7, and the order falls; a fixed
# corotated solid has no unique answer there, once a stretch is below a half.
TWISTS = {("elastic", GENTLE): 1.7, ("snow", GENTLE): 1.7, ("elastic", 1.0): 1.0}
# Where the force is derived; between them it is interpolated. None of them is at an edge or in the middle, where the
# ring is not strained: of equal principal strains the derivative of the stress is not that of a shear (mpm.linalg3).
RADII = np.linspace(INNER - 1e-3, OUTER + 1e-3, 256)


def angle(R: Array, t: Array, amplitude: Array) -> Array:
    """By how much (rad) a point at radius R has turned."""
    s = R - (INNER + OUTER) / 2
    return amplitude * jnp.sin(jnp.pi * t) * (1 - 32 * s**2 + 256 * s**4)


def turned(vectors: Array, by: Array) -> Array:
    """Vectors (2, ..), turned by angles (..)."""
    c, s = jnp.cos(by), jnp.sin(by)
    return jnp.stack([c * vectors[0] - s * vectors[1], s * vectors[0] + c * vectors[1]])


def motion(X: Array, t: Array, amplitude: Array) -> Array:
    """Where the point X (2,) m is at time t."""
    return turned(X, angle(jnp.sqrt(X @ X), t, amplitude))


def velocity(X: Array, t: Array, amplitude: Array) -> Array:
    """Its velocity (2,) m/s."""
    return jax.jacfwd(motion, argnums=1)(X, t, amplitude)


@jax.jit
def moving(X: Array, t: Array, amplitude: Array) -> tuple[Array, Array]:
    """Velocities (2, n) m/s of points (n, 2) m, and their gradients (2, 2, n) 1/s."""
    v, C = (jax.vmap(f, (0, None, None))(X, t, amplitude) for f in (velocity, jax.jacfwd(velocity)))
    return v.T, jnp.moveaxis(C, 0, -1)


def force(material: Material, X: Array, t: Array, amplitude: Array) -> Array:
    """Force per mass (2,) m/s^2 that keeps X on its way: a - div P / rho0, with P = tau F^-T."""

    def P(X: Array) -> Array:
        F = jax.jacfwd(motion)(X, t, amplitude)
        b = F @ F.T
        e = jnp.stack([b[0, 0] - 1, b[1, 1] - 1, jnp.zeros(()), b[0, 1]])[:, None]
        _, _, tau = material.update(e, jnp.asarray(material.history_start)[:, None], 0.0)
        return jnp.array([[r[0] for r in row] for row in matrix_rows(tau)]) @ jnp.linalg.inv(F).T

    acceleration = jax.jacfwd(velocity, argnums=1)(X, t, amplitude)
    return acceleration - jnp.trace(jax.jacfwd(P)(X), axis1=1, axis2=2) / material.rho


@partial(jax.jit, static_argnums=(0, 1))
def twist(
    grid: Grid,
    steps: int,
    laws: tuple[Material, Material],
    p: Particles,
    X: Array,
    dt: Array,
    amplitude: Array,
    affine: Array,
) -> Array:
    """Root mean square distances (steps,) m of grains from where they should be, after each substep.

    laws: of the grains, and that which the force is derived from.
    """
    material, law = laws
    middle, R = (p.x - X)[:, :1], jnp.sqrt(jnp.sum(X**2, axis=0))
    radial = jnp.stack([RADII, 0 * RADII], axis=1)

    def one(p: Particles, k: Array) -> tuple[Particles, Array]:
        at = jax.vmap(force, (None, 0, None, None))(law, radial, k * dt, amplitude)
        push = jnp.stack([jnp.interp(R, RADII, f) for f in at.T])
        # By symmetry the force on a point at another angle is that on the one at angle 0, turned.
        p = replace(p, v=p.v + dt * turned(push, jnp.arctan2(X[1], X[0])))
        p, _carry = substep(grid, (Bed(material, 0, p.count),), p, dt, jnp.zeros(2, p.x.dtype))
        p = replace(p, C=p.C * affine)
        off = p.x - middle - turned(X, angle(R, (k + 1) * dt, amplitude))
        return p, jnp.sqrt(jnp.sum(p.m * jnp.sum(off**2, axis=0)) / jnp.sum(p.m))

    return lax.scan(one, p, jnp.arange(steps, dtype=p.x.dtype))[1]


class Twisted(NamedTuple):
    """What became of a ring."""

    error: float  # m, largest over time of the root mean square over grains
    cpu_s: float


def run(cells: int, amplitude: float, *, law: str = "elastic", affine: float = 1.0, stiffer: float = 1.0) -> Twisted:
    """A ring of a law of LAWS with so many cells to a metre, twisted by `amplitude` rad.

    affine = 0 is PIC, `stiffer` the modulus over that which the force was derived for: negative controls.
    """
    dx = 1 / cells
    half = round(OUTER * cells) + ROOM
    grid = box((2 * half, 2 * half), dx)
    X = lattice((-half * dx,) * 2, (2 * half * PER_SIDE,) * 2, dx / PER_SIDE)
    X = X[:, (np.hypot(*X) > INNER) & (np.hypot(*X) < OUTER)]
    with jax.enable_x64(True):
        told, real = (example(law, "float64", E=E * s, nu=NU, rho=RHO, **LAWS[law]) for s in (1.0, stiffer))
        dt = COURANT * dx / float(p_wave_speed(told.E, told.nu, told.rho))
        # Velocities are those between two positions: the first is half a step before the start.
        v, C = moving(jnp.asarray(X.T), jnp.asarray(-dt / 2), jnp.asarray(amplitude))
        p = block(grid, told, X + half * dx, volume=(dx / PER_SIDE) ** 2, v=np.asarray(v), dtype="float64")
        empty = p.count - X.shape[1]
        p = replace(p, C=jnp.asarray(np.pad(C, ((0, 0), (0, 0), (0, empty)))))
        X = np.pad(X, ((0, 0), (0, empty)), mode="edge")
        numbers = (jnp.asarray(a) for a in (dt, amplitude, affine))
        given = ((real, told), p, jnp.asarray(X), *numbers)
        program = twist.lower(grid, round(SECONDS / dt), *given).compile()
        began = time.process_time()
        off = np.asarray(program(*given))
        cpu = time.process_time() - began
    return Twisted(float(off.max()), cpu)


def sweep(law: str, amplitude: float, cells: tuple[int, ...]) -> tuple[dict[int, Twisted], float]:
    """Rings over cells, and the order of convergence."""
    runs = {n: run(n, amplitude, law=law) for n in cells}
    return runs, exponent(1 / np.array(cells), np.array([r.error for r in runs.values()]))


def measure(quick: bool) -> dict[str, Any]:
    """All of TWISTS."""
    job.pin(1)
    cells, cases, series = CELLS[:3] if quick else CELLS, [], []
    for k, ((law, amplitude), least) in enumerate(TWISTS.items()):
        runs, order = sweep(law, amplitude, cells)
        cpu, over = sum(r.cpu_s for r in runs.values()), f"{', '.join(map(str, cells))} cells to 1 m, f64"
        name = f"ring of {NAMES[law]} solid, twisted by {amplitude:g} rad"
        cases.append(Case(f"{name}: order", "quadratic splines", 2, at_least(least), order, over, cpu))
        if amplitude == GENTLE:
            error, kept = runs[16].error, ("16 cells to 1 m, f64", runs[16].cpu_s)
            cases.append(Case(f"{name}: largest rms error, m", SOURCE, 0, at_most(3e-3), error, *kept))
        errors = np.array([r.error for r in runs.values()])
        cell = 1 / np.array(cells)
        line = errors[1] * (cell / cell[1]) ** 2
        series += [Series(f"{NAMES[law]}, {amplitude:g} rad", cell, errors, colour=k), Series("", cell, line, True, k)]
    about = ("A ring twisted as told; lines of second order", "cell, m", "largest rms error of positions, m")
    plot(PLOTS / "vortex.png", *about, series, log=True)
    return {"cases": case.say(cases)}


if __name__ == "__main__":
    part.main("validation_vortex", measure, __doc__)
