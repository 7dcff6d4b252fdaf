"""The order of the slots: grains of one cell side by side, where that pays.

Kernels read and add a cell's nodes once for all grains that follow each other in it. What is mixed by flow is put in
order again; a bed at rest stays as it is.
"""

from __future__ import annotations

from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mpm_env.mpm.transfer import weights
from mpm_env.mpm.types import Grid, Particles

Rows = TypeVar("Rows")

MOST_DISORDER = 0.05  # share of slots out of order; with native kernels a sort then pays within tens of substeps


def in_order(grid: Grid, p: Particles, spans: tuple[tuple[int, int], ...], order: Array) -> tuple[Particles, Array]:
    """Grains by cell within their spans of slots, and order (n,) along with them; as they are while that will do.

    Empty slots come last in their span.
    """
    cell = cells(grid, p, spans)
    return lax.cond(disorder(cell) > MOST_DISORDER, by_cell, lambda _, both: both, cell, (p, order))


def by_cell(cell: Array, rows: Rows) -> Rows:
    """Rows (.., n) in the order of their cells (n,)."""
    return jax.tree.map(partial(jnp.take, indices=jnp.argsort(cell, stable=True), axis=-1, mode="clip"), rows)


def disorder(cell: Array) -> Array:
    """Share () of the slots (n,) whose cell comes before that of the slot in front of them."""
    return jnp.mean(cell[1:] < cell[:-1])


def cells(grid: Grid, p: Particles, spans: tuple[tuple[int, int], ...]) -> Array:
    """The cell of each slot (n,), counted on from span to span."""
    base, _, _ = weights(p.x, grid.cell_size, grid.shape)
    cell = jnp.where(p.m > 0, jnp.ravel_multi_index(tuple(base), grid.shape, mode="clip"), grid.nodes)
    first = np.repeat(np.arange(len(spans)) * (grid.nodes + 1), np.diff(spans, axis=1).ravel())
    return cell + jnp.asarray(first, jnp.int32)
