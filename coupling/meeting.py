"""Points meet bodies: who is near one, and the momentum that those near enough exchange with it.

What contact does in a substep, as two functions. Each runs in JAX, which is the reference and differentiable, or as a
native kernel for the CPU, which skips the points that are far away and does not care how many of those there are.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from coupling.constraints import Rows
from coupling.contact import Points, Surface, depth_of, distances, nearest_geom
from coupling.exchange import Exchange, Twists, exchange
from coupling.geoms import Shape, bounding_radius, dot
from mpm_env import native

NO_GAP = 0.25  # cells; what a node tells of its material's surface is no more exact than that
CLOSED = 0.1  # of a gap closes in a substep, at most: if all could, contact would come and go, and friction with it
LEAST_NORMAL = 1e-6  # of a normal's part in the plane of plane strain; a shorter one is no direction


class Geoms(NamedTuple):
    """The coupled geoms, and how contact with them is computed."""

    shapes: tuple[Shape, ...]
    body_of: tuple[int, ...]  # of each geom
    iterations: int  # of the exchange, at most
    layer: float  # m, a grid cell: what a layer of nodes stands for
    dt: float  # s, in which a gap may close
    plane_strain: bool  # normals lie in the plane y = 0
    kernels: str  # "native" or "xla", as `native.chosen` says


class Meeting(NamedTuple):
    """How points met bodies."""

    phi: Array  # (K,) m, signed distance to the nearest geom; of points that take no part, the reach
    n: Array  # (3, K) outward normal of that geom; of points that take no part, zero
    exchange: Exchange


def near(g: Geoms, pos: Array, mat: Array, x: Array, low: float, high: Array, room: int) -> tuple[Array, Array]:
    """Indices (room,) of points x (3, N) m between `low` and high (N,) m away from the nearest geom, ascending.

    N where there are fewer; also whether there were more. Geoms stand at pos (G, 3) m with axes mat (G, 3, 3).
    """
    if g.kernels == "native":
        index, found = jax.ffi.ffi_call(
            "mpm_env_near",
            (jax.ShapeDtypeStruct((room,), jnp.int32), jax.ShapeDtypeStruct((1,), jnp.int32)),
            vmap_method="expand_dims",
        )(*jax.lax.stop_gradient((x, high, pos, mat)), _voxels(g), **_table(g), low=np.float64(low))
        return index, found[0] > room
    phi = distances(g.shapes, x, pos, mat)
    return pick((phi > low) & (phi < high), room)


class Surfaces(NamedTuple):
    """How the geoms' surfaces are to each of M materials."""

    mu: Array  # (G, M) friction of each geom
    hold: Array  # (M,) N s, the most that a layer of points at full weight is held back by: adhesion
    shares: Array | None  # (M, K) of the materials in each point; None where there is one material
    full: Array | None = None  # (K,) kg, mass of a node with material all around it; None where points are all there is


def meet(
    g: Geoms, pos: Array, mat: Array, t: Twists, s: Surfaces, q_free: Array, x: Array, v: Array, m: Array, reach: float
) -> Meeting:
    """Points x (3, K) m with velocities v (3, K) m/s and masses m (K,) kg against the bodies.

    Those with mass and nearer than `reach` to a geom take part in the exchange, see `exchange`; geoms stand at
    pos (G, 3) m with axes mat (G, 3, 3). Adhesion is shared among the points of one layer beneath the reach, so that
    those in line with each other add up to one at full weight.

    A node has mass from 1.5 cells before the material's surface on, so by its share of the full mass it tells how far
    away that surface is, see `depth_of`, and meets the body only when that gap closes.
    """

    def reference(
        pos: Array, mat: Array, t: Twists, s: Surfaces, q_free: Array, x: Array, v: Array, m: Array
    ) -> Meeting:
        phi, n, geom = nearest_geom(g.shapes, x, pos, mat)
        if g.plane_strain:
            n = n.at[1].set(0)
            n = n / jnp.maximum(jnp.sqrt(dot(n, n)), LEAST_NORMAL)
        meets = (m > 0) & (phi < reach)
        shares = jnp.ones((1, 1), x.dtype) if s.shares is None else s.shares
        weight = jnp.maximum(1 - jnp.abs(phi - (reach - g.layer)) / g.layer, 0)
        slack = jnp.zeros_like(phi)
        if s.full is not None:
            slack = jnp.maximum(phi - g.layer * (depth_of(m / s.full) + NO_GAP), 0) * (CLOSED / g.dt)
        surface = Surface(dot(s.mu[geom].T, shares), weight * dot(s.hold, shares), slack)
        points = Points(x, v, jnp.where(meets, m, 0), phi, n, geom)
        done = exchange(points, t, q_free, surface, g.body_of, g.iterations)
        return Meeting(jnp.where(meets, phi, reach), jnp.where(meets, n, 0), done)

    def kernel(pos: Array, mat: Array, t: Twists, s: Surfaces, q_free: Array, x: Array, v: Array, m: Array) -> Meeting:
        none = jnp.zeros((0,), x.dtype)
        rows = t.rows or Rows(none[:, None] * q_free, t.M, *[none] * 5)
        shapes = (m.shape, x.shape, q_free.shape, x.shape, (len(g.shapes), 6), (1,), (1,), rows.D.shape)
        call = jax.ffi.ffi_call(
            "mpm_env_meet", [jax.ShapeDtypeStruct(s, x.dtype) for s in shapes], vmap_method="expand_dims"
        )
        attributes = {
            "body_of": np.asarray(g.body_of, np.int64),
            "iterations": np.int64(g.iterations),
            "plane_strain": g.plane_strain,
            "within": np.float64(reach),
            "layer": np.float64(g.layer),
            "dt": np.float64(g.dt),
        }
        shares = jnp.zeros((0, 0), x.dtype) if s.shares is None else s.shares
        laws = jnp.stack([rows.D, rows.aim, rows.low, rows.high, rows.given])
        full = none if s.full is None else s.full
        arrays = (x, v, m, pos, mat, t.centre, t.J, t.d, t.M, s.mu, s.hold, shares, full, q_free, rows.J, rows.T, laws)
        phi, n, q, impulse, wrench, residual, scale, given = call(*arrays, _voxels(g), **_table(g), **attributes)
        return Meeting(phi, n, Exchange(q, impulse, wrench, residual[0], scale[0], given))

    either = native.differentiable(kernel, reference) if g.kernels == "native" else reference
    return either(pos, mat, t, s, q_free, x, v, m)


def pick(mask: Array, room: int) -> tuple[Array, Array]:
    """Indices (room,) where the mask (n,) holds, n where there are fewer, and whether there were more."""
    count = counted(mask)
    return found(count, jnp.arange(room, dtype=count.dtype)), count[-1] > room


def counted(mask: Array) -> Array:
    """How many of the mask (n,) hold up to here, (n,)."""
    return jnp.cumsum(mask.astype(jnp.int32))


def found(count: Array, k: Array) -> Array:
    """Indices (size,) of the k-th that hold, from 0, by their count (n,); n where there are fewer.

    A search takes less time than jnp.nonzero, which scatters the whole mask.
    """
    return jnp.searchsorted(count, k + 1).astype(jnp.int32)


def _voxels(g: Geoms) -> Array:
    """The distances of all meshes behind each other."""
    values = [shape.voxels.values.ravel() for shape in g.shapes if shape.voxels is not None]
    return jnp.asarray(np.concatenate([np.zeros(0, np.float32), *values]))


def _table(g: Geoms) -> dict[str, Any]:
    """What the kernels are told of the geoms, see GeomTable in kernels.h."""
    meshes = [shape.voxels for shape in g.shapes]
    counts = [0 if some is None else some.values.size for some in meshes]
    return {
        "kind": np.asarray([shape.kind for shape in g.shapes], np.int64),
        "first": np.cumsum([0, *counts])[:-1].astype(np.int64),
        "nodes": np.asarray([(0, 0, 0) if some is None else some.values.shape for some in meshes], np.int64).ravel(),
        "size": np.asarray([shape.size for shape in g.shapes], np.float64).ravel(),
        "reach": np.asarray([bounding_radius(shape) for shape in g.shapes], np.float64),
        "origin": np.asarray([(0, 0, 0) if some is None else some.origin for some in meshes], np.float64).ravel(),
        "spacing": np.asarray([math.nan if some is None else some.spacing for some in meshes], np.float64),
    }
