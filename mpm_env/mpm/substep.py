"""One substep of the continuum: scatter, move the grid, gather, let the materials answer.

Explicit symplectic Euler (J16 section 10). What else acts on the nodes, rigid bodies for one, comes in as a Boundary:
nothing here knows what is behind it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
from jax import Array, lax

from mpm_env.mpm.linalg3 import matrix_rows
from mpm_env.mpm.materials import Material
from mpm_env.mpm.transfer import CHUNK, each_chunk, g2p, p2g
from mpm_env.mpm.types import MARGIN, Grid, Particles

LEAST_SPEED2 = 1e-30  # (m/s)^2, guards the direction of sliding at rest
LEAST_MASS = 1e-30  # kg: below this a node's velocity is nothing but rounding, and f32 flushes its mass to zero


class Bed(NamedTuple):
    """The grains from `start` to `stop` are of this material; both are multiples of the chunk."""

    material: Material
    start: int
    stop: int


class Boundary(Protocol):
    """What acts on the grid and the grains between two transfers; `carry` is its own business."""

    @property
    def watched(self) -> Array:
        """Indices (K,) into the flattened grid of the nodes it may act on; `grid.nodes` stands for none."""

    def nodes(self, carry: Any, v: Array, m: Array) -> tuple[Any, Array]:
        """Change (K, d) m/s of the watched nodes' velocities v (K, d) m/s, given their masses m (K,) kg."""

    def grains(self, carry: Any, p: Particles) -> tuple[Any, Particles]:
        """Change grains after they have moved."""


def substep(
    grid: Grid,
    beds: tuple[Bed, ...],
    p: Particles,
    dt: float,
    gravity: Array,
    boundary: Boundary | None = None,
    carry: Any = None,
) -> tuple[Particles, Any]:
    """Advance the grains by dt; gravity (d,) m/s^2. Returns the grains and the boundary's carry."""
    v, m = node_velocities(p2g(grid, p, dt, chunk_of(p)), dt, gravity)
    v = walls(grid, v)
    if boundary is not None:
        at, d = boundary.watched, grid.dimension
        v_at, m_at = (
            v.reshape(-1, d).at[at].get(mode="fill", fill_value=0),
            m.reshape(-1).at[at].get(mode="fill", fill_value=0),
        )
        carry, change = boundary.nodes(carry, v_at, m_at)
        # A node shared by a wall and a body belongs to the wall.
        change = walls(grid, v_at + change, jnp.unravel_index(at, grid.shape)) - v_at
        v = v.reshape(-1, d).at[at].add(change, mode="drop").reshape(v.shape)
    for bed in beds:
        p = move(grid, bed, p, v, dt)
    if boundary is not None:
        carry, p = boundary.grains(carry, p)
    return p, carry


def chunk_of(p: Particles) -> int:
    """How many grains are walked through at a time."""
    return min(CHUNK, p.count)


def node_velocities(nodes: Array, dt: float, gravity: Array) -> tuple[Array, Array]:
    """Velocity (*shape, d) m/s after forces and gravity, and mass (*shape,) kg, of nodes (*shape, d + 1)."""
    d = nodes.shape[-1] - 1
    m = nodes[..., d]
    present = m > LEAST_MASS
    per_mass = jnp.where(present, 1 / jnp.where(present, m, 1), 0)
    v = [jnp.where(present, nodes[..., i] * per_mass + dt * gravity[i], 0) for i in range(d)]
    return jnp.stack(v, axis=-1), m


def walls(grid: Grid, v: Array, at: tuple[Array, ...] | None = None) -> Array:
    """Node velocities (.., d) that respect the walls; nodes on a wall's plane and behind it are its own.

    Of all nodes in the grid's shape, or of those with the indices `at`, one array (..,) per axis.
    """
    d = grid.dimension
    rows = [v[..., i] for i in range(d)]
    for a, pair in enumerate(grid.walls):
        index = lax.broadcasted_iota(jnp.int32, v.shape[:-1], a) if at is None else at[a]
        for side, wall in enumerate(pair):
            inward = 1 - 2 * side
            behind = index <= MARGIN if side == 0 else index >= MARGIN + grid.cells[a]
            if wall.kind == "slip":
                rows[a] = jnp.where(behind, 0, rows[a])
            elif wall.kind == "stick":
                rows = [jnp.where(behind, 0, row) for row in rows]
            elif wall.kind == "separate":
                into = jnp.where(behind, jnp.maximum(-inward * rows[a], 0), 0)
                speed = jnp.sqrt(sum(rows[i] ** 2 for i in range(d) if i != a) + LEAST_SPEED2)
                keep = jnp.maximum(1 - wall.friction * into / speed, 0)  # Coulomb: at most mu times the normal impulse
                rows = [row + inward * into if i == a else row * keep for i, row in enumerate(rows)]
    return jnp.stack(rows, axis=-1)


def move(grid: Grid, bed: Bed, p: Particles, node_v: Array, dt: float) -> Particles:
    """Gather velocities, move the bed's grains, strain them and ask the material for the stress."""
    chunk = chunk_of(p)

    def body(k: Array, p: Particles) -> Particles:
        start = bed.start + k

        def rows(a: Array) -> Array:
            return lax.dynamic_slice_in_dim(a, start, chunk, axis=-1)

        x, e, history, m = lax.optimization_barrier((rows(p.x), rows(p.e), rows(p.history), rows(p.m)))
        v, C = lax.optimization_barrier(g2p(grid, node_v, x))
        here = m > 0
        v, C = jnp.where(here, v, 0), jnp.where(here, C, 0)
        x = x + dt * v
        e, history, tau = bed.material.update(stretch(e, dt * C), history)
        new = replace(p, x=x, v=v, C=C, e=e, tau=tau, history=history, m=take_out(grid, x, m), V0=p.V0)
        return Particles(
            *(
                old if fresh is old else lax.dynamic_update_slice_in_dim(old, fresh.astype(old.dtype), start, axis=-1)
                for old, fresh in ((getattr(p, f), getattr(new, f)) for f in p.__dataclass_fields__)
            )
        )

    return each_chunk(bed.stop - bed.start, body, p, chunk)


def stretch(e: Array, G: Array) -> Array:
    """Trial strain b - I of e = b_old - I after the velocity gradient G = dt grad v (d, d, n) acted.

    b = (I + G) b_old (I + G)^T, written for the difference to I so that small strains keep their digits:
    e + M + M^T + M G^T with M = G (I + e).
    """
    d = G.shape[0]
    rows = matrix_rows(e)
    M = [[G[i, j] + sum(G[i, k] * rows[k][j] for k in range(d)) for j in range(d)] for i in range(d)]

    def entry(i: int, j: int) -> Array:
        return rows[i][j] + M[i][j] + M[j][i] + sum(M[i][k] * G[j, k] for k in range(d))

    if d == 2:
        return jnp.stack([entry(0, 0), entry(1, 1), e[2], entry(0, 1)])
    return jnp.stack([entry(0, 0), entry(1, 1), entry(2, 2), entry(1, 2), entry(0, 2), entry(0, 1)])


def take_out(grid: Grid, x: Array, m: Array) -> Array:
    """Masses (n,) with those of grains beyond an open wall set to zero: they have left."""
    for a, (lower, upper) in enumerate(grid.walls):
        first = MARGIN * grid.cell_size
        if lower.kind == "open":
            m = jnp.where(x[a] < first, 0, m)
        if upper.kind == "open":
            m = jnp.where(x[a] > first + grid.cells[a] * grid.cell_size, 0, m)
    return m
