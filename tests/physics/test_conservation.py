"""What motion keeps: mass, momentum, angular momentum with its affine part; free fall; the energy of a rigid turn."""

import jax
import numpy as np
import pytest

from mpm_env.mpm.budgets import Budgets
from mpm_env.mpm.materials import Material
from mpm_env.mpm.types import Grid, Particles
from tests.physics.blocks import GRAVITY, alive, balance, block, box, example, go, lattice, longest_step, spinning

MASS = 1e-6  # float32 sums of weights; 0 observed, since grains carry their mass
MOMENTUM = 1e-6  # of M omega R after 1000 steps; 4e-7 observed
ANGULAR = 1e-5  # 3e-9 per step, rounding of D = dx^2/4 and of the weights; 3e-6 observed
ROUNDING = 1e-13  # float64, 1000 steps; 2e-15 observed
PIC_LOSES = 0.5  # without its affine part the same block loses at least this share; all of it observed
FALL = 1e-5  # relative, 1 s in float32; 2e-6 observed
TURN_LOSS = (0.0, 1e-3)  # kinetic energy of a 1 m block, one rad/s, 20 s: 1.6e-4 observed, gone into rim and sound

OMEGA = 5.0  # rad/s
STEPS = 1000
BLOCKS = {
    2: (box((24, 24), 1 / 12), lattice((0.5, 0.5), (24, 24), 1 / 24)),  # 1 m wide, three slots of a chunk stay empty
    3: (box((16, 16, 16), 1 / 16), lattice((0.375, 0.375, 0.375), (8, 8, 8), 1 / 32)),
}


def turning(d: int, omega: float, dtype: str = "float32") -> tuple[Grid, Material, Particles]:
    """An elastic block that turns about its centre far from any wall."""
    grid, sites = BLOCKS[d]
    material = example("elastic", dtype)
    v, C = spinning(sites, omega)
    volume = (grid.cell_size / 2) ** d
    return grid, material, block(grid, material, sites, volume=volume, v=v, C=C, dtype=dtype)


def before_and_after(d: int, *, affine: float, dtype: str = "float32") -> tuple[Budgets, Budgets]:
    with jax.enable_x64(dtype == "float64"):
        grid, material, p = turning(d, OMEGA, dtype)
        q = go(grid, material, p, dt=0.6 * longest_step(grid, material), steps=STEPS, affine=affine)
    return balance(grid, material, p), balance(grid, material, q)


def errors(d: int, before: Budgets, after: Budgets) -> tuple[float, float, float]:
    """Relative change of mass, momentum (over M omega R) and angular momentum."""
    _, sites = BLOCKS[d]
    scale = before.mass * OMEGA * np.ptp(sites[0]) / 2
    p, L = after.momentum - before.momentum, after.angular_momentum - before.angular_momentum
    return (
        abs(after.mass / before.mass - 1),
        np.abs(p).max() / scale,
        np.abs(L).max() / before.angular_momentum[2],
    )


@pytest.mark.parametrize("d", BLOCKS)
def test_thousand_steps_keep_mass_and_both_momenta(d: int) -> None:
    mass, momentum, angular = errors(d, *before_and_after(d, affine=1.0))
    assert mass <= MASS
    assert momentum <= MOMENTUM
    assert angular <= ANGULAR


@pytest.mark.parametrize("d", BLOCKS)
def test_without_the_affine_part_angular_momentum_is_lost(d: int) -> None:
    """The negative control: the same block under PIC."""
    before, after = before_and_after(d, affine=0.0)
    assert after.angular_momentum[2] < (1 - PIC_LOSES) * before.angular_momentum[2]
    assert errors(d, before, after)[1] <= MOMENTUM


def test_float64_keeps_momenta_to_its_own_rounding() -> None:
    assert max(errors(2, *before_and_after(2, affine=1.0, dtype="float64"))) <= ROUNDING


@pytest.mark.parametrize("name", ["sand", "elastic"])
def test_free_fall_is_symplectic_eulers_to_the_step(name: str) -> None:
    grid, material = box((12, 70), 0.1), example(name)
    p = block(grid, material, lattice((0.4, 6.0), (8, 8), 0.05), volume=0.05**2)
    n, dt = 1000, 1e-3
    q = go(grid, material, p, dt=dt, steps=n, gravity=(0.0, -GRAVITY))
    fell = np.asarray(q.x, np.float64) - np.asarray(p.x, np.float64)
    expected = GRAVITY * dt**2 * n * (n + 1) / 2
    np.testing.assert_allclose(fell[1], -expected, rtol=FALL)
    np.testing.assert_allclose(fell[0], 0, atol=FALL * expected)
    # The control: the exact parabola, half a step off, is told apart.
    assert abs(expected / (GRAVITY * (n * dt) ** 2 / 2) - 1) > 10 * FALL


def test_rigid_turn_of_twenty_seconds_keeps_its_energy() -> None:
    """1 x 1 m, E = 1 MPa, nu = 0.3, 1550 kg/m^3, 1 rad/s, 12 cells: 3.2 turns in 17 600 steps."""
    grid, material, p = turning(2, 1.0)
    dt = 0.6 * longest_step(grid, material)
    q = go(grid, material, p, dt=dt, steps=round(20 / dt))
    before, after = balance(grid, material, p), balance(grid, material, q)
    loss = 1 - after.kinetic / before.kinetic
    assert TURN_LOSS[0] <= loss <= TURN_LOSS[1]
    assert after.kinetic + after.elastic <= before.kinetic
    # The control: it has turned, by omega T = 20 rad.
    x, y = (np.asarray(a.x, np.float64)[:, alive(p)] for a in (p, q))
    x, y = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
    angle = np.arctan2(np.sum(x[0] * y[1] - x[1] * y[0]), np.sum(x * y))
    assert abs((angle - 20 + np.pi) % (2 * np.pi) - np.pi) < 0.02
