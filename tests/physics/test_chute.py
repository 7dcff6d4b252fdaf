"""Grains down a rough incline, steady: Bagnold's profile of mu(I), on a slice that is periodic along the slope."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array, lax

from benchmarks.validation.blocks import alive, block, box, example, lattice, longest_step
from benchmarks.validation.periodic import FIRST, Round
from mpm_env.mpm.materials import MuI
from mpm_env.mpm.substep import Bed, substep
from mpm_env.mpm.types import MARGIN, Particles, Wall

ACROSS, HIGH = 4, 24  # periodic cells along the slope, and cells of depth 1
DX = 1 / HIGH
SLOPE = 0.43  # rad
GRID = box((ACROSS + 2 * FIRST, HIGH + 6), DX, lower=Wall("stick"), other=Wall("slip"))
# Depth, gravity and density are 1. Large grains: the profile settles in the time that momentum takes to cross the bed.
LAW = {"mu_s": 0.38, "mu_2": 0.64, "I_0": 0.3, "grain_size": 0.12, "grain_density": 1.0}
SOLID = {"E": 300.0, "nu": 0.3, "rho": 1.0}  # its own weight strains the bed by 0.25 %
TOP = 2.06631 / 3  # the closed form at the surface, published for a grain size of 0.04, to which it is inverse
TIME = 50.0  # sqrt(depth / gravity); what is off falls to a third in about 13
PROFILE = 0.05  # of the surface velocity, in the mean square; 0.012 observed from half the speed, 0.008 from above


def bagnold(y: np.ndarray) -> np.ndarray:
    """Velocity at heights y above the floor."""
    tan = np.tan(SLOPE)
    inertial = LAW["I_0"] * (tan - LAW["mu_s"]) / (LAW["mu_2"] - tan)
    return 2 / 3 * inertial / LAW["grain_size"] * np.sqrt(np.cos(SLOPE)) * (1 - (1 - y).clip(0) ** 1.5)


@jax.jit
def flow(material: MuI, p: Particles, dt: Array, steps: Array) -> Particles:
    gravity = jnp.asarray([np.sin(SLOPE), -np.cos(SLOPE)], p.x.dtype)
    ends = Round(GRID, ACROSS)

    def one(_: Array, p: Particles) -> Particles:
        return substep(GRID, (Bed(material, 0, p.count),), p, dt, gravity, ends, None)[0]

    return lax.fori_loop(0, steps, one, p)


def flowing(share: float, time: float, **changes: float) -> tuple[np.ndarray, np.ndarray]:
    """Heights and velocities along the slope of grains that started with a share of Bagnold's velocities."""
    material = example("mu_i", **(LAW | SOLID | changes))
    assert isinstance(material, MuI)
    sites = lattice((FIRST * DX, 0.0), (2 * ACROSS, 2 * HIGH), DX / 2)
    p = block(GRID, material, sites, volume=DX**2 / 4)
    v = np.zeros((2, p.count))
    v[0, : sites.shape[1]] = share * bagnold(sites[1])
    p = replace(p, v=jnp.asarray(v, p.v.dtype))
    dt = 0.8 * longest_step(GRID, material)
    p = flow(material, p, jnp.asarray(dt, p.x.dtype), jnp.int32(round(time / dt)))
    here = alive(p)
    return np.asarray(p.x[1])[here] - MARGIN * DX, np.asarray(p.v[0])[here]


@pytest.mark.parametrize("share", [0.5, 1.3])
def test_grains_down_a_rough_incline_come_to_bagnolds_profile(share: float) -> None:
    """From half of it and from more than it."""
    assert bagnold(np.array([1.0]))[0] == pytest.approx(TOP, rel=1e-5)
    y, v = flowing(share, TIME)
    off = np.sqrt(np.mean((v - bagnold(y)) ** 2)) / TOP
    assert off < PROFILE, off


def test_grains_whose_friction_does_not_grow_run_away() -> None:
    """The control: at mu_s alone the slope is too steep, and speeds grow past Bagnold's for ever."""
    _, v = flowing(1.0, TIME / 2, mu_2=0.3801)
    assert v.max() > 1.2 * TOP
