"""How tools are moved through beds, and how lines and powers are laid through what was measured."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.coupling.fits import exponent, line, smooth
from benchmarks.coupling.scenes import about, soft_travel

SPEED, RAMP = 0.3, 0.05  # m/s, s


def test_a_tool_that_starts_softly_lags_by_half_the_ramp() -> None:
    t = np.linspace(RAMP, 1, 50)
    np.testing.assert_allclose(soft_travel(t, SPEED, RAMP), SPEED * (t - RAMP / 2), rtol=1e-12)


def test_a_tool_that_starts_softly_never_jerks() -> None:
    t = np.linspace(0, 2 * RAMP, 2001)
    speed = np.gradient(soft_travel(t, SPEED, RAMP), t)
    most = np.pi * SPEED / (2 * RAMP)  # of a raised cosine
    assert np.abs(np.diff(speed)).max() / (t[1] - t[0]) < 1.001 * most
    assert abs(speed[0]) < 1e-3 * SPEED


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_turn_about_an_axis_is_scipy_s(axis: str) -> None:
    expected = Rotation.from_euler(axis, 33, degrees=True).as_quat(scalar_first=True)
    np.testing.assert_allclose(about(axis, 33), expected, atol=1e-15)


def test_fits_find_what_made_the_points() -> None:
    x = np.geomspace(0.1, 3, 20)
    assert exponent(x, 7 * x**0.4) == pytest.approx(0.4)
    found = line(x, 2 - 3 * x)
    assert (found.slope, found.start, found.r2) == pytest.approx((-3, 2, 1))
    np.testing.assert_allclose(smooth(np.arange(10.0), np.arange(10.0), 2)[1:-1], np.arange(1, 9))
