"""Closed forms of the further constitutive models: metal, mud, mu(I), Cam-Clay; and snow's compaction."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.validation.blocks import PARAMETERS, example, update
from mpm_env import element
from mpm_env.mpm.materials import Material
from tests.physics.oracles import lame

LINE = 1e-6  # of the yield stress; 1e-8 observed, the confining pressure's share
LAW = 1e-3  # of the flow law; 2e-4 observed: elastic strain turns with the flow, to second order in it
FRICTION = 1e-3  # of mu(I); 3e-4 observed, the same
FIRST_ORDER = 0.15  # of the order of convergence
LAG = 0.02  # of the step by which Cam-Clay's strength lags behind, and of its strength; 1e-3 observed
CRITICAL = 2e-3  # of its critical state
STEP = 1e-4  # strain


def sheared(name: str, *, pressure: float = 1e4, rate: float = 1.0, **changes: float) -> element.Curve:
    return element.run(example(name, **changes), "shear", pressure=pressure, rate=rate, steps=400, dimension=2)


# Metal


@pytest.mark.parametrize("hardening", [0.0, 1e5])
def test_metal_under_tension_and_compression_follows_two_straight_lines(hardening: float) -> None:
    """Kirchhoff stress over log strain: E up to the yield stress, then E H / (E + H)."""
    given = PARAMETERS["von_mises"]
    E, yields = given["E"], given["yield_stress"]
    for way in (0.1, -0.1):
        curve = element.run(example("von_mises", hardening=hardening), "triaxial", pressure=1e-3, strain=way, steps=200)
        eps = np.abs(curve.strain)
        after = yields + E * hardening / (E + hardening) * (eps - yields / E)
        expected = np.where(E * eps < yields, E * eps, after)
        kirchhoff = curve.q * np.exp(-curve.volume_strain)
        np.testing.assert_allclose(kirchhoff, expected, rtol=0, atol=LINE * yields)
    assert expected[-1] / yields == pytest.approx(1 if hardening == 0 else 1.36, abs=0.01)


def test_metal_in_shear_yields_at_its_stress_over_root_three() -> None:
    curve = sheared("von_mises", hardening=0.0, pressure=1.0)
    assert curve.q[-1] == pytest.approx(PARAMETERS["von_mises"]["yield_stress"], rel=LAW)
    assert abs(curve.stress[-1, 3]) == pytest.approx(PARAMETERS["von_mises"]["yield_stress"] / np.sqrt(3), rel=LAW)


# Mud

STIFF = {"E": 1e8}  # Pa: elastic strain of 1e-5, so that flow is all there is


@pytest.mark.parametrize("index", [0.3, 0.5, 1.0, 1.7])
def test_mud_in_shear_follows_herschel_and_bulkley(index: float) -> None:
    given = PARAMETERS["herschel_bulkley"]
    for rate in (0.1, 10.0, 100.0):
        s = sheared("herschel_bulkley", flow_index=index, rate=rate, **STIFF).stress[-1, 3]
        assert s == pytest.approx(given["yield_stress"] + given["consistency"] * rate**index, rel=LAW)


def test_mud_without_hurry_bears_its_yield_stress_and_without_one_is_newtons() -> None:
    slow = sheared("herschel_bulkley", rate=1e-9, **STIFF).stress[-1, 3]
    assert slow == pytest.approx(PARAMETERS["herschel_bulkley"]["yield_stress"], rel=LAW)
    for rate in (1.0, 2.0):
        fluid = sheared("herschel_bulkley", yield_stress=0.0, flow_index=1.0, rate=rate, **STIFF).stress[-1, 3]
        assert fluid == pytest.approx(PARAMETERS["herschel_bulkley"]["consistency"] * rate, rel=LAW)


def relaxed(material: Material, deviator: float, dt: float, steps: int) -> float:
    """Norm of the stress deviator in Pa after steps of dt s, from a norm of `deviator` Pa."""
    _, mu = lame(float(material.E), float(material.nu))
    eps = deviator / (2 * mu) * np.array([1, -1, 0]) / np.sqrt(2)
    e, history = jnp.asarray([*np.expm1(2 * eps), 0.0, 0.0, 0.0])[:, None], jnp.zeros((0, 1))
    for _ in range(steps):
        e, history, tau = update(material, e, history, dt)
    return float(np.linalg.norm(np.asarray(tau[:3, 0]) - np.asarray(tau[:3, 0]).mean()))


@pytest.mark.parametrize(("viscosity", "expected"), [(10.0, 102.380952), (100.0, 116.666667)])
def test_mud_gives_the_published_step(viscosity: float, expected: float) -> None:
    """Y15 for flow index 1 in norms of the deviator: yield at 100, trial at 150, mu = 1e5, dt = 1e-3."""
    with jax.enable_x64(True):
        shear = {"yield_stress": 100 / np.sqrt(2), "consistency": viscosity / 2, "flow_index": 1.0}
        mud = example("herschel_bulkley", "float64", E=2.6e5, nu=0.3, **shear)
        assert relaxed(mud, 150.0, 1e-3, 1) == pytest.approx(expected, rel=1e-8)


def test_maxwell_fluid_relaxes_exponentially_to_first_order_in_the_step() -> None:
    with jax.enable_x64(True):
        fluid = example(
            "herschel_bulkley", "float64", E=2.6e5, nu=0.3, yield_stress=0.0, consistency=1e3, flow_index=1.0
        )
        exact = 100 * np.exp(-0.02 * 1e5 / 1e3)
        errors = [abs(relaxed(fluid, 100.0, 0.02 / n, n) - exact) for n in (20, 40, 80)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 1, atol=FIRST_ORDER)


# mu(I)


@pytest.mark.parametrize("pressure", [100.0, 1e4])
def test_grains_in_shear_follow_mu_of_i(pressure: float) -> None:
    """The stress ratio of steady shear; at rest that of mu_s, in a hurry mu_2, and in between the law to 0.1 %."""
    g = PARAMETERS["mu_i"]
    for inertial in (1e-9, 0.01, 0.1, 0.28, 1.0, 1e6):
        rate = inertial / g["grain_size"] * np.sqrt(pressure / g["grain_density"])
        curve = sheared("mu_i", pressure=pressure, rate=rate, E=1e8)
        # p is that of the grains themselves: across the plane the stress is the same.
        inertial = rate * g["grain_size"] * np.sqrt(g["grain_density"] / curve.p[-1])
        expected = g["mu_s"] + (g["mu_2"] - g["mu_s"]) / (1 + g["I_0"] / inertial)
        assert curve.q[-1] / np.sqrt(3) / curve.p[-1] == pytest.approx(expected, rel=FRICTION)
        assert curve.stress[-1, 3] / curve.stress[-1, 1] == pytest.approx(expected, rel=5 * FRICTION)


def test_separated_grains_touch_nobody_and_close_their_gap_first() -> None:
    material = example("mu_i")
    _, history, tau = update(material, jnp.asarray([0.02, 0, 0, 0, 0, 0])[:, None], jnp.zeros((1, 1)), 1e-4)
    np.testing.assert_array_equal(tau, 0)
    assert float(history[0, 0]) == pytest.approx(0.5 * np.log(1.02), rel=1e-5)
    squeeze = jnp.asarray([np.expm1(2 * -0.005), 0, 0, 0, 0, 0])[:, None]
    assert float(jnp.abs(update(material, squeeze, history, 1e-4)[2]).max()) == 0
    assert float(update(material, squeeze, jnp.zeros((1, 1)), 1e-4)[2][0, 0]) < -1e3


# Cam-Clay


@jax.jit
def strained(material: Material, steps: jax.Array, e: jax.Array, history: jax.Array) -> tuple[jax.Array, ...]:
    """Principal stresses (n, 3) Pa after each of the log strain increments (n, 3), the last e, and all lnJp (n,)."""

    def one(state: tuple[jax.Array, jax.Array], step: jax.Array) -> tuple[tuple[jax.Array, jax.Array], Any]:
        e, history = state
        trial = e.at[:3].set((1 + e[:3]) * jnp.exp(2 * step)[:, None] - 1)
        e, history, tau = material.update(trial, history, 0.0)
        return (e, history), (tau[:3, 0], history[0, 0])

    (e, _), (tau, lnJp) = jax.lax.scan(one, (e, history), steps)
    return tau, e, lnJp


def packed_to(material: Material, strain: float, step: float = STEP) -> tuple[np.ndarray, jax.Array, np.ndarray]:
    """Even compression by a log strain of volume: pressures (n,) Pa, the last e and lnJp (n,)."""
    n = round(strain / step)
    tau, e, lnJp = strained(material, jnp.full((n, 3), -strain / n / 3), jnp.zeros((6, 1)), jnp.zeros((1, 1)))
    return -np.asarray(tau).mean(axis=1), e, np.asarray(lnJp)


def test_clay_under_even_pressure_hardens_on_its_closed_form() -> None:
    """Log strain = p / K elastic + asinh(p / K) / xi - compaction plastic, once p has reached p0; a step behind it."""
    given = PARAMETERS["cam_clay"]
    lam, mu = lame(given["E"], given["nu"])
    K = lam + 2 * mu / 3
    with jax.enable_x64(True):
        clay = example("cam_clay", "float64")
        first = np.sinh(given["xi"] * given["compaction"])  # p0 / K at the start
        errors = []
        for step in (4 * STEP, 2 * STEP, STEP):
            p, _, lnJp = packed_to(clay, 0.4, step)
            strain = step * np.arange(1, len(p) + 1)
            soft = strain < 0.99 * first
            np.testing.assert_allclose(p[soft], K * strain[soft], rtol=1e-9)
            yields = strain > 1.1 * first
            exact = p / K + np.arcsinh(p / K) / given["xi"] - given["compaction"]
            errors.append(np.abs(exact - strain)[yields].max())
            np.testing.assert_allclose(lnJp, -(strain - p / K), atol=1e-12)
    np.testing.assert_allclose(errors, (4 * STEP, 2 * STEP, STEP), rtol=LAG)


def test_clay_sheared_at_constant_volume_comes_to_its_critical_state_from_both_sides() -> None:
    """q/p = M (1 + beta) / ((1 - beta) sqrt(1 + 2 beta)) and p0 = 2 p / (1 - beta), loose or dense before."""
    given = PARAMETERS["cam_clay"]
    beta = given["beta"]
    critical = given["M"] * (1 + beta) / ((1 - beta) * np.sqrt(1 + 2 * beta))
    lam, mu = lame(given["E"], given["nu"])
    K = lam + 2 * mu / 3
    with jax.enable_x64(True):
        clay = example("cam_clay", "float64")
        peaks = {}
        for start, back in (("loose", 0.0), ("dense", 0.75)):
            p, e, lnJp = packed_to(clay, 0.3)
            let_go = jnp.full((100, 3), back * p[-1] / K / 300)  # elastically
            _, e, _ = strained(clay, let_go, e, jnp.full((1, 1), lnJp[-1]))
            shear = jnp.tile(STEP * jnp.asarray([-2.0, 1.0, 1.0]), (20_000, 1))
            tau, _, lnJp_end = strained(clay, shear, e, jnp.full((1, 1), lnJp[-1]))
            tau = np.asarray(tau)
            q, p = np.abs(tau[:, 0] - tau[:, 1]), -tau.mean(axis=1)
            np.testing.assert_allclose(p, p[0], rtol=1e-9)
            p0 = float(clay.strength(lnJp_end[None, -1]))
            assert q[-1] / p[-1] == pytest.approx(critical, rel=CRITICAL)
            assert p0 == pytest.approx(2 * p[-1] / (1 - beta), rel=CRITICAL)
            peaks[start] = q.max() / p[-1]
    assert peaks["loose"] < 1.001 * critical and peaks["dense"] > 1.1 * critical, peaks


def test_clay_tears_at_its_tension_and_crumbles() -> None:
    given = PARAMETERS["cam_clay"]
    lam, mu = lame(given["E"], given["nu"])
    with jax.enable_x64(True):
        clay = example("cam_clay", "float64")
        pull = jnp.full((4000, 3), STEP / 3)
        tau, _, lnJp = strained(clay, pull, jnp.zeros((6, 1)), jnp.zeros((1, 1)))
    tension = np.asarray(tau).mean(axis=1)
    K = lam + 2 * mu / 3
    assert tension.max() == pytest.approx(given["beta"] * K * np.sinh(given["xi"] * given["compaction"]), rel=LAG)
    assert tension[-1] == 0 and float(lnJp[-1]) > given["compaction"]


# Snow


def test_snow_hardens_monotonely_in_the_oedometer() -> None:
    """The closed form of test_snow once more, through the driver: compaction to J = 0.6 in 500 steps."""
    given = PARAMETERS["snow"]
    lam, mu = lame(given["E"], given["nu"])
    curve = element.run(example("snow"), "oedometer", strain=-np.log(0.6), steps=500)
    s, J = 1 - given["theta_c"], np.exp(-curve.strain)
    yields = s > J
    h = np.exp(given["xi"] * (1 - J / s))
    cauchy = -h * (2 * mu * (s - 1) * s + lam * (s - 1) * s) / J
    np.testing.assert_allclose(curve.stress[yields, 0], cauchy[yields], rtol=1e-6)
    assert np.all(np.diff(curve.stress[:, 0]) > 0)
    assert curve.stress[-1, 0] == pytest.approx(295.8e3, rel=1e-3)
