"""How a picture is lit: a distant sun that casts shadows, the sky for the rest, darker creases, some haze."""

from typing import Any

import mujoco
import numpy as np

from mpm_env.render_surface import FAR, Rays, Surface, cast, colour_of_geoms, only

SUN = np.array([-0.518, -0.378, 0.767], np.float32)  # unit vector towards it
SUNLIGHT = np.array([1.02, 0.95, 0.82], np.float32)
SKYLIGHT, BOUNCE = np.array([[0.34, 0.39, 0.47], [0.20, 0.18, 0.15]], np.float32)  # from above, from below
HORIZON, ZENITH = np.array([[0.84, 0.88, 0.91], [0.36, 0.53, 0.74]], np.float32)
CREASE_REACH = (1 / 50, 1 / 80, 1 / 160)  # of the picture's height; several, or edges would throw echoes
BODY_SLACK = 2e-3  # of the viewing distance: a body nearer to a point than this is the point's own


def shade(seen: Surface, model: Any, data: Any, grains: np.ndarray, radius: float, rays: Rays) -> np.ndarray:
    """Linear light (P, 3) that reaches the camera."""
    from scipy import ndimage

    picture = HORIZON + (ZENITH - HORIZON) * np.sqrt(rays.direction[:, 2:].clip(0))  # the sky
    hit = np.flatnonzero(seen.distance < FAR)
    d, n, t = rays.direction[hit], seen.normal[hit], seen.distance[hit]
    sunny = np.ones(len(picture), np.float32)
    point = rays.eye + d * t[:, None]
    if model is not None:
        sunny[hit] = _body_light(point, model, data, rays)
    if len(grains):
        sunny[hit] *= 1 - 0.9 * _grain_shadow(point + 4 * np.float32(radius) * n, grains, radius)
    sunny = ndimage.gaussian_filter(sunny.reshape(rays.size), 0.7).reshape(-1)[hit]
    up = (0.5 + 0.5 * n[:, 2])[:, None]
    sky = (SKYLIGHT * up + BOUNCE * (1 - up)) * (1 - 0.7 * _crease(seen.distance, rays)[hit, None])
    light = seen.albedo[hit] * (SUNLIGHT * ((n @ SUN).clip(0) * sunny)[:, None] + sky)
    picture[hit] = HORIZON + (light - HORIZON) * np.exp(-((t / (6 * rays.scale)) ** 2))[:, None]  # haze
    return picture


def _crease(distance: np.ndarray, rays: Rays) -> np.ndarray:
    """How far (P,) 0..1 a pixel lies in a valley: a little behind the middle of two opposite neighbours."""
    rows, columns = rays.size
    depth = np.minimum(distance / np.float32(0.01 * rays.scale), 400).reshape(rays.size)
    valley = np.zeros_like(depth)
    for share in CREASE_REACH:
        k = max(1, round(share * rows))
        wide = np.pad(depth, k, mode="reflect", reflect_type="odd")
        for i, j in ((0, k), (k, 0), (k, k), (k, -k)):
            ahead = wide[k + i : k + i + rows, k + j : k + j + columns]
            behind = wide[k - i : k - i + rows, k - j : k - j + columns]
            deep = 2 * depth - ahead - behind
            valley += (1 - np.abs(deep - 1)).clip(0)  # far behind is no valley, but another thing's edge
    return valley.reshape(-1) / (4 * len(CREASE_REACH))


def _body_light(point: np.ndarray, model: Any, data: Any, rays: Rays) -> np.ndarray:
    """Share of the sun (k,) that the bodies let through to each point."""
    lamp = rays.eye + SUN.astype(float) * 100 * rays.scale  # near enough that all shadow rays share an origin
    ray = point - lamp
    length = np.linalg.norm(ray, axis=1)
    first = cast(model, data, lamp, ray / length[:, None])[1]
    return (first > length - BODY_SLACK * rays.scale).astype(np.float32)


def _grain_shadow(point: np.ndarray, grains: np.ndarray, radius: float) -> np.ndarray:
    """Shadow (k,) 0..1 that the grains cast, by a map of the grains nearest to the sun."""
    from scipy import ndimage

    across = np.cross(SUN, np.array([0, 0, 1], np.float32))
    across /= np.linalg.norm(across)
    basis = np.stack([across, np.cross(SUN, across), SUN], 1)
    g, p = grains @ basis, point @ basis
    low, high = np.percentile(g[:, :2], [0.1, 99.9], axis=0).astype(np.float32)  # without a few strays
    cell = np.float32(max(2 * radius, (high - low).max() / 400))
    low, shape = low - 2 * cell, np.ceil((high - low) / cell).astype(int) + 5
    place = np.floor((g[:, :2] - low) / cell + 0.5).astype(int)
    held = ((place >= 0) & (place < shape)).all(1)
    top = np.full(shape, -FAR, np.float32)
    np.maximum.at(top, tuple(place[held].T), g[held, 2])
    top = ndimage.grey_closing(top, 3)  # gaps between grains let no sun through
    where = (p[:, :2] - low) / cell
    inside = np.flatnonzero(((where >= 0) & (where < shape - 1)).all(1))
    where, height, shadow = where[inside], p[inside, 2], np.zeros(len(p), np.float32)
    corner = where.astype(int)
    weight = where - corner.astype(np.float32)
    for step in ((0, 0), (0, 1), (1, 0), (1, 1)):  # shadows, not heights, are averaged: edges stay soft
        above = top[corner[:, 0] + step[0], corner[:, 1] + step[1]] - height
        share = np.abs(1 - np.array(step, np.float32) - weight).prod(1)
        shadow[inside] += share * (above / (4 * radius) - 1.5).clip(0, 1)
    return shadow


def cover(light: np.ndarray, distance: np.ndarray, model: mujoco.MjModel, data: Any, geom: int, rays: Rays) -> None:
    """Lay one see-through geom over the picture, more mirror-like where it is seen at a slant."""
    hit, near, normal = cast(only(model, np.arange(model.ngeom) == geom), data, rays.eye, rays.direction)
    front = np.flatnonzero((hit >= 0) & (near < distance))
    rgba = colour_of_geoms(model)[geom]
    slant = 1 - np.abs(np.einsum("ij,ij->i", normal[front], rays.direction[front]))
    alpha = (rgba[3] + (1 - rgba[3]) * 0.4 * slant**4).astype(np.float32)[:, None]
    light[front] += alpha * (rgba[:3] ** 2 - light[front])
