"""Blocks of grains in a box and one compiled walk through many substeps, for validation and for tests of physics."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mpm_env.mpm.budgets import Budgets, budgets
from mpm_env.mpm.materials import MATERIALS, Material
from mpm_env.mpm.stability import largest_dt
from mpm_env.mpm.substep import Bed, substep
from mpm_env.mpm.transfer import CHUNK
from mpm_env.mpm.types import MARGIN, Grid, Particles, Wall

GRAVITY = 9.81  # m/s^2
PATIENCE = 1e24  # s: what depends on the rate has then come to its slowest, rate-free answer

# fmt: off
PARAMETERS: dict[str, dict[str, float]] = {
    "elastic": {"E": 1e6, "nu": 0.3, "rho": 1550.0},
    "sand": {"E": 3.537e5, "nu": 0.3, "rho": 2200.0, "friction": np.deg2rad(30), "cohesion": 0.0},
    "snow": {"E": 1.4e5, "nu": 0.2, "rho": 400.0, "theta_c": 0.025, "theta_s": 0.0075, "xi": 10.0, "Jp_min": 0.5},
    "von_mises": {"E": 1e6, "nu": 0.3, "rho": 1550.0, "yield_stress": 2e4, "hardening": 1e5},
    "herschel_bulkley": {
        "E": 1e5, "nu": 0.3, "rho": 1200.0, "yield_stress": 1e3, "consistency": 40.0, "flow_index": 0.5,
    },
    "mu_i": {
        "E": 1e6, "nu": 0.3, "rho": 1500.0,
        "mu_s": 0.38, "mu_2": 0.64, "I_0": 0.28, "grain_size": 5e-4, "grain_density": 2450.0,
    },
    "cam_clay": {"E": 1e6, "nu": 0.3, "rho": 300.0, "M": 1.2, "beta": 0.3, "xi": 3.0, "compaction": 0.05},
}
# fmt: on


def example(name: str, dtype: str = "float32", **changes: float | str | bool) -> Material:
    """A material of the table with usual parameters; numbers become arrays of the dtype."""
    given = {**PARAMETERS[name], **changes}
    return MATERIALS[name](**{k: v if isinstance(v, str | bool) else jnp.asarray(v, dtype) for k, v in given.items()})


def box(cells: tuple[int, ...], cell_size: float, *, lower: Wall | None = None, other: Wall | None = None) -> Grid:
    """A box of stick walls; `lower` replaces the wall below (the last axis), `other` all the rest."""
    side = other or Wall("stick")
    pairs = [(side, side)] * (len(cells) - 1) + [(lower or side, side)]
    return Grid((0.0,) * len(cells), cells, cell_size, tuple(pairs))


def lattice(lower: tuple[float, ...], counts: tuple[int, ...], spacing: float) -> np.ndarray:
    """Sites (d, n) in m of a regular lattice that fills a box from its lower corner."""
    axes = [lo + (np.arange(n) + 0.5) * spacing for lo, n in zip(lower, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij")).reshape(len(counts), -1)


def block(
    grid: Grid,
    material: Material,
    sites: np.ndarray,
    *,
    volume: float,
    v: np.ndarray | float = 0.0,
    C: np.ndarray | float = 0.0,
    slots: int | None = None,
    dtype: str = "float32",
) -> Particles:
    """Unstrained grains at sites (d, n) m of the box's frame, each of volume m^3; empty slots fill the last chunk."""
    d, n = sites.shape
    slots = slots or (n if n <= CHUNK else -(-n // CHUNK) * CHUNK)
    s = 4 if d == 2 else 6
    history = np.repeat(np.asarray(material.history_start, dtype)[:, None], slots, axis=1)
    x = np.pad(sites + MARGIN * grid.cell_size, ((0, 0), (0, slots - n)), mode="edge")
    C = np.broadcast_to(np.asarray(C, dtype).reshape(*np.shape(C), 1) if np.ndim(C) == 2 else C, (d, d, slots))
    m = np.where(np.arange(slots) < n, float(material.rho) * volume, 0)
    v = np.broadcast_to(np.asarray(v)[:, None] if np.ndim(v) == 1 else v, (d, n))
    rows = (x, np.pad(v, ((0, 0), (0, slots - n))), C, np.zeros((s, slots)), np.zeros((s, slots)), history, m)
    return Particles(*(jnp.asarray(a, dtype) for a in (*rows, np.full(slots, volume))))


def spinning(sites: np.ndarray, omega: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocities (d, n) and affine velocity (d, d) of a rigid turn about the sites' centre, axis 0 to 1."""
    d = len(sites)
    W = np.zeros((d, d))
    W[0, 1], W[1, 0] = -omega, omega
    return W @ (sites - sites.mean(axis=1, keepdims=True)), W


@jax.jit
def update(material: Material, e: Array, history: Array, dt: float | Array = PATIENCE) -> tuple[Array, Array, Array]:
    """The material's answer e, history, tau to trial strains, given all the time it wants if not less."""
    return material.update(e, history, dt)


@partial(jax.jit, static_argnums=0)
def advance(
    grid: Grid, material: Material, p: Particles, dt: Array, gravity: Array, steps: Array, affine: Array
) -> Particles:
    """The grains after so many substeps. affine = 0 forgets C after each: PIC, the negative control."""
    beds = (Bed(material, 0, p.count),)

    def one(_: Array, p: Particles) -> Particles:
        p, _carry = substep(grid, beds, p, dt, gravity)
        return replace(p, C=p.C * affine)

    return lax.fori_loop(0, steps, one, p)


def go(
    grid: Grid,
    material: Material,
    p: Particles,
    *,
    dt: float,
    steps: int,
    gravity: tuple[float, ...] | None = None,
    affine: float = 1.0,
) -> Particles:
    """`advance` with plain numbers: same shapes, same program, whatever the numbers. Done when it returns."""
    dtype = p.x.dtype
    g = jnp.asarray(gravity or (0.0,) * grid.dimension, dtype)
    numbers = (jnp.asarray(dt, dtype), g, jnp.int32(steps), jnp.asarray(affine, dtype))
    return jax.block_until_ready(advance(grid, material, p, *numbers))


def balance(grid: Grid, material: Material, p: Particles, gravity: tuple[float, ...] | None = None) -> Budgets:
    """Budgets summed in float64 whatever the grains' precision: what is left is the solver's own error."""
    with jax.enable_x64(True):
        wide_p, wide = jax.tree_util.tree_map(lambda a: jnp.asarray(np.asarray(a), "float64"), (p, material))
        g = jnp.asarray(gravity or (0.0,) * grid.dimension, "float64")
        sums = budgets(grid, (Bed(wide, 0, p.count),), wide_p, g)
        return Budgets(*(np.asarray(a) for a in sums))


def longest_step(grid: Grid, material: Material) -> float:
    """The library's own bound on dt in s for grains at rest."""
    return largest_dt((material,), grid.cell_size, grid.dimension, 0.0).dt


def alive(p: Particles) -> np.ndarray:
    """Which slots hold a grain, (n,) bool."""
    return np.asarray(p.m) > 0
