"""Scatter to the grid and gather from it: quadratic B-splines, APIC, MLS-MPM (J15, H18).

The only module that knows how grains are walked through: in chunks of CHUNK, small enough for a chunk's window of
3^d nodes per grain to stay in cache, with ONE window scatter and ONE window gather per chunk. On XLA:CPU that is five
to ten times faster than a scatter per node. Grid arrays are `(*shape, channels)`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
from jax import Array, lax

from mpm_env.mpm.linalg3 import matrix_rows
from mpm_env.mpm.types import Grid, Particles

CHUNK = 512  # grains walked through at a time; 128 to 1024 cost the same, above 4096 the window leaves the cache


def weights(x: Array, cell_size: float, shape: tuple[int, ...]) -> tuple[Array, list[list[Array]], list[list[Array]]]:
    """First node (d, n) of each grain's window, and per axis and node the weights (n,) and offsets x_i - x_p (n,) in m.

    Quadratic B-splines (J16 eq. 123). A window that would leave the grid is moved back inside: the caller flags it.
    Along the last axis one node beyond it stays on the grid, since the native kernels read rows of four.
    """
    s = x / cell_size
    last = jnp.asarray([*(n - 3 for n in shape[:-1]), shape[-1] - 4], jnp.int32)[:, None]
    base = jnp.clip(jnp.floor(s - 0.5).astype(jnp.int32), 0, last)
    # The barrier makes every use below see the same window, however XLA rounds the position in each fusion.
    base, s = lax.optimization_barrier((base, s))
    w: list[list[Array]] = []
    r: list[list[Array]] = []
    for a in range(len(shape)):
        f = s[a] - base[a]
        w.append([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
        r.append([(i - f) * cell_size for i in range(3)])
    return base, w, r


def _windows(d: int) -> tuple[lax.ScatterDimensionNumbers, lax.GatherDimensionNumbers]:
    """One index per grain, a window of 3^d nodes with all channels behind it."""
    window, axes = tuple(range(1, d + 2)), tuple(range(d))
    return (
        lax.ScatterDimensionNumbers(window, (), axes),
        lax.GatherDimensionNumbers(window, (), axes),
    )


def _product(w: list[list[Array]], node: tuple[int, ...]) -> Array:
    """Weight (n,) of one node of the window."""
    out = w[0][node[0]]
    for a in range(1, len(node)):
        out = out * w[a][node[a]]
    return out


T = TypeVar("T")


def each_chunk(count: int, body: Callable[[Array, T], T], carry: T, chunk: int = CHUNK) -> T:
    """Walk `count` grains in chunks: carry = body(first grain of the chunk, carry). count is a multiple of chunk."""
    if count == chunk:
        return body(jnp.int32(0), carry)
    return lax.fori_loop(0, count // chunk, lambda k, c: body(k * chunk, c), carry)


def p2g(grid: Grid, p: Particles, dt: float | Array, chunk: int = CHUNK) -> Array:
    """Momentum and mass on the nodes, (*shape, d + 1) kg m/s and kg, internal forces over dt included.

    A node gets w (m v + (m C - dt V0 tau / D) (x_i - x_p)) with D = dx^2/4: APIC's affine momentum and MLS-MPM's
    force in one matrix (H18 eq. 29, with tau = J sigma).
    """
    d, n = p.x.shape
    per_D = 4 / grid.cell_size**2
    scatter, _ = _windows(d)
    # The product with a hidden one makes the transpose part of a loop fusion, nine times faster than XLA's own.
    one = lax.optimization_barrier(jnp.ones((), p.x.dtype))

    def body(start: Array, nodes: Array) -> Array:
        def rows(a: Array) -> Array:
            return lax.dynamic_slice_in_dim(a, start, chunk, axis=-1)

        x, v, C, tau, m, V0 = lax.optimization_barrier(tuple(map(rows, (p.x, p.v, p.C, p.tau, p.m, p.V0))))
        base, w, r = weights(x, grid.cell_size, grid.shape)
        stress = matrix_rows(tau)
        force = jnp.where(m > 0, dt * per_D * V0, 0)  # an empty slot keeps its last stress: it must push nobody
        q = jnp.stack([*(m * v[i] for i in range(d)), m])
        A = [jnp.stack([*(m * C[i, j] - force * stress[i][j] for i in range(d)), 0 * m]) for j in range(d)]
        # Momentum is linear in the offsets, so it is built axis by axis: (3, .., 3, d + 1, chunk).
        w_axis = [jnp.stack(w[a]) for a in range(d)]
        w_axis, slopes, q = lax.optimization_barrier((w_axis, [A[a] * jnp.stack(r[a])[:, None] for a in range(d)], q))
        W, values = w_axis[0], q + slopes[0]
        for a in range(1, d):
            W, values = W[..., None, :] * w_axis[a], values[..., None, :, :] + slopes[a]
        values = (lax.optimization_barrier(W)[..., None, :] * values).reshape(-1, chunk)
        updates = lax.optimization_barrier(lax.optimization_barrier(values).T * one).reshape(chunk, *(3,) * d, d + 1)
        return lax.scatter_add(nodes, base.T, updates, scatter, mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)

    return each_chunk(n, body, jnp.zeros((*grid.shape, d + 1), p.x.dtype), chunk)


def g2p(grid: Grid, node_v: Array, x: Array) -> tuple[Array, Array]:
    """Velocity (d, n) m/s and affine velocity (d, d, n) 1/s of grains at x, from node velocities (*shape, d), behind
    which other channels may follow.

    v_p = sum w v_i, C_p = sum w v_i (x_i - x_p)^T / D (J15 eq. 8, with D = dx^2/4).
    """
    d, n = x.shape
    base, w, r = weights(x, grid.cell_size, grid.shape)
    _, gather = _windows(d)
    window = lax.gather(
        node_v, base.T, gather, slice_sizes=(*(3,) * d, d), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS
    )
    rows = lax.optimization_barrier(window.reshape(n, -1).T)  # (3^d d, n): back to component rows
    per_D = 4 / grid.cell_size**2
    v = [jnp.zeros((n,), x.dtype)] * d
    C = [[jnp.zeros((n,), x.dtype)] * d for _ in range(d)]
    for k, node in enumerate(itertools.product(range(3), repeat=d)):
        W = _product(w, node)
        for i in range(d):
            part = W * rows[k * d + i]
            v[i] = v[i] + part
            for j in range(d):
                C[i][j] = C[i][j] + part * r[j][node[j]]
    return jnp.stack(v), per_D * jnp.stack([jnp.stack(row) for row in C])
