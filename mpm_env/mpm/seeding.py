"""Filling shapes with grains: a jittered lattice whose mass is density times volume whatever the number of grains."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

JITTER = 0.25  # of the spacing, each way: breaks the lattice's crystal planes and still leaves no gap wider than a cell


@dataclass(frozen=True)
class Relief:
    """A seeded uneven top: a sum of random waves with this standard deviation, none shorter than the wavelength."""

    height: float  # m, standard deviation
    wavelength: float  # m


@dataclass(frozen=True)
class Fill:
    """Lattice sites of one filled shape, in space even for plane strain. Static."""

    sites: np.ndarray  # (n, d) m, in the scene's frame
    spacing: np.ndarray  # (d,) m
    volume: float  # m^3 per site, the slice's thickness included
    velocity: tuple[float, ...]  # (d,) m/s
    top: float | None  # m, mean height of an uneven top; None where all sites are filled
    relief: Relief | None


def _lattice(lower: np.ndarray, upper: np.ndarray, target: float) -> tuple[np.ndarray, np.ndarray]:
    """Sites (n, d) and their spacing (d,): as many per axis as fit the target spacing best, at least one."""
    sides = upper - lower
    counts = np.maximum(np.round(sides / target).astype(int), 1)
    spacing = sides / counts
    axes = [lo + (np.arange(n) + 0.5) * s for lo, n, s in zip(lower, counts, spacing, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(sides)), spacing


def fill_box(
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    target: float,
    thickness: float,
    velocity: tuple[float, ...],
    relief: Relief | None = None,
) -> Fill:
    """A box from lower to upper (d,) m, sites about `target` m apart; thickness m is the slice's (1 in 3-D).

    With a relief, sites reach three standard deviations above `upper` and a seed decides which are filled.
    """
    high = upper.copy()
    if relief is not None:
        high[-1] += 3 * relief.height
    sites, spacing = _lattice(lower, high, target)
    top = float(upper[-1]) if relief is not None else None
    return Fill(sites, spacing, float(np.prod(spacing)) * thickness, velocity, top, relief)


def fill_ball(
    centre: np.ndarray, radius: float, *, target: float, thickness: float, velocity: tuple[float, ...]
) -> Fill:
    """A sphere, or in plane strain a disc, of exactly its mass: the sites inside share its volume."""
    sites, spacing = _lattice(centre - radius, centre + radius, target)
    inside = sites[np.sum((sites - centre) ** 2, axis=-1) <= radius**2]
    volume = 4 / 3 * math.pi * radius**3 if len(centre) == 3 else math.pi * radius**2 * thickness
    return Fill(inside, spacing, volume / max(len(inside), 1), velocity, None, None)


def fill_cylinder(
    base: np.ndarray, radius: float, height: float, *, target: float, thickness: float, velocity: tuple[float, ...]
) -> Fill:
    """An upright cylinder on its base centre; in plane strain its mid section, a rectangle."""
    lower, upper = base - radius, base + radius
    lower[-1], upper[-1] = base[-1], base[-1] + height
    sites, spacing = _lattice(lower, upper, target)
    if len(base) == 2:
        return Fill(sites, spacing, float(np.prod(spacing)) * thickness, velocity, None, None)
    inside = sites[np.sum((sites - base)[:, :-1] ** 2, axis=-1) <= radius**2]
    return Fill(inside, spacing, math.pi * radius**2 * height / max(len(inside), 1), velocity, None, None)


def scatter(fill: Fill, key: Array, dtype: jnp.dtype, *, origin: np.ndarray | float = 0.0) -> tuple[Array, Array]:
    """Jittered positions (d, n) m from the origin (d,) m in the scene's frame, and which sites are filled (n,) bool.

    Sites are taken relative to the origin in f64: a scene a kilometre away starts as the same scene.
    """
    key_jitter, key_relief = jax.random.split(key)
    sites = jnp.asarray((fill.sites - origin).T, dtype)
    spacing = jnp.asarray(fill.spacing, dtype)[:, None]
    x = sites + spacing * jax.random.uniform(key_jitter, sites.shape, dtype, -JITTER, JITTER)
    if fill.relief is None or fill.top is None:
        return x, jnp.ones(sites.shape[1:], bool)
    sites = jnp.asarray(fill.sites.T, dtype)
    return x, sites[-1] < fill.top + relief_height(fill.relief, sites[:-1], key_relief)


def relief_height(relief: Relief, x: Array, key: Array) -> Array:
    """Height (n,) m of a seeded relief over points x (d - 1, n) m, bounded by three standard deviations."""
    waves = 8
    key_direction, key_length, key_phase = jax.random.split(key, 3)
    number = 2 * math.pi / relief.wavelength * jax.random.uniform(key_length, (waves,), x.dtype, 0.3, 1.0)
    if x.shape[0] == 2:
        angle = jax.random.uniform(key_direction, (waves,), x.dtype, 0, 2 * math.pi)
        along = jnp.cos(angle)[:, None] * x[0] + jnp.sin(angle)[:, None] * x[1]
    else:
        along = jnp.broadcast_to(x[0], (waves, x.shape[1]))
    phase = jax.random.uniform(key_phase, (waves, 1), x.dtype, 0, 2 * math.pi)
    height = relief.height * math.sqrt(2 / waves) * jnp.sum(jnp.sin(number[:, None] * along + phase), axis=0)
    return jnp.clip(height, -3 * relief.height, 3 * relief.height)
