"""A slice of a box whose ends are one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mpm_env.mpm.types import MARGIN, Grid, Particles

FIRST = 2  # cells from the box's wall to the slice


class Round:
    """Nodes that are each other's images move together, and grains that leave the slice come back at its other end."""

    def __init__(self, grid: Grid, cells: int) -> None:
        """A slice of so many cells along the first axis of a box that has FIRST more on either side."""
        k = MARGIN + FIRST + np.arange(-1, 2)
        j = np.arange(grid.shape[1])
        ends = [np.ravel_multi_index(np.meshgrid(k + n, j, indexing="ij"), grid.shape).ravel() for n in (0, cells)]
        self.watched = jnp.asarray(np.concatenate(ends), jnp.int32)
        self.low, self.length = (MARGIN + FIRST) * grid.cell_size, cells * grid.cell_size

    def nodes(self, carry: Any, v: Array, m: Array) -> tuple[Any, Array]:
        (v0, v1), (m0, m1) = jnp.split(v, 2), jnp.split(m, 2)
        total = m0 + m1
        one = (m0[:, None] * v0 + m1[:, None] * v1) / jnp.where(total > 0, total, 1)[:, None]
        return carry, jnp.concatenate([one, one]) - v

    def grains(self, carry: Any, p: Particles) -> tuple[Any, Particles]:
        return carry, replace(p, x=p.x.at[0].set(self.low + jnp.mod(p.x[0] - self.low, self.length)))
