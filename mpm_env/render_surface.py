"""What each pixel of a picture sees: bodies by MuJoCo's own ray casting, grains as small spheres."""

import copy
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

GROUND = np.array([0.44, 0.43, 0.41], np.float32)  # of the plane at `ground_z`
CHECK = 0.1  # m, side of the faint squares on level planes: a scale to measure by
VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)  # what MuJoCo's viewer shows at first
HIDDEN_GROUP = 5
MUJOCO_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
FAR = 1e6  # m, farther than any body; where the sky is
FRAGMENTS = 2_000_000  # grain pixels tested at a time: bounds the memory, not the result


@dataclass(frozen=True)
class Rays:
    """One ray per pixel, row by row from the top left; P = rows * columns."""

    eye: np.ndarray  # (3,) m
    direction: np.ndarray  # (P, 3) unit
    stretch: np.ndarray  # (P,) distance along the ray per distance along the view axis
    basis: np.ndarray  # (3, 3) rows: right, down, forward
    focal: np.float32  # pixels
    size: tuple[int, int]  # rows, columns
    scale: float  # m, from the eye to what it looks at: what counts as near


@dataclass(frozen=True)
class Surface:
    """What each pixel sees; colours add up when linear, and bytes are 255 times their square root."""

    distance: np.ndarray  # (P,) m along the ray; FAR is sky
    normal: np.ndarray  # (P, 3) unit, towards the eye
    albedo: np.ndarray  # (P, 3) linear colour


def colour_of_geoms(model: mujoco.MjModel) -> np.ndarray:
    """(g, 4) rgba, 0 to 1, by MuJoCo's rule: a material's, unless the geom has a colour of its own."""
    rgba, material = model.geom_rgba.copy(), model.geom_matid
    default = (rgba == MUJOCO_DEFAULT_RGBA).all(1) & (material >= 0)
    rgba[default] = model.mat_rgba[material[default]]
    return rgba


def shown_geoms(model: mujoco.MjModel) -> np.ndarray:
    """(g,) whether a geom is in a group that MuJoCo's viewer shows at first, and not wholly see-through."""
    return (VISIBLE_GROUPS[model.geom_group.clip(0, HIDDEN_GROUP)] > 0) & (colour_of_geoms(model)[:, 3] > 0)


def only(model: mujoco.MjModel, keep: np.ndarray) -> mujoco.MjModel:
    """A copy of the model where only the geoms of the mask are drawn; the caller's model stays as it is."""
    shown = copy.copy(model)
    shown.geom_group[~keep] = HIDDEN_GROUP
    return shown


def cast(model: Any, data: Any, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, ...]:
    """First hit of each unit ray (k, 3) from one point: geom (k,) or -1, distance (k,) m, normal (k, 3)."""
    k, origin, ray = len(direction), origin.astype(float), direction.astype(float).reshape(-1)
    geom, distance, normal = np.full(k, -1, np.int32), np.zeros(k), np.zeros(3 * k)
    mujoco.mj_multiRay(model, data, origin, ray, VISIBLE_GROUPS, True, -1, geom, distance, normal, k, FAR)
    distance[geom < 0] = FAR
    return geom, distance.astype(np.float32), normal.astype(np.float32).reshape(-1, 3)


def see_bodies(model: Any, data: Any, rays: Rays, ground_z: float | None) -> Surface:
    """What the geoms and the ground show; squares of `CHECK` on level planes."""
    d, eye = rays.direction, rays.eye
    distance, level = np.full(len(d), FAR, np.float32), np.zeros(len(d), bool)
    normal, albedo = np.zeros((2, len(d), 3), np.float32)
    if model is not None:
        geom, distance, normal = cast(model, data, eye, d)
        # geom -1, the sky, is the last entry of each table
        level = np.append(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, False)[geom]
        albedo = np.append(colour_of_geoms(model)[:, :3] ** 2, np.zeros((1, 3), np.float32), 0)[geom]
    if ground_z is not None:
        t = np.float32(ground_z - eye[2]) / np.where(d[:, 2] == 0, np.float32(1e-12), d[:, 2])
        ground = (t > 0) & (t < distance)
        distance[ground], normal[ground], albedo[ground] = t[ground], (0, 0, 1), GROUND
        level |= ground
    away = np.einsum("ij,ij->i", normal, d) > 0  # an open mesh or the ground may show its back
    normal[away] *= -1
    level = np.flatnonzero(level & (np.abs(normal[:, 2]) > 0.9))
    x = eye[:2] + d[level, :2] * distance[level, None]
    footprint = distance[level] / rays.focal / np.abs(d[level, 2]).clip(1e-6)
    sharp = (1.5 - 3 * footprint / CHECK).clip(0, 1)  # fades before squares shrink to pixels
    odd = (np.floor(x[:, 0] / CHECK) + np.floor(x[:, 1] / CHECK)) % 2
    albedo[level] *= (1 + 0.14 * sharp * (odd - 0.5))[:, None]
    return Surface(distance, normal, albedo)


def splat(seen: Surface, grains: np.ndarray, colour: np.ndarray, radius: float, rays: Rays) -> None:
    """Draw the grains (n, 3) m, n > 0, as spheres into `seen` where they are nearer."""
    rows, columns = rays.size
    x = (grains - rays.eye) @ rays.basis.T
    index = np.flatnonzero(x[:, 2] > 2 * radius)  # behind the eye or about to cover the lens
    z = x[index, 2]
    u, v = (x[index, :2] * rays.focal / z[:, None] + np.array([columns / 2, rows / 2], np.float32)).T
    r = np.maximum(rays.focal * np.float32(radius) / z, np.float32(0.71))  # no smaller than a pixel's corner
    inside = (u > -r) & (u < columns + r) & (v > -r) & (v < rows + r)
    index, z, u, v, r = index[inside], z[inside], u[inside], v[inside], r[inside]
    # Nearest wins: positive floats order as their bits do, so distance bits and grain make one integer.
    nobody = np.uint64(0xFFFFFFFF)
    key = (seen.distance.view(np.uint32).astype(np.uint64) << np.uint64(32)) | nobody
    half = np.ceil(r).astype(int)
    for h in np.unique(half):
        offset = np.arange(-h, h + 1)
        same = np.flatnonzero(half == h)
        for part in np.array_split(same, len(same) * len(offset) ** 2 // FRAGMENTS + 1):
            column = np.floor(u[part]).astype(int)[:, None] + offset
            row = np.floor(v[part]).astype(int)[:, None] + offset
            a = ((column.astype(np.float32) + 0.5 - u[part, None]) / r[part, None]) ** 2
            b = ((row.astype(np.float32) + 0.5 - v[part, None]) / r[part, None]) ** 2
            a[(column < 0) | (column >= columns)] = 2
            b[(row < 0) | (row >= rows)] = 2
            bulge = 1 - (b[:, :, None] + a[:, None, :])
            g, i, j = np.nonzero(bulge >= 0)
            pixel = row[g, i] * columns + column[g, j]
            near = (z[part][g] - np.float32(radius) * np.sqrt(bulge[g, i, j])) * rays.stretch[pixel]
            bits = near.view(np.uint32).astype(np.uint64) << np.uint64(32)
            np.minimum.at(key, pixel, bits | part[g].astype(np.uint64))
    pixel = np.flatnonzero((key & nobody) != nobody)
    g = (key[pixel] & nobody).astype(int)
    seen.distance[pixel] = (key[pixel] >> np.uint64(32)).astype(np.uint32).view(np.float32)
    seen.albedo[pixel] = colour[index[g]]
    a = ((pixel % columns).astype(np.float32) + 0.5 - u[g]) / r[g]
    b = ((pixel // columns).astype(np.float32) + 0.5 - v[g]) / r[g]
    ball = np.stack([a, b, -np.sqrt((1 - a * a - b * b).clip(0))], 1) @ rays.basis
    normal = _heap_normal(grains, radius)[index[g]] + 0.45 * ball  # the heap's slope, and the grain's roundness on it
    seen.normal[pixel] = normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-6)


def _heap_normal(grains: np.ndarray, radius: float) -> np.ndarray:
    """Outward direction of the heap at each grain (n, 3), from the grains' number density; near 0 inside."""
    from scipy import ndimage

    low, high = np.percentile(grains, [0.5, 99.5], axis=0)  # a few strays must not blow up the grid
    cell = max(3 * radius, float((high - low).max()) / 60)
    shape = np.ceil((high - low) / cell).astype(int) + 5
    place = (grains - np.float32(low)) / np.float32(cell) + 2
    nearest = np.floor(place + 0.5).astype(int)
    held = ((nearest >= 0) & (nearest < shape)).all(1)
    flat = np.ravel_multi_index(tuple(nearest[held].T), tuple(shape))
    density = np.bincount(flat, minlength=int(shape.prod())).reshape(shape).astype(np.float32)
    density = ndimage.gaussian_filter(density, 1.5, mode="nearest")
    slope = np.stack([ndimage.map_coordinates(-g, place.T, order=1) for g in np.gradient(density)], 1)
    slope[:, 2] = slope[:, 2].clip(0)  # what lies on the floor has no underside to see
    slope /= max(float(density.max()), 1e-6)
    steep = np.linalg.norm(slope, axis=1, keepdims=True)
    return slope * steep / (steep**2 + 0.12**2)  # 0.35 at a free surface; a little is only uneven filling
