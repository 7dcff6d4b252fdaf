"""The laboratory's element tests on a material of this library: one grain, driven by strains and stresses.

What is tested is the solver's own material through its public `update`, with the solver's own straining of it. Each
step moves some strains as told and solves for those that a held stress leaves free, by Newton with exact derivatives.
Stresses are Cauchy's; in what comes out, compression and compaction are positive, as soil mechanics has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mpm_env.mpm.linalg3 import matrix_rows
from mpm_env.mpm.materials import Material
from mpm_env.mpm.substep import stretch

NEWTONS = 60  # iterations at most; 3 to 8 are usual, more where the stress has a kink
CLOSE = 1e-9  # of the pressure held; round-off of f64 at stiffnesses a million times that
HELD = 1e-6  # of the pressure held: what is further off was not held
SETTLING = 50  # steps from no stress to the pressure
LEAST_PRESSURE = 1e-30  # Pa, for ratios of stresses that may all be nil


@dataclass(frozen=True)
class Test:
    """How a test drives a grain. Axes are x, y, z; in plane strain z is the one out of the plane."""

    about: str
    settles: tuple[int, ...]  # axes whose stress is the pressure at the start, from no stress
    holds: tuple[int, ...]  # axes whose stress stays there
    driven: tuple[int, int]  # component of the velocity gradient that is driven
    dimension: int  # where none is asked for
    strain: float  # how far, if not told: log strain, or shear
    plane_strain: bool  # whether it can be done in 2-D


TESTS = {
    "triaxial": Test("x shortens, y and z bear the pressure", (0, 1, 2), (1, 2), (0, 0), 3, 0.1, False),
    "biaxial": Test("x shortens, y bears the pressure, z keeps its length", (0, 1), (1,), (0, 0), 2, 0.2, True),
    "oedometer": Test("x shortens from no stress, y and z keep their length", (), (), (0, 0), 3, 0.02, True),
    "shear": Test("x slides along y, which bears the pressure; x, z keep length", (1,), (1,), (0, 1), 2, 0.2, True),
}  # fmt: skip


class Curve(NamedTuple):
    """What a test measured: a row for each of n steps, the state before the first of them included."""

    strain: np.ndarray  # (n,) log strain along x, compression positive; in shear the shear
    volume_strain: np.ndarray  # (n,) log of the volume lost since the test began, the settling left out
    stress: np.ndarray  # (n, 4) Pa: xx, yy, zz, compression positive, and xy

    @property
    def principal(self) -> np.ndarray:
        """(n, 3) Pa, the largest compression first."""
        middle = (self.stress[:, 0] + self.stress[:, 1]) / 2
        radius = np.hypot((self.stress[:, 0] - self.stress[:, 1]) / 2, self.stress[:, 3])
        return -np.sort(-np.stack([middle + radius, middle - radius, self.stress[:, 2]], axis=1), axis=1)

    @property
    def p(self) -> np.ndarray:
        """(n,) Pa, mean pressure."""
        return self.principal.mean(axis=1)

    @property
    def q(self) -> np.ndarray:
        """(n,) Pa, equivalent stress: s1 - s3 in triaxial compression."""
        s = self.principal
        return np.sqrt(((s[:, 0] - s[:, 1]) ** 2 + (s[:, 1] - s[:, 2]) ** 2 + (s[:, 2] - s[:, 0]) ** 2) / 2)

    @property
    def mobilised_deg(self) -> np.ndarray:
        """(n,) the angle of Mohr's circle of x and y, sin = (s1 - s3) / (s1 + s3); nan without pressure."""
        s = self.stress
        total = s[:, 0] + s[:, 1]
        ratio = np.hypot(s[:, 0] - s[:, 1], 2 * s[:, 3]) / np.where(total > LEAST_PRESSURE, total, np.nan)
        return np.rad2deg(np.arcsin(np.where(np.abs(ratio) <= 1, ratio, np.nan)))


class _Grain(NamedTuple):
    """One grain on its way through a test."""

    e: Array  # (s, 1)
    history: Array  # (k, 1)
    stress: Array  # (4,) Pa, tension positive: xx, yy, zz, xy
    volume: Array  # () log of J
    free: Array  # (3,) last increments of the free log strains
    miss: Array  # () Pa, largest distance of a held stress from what it should be


def run(
    material: Material,
    test: str,
    *,
    pressure: float = 1e4,
    strain: float | None = None,
    rate: float = 1.0,
    steps: int = 1000,
    dimension: int | None = None,
) -> Curve:
    """Put a material through a test of TESTS, in float64.

    pressure Pa held; strain is how far it is driven (log strain of x, or shear; the test's own if None), negative for
    extension; rate 1/s matters to materials that depend on it. dimension 2 is the solver's plane strain. Raises
    ValueError for a test or number that makes no sense, or a stress that the material cannot bear.
    """
    kind, strain, dimension = checked(test, pressure, strain, rate, steps, dimension)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda a: jnp.asarray(a, "float64"), material)
        drive = driven(kind, steps, pressure, strain, rate)
        volume, stress, miss = (np.asarray(a) for a in path(dimension, wide, drive))
    return curve_of(kind, pressure, strain, volume, stress, miss)


def curve_of(
    kind: Test, pressure: float, strain: float, volume: np.ndarray, stress: np.ndarray, miss: np.ndarray
) -> Curve:
    """What `path` gives, as measured. Raises ValueError where a pressure was not held."""
    volume, stress, miss = (a[SETTLING - 1 :] for a in (volume, stress, miss))
    strains = strain * np.arange(len(miss)) / (len(miss) - 1)
    lost = ~(miss <= HELD * pressure) | ~np.isfinite(stress).all(axis=1)
    if lost.any():
        where = " and ".join("xyz"[a] for a in kind.holds)
        raise ValueError(
            f"The material cannot bear {pressure:.4g} Pa along {where}: lost at a strain of"
            f" {strains[np.argmax(lost)]:.3g}. Use another pressure, a smaller strain or more steps."
        )
    return Curve(strains, volume[0] - volume, stress * np.array([-1, -1, -1, 1]))


def checked(
    test: str, pressure: float, strain: float | None, rate: float, steps: int, dimension: int | None
) -> tuple[Test, float, int]:
    """The test, its strain and dimension. Raises ValueError for what makes no sense."""
    if test not in TESTS:
        raise ValueError(f"There is no test {test!r}: known are {', '.join(TESTS)}.")
    kind = TESTS[test]
    strain = kind.strain if strain is None else strain
    dimension = kind.dimension if dimension is None else dimension
    if not (np.isfinite(pressure) and pressure > 0):
        raise ValueError(f"pressure should be positive and finite, got {pressure} Pa.")
    if not (np.isfinite(strain) and 0 < abs(strain) <= 3):
        raise ValueError(f"strain should lie between -3 and 3 and not be 0, got {strain}.")
    if not (np.isfinite(rate) and rate > 0):
        raise ValueError(f"rate should be positive and finite, got {rate} 1/s.")
    if not 10 <= steps <= 1_000_000:
        raise ValueError(f"steps should lie between 10 and a million, got {steps}.")
    if dimension not in (2, 3):
        raise ValueError(f"dimension should be 2 or 3, got {dimension}.")
    if dimension == 2 and not kind.plane_strain:
        raise ValueError(f"The {test} test lets all three axes change: it needs dimension 3.")
    return kind, strain, dimension


class _Search(NamedTuple):
    """Newton on its way to the free strains of a step."""

    u: Array  # (3,) log strains
    r: Array  # (3,) Pa, how far the held stresses are off
    slope: Array  # (3, 3) Pa, of r over u
    plainly: Array  # () whether Newton's step from here went the wrong way
    tries: Array  # ()


class _Drive(NamedTuple):
    """What a step is told; one leading axis over all steps of a test."""

    G: Array  # (.., 3, 3) increment of the velocity gradient
    held: Array  # (.., 3) 1 where the stress along an axis is the pressure, 0 where its strain is told
    pressure: Array  # (..) Pa
    dt: Array  # (..) s


def driven(kind: Test, steps: int, pressure: float, strain: float, rate: float) -> _Drive:
    """All steps of a test: SETTLING to the pressure, in the time of as many others, then those that drive it.

    Where nothing settles the first do nothing, so that all tests are one program.
    """
    share = np.minimum(np.arange(1, SETTLING + steps + 1) / SETTLING, 1)
    settles = np.arange(len(share)) < SETTLING
    held = np.where(settles[:, None], np.isin(np.arange(3), kind.settles), np.isin(np.arange(3), kind.holds))
    i, j = kind.driven
    G = np.zeros((len(share), 3, 3))
    G[~settles, i, j] = np.expm1(-strain / steps) if i == j else strain / steps
    rows = (G, held.astype(float), pressure * share, np.full(len(share), abs(strain) / steps / rate))
    return _Drive(*map(jnp.asarray, rows))


@partial(jax.jit, static_argnums=0)
def path(d: int, material: Material, drive: _Drive) -> tuple[Array, Array, Array]:
    """After each of n steps: ln J (n,), stress (n, 4) Pa with tension positive, and by how much a held one was missed.

    Differentiable in the material's parameters, forward.
    """
    history = jnp.asarray(type(material).history_start, drive.dt.dtype)[:, None]
    rest = _Grain(jnp.zeros((4 if d == 2 else 6, 1)), history, jnp.zeros(4), jnp.zeros(()), jnp.zeros(3), jnp.zeros(()))

    def one(grain: _Grain, told: _Drive) -> tuple[_Grain, tuple[Array, Array, Array]]:
        grain = _step(material, d, told, grain)
        return grain, (grain.volume, grain.stress, grain.miss)

    return lax.scan(one, rest, drive)[1]


def _step(material: Material, d: int, told: _Drive, g: _Grain) -> _Grain:
    """One step, with the strains that it takes to hold what is held.

    Newton with the exact slope. Where the stress knows none (loose sand), or a kink sends a step the wrong way, the
    next one takes the stiffest slope the material can have: that comes from one side and arrives in the end.
    """
    held, eye = told.held, jnp.eye(3)
    fixed = lax.stop_gradient((material, g))  # no derivative goes through the search
    stiffest = 3 * fixed[0].rho * fixed[0].wave_speed() ** 2

    def at(u: Array, material: Material, g: _Grain) -> _Grain:
        H = told.G + jnp.diag(jnp.expm1(held * u))
        e, history, tau = material.update(stretch(g.e, H[:d, :d, None]), g.history, told.dt)
        volume = g.volume + jnp.sum(jnp.log1p(jnp.diag(H)))
        stress = jnp.stack([tau[0, 0], tau[1, 0], tau[2, 0], matrix_rows(tau)[0][1][0]]) / jnp.exp(volume)
        return _Grain(e, history, stress, volume, held * u, jnp.zeros(()))

    def residual(u: Array, material: Material, g: _Grain) -> Array:
        return held * (at(u, material, g).stress[:3] + told.pressure)

    def size(r: Array) -> Array:
        return jnp.max(jnp.where(jnp.isfinite(r), jnp.abs(r), jnp.inf))

    def newton(u: Array, r: Array, slope: Array) -> Array:
        change = jnp.linalg.solve(slope + jnp.diag(1 - held) + 1e-12 * stiffest * eye, r)
        return u - jnp.where(jnp.isfinite(change), change, 0)

    def better(s: _Search) -> _Search:
        u = jnp.where(s.plainly, s.u - s.r / stiffest, newton(s.u, s.r, s.slope))
        u = jnp.where(s.tries == 0, s.u, u)
        slope, r = jax.jacfwd(lambda u: (residual(u, *fixed),) * 2, has_aux=True)(u)
        take = s.plainly | (size(r) < size(s.r))
        new = _Search(u, r, slope, jnp.asarray(False), s.tries + 1)
        kept = _Search(s.u, s.r, s.slope, jnp.asarray(True), s.tries + 1)
        return jax.tree.map(partial(jnp.where, take), new, kept)

    def going_on(s: _Search) -> Array:
        return (size(s.r) > CLOSE * told.pressure) & (s.tries < NEWTONS)

    start = _Search(held * fixed[1].free, jnp.full(3, jnp.inf), eye, jnp.asarray(False), jnp.int32(0))
    found = lax.while_loop(going_on, better, start)
    # One more of Newton's steps carries the derivative: du = -slope^-1 dr, as the implicit function has it.
    r = residual(found.u, material, g)
    u = jnp.where(size(r) < HELD * told.pressure, newton(found.u, r, found.slope), found.u)
    return at(u, material, g)._replace(miss=size(lax.stop_gradient(r)))


def figures(curve: Curve, test: str) -> dict[str, float]:
    """What a laboratory would report of a curve, by name with its unit."""
    s, end = curve.stress, -1
    steps = slice(1, None)
    out = {
        "mobilised angle at the end, deg": float(curve.mobilised_deg[end]),
        "largest mobilised angle, deg": float(np.nanmax(curve.mobilised_deg[steps])),
        "largest q/p": float(np.max(curve.q[steps] / np.maximum(curve.p[steps], LEAST_PRESSURE))),
        "p at the end, Pa": float(curve.p[end]),
        "q at the end, Pa": float(curve.q[end]),
    }
    first = curve.strain[1] - curve.strain[0]
    if test == "shear":
        out["shear stress over normal stress at the end"] = float(s[end, 3] / s[end, 1])
        out["shear modulus of the first step, Pa"] = float((s[1, 3] - s[0, 3]) / first)
    else:
        name = "oedometric" if test == "oedometer" else "axial"
        out[f"{name} modulus of the first step, Pa"] = float((s[1, 0] - s[0, 0]) / first)
    if test == "oedometer":
        out["K0 at the end"] = float(s[end, 1] / s[end, 0])
    else:
        half = s[0] + (s[np.argmax(np.abs(curve.q))] - s[0]) / 2
        column = 3 if test == "shear" else 0
        reached = np.argmax(np.abs(s[:, column] - s[0, column]) >= np.abs(half[column] - s[0, column]))
        if reached:
            out["secant modulus at half the strength, Pa"] = float(
                (s[reached, column] - s[0, column]) / (curve.strain[reached] - curve.strain[0])
            )
    out["volume strain at the end, %"] = 100 * float(curve.volume_strain[end])
    return out
