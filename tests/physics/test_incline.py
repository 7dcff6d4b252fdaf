"""Coulomb friction of a wall: a block on an incline, made by tilting gravity over a level floor."""

import numpy as np

from benchmarks.validation.blocks import GRAVITY, block, box, example, go, lattice, longest_step
from mpm_env.mpm.types import Wall

FRICTION_DEG = 15.0
SLIDE = 1e-3  # relative after 5 s; 5.7e-4 observed, nearly all of it the first 2 ms until the block's base is sheared
STAYS = 1e-4  # m in 1 s; 0 observed
CELL = 0.025  # m; the block is 4 x 2 cells of 4 grains


def slid(
    slope_deg: float, duration: float, *, friction_deg: float = FRICTION_DEG, settle: int = 0, length: float = 0.6
) -> float:
    """How far in m a 0.1 x 0.05 m elastic block (1 MPa) slides down in the time.

    `settle` steps without the affine part come first: they let it come to rest under its own weight.
    """
    grid = box((round(length / CELL), 6), CELL, lower=Wall("separate", float(np.tan(np.deg2rad(friction_deg)))))
    material = example("elastic")
    p = block(grid, material, lattice((4 * CELL, 0.0), (8, 4), CELL / 2), volume=(CELL / 2) ** 2)
    slope = np.deg2rad(slope_deg)
    gravity = (GRAVITY * np.sin(slope), -GRAVITY * np.cos(slope))
    dt = 0.5 * longest_step(grid, material)
    p = go(grid, material, p, dt=dt, steps=settle, gravity=gravity, affine=0.0)
    q = go(grid, material, p, dt=dt, steps=round(duration / dt), gravity=gravity)
    return float(np.mean(np.asarray(q.x[0], np.float64) - np.asarray(p.x[0], np.float64)))


def test_block_slides_as_coulomb_says() -> None:
    """24 degrees, friction angle 15: g t^2/2 (sin - mu cos) = 19.8595 m in 5 s."""
    slope, mu = np.deg2rad(24), np.tan(np.deg2rad(FRICTION_DEG))
    expected = GRAVITY * 5**2 / 2 * (np.sin(slope) - mu * np.cos(slope))
    np.testing.assert_allclose(expected, 19.8595, rtol=1e-5)
    np.testing.assert_allclose(slid(24, 5.0, length=21.0), expected, rtol=SLIDE)


def test_block_below_the_friction_angle_stays() -> None:
    assert abs(slid(14.5, 1.0, settle=4000)) <= STAYS


def test_block_above_the_friction_angle_goes() -> None:
    """The negative control of the block that stays."""
    assert slid(15.5, 1.0, settle=4000) > 100 * STAYS
