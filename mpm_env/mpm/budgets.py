"""What must balance: mass, momentum, angular momentum and energy of the grains."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mpm_env.mpm.substep import Bed
from mpm_env.mpm.types import Grid, Particles


class Budgets(NamedTuple):
    """Sums over all grains."""

    mass: Array  # () kg
    momentum: Array  # (d,) kg m/s
    angular_momentum: Array  # (3,) kg m^2/s about the grid's origin; in plane strain only the last is not zero
    kinetic: Array  # () J, the affine part included
    elastic: Array  # () J
    potential: Array  # () J, zero at the grid's origin


def budgets(grid: Grid, beds: tuple[Bed, ...], p: Particles, gravity: Array) -> Budgets:
    """Budgets of the grains.

    A grain carries the affine field v + C (x - x_p) with the kernel's inertia D = dx^2/4, so angular momentum and
    kinetic energy have an affine part each (J15 section 5.3; without it APIC seems to lose angular momentum).
    """
    D = grid.cell_size**2 / 4
    d = grid.dimension
    linear = jnp.sum(p.m * p.v, axis=-1)
    pairs = ((1, 2), (2, 0), (0, 1)) if d == 3 else ((0, 1),)
    turning = [
        jnp.sum(p.m * (p.x[i] * p.v[j] - p.x[j] * p.v[i])) + D * jnp.sum(p.m * (p.C[j, i] - p.C[i, j]))
        for i, j in pairs
    ]
    angular = jnp.stack(turning if d == 3 else [jnp.zeros_like(turning[0])] * 2 + turning)
    kinetic = 0.5 * jnp.sum(p.m * (jnp.sum(p.v**2, axis=0) + D * jnp.sum(p.C**2, axis=(0, 1))))
    elastic = sum(
        (
            jnp.sum(jnp.where(p.m[a:b] > 0, p.V0[a:b] * mat.energy(p.e[:, a:b], p.history[:, a:b]), 0))
            for mat, a, b in beds
        ),
        start=jnp.zeros((), p.x.dtype),
    )
    potential = -jnp.sum(p.m * jnp.sum(gravity[:, None] * p.x, axis=0))
    return Budgets(jnp.sum(p.m), linear, angular, kinetic, elastic, potential)


def mass_that_left(before: Particles, after: Particles) -> Array:
    """Mass () in kg of the grains that an open wall took out between two states: exact, grain by grain."""
    return jnp.sum(jnp.where(after.m > 0, 0, before.m))


def height_map(
    x: Array,
    m: Array,
    *,
    lower: tuple[float, float],
    upper: tuple[float, float],
    columns: tuple[int, int],
    floor: float,
) -> Array:
    """Top of the material over a rectangle, (columns) m: the highest grain of each column, `floor` where none is.

    x (3, n) m and m (n,) kg in the frame of lower and upper.
    """
    index = []
    inside = m > 0
    for a in range(2):
        i = jnp.floor((x[a] - lower[a]) / (upper[a] - lower[a]) * columns[a]).astype(jnp.int32)
        inside &= (i >= 0) & (i < columns[a])
        index.append(jnp.clip(i, 0, columns[a] - 1))
    flat = jnp.where(inside, index[0] * columns[1] + index[1], columns[0] * columns[1])
    top = jnp.full((columns[0] * columns[1] + 1,), floor, x.dtype).at[flat].max(x[2])
    return top[:-1].reshape(columns)


total = partial(np.sum, dtype=np.float64)  # sums on the host run in f64, so that a ledger closes to the last grain
