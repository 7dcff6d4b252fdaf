"""One substep of the continuum: scatter, move the grid, gather, let the materials answer.

Explicit symplectic Euler (J16 section 10). What else acts on the nodes, rigid bodies for one, comes in as a Boundary:
nothing here knows what is behind it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import Array, lax

from mpm_env import native
from mpm_env.mpm import kernels as in_cpp
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
    dt: float | Array,
    gravity: Array,
    boundary: Boundary | None = None,
    carry: Any = None,
    kernels: str = "auto",
) -> tuple[Particles, Any]:
    """Advance the grains by dt; gravity (d,) m/s^2. Returns the grains and the boundary's carry.

    kernels: "native" or "xla", two implementations of the same equations, or "auto" (see `mpm_env.native`).
    """
    kernels = "xla" if p.count % native.LANES else native.chosen(kernels)
    watched = jnp.zeros((0,), jnp.int32) if boundary is None else boundary.watched
    nodes = to_nodes(grid, p, dt, gravity, watched, kernels)
    if boundary is not None:
        d, flat = grid.dimension, nodes.reshape(-1, nodes.shape[-1])
        seen = flat.at[watched].get(mode="fill", fill_value=0)
        carry, change = boundary.nodes(carry, seen[:, :d], seen[:, -1])
        # A node shared by a wall and a body belongs to the wall.
        change = walls(grid, seen[:, :d] + change, jnp.unravel_index(watched, grid.shape)) - seen[:, :d]
        change = jnp.pad(change, ((0, 0), (0, nodes.shape[-1] - d)))
        nodes = flat.at[watched].add(change, mode="drop").reshape(nodes.shape)
    for bed in beds:
        p = move(grid, bed, p, nodes, dt, kernels)
    p = take_out(grid, p)
    if boundary is not None:
        carry, p = boundary.grains(carry, p)
    return p, carry


def to_nodes(grid: Grid, p: Particles, dt: float | Array, gravity: Array, watched: Array, kernels: str) -> Array:
    """Nodes (*shape, .., mass last): velocity m/s after forces, gravity and walls, and mass kg.

    Where no grain reaches, native kernels define only the nodes `watched`.
    """

    def reference(p: Particles, dt: float | Array, gravity: Array) -> Array:
        v, m = node_velocities(p2g(grid, p, dt, chunk_of(p)), dt, gravity)
        return jnp.concatenate([walls(grid, v), m[..., None]], axis=-1)

    if kernels == "xla":
        return reference(p, dt, gravity)
    return in_cpp.to_nodes(grid, p, dt, gravity, watched, LEAST_MASS, reference)


def move(grid: Grid, bed: Bed, p: Particles, nodes: Array, dt: float | Array, kernels: str) -> Particles:
    """Gather velocities, move the bed's grains, strain them and ask the material for the stress."""
    span = (bed.start, bed.stop)

    def reference(p: Particles, nodes: Array, dt: float | Array, material: Material | None) -> Particles:
        return _moved(grid, material, span, p, nodes, dt)

    if kernels == "xla":
        return reference(p, nodes, dt, bed.material)
    if in_cpp.knows(bed.material):
        return in_cpp.to_grains(grid, bed.material, span, p, nodes, dt, reference)
    return strain(bed, in_cpp.to_grains(grid, None, span, p, nodes, dt, reference), dt)


def chunk_of(p: Particles) -> int:
    """How many grains are walked through at a time: on a GPU all of them, since each chunk would wait for the last."""
    return min(CHUNK, p.count) if jax.default_backend() == "cpu" else p.count


def node_velocities(nodes: Array, dt: float | Array, gravity: Array) -> tuple[Array, Array]:
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


def _moved(
    grid: Grid, material: Material | None, span: tuple[int, int], p: Particles, nodes: Array, dt: float | Array
) -> Particles:
    """The grains of a span after nodes moved them; strained too where a material is given."""

    def one(p: Particles) -> Particles:
        v, C = lax.optimization_barrier(g2p(grid, nodes, p.x))
        here = p.m > 0
        v, C = jnp.where(here, v, 0), jnp.where(here, C, 0)
        p = replace(p, x=p.x + dt * v, v=v, C=C)
        return p if material is None else _answered(material, p, dt)

    return _by_chunks(span, p, one)


def strain(bed: Bed, p: Particles, dt: float | Array) -> Particles:
    """Strain the bed's grains by their velocity gradient, and ask the material for the stress."""
    return _by_chunks((bed.start, bed.stop), p, lambda p: _answered(bed.material, p, dt))


def _answered(material: Material, p: Particles, dt: float | Array) -> Particles:
    e, history, tau = material.update(stretch(p.e, dt * p.C), p.history, dt)
    return replace(p, e=e, tau=tau, history=history)


def _by_chunks(span: tuple[int, int], p: Particles, change: Callable[[Particles], Particles]) -> Particles:
    """Grains with a span of them changed, a chunk at a time."""
    start, stop = span
    chunk = chunk_of(p)

    def body(k: Array, p: Particles) -> Particles:
        some = jax.tree.map(lambda a: lax.dynamic_slice_in_dim(a, start + k, chunk, axis=-1), p)
        some = lax.optimization_barrier(some)
        new = change(some)
        return jax.tree.map(
            lambda whole, old, fresh: (
                whole
                if fresh is old
                else lax.dynamic_update_slice_in_dim(whole, fresh.astype(whole.dtype), start + k, axis=-1)
            ),
            p,
            some,
            new,
        )

    return each_chunk(stop - start, body, p, chunk)


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


def take_out(grid: Grid, p: Particles) -> Particles:
    """Grains without those beyond an open wall, whose mass becomes zero: they have left."""
    m = p.m
    for a, (lower, upper) in enumerate(grid.walls):
        first = MARGIN * grid.cell_size
        if lower.kind == "open":
            m = jnp.where(p.x[a] < first, 0, m)
        if upper.kind == "open":
            m = jnp.where(p.x[a] > first + grid.cells[a] * grid.cell_size, 0, m)
    return p if m is p.m else replace(p, m=m)
