"""What motion keeps: mass, momentum, angular momentum with its affine part; free fall; the energy of a rigid turn."""

import numpy as np
import pytest

from benchmarks.validation.blocks import GRAVITY, alive, balance
from benchmarks.validation.motion import BLOCKS, fallen, kept, turned

MASS = 1e-6  # float32 sums of weights; 0 observed, since grains carry their mass
MOMENTUM = 1e-6  # of M omega R after 1000 steps; 4e-7 observed
ANGULAR = 1e-5  # 3e-9 per step, rounding of D = dx^2/4 and of the weights; 3e-6 observed
ROUNDING = 1e-13  # float64, 1000 steps; 2e-15 observed
PIC_LOSES = 0.5  # without its affine part the same block loses at least this share; all of it observed
FALL = 1e-5  # relative, 1 s in float32; 2e-6 observed
TURN_LOSS = (0.0, 1e-3)  # kinetic energy of a 1 m block, one rad/s, 20 s: 1.6e-4 observed, gone into rim and sound


@pytest.mark.parametrize("d", BLOCKS)
def test_thousand_steps_keep_mass_and_both_momenta(d: int) -> None:
    k = kept(d)
    assert k.mass <= MASS
    assert k.momentum <= MOMENTUM
    assert k.angular <= ANGULAR


@pytest.mark.parametrize("d", BLOCKS)
def test_without_the_affine_part_angular_momentum_is_lost(d: int) -> None:
    """The negative control: the same block under PIC."""
    k = kept(d, affine=0.0)
    assert k.after.angular_momentum[2] < (1 - PIC_LOSES) * k.before.angular_momentum[2]
    assert k.momentum <= MOMENTUM


def test_float64_keeps_momenta_to_its_own_rounding() -> None:
    k = kept(2, dtype="float64")
    assert max(k.mass, k.momentum, k.angular) <= ROUNDING


@pytest.mark.parametrize("name", ["sand", "elastic"])
def test_free_fall_is_symplectic_eulers_to_the_step(name: str) -> None:
    n, dt = 1000, 1e-3
    fell, expected = fallen(name, n, dt)
    np.testing.assert_allclose(fell[1], -expected, rtol=FALL)
    np.testing.assert_allclose(fell[0], 0, atol=FALL * expected)
    # The control: the exact parabola, half a step off, is told apart.
    assert abs(expected / (GRAVITY * (n * dt) ** 2 / 2) - 1) > 10 * FALL


def test_rigid_turn_of_twenty_seconds_keeps_its_energy() -> None:
    """1 x 1 m, E = 1 MPa, nu = 0.3, 1550 kg/m^3, 1 rad/s, 12 cells: 3.2 turns in 17 600 steps."""
    grid, material, p, q = turned(20.0)
    before, after = balance(grid, material, p), balance(grid, material, q)
    loss = 1 - after.kinetic / before.kinetic
    assert TURN_LOSS[0] <= loss <= TURN_LOSS[1]
    assert after.kinetic + after.elastic <= before.kinetic
    # The control: it has turned, by omega T = 20 rad.
    x, y = (np.asarray(a.x, np.float64)[:, alive(p)] for a in (p, q))
    x, y = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
    angle = np.arctan2(np.sum(x[0] * y[1] - x[1] * y[0]), np.sum(x * y))
    assert abs((angle - 20 + np.pi) % (2 * np.pi) - np.pi) < 0.02
