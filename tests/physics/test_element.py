"""Element tests on sand: its strength in each test and with each fit, 2-D beside 3-D, and what is refused."""

from collections.abc import Callable

import jax
import numpy as np
import pytest

from benchmarks.validation.blocks import PARAMETERS, example
from benchmarks.validation.laws import compression, extension, plane, slope
from mpm_env import element
from mpm_env.element import TESTS, Curve
from mpm_env.mpm.materials.sand import FRICTION_FITS

PRESSURE = 2e3  # Pa
ANGLE = 0.01  # degrees off the closed form; 0.003 observed, of plane strain, which creeps to its end
RATIO = 1e-6  # of K0; 1e-9 observed
SAME = 1e-9  # of the pressure: 2-D beside 3-D; 1e-12 observed
TOLD_APART = 0.3  # degrees: what the project promises, and less than any wrong fit is off
K0_PHI = (20.0, 30.0, 35.0)  # degrees; with nu = 0.3 the first two rest at nu / (1 - nu) or just above


CLOSED: dict[str, Callable[[float], float]] = {"triaxial": compression, "biaxial": plane, "shear": plane}


def of_sand(test: str, fit: str, *, phi: float = 30.0, **asked: float) -> Curve:
    material = example("sand", friction_fit=fit, friction=np.deg2rad(phi))
    return element.run(material, test, pressure=PRESSURE, **asked)  # type: ignore[arg-type]


@pytest.mark.parametrize("fit", ["triaxial", "plane_strain"])
@pytest.mark.parametrize("test", CLOSED)
def test_sand_fails_at_the_angle_of_its_fit_in_each_test(test: str, fit: str) -> None:
    for phi in (20.0, 30.0, 35.0):
        expected = CLOSED[test](slope(fit, phi))
        curve = of_sand(test, fit, phi=phi, strain=0.6 if expected > 50 else None, dimension=3)
        assert curve.mobilised_deg[-1] == pytest.approx(expected, abs=ANGLE)
    other = {"triaxial": "plane_strain", "plane_strain": "triaxial"}[fit]
    assert abs(CLOSED[test](slope(other, 30.0)) - CLOSED[test](slope(fit, 30.0))) > TOLD_APART


def test_the_angle_of_a_fit_is_that_of_the_test_it_names() -> None:
    """30 degrees is 30 degrees in the test that it was measured in, 43.9 or 22.2 in the other."""
    angles = {
        fit: [CLOSED[test](slope(fit, 30.0)) for test in ("triaxial", "biaxial")]
        for fit in ("triaxial", "plane_strain")
    }
    np.testing.assert_allclose(angles["triaxial"], (30, 43.85), atol=0.005)
    np.testing.assert_allclose(angles["plane_strain"], (22.23, 30), atol=0.005)


def test_triaxial_extension_has_the_same_cone() -> None:
    curve = of_sand("triaxial", "triaxial", strain=-0.1)
    assert curve.mobilised_deg[-1] == pytest.approx(extension(slope("triaxial", 30.0)), abs=ANGLE)
    assert extension(slope("triaxial", 30.0)) == pytest.approx(48.6, abs=0.05)


@pytest.mark.parametrize("test", ["biaxial", "shear"])
def test_two_dimensional_mohr_coulomb_fails_at_its_angle_at_once(test: str) -> None:
    """And at the strain where the others have still some way to go."""
    for phi in (20.0, 30.0, 40.0):
        assert of_sand(test, "mc2d", phi=phi).mobilised_deg[-1] == pytest.approx(phi, abs=ANGLE)
    early = {fit: of_sand(test, fit, strain=0.015).mobilised_deg[-1] for fit in ("mc2d", "plane_strain")}
    assert early["mc2d"] == pytest.approx(30, abs=ANGLE) and abs(early["plane_strain"] - 30) > ANGLE, early
    # The negative control: the fit of triaxial compression in the plane alone is 27.5 degrees for 30.
    wrong = np.rad2deg(np.arcsin(np.sqrt(2) * FRICTION_FITS["triaxial"](0.5)))
    assert wrong == pytest.approx(27.51, abs=0.01) and abs(wrong - 30) > TOLD_APART


@pytest.mark.parametrize("fit", ["triaxial", "plane_strain"])
@pytest.mark.parametrize("test", [name for name, kind in TESTS.items() if kind.plane_strain])
def test_plane_strain_is_the_same_sand_as_3d(test: str, fit: str) -> None:
    """All stresses, that across the plane too, all the way."""
    flat, full = (of_sand(test, fit, dimension=d) for d in (2, 3))
    np.testing.assert_allclose(flat.stress, full.stress, rtol=0, atol=SAME * PRESSURE)
    np.testing.assert_allclose(flat.volume_strain, full.volume_strain, rtol=0, atol=SAME)
    across = flat.stress[:, 2]
    if test == "biaxial":  # Hooke at the start, midway at the end
        np.testing.assert_allclose(across[0], 0.3 * (flat.stress[0, 0] + flat.stress[0, 1]), rtol=1e-2)
        np.testing.assert_allclose(across[-1], (flat.stress[-1, 0] + flat.stress[-1, 1]) / 2, rtol=1e-3)


@pytest.mark.parametrize("fit", ["triaxial", "plane_strain", "mc2d"])
def test_oedometer_rests_at_the_larger_of_the_elastic_and_the_active_pressure(fit: str) -> None:
    nu = PARAMETERS["sand"]["nu"]
    for phi in K0_PHI:
        angle = phi if fit == "mc2d" else compression(slope(fit, phi))
        sin = np.sin(np.deg2rad(angle))
        s = of_sand("oedometer", fit, phi=phi, dimension=2).stress[-1]
        assert s[1] / s[0] == pytest.approx(max(nu / (1 - nu), (1 - sin) / (1 + sin)), rel=RATIO)
        if fit != "mc2d":
            assert s[2] == pytest.approx(s[1], rel=RATIO)


def test_held_stress_is_held_and_the_volume_is_the_lengths() -> None:
    curve = of_sand("triaxial", "triaxial")
    np.testing.assert_allclose(curve.stress[:, 1:3], PRESSURE, rtol=1e-6)
    # Flow on the cone keeps the volume: at failure the mean stress, and so the volume, no longer changes.
    assert abs(curve.volume_strain[-1] - curve.volume_strain[-100]) < 1e-9
    K = PARAMETERS["sand"]["E"] / (3 * (1 - 2 * PARAMETERS["sand"]["nu"]))
    squeezed = np.array([0.0, 0.0])  # when settled and at the end: K times it is the Kirchhoff pressure p J
    for _ in range(30):
        squeezed = np.array([PRESSURE, curve.p[-1]]) * np.exp(-squeezed) / K
    assert curve.volume_strain[-1] == pytest.approx(squeezed[1] - squeezed[0], rel=RATIO)


def test_figures_say_what_the_curve_holds() -> None:
    found = element.figures(of_sand("triaxial", "triaxial"), "triaxial")
    assert found["mobilised angle at the end, deg"] == pytest.approx(30, abs=ANGLE)
    assert found["largest q/p"] == pytest.approx(1.2, rel=1e-5)
    assert found["axial modulus of the first step, Pa"] == pytest.approx(PARAMETERS["sand"]["E"], rel=0.02)
    rest = element.figures(of_sand("oedometer", "triaxial"), "oedometer")
    assert rest["K0 at the end"] == pytest.approx(3 / 7, rel=RATIO)


REFUSED = {
    "traxial": ({}, "There is no test 'traxial'"),
    "triaxial": ({"dimension": 2}, "it needs dimension 3"),
    "biaxial": ({"pressure": -1.0}, "pressure should be positive and finite, got -1.0 Pa"),
    "shear": ({"rate": 0.0}, "rate should be positive and finite, got 0.0 1/s"),
    "oedometer": ({"strain": 0.0}, "strain should lie between -3 and 3 and not be 0, got 0.0"),
}


@pytest.mark.parametrize("test", REFUSED)
def test_senseless_test_is_refused_in_one_sentence(test: str) -> None:
    asked, sentence = REFUSED[test]
    with pytest.raises(ValueError, match=sentence):
        element.run(example("sand"), test, **asked)


def test_pressure_that_a_material_cannot_bear_is_refused() -> None:
    """Snow's elastic strains are bounded: unpacked, it bears 5 kPa and no more."""
    with pytest.raises(ValueError, match="cannot bear 1e\\+06 Pa along y and z"):
        element.run(example("snow", xi=0.0), "triaxial", pressure=1e6, steps=20)


def test_plane_strain_fit_is_refused_in_3d() -> None:
    with pytest.raises(ValueError, match="'mc2d' knows plane strain only"):
        element.run(example("sand", friction_fit="mc2d"), "triaxial", steps=20)


@pytest.mark.slow
def test_path_has_the_derivative_of_what_it_solves_for() -> None:
    """Of the biaxial stress by Young's modulus and friction, beside differences."""
    kind, steps = TESTS["biaxial"], 40
    with jax.enable_x64(True):
        drive = element.driven(kind, steps, PRESSURE, 0.02, 1.0)

        def q(theta: jax.Array) -> jax.Array:
            material = example("sand", "float64", E=theta[0] * 1e6, friction=theta[1])
            return element.path(2, material, drive)[1][-steps:, 0]

        at = jax.numpy.asarray([0.35, 0.5])
        exact = np.asarray(jax.jit(jax.jacfwd(q))(at))
        h = 1e-6
        for k in range(2):
            side = np.eye(2)[k] * h
            difference = (np.asarray(q(at + side)) - np.asarray(q(at - side))) / (2 * h)
            np.testing.assert_allclose(exact[:, k], difference, rtol=0, atol=1e-4 * np.abs(difference).max())
        assert np.abs(exact).max(axis=0).min() > 1e2
