"""Points against rigid geoms: how far and which way, and the law of an inelastic contact with Coulomb friction.

Many points are rows (3, K): with their axis last they are computed side by side.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from coupling.geoms import Shape, distance, distance_and_normal, dot, once

TINY = 1e-20  # (m/s)^2, guards the direction of sliding at rest
LEAST_FILL = 1e-6  # of a node: 0.02 cells from none at all, where the slope of the cube root is not finite


class Points(NamedTuple):
    """Grid nodes or grains near bodies, each facing its nearest geom."""

    x: Array  # (3, K) m
    v: Array  # (3, K) m/s
    m: Array  # (K,) kg; 0 where the point takes no part
    phi: Array  # (K,) m, signed distance to the nearest geom
    n: Array  # (3, K) outward normal of that geom
    geom: Array  # (K,) its index among the coupled geoms


def distances(shapes: tuple[Shape, ...], x: Array, pos: Array, mat: Array) -> Array:
    """Signed distance (K,) m of points x (3, K) m to the nearest geom; arguments as for `nearest_geom`."""
    return functools.reduce(jnp.minimum, (jnp.min(some.distances(x), axis=0) for some in _alike(shapes, pos, mat)))


def nearest_geom(shapes: tuple[Shape, ...], x: Array, pos: Array, mat: Array) -> tuple[Array, Array, Array]:
    """Signed distance (K,) m, outward normal (3, K) and index (K,) of the geom nearest to points x (3, K) m.

    Geoms stand at pos (G, 3) m with axes mat (G, 3, 3), columns in world coordinates.
    """

    def nearer(a: tuple[Array, Array, Array], b: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        return jax.tree.map(functools.partial(jnp.where, b[0] < a[0]), b, a)

    return functools.reduce(nearer, (some.nearest(x) for some in _alike(shapes, pos, mat)))


class Alike(NamedTuple):
    """Some geoms of one kind, computed together so that a bucket of many plates compiles as one; or one mesh."""

    shape: Shape  # of the first
    among: np.ndarray  # (g,) indices of the coupled geoms
    size: Array  # (3, g) m
    at: Array  # (3, g) m
    axes: Array  # (3, 3, g), columns in world coordinates

    def distances(self, x: Array) -> Array:
        """Signed distances (g, K) m of points x (3, K) m."""
        size, at, axes = self.size[..., None], self.at[..., None], self.axes[..., None]
        return distance(self.shape, _inward(axes, x[:, None] - at), size)

    def nearest(self, x: Array) -> tuple[Array, Array, Array]:
        """Signed distance (K,) m, outward normal (3, K) and index (K,) of the one nearest to points x (3, K) m."""
        phi = once(self.distances(x))
        g = jnp.argmin(phi, axis=0)
        size, at, axes = once((self.size[:, g], self.at[:, g], self.axes[..., g]))
        n = distance_and_normal(self.shape, once(_inward(axes, x - at)), size)[1]
        return jnp.min(phi, axis=0), _outward(axes, once(n)), jnp.asarray(self.among, jnp.int32)[g]


def _alike(shapes: tuple[Shape, ...], pos: Array, mat: Array) -> list[Alike]:
    """The geoms by kind; every mesh on its own."""
    kinds = [shape.kind if shape.voxels is None else -1 - i for i, shape in enumerate(shapes)]
    out = []
    for kind in dict.fromkeys(kinds):
        mine = [i for i, other in enumerate(kinds) if other == kind]
        among, size = np.asarray(mine), jnp.asarray([shapes[i].size for i in mine], pos.dtype).T
        out.append(Alike(shapes[mine[0]], among, size, pos[among].T, jnp.moveaxis(mat[among], 0, -1)))
    return out


def _inward(axes: Array, v: Array) -> Array:
    """World vectors v (3, ..) in a frame with these axes (3, 3, ..), columns in world coordinates."""
    return jnp.stack([dot(axes[:, i], v) for i in range(3)])


def _outward(axes: Array, v: Array) -> Array:
    """Vectors v (3, ..) of a frame with these axes (3, 3, ..) in the world."""
    return jnp.stack([dot(axes[i], v) for i in range(3)])


def cross(a: Array, b: Array) -> Array:
    """Vector products (3, ..), row by row."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class Surface(NamedTuple):
    """How the bodies' surface is to each point."""

    mu: Array  # (K,) Coulomb's coefficient of friction
    hold: Array | float = 0.0  # (K,) N s, the most that the surface pulls on a point that leaves: adhesion
    slack: Array | float = 0.0  # (K,) m/s, with which a point may approach before it touches


def depth_of(fill: Array) -> Array:
    """How deep (..) in cells a node lies in a half space of material that gives it this share of its full mass.

    The inverse of a quadratic B-spline's integral; from -1.5 (none) to 1.5 (all around), 0 on the surface.
    """
    fill = jnp.clip(fill, LEAST_FILL, 1 - LEAST_FILL)
    some, rest = jnp.minimum(fill, 1 / 6), jnp.minimum(1 - fill, 1 / 6)
    s = 1.4 * (jnp.clip(fill, 1 / 6, 5 / 6) - 0.5)
    for _ in range(2):  # Newton: off by 2e-2, 6e-5, 1e-9
        s = s - (0.75 * s - s * s * s / 3 - (jnp.clip(fill, 1 / 6, 5 / 6) - 0.5)) / (0.75 - s * s)
    edge = jnp.cbrt(6 * some) - jnp.cbrt(6 * rest)  # -1 + .. below a sixth, 1 - .. above five sixths
    return jnp.where(fill < 1 / 6, edge - 0.5, jnp.where(fill > 5 / 6, edge + 0.5, s))


def impulses(p: Points, w: Array, surface: Surface) -> Array:
    """Impulses (3, .., K) N s on points that move with w (3, .., K) m/s relative to their body.

    A point that separates gets none, or where the surface is sticky as much as keeps it, up to the hold. One that
    approaches loses its approach, but for the slack. By Coulomb's bound on the tangential impulse, mu times the normal
    one beyond the pull that the surface can give, it loses all or part of its sliding. The law only dissipates.
    """
    approach = -dot(w, p.n)
    w_t = [a + approach * n for a, n in zip(w, p.n, strict=True)]
    normal = jnp.maximum(p.m * (approach - surface.slack), -surface.hold)
    bound = surface.mu * (normal + surface.hold)
    held = jnp.minimum(p.m, bound / jnp.sqrt(dot(w_t, w_t) + TINY))
    push, held = once((normal - held * approach, held))
    return jnp.stack([push * n - held * a for a, n in zip(w, p.n, strict=True)])


def stiffness(p: Points, w: Array, surface: Surface) -> Array:
    """Derivative (3, 3, K) kg of minus the impulses with respect to w: what one more m/s of approach would cost."""
    approach = -dot(w, p.n)
    w_t = w + approach * p.n
    speed = jnp.sqrt(dot(w_t, w_t) + TINY)
    touching = p.m * (approach - surface.slack) > -surface.hold
    normal = jnp.maximum(p.m * (approach - surface.slack), -surface.hold)
    rub = surface.mu * (normal + surface.hold) / speed  # kg
    t = w_t / speed
    eye = jnp.eye(3, dtype=w.dtype)[..., None]
    nn, tt, tn = p.n[:, None] * p.n, t[:, None] * t, t[:, None] * p.n
    m = jnp.where(touching, p.m, 0)
    return jnp.where(rub >= p.m, m * nn + p.m * (eye - nn), m * (nn - surface.mu * tn) + rub * (eye - nn - tt))
