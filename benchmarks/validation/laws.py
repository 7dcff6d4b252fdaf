"""What one grain answers: the laboratory's tests on sand and snow, and trials with known answers.

python -m benchmarks.validation.laws [--quick]
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import case, job, part
from benchmarks.case import Case, at_most, within
from benchmarks.validation.blocks import PARAMETERS, example, update
from mpm_env import element
from mpm_env.mpm.materials.protocol import lame

PRESSURE = 2e3  # Pa
ANGLES = (20.0, 25.0, 30.0, 35.0)  # degrees
KLAR, CONE, STOMAKHIN = "Klar et al. 2016", "closed form of the cone", "Stomakhin et al. 2013, closed form"
VOLUMES = (0.975, 0.95, 0.9, 0.8, 0.7, 0.6)  # volume ratios to which snow is squeezed

SHEAR = [[1, 0.05, 0], [0, 0.97, 0], [0, 0, 1]]


class Vector(NamedTuple):
    """A trial, and the principal log strains, volume correction and stress (xx, yy, zz, xy) that answer it."""

    F: np.ndarray
    vc: float
    H: tuple[float, float, float]  # ascending
    vc_new: float
    tau: tuple[float, float, float, float]


# E = 353.7 kPa, nu = 0.3, 30 degrees in triaxial compression (K16 section 6.3, volume correction of T17).
# C3 has its strains along x, y, z; those given are sorted.
VECTORS = {
    "elastic": Vector(
        np.diag([0.99, 0.985, 0.99]), 0, (-0.0151136, -0.0100503, -0.0100503), 0,
        (-9920.2151912, -11297.8228081, -9920.2151912, 0),
    ),
    "tip": Vector(np.diag([1.02, 1, 0.99]), 0, (0, 0, 0), 0.0097522914, (0, 0, 0, 0)),
    "cone": Vector(
        np.diag([1.01, 0.95, 1]), 0, (-0.0491986308, -0.0007695217, 0.0086251890), 0,
        (-6089.6348533, -21822.1618313, -8645.7188207, 0),
    ),
    "sheared cone": Vector(
        np.array(SHEAR), 0, (-0.0358265488, -0.0026355716, 0.0080029129), 0,
        (-6804.1061061, -13196.9343159, -6932.5137963, 5033.314418),
    ),
    "correction consumed": Vector(0.995 * np.eye(3), 0.03, (0, 0, 0), 0.0149623745, (0, 0, 0, 0)),
    "corrected cone": Vector(
        np.diag([1, 0.93, 1]), 0.02, (-0.0630848314, 0.0052570693, 0.0052570693), 0,
        (-9297.1270278, -27891.3810835, -9297.1270278, 0),
    ),
}  # fmt: skip


def slope(fit: str, phi: float) -> float:
    """q/p of the cone in triaxial compression, from what each fit promises of the angle phi in degrees."""
    sin = np.sin(np.deg2rad(phi))
    return float({"triaxial": 6 * sin / (3 - sin), "plane_strain": np.sqrt(3) * sin}[fit])


def compression(M: float) -> float:
    """Angle in degrees that a cone of this slope has in triaxial compression."""
    return float(np.rad2deg(np.arcsin(3 * M / (6 + M))))


def extension(M: float) -> float:
    """In triaxial extension."""
    return float(np.rad2deg(np.arcsin(3 * M / (6 - M))))


def plane(M: float) -> float:
    """In plane strain, once it flows."""
    return float(np.rad2deg(np.arcsin(M / np.sqrt(3))))


def answered(v: Vector, dtype: str) -> float:
    """How far the stress that answers a trial is off, over the largest there (or 10 kPa, where all is nil)."""
    with jax.enable_x64(dtype == "float64"):
        b = v.F @ v.F.T - np.eye(3)
        e = jnp.asarray(np.array([b[0, 0], b[1, 1], b[2, 2], b[1, 2], b[0, 2], b[0, 1]])[:, None], dtype)
        _, _, tau = update(example("sand", dtype), e, jnp.full((1, 1), v.vc, dtype))
    got = np.asarray(tau, np.float64)[[0, 1, 2, 5], 0]
    return float(np.abs(got - v.tau).max() / (np.abs(v.tau).max() or 1e4))


def asked(name: str, why: str, reference: float, share: float, value: float, told: str, began: float) -> Case:
    """A case of so small a share."""
    return Case(name, why, reference, within(reference, share), float(value), told, time.process_time() - began)


def strengths() -> list[Case]:
    """Friction angles in degrees that sand shows in each test."""
    out = []
    for phi in ANGLES:
        law = example("sand", friction=np.deg2rad(phi))
        M = slope("triaxial", phi)
        for test, why, angle, strain in (
            ("triaxial", KLAR, compression(M), None),
            ("triaxial", CONE, extension(M), -0.1),
            ("biaxial", CONE, plane(M), 0.6),
        ):
            began = time.process_time()
            got = element.run(law, test, pressure=PRESSURE, strain=strain).mobilised_deg[-1]
            name = f"{test} {'extension' if strain == -0.1 else 'compression'}, phi {phi:g}: angle, degrees"
            out.append(asked(name, why, angle, 1e-3, got, "one grain, f64", began))
        began = time.process_time()
        fitted = example("sand", friction=np.deg2rad(phi), friction_fit="plane_strain")
        got = element.run(fitted, "biaxial", pressure=PRESSURE, strain=0.6).mobilised_deg[-1]
        name = f"biaxial compression of its fit, phi {phi:g}: angle, degrees"
        out.append(asked(name, "its own angle", phi, 1e-3, got, "one grain, f64", began))
    return out


def squeezed_sand() -> list[Case]:
    """K0 of sand in the oedometer, held by its walls or at failure."""
    out = []
    for phi, nu in ((30.0, 0.3), (20.0, 0.1)):
        began, sin = time.process_time(), np.sin(np.deg2rad(phi))
        s = element.run(example("sand", friction=np.deg2rad(phi), nu=nu), "oedometer").stress[-1]
        k0 = max(nu / (1 - nu), (1 - sin) / (1 + sin))
        out.append(asked(f"oedometer, nu {nu:g}: K0", CONE, k0, 1e-3, s[1] / s[0], "one grain, f64", began))
    return out


def squeezed_snow() -> Case:
    """Snow in the oedometer: how far its stress is off the closed form, at worst.

    The axial elastic stretch is 1 - theta_c once it yields, and J_P = J / (1 - theta_c).
    """
    began, given = time.process_time(), PARAMETERS["snow"]
    curve = element.run(example("snow"), "oedometer", strain=-float(np.log(min(VOLUMES))))
    (lam, mu), s = lame(given["E"], given["nu"]), 1 - given["theta_c"]
    J = np.array(VOLUMES)
    closed = np.exp(given["xi"] * (1 - J / s)) * (2 * mu + lam) * (1 - s) * s / J
    got = np.interp(-np.log(J), curve.strain, curve.stress[:, 0])
    off, told = float(np.abs(got / closed - 1).max()), f"J = {VOLUMES[0]:g} to {VOLUMES[-1]:g}, f64"
    name = "snow in the oedometer: stress off, at worst"
    return Case(name, STOMAKHIN, 0, at_most(1e-2), off, told, time.process_time() - began)


def trials() -> list[Case]:
    """Trials of sand."""
    out = []
    for dtype, bound in (("float32", 1e-5), ("float64", 1e-9)):
        began = time.process_time()
        off = max(answered(v, dtype) for v in VECTORS.values())
        name, told = f"sand, {len(VECTORS)} trials: stress off, at worst", f"one grain, f{dtype[-2:]}"
        out.append(Case(name, KLAR, 0, at_most(bound), off, told, time.process_time() - began))
    return out


def measure(quick: bool) -> dict[str, Any]:
    """All cases; they are small, so quick changes nothing."""
    job.pin(1)
    return {"cases": case.say([*trials(), *strengths(), *squeezed_sand(), squeezed_snow()])}


if __name__ == "__main__":
    part.main("validation_laws", measure, __doc__)
