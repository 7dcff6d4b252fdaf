"""The bound on the time step: where a lone grain and a ragged block really become unstable."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.validation.blocks import alive, block, box, example, go, lattice, update
from mpm_env.mpm.materials import Material
from mpm_env.mpm.stability import SAFETY, courant_limit
from mpm_env.mpm.types import Grid, Particles

LONE = (0.99, 1.01)  # of the closed form: a lone grain is stable at the first and not at the second
GROWTH = 10.0  # of the first speeds; what is stable decays, what is not grows without bound
RAGGED_BREAKS = (
    1.3  # of the lone grain's limit: blocks at one grain per cell broke at 1.03 to 1.2 (24 blocks, nu 0 to .45)
)
STEPS = 600
STRAIN = 0.15  # b - I: a stretch of 7 %
RESONANCE = np.sin(np.pi / 3)
GRIDS: dict[int, Grid] = {2: box((24, 24), 1 / 12), 3: box((16, 16, 16), 1 / 16)}
SLOTS = {2: 1024, 3: 512}
QUIET = 1e-6  # of the sound speed: small enough for linear, large enough for float32


def lone_limit(nu: float, d: int) -> float:
    """Courant number sqrt((lam + 2 mu) / (d lam + 2 mu)), in terms of Poisson's ratio."""
    return float(np.sqrt((1 - nu) / (1 - 2 * nu + d * nu)))


def growth(sites: np.ndarray, nu: float, courant: float, *, C: float = 0.0, v: float = 0.0, e: float = 0.0) -> float:
    """Largest motion (speed, C dx or c e) ever seen over the first; inf where a number is lost.

    The first motion: random speeds of size v c, an expansion of rate C c / dx, an even strain e = b - I.
    """
    d = len(sites)
    grid = GRIDS[d]
    material: Material = example("elastic", nu=nu)
    c, dx = float(material.wave_speed()), grid.cell_size
    noise = np.random.default_rng(0).normal(size=sites.shape)
    p = block(grid, material, sites, volume=dx**d, v=v * c * noise, C=C * c / dx * np.eye(d), slots=SLOTS[d])
    strain, history, tau = update(material, jnp.zeros_like(p.e).at[:d].set(e), p.history)
    p = replace(p, e=strain, tau=tau, history=history)

    def motion(p: Particles) -> float:
        parts = (p.v, p.C * dx, c * p.e)
        return float(np.max([np.abs(np.asarray(a)[..., alive(p)]).max() for a in parts]))  # a NaN stays one

    first, most = motion(p), 0.0
    for _ in range(5):
        p = go(grid, material, p, dt=courant * dx / c, steps=STEPS // 5)
        most = max(most, motion(p)) if np.isfinite(motion(p)) else np.inf
    return most / first


def ragged(d: int, seed: int) -> np.ndarray:
    """About 70 % of the sites of a jittered lattice of one grain per cell: holes, edges, lone grains."""
    rng = np.random.default_rng(seed)
    side, dx = {2: 14, 3: 7}[d], GRIDS[d].cell_size
    sites = lattice((4.5 * dx,) * d, (side,) * d, dx)
    sites = sites + rng.uniform(-0.5, 0.5, sites.shape) * dx
    return sites[:, rng.uniform(size=sites.shape[1]) < 0.7]


@pytest.mark.parametrize("d", GRIDS)
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_lone_grain_is_stable_just_below_its_closed_form_only(d: int, nu: float) -> None:
    site = np.full((d, 1), 8.2) * GRIDS[d].cell_size
    below, above = (growth(site, nu, f * lone_limit(nu, d), C=1e-5) for f in LONE)
    assert below < GROWTH < above


@pytest.mark.parametrize("d", GRIDS)
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_ragged_block_is_stable_at_the_limit_used(d: int, nu: float) -> None:
    for seed in range(3):
        assert growth(ragged(d, seed), nu, courant_limit(nu, d), v=QUIET) < GROWTH
    assert growth(ragged(d, 0), nu, RAGGED_BREAKS * lone_limit(nu, d), v=QUIET) > GROWTH


@pytest.mark.parametrize("d", GRIDS)
@pytest.mark.parametrize("strain", [-STRAIN, STRAIN])
def test_lone_strained_grain_is_stable_at_the_limit_used_not_near_the_resonance(d: int, strain: float) -> None:
    """Symplectic Euler's third-order resonance lies at sin 60 deg of the limit; the safety has to stay below it."""
    site, limit = np.full((d, 1), 8.2) * GRIDS[d].cell_size, lone_limit(0.3, d)
    assert growth(site, 0.3, courant_limit(0.3, d), e=strain) < GROWTH
    assert growth(site, 0.3, RESONANCE * limit, e=strain) > GROWTH


@pytest.mark.parametrize("d", GRIDS)
@pytest.mark.parametrize("nu", [0.0, 0.2, 0.45])
def test_limit_is_the_lone_grains_with_its_safety(d: int, nu: float) -> None:
    assert courant_limit(nu, d) == pytest.approx(SAFETY * lone_limit(nu, d))
