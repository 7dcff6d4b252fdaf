"""Snow after S13: vectors of the return mapping and the closed form of confined compression."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.validation.blocks import PARAMETERS, example, update
from mpm_env.mpm.materials import Material
from tests.physics.oracles import lame

VECTOR = {"float32": 2e-6, "float64": 3e-10}  # relative; 4e-7, 6e-11 (the digits given) observed
CURVE = {"float32": 4e-6, "float64": 4e-13}  # relative to the closed form after 400 steps; 7e-7, 7e-14 observed
TABLE = 5e-3  # relative to the figures of the table, which have three digits; 1e-3 observed

# Trial stretches -> elastic stretches, J_P, stress in Pa. E = 140 kPa, nu = 0.2, theta 2.5 % and 0.75 %, xi = 10.
VECTORS = {
    "elastic": ((0.99, 1, 1.005), (0.99, 1, 1.005), 1.0, (-1350.397125, -195.397125, 390.852875)),
    "compressed": ((0.9, 1, 1), (0.975, 1, 1), 0.9230769231, (-8182.8168162, -2045.7042041, -2045.7042041)),
    "even": ((0.9, 0.9, 0.9), (0.975, 0.975, 0.975), 0.7865270824, (-46332.6533030,) * 3),
    "stretched": ((1.05, 1, 1), (1.0075, 1, 1), 1.0421836228, (770.8869579, 192.7217395, 192.7217395)),
}


def mapped(material: Material, e: np.ndarray, lnJp: float, dtype: str) -> tuple[np.ndarray, float, np.ndarray]:
    with jax.enable_x64(dtype == "float64"):
        out = update(material, jnp.asarray(e, dtype)[:, None], jnp.full((1, 1), lnJp, dtype))
    return np.array(out[0][:, 0], np.float64), float(out[1][0, 0]), np.array(out[2][:, 0], np.float64)


@pytest.mark.parametrize("case", VECTORS)
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_return_mapping_gives_the_vectors(case: str, d: int, dtype: str) -> None:
    trial, stretch, Jp, tau = VECTORS[case]
    with jax.enable_x64(dtype == "float64"):
        material = example("snow", dtype)
    rest = [0.0] * (1 if d == 2 else 3)
    e, lnJp, got = mapped(material, np.array([*(np.square(trial) - 1), *rest]), 0.0, dtype)
    np.testing.assert_allclose(np.sqrt(1 + e[:3]), stretch, rtol=VECTOR[dtype])
    np.testing.assert_allclose(np.exp(lnJp), Jp, rtol=VECTOR[dtype])
    np.testing.assert_allclose(got[:3], tau, rtol=0, atol=VECTOR[dtype] * np.abs(tau).max())
    np.testing.assert_allclose(got[3:], 0, atol=VECTOR[dtype])


# Confined compression to the volume ratio J -> vertical Cauchy stress in kPa and sound speed in m/s.
CURVE_TABLE = {
    0.975: (3.89, 19.7), 0.95: (5.16, 22.4), 0.9: (9.09, 29.0), 0.85: (16.08, 37.4), 0.8: (28.53, 48.4),
    0.7: (90.92, 80.8), 0.6: (295.8, 134.9),
}  # fmt: skip


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_confined_compression_follows_its_closed_form(dtype: str) -> None:
    """Axial elastic stretch 1 - theta_c once it yields, J_P = J / (1 - theta_c); driven in steps of 0.1 %."""
    given = PARAMETERS["snow"]
    lam, mu = lame(given["E"], given["nu"])
    with jax.enable_x64(dtype == "float64"):
        material = example("snow", dtype)
    e, lnJp, J = np.zeros(6), 0.0, 1.0
    s = 1 - given["theta_c"]
    for target, (kPa, _) in CURVE_TABLE.items():
        steps = round((J - target) / 1e-3)
        for k in range(steps):
            ratio = (J - (J - target) * (k + 1) / steps) / (J - (J - target) * k / steps)
            e[0] = (1 + e[0]) * ratio**2 - 1
            e, lnJp, tau = mapped(material, e, lnJp, dtype)
        J = target
        h = np.exp(given["xi"] * (1 - J / s))
        cauchy = h * (2 * mu * (s - 1) * s + lam * (s - 1) * s) / J
        np.testing.assert_allclose(tau[0] / J, cauchy, rtol=CURVE[dtype])
        np.testing.assert_allclose(-tau[0] / J / 1e3, kPa, rtol=TABLE)


@pytest.mark.parametrize("J", CURVE_TABLE)
def test_wave_speed_at_the_hardening_bound_is_the_tables(J: float) -> None:
    bound = min(J / (1 - PARAMETERS["snow"]["theta_c"]), 1.0)
    np.testing.assert_allclose(float(example("snow", Jp_min=bound).wave_speed()), CURVE_TABLE[J][1], rtol=TABLE)


def test_hardening_stops_at_its_bound() -> None:
    """The control of the curve: at J_P = 0.6 a bound of 0.8 answers with the factor of 0.8."""
    squeezed = np.array([0.97**2 - 1, 0, 0, 0, 0, 0])
    hard, bounded = (mapped(example("snow", Jp_min=m), squeezed, np.log(0.6), "float32")[2][0] for m in (0.1, 0.8))
    Jp = 0.6 * 0.97 / (1 - PARAMETERS["snow"]["theta_c"])
    np.testing.assert_allclose(hard / bounded, np.exp(10 * (0.8 - Jp)), rtol=1e-5)
