"""How far a point is from a MuJoCo geom: signed distance in metres, negative inside, in the geom's own frame.

Primitive shapes have exact distances, one function each in `GEOM_SDF`, written on the rows x, y, z of one point (3,) or
of many (3, ..): with the points' axis last they are computed side by side. A mesh, concave or not, is turned once
into a grid of distances (voxels), kept on disk and sampled linearly. MuJoCo itself collides a mesh as its
convex hull, so a concave tool that must also touch rigid bodies is better built from boxes.

To add a primitive: write its distance, then add one line to `GEOM_SDF` and one to `BOUNDS`.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.scipy.ndimage import map_coordinates

from coupling.voxels import Voxels, voxels_of

MESH = int(mujoco.mjtGeom.mjGEOM_MESH)

TINY_SQUARE = 1e-30
"""Squared lengths below this count as zero: 1e-15 m is no distance here, and its square fits float32."""
NUDGE = 1e-9
"""An ellipsoid's point stays this share of the shortest half axis off each mid plane, where the nearest point
of the surface is not unique. It moves that by as little."""
HALVINGS = 10
"""Brackets up to e^32 wide (`NUDGE`, and points 1e5 half axes away) shrink to e^(32 / 2^10) = 1.03."""
NEWTON_STEPS = 4
"""From 3 % off, an error e becomes 1.5 e^2 each step: 1e-3, 3e-6, 1e-11, below float64's digits."""
FLAT_GRADIENT = 1e-6
"""A squared gradient below this has no direction left: exact distances have 1, voxels 0 on ridges inside."""


Rows = Array | Sequence[Array]


@dataclass(frozen=True, eq=False)
class Shape:
    """What a coupled geom is, apart from where it is. Equal only to itself."""

    kind: int  # a key of GEOM_SDF, or MESH
    size: tuple[float, float, float]  # m, as in `model.geom_size`; a mesh does not use it
    voxels: Voxels | None = None  # meshes only


def dot(a: Rows, b: Rows) -> Array:
    """Inner products (..) of vectors (n, ..), row by row: a reduction of the first axis is not vectorised."""
    return functools.reduce(lambda s, t: s + t, (p * q for p, q in zip(a, b, strict=True)))


def once(a: Any) -> Any:
    """Arrays as they are, but computed once: XLA likes to compute them anew in every loop that reads them."""
    return jax.lax.optimization_barrier(a)


def length(v: Rows) -> Array:
    """Euclidean lengths (..) of v (n, ..), whose gradient is a unit vector even at zero (there: along the first axis).

    The first axis is at right angles to every geom's axis of symmetry, z, so it is a true normal there too.
    """
    square = dot(v, v)
    far = square > TINY_SQUARE
    return jnp.where(far, jnp.sqrt(jnp.where(far, square, 1)), v[0])


def magnitude(v: Array) -> Array:
    """|v|, with gradient 1 rather than 0 at zero."""
    return jnp.where(v < 0, -v, v)


def corner(q: Rows) -> Array:
    """Signed distances (..) to the region where all of q (n, ..) <= 0: boxes and cylinders, seen from one corner."""
    # Not jnp.max, which shares the gradient among equals and so shortens it.
    nearest = functools.reduce(lambda a, b: jnp.where(b > a, b, a), q)
    return jnp.where(nearest > 0, length([jnp.maximum(a, 0) for a in q]), nearest)


def plane(size: Array, p: Array) -> Array:
    """Height over the half space z <= 0. It has no edge: MuJoCo's plane size is for drawing only."""
    return p[2]


def sphere(size: Array, p: Array) -> Array:
    """Sphere of radius size[0]."""
    return length(p) - size[0]


def capsule(size: Array, p: Array) -> Array:
    """Capsule of radius size[0] around the segment |z| <= size[1]."""
    return length((p[0], p[1], p[2] - jnp.clip(p[2], -size[1], size[1]))) - size[0]


def cylinder(size: Array, p: Array) -> Array:
    """Cylinder of radius size[0] and half height size[1], along z."""
    return corner((length(p[:2]) - size[0], magnitude(p[2]) - size[1]))


def box(size: Array, p: Array) -> Array:
    """Box of half sides size."""
    return corner([magnitude(a) - half for a, half in zip(p, size, strict=True)])


def ellipsoid(size: Array, p: Array) -> Array:
    """Ellipsoid of half axes r = size.

    The nearest surface point is x_i = r_i u_i with u_i = r_i p_i / (t + r_i^2), t the largest root of |u| = 1
    (D. Eberly, Distance from a Point to an Ellipse, an Ellipsoid, or a Hyperellipsoid). We solve for
    s = t + min(r)^2, which keeps float32's digits deep inside, and return n . (p - x), n the normal at x: its
    error is second order in that of x. Gradients by p and by size are exact; second derivatives are left out.
    """
    r, a = jax.lax.stop_gradient((size, magnitude(p)))
    r_min = jnp.min(r, axis=0)
    rp = r * jnp.maximum(a, NUDGE * r_min)
    gap = (r - r_min) * (r + r_min)

    low, high = jnp.max(rp - gap, axis=0), jnp.sqrt(dot(rp, rp))  # not 0, by NUDGE; |u| >= 1 at low, <= 1 at high
    for _ in range(HALVINGS):
        middle = jnp.sqrt(low * high)
        below = jnp.sum((rp / (middle + gap)) ** 2, axis=0) > 1
        low, high = jnp.where(below, middle, low), jnp.where(below, high, middle)
    s = low  # |u|^2 falls and is convex, so Newton from below never oversteps
    for _ in range(NEWTON_STEPS):
        u_square = (rp / (s + gap)) ** 2
        s = s + (jnp.sum(u_square, axis=0) - 1) / jnp.sum(2 * u_square / (s + gap), axis=0)

    u = jnp.where(p < 0, -1, 1) * rp / (s + gap)
    u = jax.lax.stop_gradient(u / length(u))
    n = jax.lax.stop_gradient(u / r / length(u / r))
    return dot(n, p - size * u)


def mesh(voxels: Voxels, p: Array) -> Array:
    """Mesh, sampled linearly from its voxels.

    Off by a small part of a voxel at flat places, by up to half of one at sharp edges; walls need two voxels.
    Outside the grid: the distance to the grid's nearest point plus the value there, which is continuous and,
    but for that error, never below the true distance.
    """
    values = jnp.asarray(voxels.values, p.dtype)
    origin, last = _beside(voxels.origin, p), _beside(np.array(values.shape) - 1, p)
    at = jnp.clip(p, origin, origin + voxels.spacing * last)
    sampled = map_coordinates(values, list((at - origin) / voxels.spacing), order=1, mode="nearest")
    return sampled + length(p - at)


GEOM_SDF: dict[int, Callable[[Array, Array], Array]] = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): plane,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): sphere,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): capsule,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ellipsoid,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): cylinder,
    int(mujoco.mjtGeom.mjGEOM_BOX): box,
}
"""Signed distances (..) m of points p (3, ..) from a primitive of MuJoCo's size (3, ..), in the geom's frame."""

BOUNDS: dict[int, Callable[[float, float, float], tuple[tuple[float, float, float], float]]] = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): lambda a, b, c: ((math.inf, math.inf, math.inf), math.inf),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda a, b, c: ((a, a, a), a),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): lambda a, b, c: ((a, a, a + b), a + b),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): lambda a, b, c: ((a, b, c), max(a, b, c)),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda a, b, c: ((a, a, b), math.hypot(a, b)),
    int(mujoco.mjtGeom.mjGEOM_BOX): lambda a, b, c: ((a, b, c), math.hypot(a, b, c)),
}
"""Half sides of a primitive's bounding box and radius of its bounding sphere, m, from MuJoCo's size."""


def distance(shape: Shape, p: Array, size: Array | None = None) -> Array:
    """Signed distances (..) m of points p (3, ..) m of the geom's frame; negative inside. In p's precision.

    With a size (3, ..) m for each point, each is measured from a geom of its own, of the same kind.
    """
    if shape.voxels is not None:
        return mesh(shape.voxels, p)
    return GEOM_SDF[shape.kind](_beside(shape.size, p) if size is None else size, p)


def distance_and_normal(shape: Shape, p: Array, size: Array | None = None) -> tuple[Array, Array]:
    """Signed distances (..) m of points p (3, ..) m and the outward unit normals (3, ..), in the geom's frame.

    The normal is that of the nearest surface point, inside too, or of one of several equally near. On ridges
    inside a mesh it may be any unit vector.
    """
    phi, back = jax.vjp(lambda p: distance(shape, p, size), p)
    gradient = once(back(jnp.ones_like(phi))[0])  # each distance depends on its own point only
    steep = dot(gradient, gradient) > FLAT_GRADIENT
    gradient = jnp.where(steep, gradient, _beside((1, 0, 0), p))
    return phi, gradient / length(gradient)


def _beside(a: Sequence[float] | np.ndarray, p: Array) -> Array:
    """a (3,) in the precision of points p (3, ..), with axes added so that the two go together."""
    return jnp.asarray(a, p.dtype).reshape((3,) + (1,) * (p.ndim - 1))


def half_extents(shape: Shape) -> np.ndarray:
    """Half sides (3,) m of the bounding box about `centre`, along the geom's axes; infinite for a plane."""
    if shape.voxels is not None:
        low, high = _inside(shape.voxels)
        return (high - low) / 2
    return np.array(BOUNDS[shape.kind](*shape.size)[0])


def thickness(shape: Shape) -> float:
    """Smallest side of the bounding box, m; of a mesh, whose walls are thinner than it, twice its deepest voxel."""
    if shape.voxels is not None:
        return -2 * float(shape.voxels.values.min())
    return 2 * float(np.min(half_extents(shape)))


def centre(shape: Shape) -> np.ndarray:
    """Centre (3,) m of the bounding box in the geom's frame: the frame's origin, but for meshes."""
    if shape.voxels is not None:
        low, high = _inside(shape.voxels)
        return (high + low) / 2
    return np.zeros(3)


def bounding_radius(shape: Shape) -> float:
    """Radius, m, of a sphere about the geom frame's origin that holds the geom; infinite for a plane."""
    if shape.voxels is not None:
        return float(np.linalg.norm(np.abs(centre(shape)) + half_extents(shape)))
    return BOUNDS[shape.kind](*shape.size)[1]


def _inside(voxels: Voxels) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (3,) m of a box that holds the mesh: all negative nodes, and a voxel around."""
    nodes = np.argwhere(voxels.values < 0)
    return (
        voxels.origin + voxels.spacing * (nodes.min(axis=0) - 1),
        voxels.origin + voxels.spacing * (nodes.max(axis=0) + 1),
    )


def shape_of(model: mujoco.MjModel, geom: int, *, cells: int = 64, cache_dir: Path | None = None) -> Shape:
    """The shape of a MuJoCo geom; a mesh is cut into `cells` voxels along its longest side.

    Meshes take about half a second at 64 cells, once: distances are kept in `cache_dir`, by default
    `mpm_env/sdf` in `$XDG_CACHE_HOME` or `~/.cache`.

    Raises ValueError for an unknown geom, a geom type without a distance, and what `voxels_of` refuses of a mesh.
    """
    if not 0 <= geom < model.ngeom:
        raise ValueError(f"geom = {geom} is not in this model: use an id in 0..{model.ngeom - 1}.")
    name = model.geom(geom).name or f"number {geom}"
    kind = int(model.geom_type[geom])
    a, b, c = (float(s) for s in model.geom_size[geom])
    if kind in GEOM_SDF:
        return Shape(kind, (a, b, c))
    if kind != MESH:
        supported = ", ".join(_type_name(k) for k in [*GEOM_SDF, MESH])
        raise ValueError(
            f"geom {name} is of type {_type_name(kind)}, which cannot touch grains; "
            f"supported are {supported}: replace it by those or leave it out of the coupling."
        )
    return Shape(kind, (a, b, c), voxels_of(model, geom, cells=cells, cache_dir=cache_dir))


def _type_name(kind: int) -> str:
    return mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
