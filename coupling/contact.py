"""Points against rigid geoms: who is near, and the law of an inelastic contact with Coulomb friction."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from coupling.geoms import Shape, distance_and_normal

TINY = 1e-20  # (m/s)^2, guards the direction of sliding at rest


class Points(NamedTuple):
    """Grid nodes or grains near bodies, each facing its nearest geom."""

    x: Array  # (K, 3) m
    v: Array  # (K, 3) m/s
    m: Array  # (K,) kg; 0 where the point takes no part
    phi: Array  # (K,) m, signed distance to the nearest geom
    n: Array  # (K, 3) outward normal of that geom
    geom: Array  # (K,) its index among the coupled geoms


def distances(shapes: tuple[Shape, ...], x: Array, pos: Array, mat: Array) -> tuple[Array, Array, Array]:
    """Signed distance (K,) m, outward normal (K, 3) and index (K,) of the geom nearest to points x (K, 3) m.

    Geoms stand at pos (G, 3) m with axes mat (G, 3, 3), columns in world coordinates. Geoms of one kind are computed
    together, so that a bucket of many plates compiles as one.
    """

    def one(shape: Shape, at: Array, axes: Array) -> tuple[Array, Array]:
        phi, n = jax.vmap(partial(distance_and_normal, shape))((x - at) @ axes)
        return phi, n @ axes.T

    order: list[int] = []
    phis, normals = [], []
    for kind in dict.fromkeys(shape.kind for shape in shapes):
        mine = [i for i, shape in enumerate(shapes) if shape.kind == kind]
        order += mine
        if shapes[mine[0]].voxels is not None:
            both = [one(shapes[i], pos[i], mat[i]) for i in mine]
            phis.append(jnp.stack([phi for phi, _ in both]))
            normals.append(jnp.stack([n for _, n in both]))
            continue
        index = np.asarray(mine)
        sizes = jnp.asarray([shapes[i].size for i in mine], x.dtype)
        phi, n = jax.vmap(lambda size, at, axes, kind=kind: one(Shape(kind, size), at, axes))(
            sizes, pos[index], mat[index]
        )
        phis.append(phi)
        normals.append(n)
    phi, normal = jnp.concatenate(phis), jnp.concatenate(normals)
    nearest = jnp.argmin(phi, axis=0)
    n = jnp.take_along_axis(normal, nearest[None, :, None], axis=0)[0]
    return jnp.min(phi, axis=0), n, jnp.asarray(order, jnp.int32)[nearest]


def impulses(p: Points, w: Array, mu: Array) -> Array:
    """Impulses (K, 3) N s on points that move with w (K, 3) m/s relative to their body, friction mu (K,).

    A point that separates gets none. One that approaches loses its approach and, by Coulomb's bound on the tangential
    impulse, all or part of its sliding.
    """
    approach = jnp.maximum(-jnp.sum(w * p.n, axis=-1), 0)
    w_t = w + approach[:, None] * p.n
    speed = jnp.sqrt(jnp.sum(w_t * w_t, axis=-1) + TINY)
    held = jnp.minimum(1, mu * approach / speed)
    touching = jnp.where(approach > 0, p.m, 0)
    return touching[:, None] * (approach[:, None] * p.n - held[:, None] * w_t)


def stiffness(p: Points, w: Array, mu: Array) -> Array:
    """Derivative (K, 3, 3) kg of minus the impulses with respect to w: what one more m/s of approach would cost."""
    approach = jnp.maximum(-jnp.sum(w * p.n, axis=-1), 0)
    w_t = w + approach[:, None] * p.n
    speed = jnp.sqrt(jnp.sum(w_t * w_t, axis=-1) + TINY)
    ratio = mu * approach / speed
    sticks = ratio >= 1
    t = w_t / speed[:, None]
    eye = jnp.eye(3, dtype=w.dtype)
    nn = p.n[:, :, None] * p.n[:, None, :]
    tt = t[:, :, None] * t[:, None, :]
    tn = t[:, :, None] * p.n[:, None, :]
    slide = nn - mu[:, None, None] * tn + ratio[:, None, None] * (eye - nn - tt)
    D = jnp.where(sticks[:, None, None], eye, slide)
    return jnp.where(approach > 0, p.m, 0)[:, None, None] * D
