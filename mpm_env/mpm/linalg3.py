"""Eigen-decomposition of many small symmetric tensors at once, without branches.

Works on component rows `(s, n)`: one multiply acts on all grains, which is several times faster on a CPU than arrays of
3x3 matrices. Plane strain needs one exact rotation, 3-D a few cyclic Jacobi sweeps (Golub & Van Loan, Matrix
Computations, 8.5).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

SWEEPS = 4  # cyclic Jacobi converges quadratically: 4 sweeps reach f32 round-off for any symmetric 3x3
TINY = 1e-30  # keeps square roots and quotients finite (and differentiable) at zero; above f32's smallest normal


def _rotation(app: Array, aqq: Array, apq: Array) -> tuple[Array, Array, Array]:
    """Cosine, sine and tangent of the Jacobi angle that removes the off-diagonal element apq."""
    d = aqq - app
    side = jnp.where(d >= 0, 1.0, -1.0).astype(d.dtype)
    t = 2 * apq / (d + side * jnp.sqrt(d * d + 4 * apq * apq + TINY))
    c = lax.rsqrt(1 + t * t)
    return c, c * t, t


def eigen(e: Array) -> tuple[Array, Array]:
    """Principal values (3, n), unsorted, and principal axes of symmetric tensors e (s, n).

    The axes are (2, 2, n) in plane strain, where the third value belongs to the out-of-plane direction, and (3, 3, n)
    in 3-D; axes[i, k] is component i of axis k. Derivatives of what is composed from them are right wherever the values
    differ; where two are equal to the last bit, a shear of their plane counts as none.
    """
    if e.shape[0] == 4:
        c, s, t = _rotation(e[0], e[1], e[3])
        values = jnp.stack([e[0] - t * e[3], e[1] + t * e[3], e[2]])
        return values, jnp.stack([jnp.stack([c, s]), jnp.stack([-s, c])])
    one, zero = jnp.ones_like(e[0]), jnp.zeros_like(e[0])
    start = ([e[i] for i in range(6)], [[one if i == k else zero for k in range(3)] for i in range(3)])
    # A loop, not twelve rotations in a row: XLA runs it faster, and its reverse-mode derivative forty times faster.
    a, V = lax.fori_loop(0, SWEEPS, lambda _, state: _sweep(*state), start)
    return jnp.stack(a[:3]), jnp.stack([jnp.stack(row) for row in V])


def _sweep(rows: list[Array], axes: list[list[Array]]) -> tuple[list[Array], list[list[Array]]]:
    """One rotation for each off-diagonal element of tensors in 3-D rows, and of the axes found so far."""
    a, V = list(rows), [list(row) for row in axes]
    for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
        pq, pr, qr = 6 - p - q, 6 - p - r, 6 - q - r  # where the rows hold an off-diagonal element
        # The barrier keeps XLA from recomputing one rotation in several fusions, which would round differently.
        c, s, t = lax.optimization_barrier(_rotation(a[p], a[q], a[pq]))
        a[p], a[q], a[pq] = a[p] - t * a[pq], a[q] + t * a[pq], jnp.zeros_like(t)
        a[pr], a[qr] = c * a[pr] - s * a[qr], s * a[pr] + c * a[qr]
        for i in range(3):
            V[i][p], V[i][q] = c * V[i][p] - s * V[i][q], s * V[i][p] + c * V[i][q]
    return a, V


def compose(axes: Array, values: Array) -> Array:
    """Symmetric tensors (s, n) with the given principal axes and principal values (3, n)."""
    d = axes.shape[0]

    def entry(i: int, j: int) -> Array:
        return sum((axes[i, k] * values[k] * axes[j, k] for k in range(d)), start=jnp.zeros_like(values[0]))

    if d == 2:
        return jnp.stack([entry(0, 0), entry(1, 1), values[2], entry(0, 1)])
    return jnp.stack([entry(0, 0), entry(1, 1), entry(2, 2), entry(1, 2), entry(0, 2), entry(0, 1)])


def matrix_rows(e: Array) -> list[list[Array]]:
    """Symmetric tensors (s, n) as rows of in-plane components, each (n,): 2x2 in plane strain, 3x3 in 3-D."""
    if e.shape[0] == 4:
        return [[e[0], e[3]], [e[3], e[1]]]
    return [[e[0], e[5], e[4]], [e[5], e[1], e[3]], [e[4], e[3], e[2]]]


def volume_ratio(e: Array) -> Array:
    """J = sqrt(det b) (n,), the volume of strains e = b - I (s, n) over that at rest."""
    if e.shape[0] == 4:
        det = (1 + e[2]) * ((1 + e[0]) * (1 + e[1]) - e[3] * e[3])
    else:
        xx, yy, zz, (yz, xz, xy) = 1 + e[0], 1 + e[1], 1 + e[2], e[3:]
        det = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return jnp.sqrt(jnp.maximum(det, TINY))
