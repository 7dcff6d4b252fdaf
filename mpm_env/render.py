"""Pictures of a scene without OpenGL: MuJoCo's own ray casting for bodies, numpy for grains.

One ray per pixel finds the nearest body (`mujoco.mj_multiRay`, on the CPU); every grain is then drawn as a
small sphere where it lies nearer. A distant sun casts shadows, the sky lights the rest, creases are darker.
No display, driver or GL library is needed, and the same call gives the same bytes. Textures are not drawn.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

SAND = np.array([[184, 142, 88], [236, 204, 150]], np.float32)  # a grain without a colour lies between these
SUN = np.array([-0.518, -0.378, 0.767], np.float32)  # unit vector towards it
# Light adds up in linear colour; the picture's bytes are its square root (gamma 2, close to sRGB and cheap).
SUNLIGHT = np.array([1.02, 0.95, 0.82], np.float32)
SKYLIGHT, BOUNCE = np.array([[0.34, 0.39, 0.47], [0.20, 0.18, 0.15]], np.float32)  # from above, from below
HORIZON, ZENITH = np.array([[0.84, 0.88, 0.91], [0.36, 0.53, 0.74]], np.float32)
GROUND = np.array([0.44, 0.43, 0.41], np.float32)  # of the plane at `ground_z`
CHECK = 0.1  # m, side of the faint squares on level planes: a scale to measure by
VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)  # what MuJoCo's viewer shows at first
HIDDEN_GROUP = 5
FAR = 1e6  # m, farther than any body; where the sky is
FRAGMENTS = 2_000_000  # grain pixels tested at a time: bounds the memory, not the result


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: where it stands, what it looks at, and its vertical opening angle."""

    eye: tuple[float, float, float]  # m
    target: tuple[float, float, float]  # m
    fov_deg: float = 40.0
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            value = np.asarray(getattr(self, name), float)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ValueError(f"camera {name} = {value.tolist()} is no point: give 3 finite numbers.")
            object.__setattr__(self, name, tuple(value.tolist()))  # hashable, so that its rays can be cached
        if not 0 < self.fov_deg < 180:
            raise ValueError(f"camera fov_deg = {self.fov_deg} is outside 0..180: use 40 or so.")
        look = np.subtract(self.target, self.eye)
        if np.linalg.norm(np.cross(look, self.up)) <= 1e-6 * np.linalg.norm(look) * np.linalg.norm(self.up):
            raise ValueError(f"camera looks along up = {self.up}: move eye off target or give another up.")


def camera_for(lower: Sequence[float], upper: Sequence[float]) -> Camera:
    """A three-quarter view that just holds the box `lower` to `upper` (3,) m in a picture of 3:2 or wider."""
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    if low.shape != (3,) or high.shape != (3,) or not (low <= high).all() or (low == high).all():
        raise ValueError(f"box from {lower} to {upper} is no box: give 3 coordinates each, lower below upper.")
    fov_deg, towards, centre = 35.0, np.array([0.42, -0.76, 0.50]), (low + high) / 2
    corners = np.stack(np.meshgrid(*np.stack([low, high], 1) - centre[:, None]), -1).reshape(-1, 3)
    across, down, ahead = _basis(-towards, (0, 0, 1)) @ corners.T
    half = np.tan(np.radians(fov_deg / 2)) / 1.08  # a margin
    far = (np.maximum(np.abs(across) / 1.5, np.abs(down)) / half - ahead).max()
    return Camera(tuple(centre + far * towards / np.linalg.norm(towards)), tuple(centre), fov_deg)


def _basis(look: np.ndarray, up: Sequence[float]) -> np.ndarray:
    """Right, down and forward (3, 3), one unit vector per row, of a camera that looks along `look`."""
    right, forward = np.cross(look, up), look / np.linalg.norm(look)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


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


@dataclass
class Surface:
    """What each pixel sees."""

    distance: np.ndarray  # (P,) m along the ray; FAR is sky
    normal: np.ndarray  # (P, 3) unit, towards the eye
    albedo: np.ndarray  # (P, 3) linear colour
    shiny: np.ndarray  # (P,) bool: bodies, not planes nor grains


def render(
    model: mujoco.MjModel | None,
    data: mujoco.MjData | None,
    camera: Camera,
    *,
    grains: np.ndarray | None = None,
    colors: np.ndarray | None = None,
    grain_radius: float = 0.005,
    ground_z: float | None = None,
    width: int = 480,
    height: int = 320,
    samples: int = 1,
) -> np.ndarray:
    """The scene as the camera sees it: (height, width, 3) uint8.

    `data` holds the bodies' poses (after `mj_forward` or `mj_kinematics`); both None: grains alone. Geoms of
    groups 0 to 2 are drawn, alpha below 1 is see-through. `grains` (n, 3) m in the world frame, the ones not
    finite left out; `colors` (n, 3) uint8, sand if None; `grain_radius` m. `ground_z` m adds a level plane,
    for models without one. `samples` = 2 smooths edges at 4 times the cost. Raises ValueError for what does
    not fit.
    """
    if (model is None) != (data is None):
        raise ValueError("render got only one of model and data: give both, or None for both.")
    if min(width, height, samples) < 1:
        raise ValueError(f"picture of {width} x {height}, samples = {samples}: all three must be at least 1.")
    x, color = _checked(grains, colors, grain_radius)
    rays = _rays(camera, height * samples, width * samples)
    opaque, glass = (model, []) if model is None else _split_glass(model)
    seen = _bodies(opaque, data, rays, ground_z)
    if len(x):
        _splat(seen, x, color, grain_radius, rays)
    light = _shade(seen, opaque, data, x, grain_radius, rays)
    for geom in glass:
        _cover(light, seen.distance, model, data, geom, rays)
    bright = (light - 0.7).clip(0)
    light += 0.3 * np.tanh(bright / 0.3) - bright  # snow in the sun keeps its shape
    light = light.reshape(height, samples, width, samples, 3).mean((1, 3))
    return (np.sqrt(light.clip(0, 1)) * 255 + 0.5).astype(np.uint8)


def _checked(grains: Any, colors: Any, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Finite grains (n, 3) and their linear colours (n, 3), or the sentence that says what is wrong."""
    x = np.zeros((0, 3), np.float32) if grains is None else np.asarray(grains, np.float32)
    if x.ndim != 2 or x.shape[1] != 3:
        raise ValueError(f"grains have shape {x.shape}: give (n, 3), world metres.")
    if not 0 < radius < np.inf:
        raise ValueError(f"grain_radius = {radius} m is no size: half the grain spacing is a good start.")
    if colors is None:  # by a hash of the index, so that a grain keeps its look from frame to frame
        bits = np.arange(len(x), dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        bits = (bits ^ bits >> np.uint64(32)) * np.uint64(0xD6E8FEB86659FD93) >> np.uint64(40)
        color = SAND[0] + (SAND[1] - SAND[0]) * (bits.astype(np.float32) / 2**24)[:, None]
    else:
        color = np.asarray(colors)
        if color.shape != x.shape or color.dtype != np.uint8:
            raise ValueError(f"colors are {color.dtype} {color.shape}: give uint8 {x.shape}, a row per grain.")
    known = (np.abs(x) < FAR).all(1)  # False for nan
    return x[known], np.square(color[known].astype(np.float32) / 255)


@lru_cache(maxsize=4)
def _rays(camera: Camera, rows: int, columns: int) -> Rays:
    look = np.subtract(camera.target, camera.eye)
    basis, focal = _basis(look, camera.up), rows / 2 / np.tan(np.radians(camera.fov_deg) / 2)
    u, v = np.meshgrid(np.arange(columns) + 0.5 - columns / 2, np.arange(rows) + 0.5 - rows / 2)
    ray = (np.stack([u, v, np.full_like(u, focal)], -1).reshape(-1, 3) / focal) @ basis
    stretch = np.linalg.norm(ray, axis=1)
    direction, stretch = (ray / stretch[:, None]).astype(np.float32), stretch.astype(np.float32)
    eye, size, scale = np.asarray(camera.eye, np.float32), (rows, columns), float(np.linalg.norm(look))
    return Rays(eye, direction, stretch, basis.astype(np.float32), np.float32(focal), size, scale)


def _cast(model: Any, data: Any, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, ...]:
    """First hit of each unit ray (k, 3) from one point: geom (k,) or -1, distance (k,) m, normal (k, 3)."""
    k, origin, ray = len(direction), origin.astype(float), direction.astype(float).reshape(-1)
    geom, distance, normal = np.full(k, -1, np.int32), np.zeros(k), np.zeros(3 * k)
    mujoco.mj_multiRay(model, data, origin, ray, VISIBLE_GROUPS, True, -1, geom, distance, normal, k, FAR)
    distance[geom < 0] = FAR
    return geom, distance.astype(np.float32), normal.astype(np.float32).reshape(-1, 3)


def _rgba(model: mujoco.MjModel) -> np.ndarray:
    """Colour of every geom (ngeom, 4), by MuJoCo's rule: a material's, unless the geom names its own."""
    rgba, material = model.geom_rgba.copy(), model.geom_matid
    default = (rgba == np.array([0.5, 0.5, 0.5, 1], np.float32)).all(1) & (material >= 0)
    rgba[default] = model.mat_rgba[material[default]]
    return rgba


def _only(model: mujoco.MjModel, keep: np.ndarray) -> mujoco.MjModel:
    """A copy of the model where only the geoms of the mask are drawn; the caller's model stays as it is."""
    shown = copy.copy(model)
    shown.geom_group[~keep] = HIDDEN_GROUP
    return shown


def _split_glass(model: mujoco.MjModel) -> tuple[mujoco.MjModel, list[int]]:
    alpha = _rgba(model)[:, 3]
    drawn = VISIBLE_GROUPS[model.geom_group.clip(0, 5)] > 0
    glass = np.flatnonzero((alpha > 0) & (alpha < 1) & drawn)
    return (_only(model, alpha >= 1) if len(glass) or (alpha <= 0).any() else model), glass.tolist()


def _bodies(model: Any, data: Any, rays: Rays, ground_z: float | None) -> Surface:
    """What the opaque geoms and the ground show; squares of `CHECK` on level planes."""
    d, eye = rays.direction, rays.eye
    distance, (normal, albedo) = np.full(len(d), FAR, np.float32), np.zeros((2, len(d), 3), np.float32)
    shiny, level = np.zeros((2, len(d)), bool)
    if model is not None:
        geom, distance, normal = _cast(model, data, eye, d)
        # geom -1, the sky, is the last entry of each table
        plane = np.append(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, False)
        albedo = np.append(_rgba(model)[:, :3] ** 2, np.zeros((1, 3), np.float32), 0)[geom]
        shiny, level = ~plane[geom], plane[geom]
    if ground_z is not None:
        t = np.float32(ground_z - eye[2]) / np.where(d[:, 2] == 0, np.float32(1e-12), d[:, 2])
        ground = (t > 0) & (t < distance)
        distance[ground], normal[ground], albedo[ground] = t[ground], (0, 0, 1), GROUND
        shiny, level = shiny & ~ground, level | ground
    away = np.einsum("ij,ij->i", normal, d) > 0  # an open mesh or the ground may show its back
    normal[away] *= -1
    level = np.flatnonzero(level & (np.abs(normal[:, 2]) > 0.9))
    x = eye[:2] + d[level, :2] * distance[level, None]
    footprint = distance[level] / rays.focal / np.abs(d[level, 2]).clip(1e-6)
    sharp = (1.5 - 3 * footprint / CHECK).clip(0, 1)  # fades before squares shrink to pixels
    odd = (np.floor(x[:, 0] / CHECK) + np.floor(x[:, 1] / CHECK)) % 2
    albedo[level] *= (1 + 0.14 * sharp * (odd - 0.5))[:, None]
    return Surface(distance, normal, albedo, shiny)


def _splat(seen: Surface, grains: np.ndarray, color: np.ndarray, radius: float, rays: Rays) -> None:
    """Draw the grains as spheres into `seen` where they are nearer."""
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
    a = ((pixel % columns).astype(np.float32) + 0.5 - u[g]) / r[g]
    b = ((pixel // columns).astype(np.float32) + 0.5 - v[g]) / r[g]
    ball = np.stack([a, b, -np.sqrt((1 - a * a - b * b).clip(0))], 1) @ rays.basis
    # the heap's slope, with the grain's roundness on it
    normal = _heap_normal(grains, radius)[index[g]] + 0.45 * ball
    seen.normal[pixel] = normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-6)
    seen.albedo[pixel], seen.shiny[pixel] = color[index[g]], False


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
    density = ndimage.gaussian_filter(density, 1.0, mode="nearest")
    slope = np.stack([ndimage.map_coordinates(-g, place.T, order=1) for g in np.gradient(density)], 1)
    slope[:, 2] = slope[:, 2].clip(0)  # what lies on the floor has no underside to see
    slope /= max(float(density.max()), 1e-6)
    steep = np.linalg.norm(slope, axis=1, keepdims=True)
    return slope * steep / (steep**2 + 0.12**2)  # 0.35 at a free surface; a little is only uneven filling


def _shade(seen: Surface, model: Any, data: Any, grains: np.ndarray, radius: float, rays: Rays) -> np.ndarray:
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
    sky = (SKYLIGHT * up + BOUNCE * (1 - up)) * (1 - 0.6 * _crease(seen.distance, rays)[hit, None])
    light = seen.albedo[hit] * (SUNLIGHT * ((n @ SUN).clip(0) * sunny)[:, None] + sky)
    shiny = np.flatnonzero(seen.shiny[hit])
    half = SUN - d[shiny]  # Blinn's highlight
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    light[shiny] += (0.35 * sunny[shiny] * np.einsum("ij,ij->i", half, n[shiny]).clip(0) ** 50)[:, None]
    picture[hit] = HORIZON + (light - HORIZON) * np.exp(-((t / (6 * rays.scale)) ** 2))[:, None]  # haze
    return picture


def _crease(distance: np.ndarray, rays: Rays) -> np.ndarray:
    """How far (P,) 0..1 a pixel lies in a valley: a little behind the middle of two opposite neighbours."""
    (rows, columns), reach = rays.size, max(1, round(rays.size[0] / 70))
    depth = np.minimum(distance / np.float32(0.01 * rays.scale), 400).reshape(rays.size)
    wide = np.pad(depth, reach, mode="reflect", reflect_type="odd")
    valley = np.zeros_like(depth)
    for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ahead = wide[reach + i * reach :, reach + j * reach :][:rows, :columns]
        behind = wide[reach - i * reach :, reach - j * reach :][:rows, :columns]
        deep = 2 * depth - ahead - behind
        valley += (1 - np.abs(deep - 1)).clip(0)  # far behind is no valley, but another thing's edge
    return valley.reshape(-1) / 4


def _body_light(point: np.ndarray, model: Any, data: Any, rays: Rays) -> np.ndarray:
    """Share of the sun (k,) that the bodies let through to each point."""
    lamp = rays.eye + SUN.astype(float) * 100 * rays.scale  # near enough that all shadow rays share an origin
    ray = point - lamp
    length = np.linalg.norm(ray, axis=1)
    first = _cast(model, data, lamp, ray / length[:, None])[1]
    return (first > length - 2e-3 * rays.scale).astype(np.float32)


def _grain_shadow(point: np.ndarray, grains: np.ndarray, radius: float) -> np.ndarray:
    """Shadow (k,) 0..1 that the grains cast, by a map of the grains nearest to the sun."""
    from scipy import ndimage

    across = np.cross(SUN, np.array([0, 0, 1], np.float32))
    across /= np.linalg.norm(across)
    basis = np.stack([across, np.cross(SUN, across), SUN], 1)
    g, p = grains @ basis, point @ basis
    low, high = np.percentile(g[:, :2], [0.1, 99.9], axis=0).astype(np.float32)
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


def _cover(light: np.ndarray, distance: np.ndarray, model: Any, data: Any, geom: int, rays: Rays) -> None:
    """Lay one see-through geom over the picture, more mirror-like where it is seen at a slant."""
    across = data.geom_xpos[geom] - rays.eye
    gap, reach = np.linalg.norm(across), model.geom_rbound[geom]  # reach 0: a plane
    cone = np.sqrt(1 - (reach / gap) ** 2) if 0 < reach < gap else -1.0
    front = np.flatnonzero(rays.direction @ across.astype(np.float32) >= cone * gap)
    only = _only(model, np.arange(model.ngeom) == geom)
    hit, near, normal = _cast(only, data, rays.eye, rays.direction[front])
    seen = (hit >= 0) & (near < distance[front])
    front, normal = front[seen], normal[seen]
    rgba = _rgba(model)[geom]
    slant = 1 - np.abs(np.einsum("ij,ij->i", normal, rays.direction[front]))
    alpha = (rgba[3] + (1 - rgba[3]) * 0.4 * slant**4).astype(np.float32)[:, None]
    light[front] += alpha * (rgba[:3] ** 2 - light[front])


def save_png(path: str | Path, image: np.ndarray) -> None:
    """Write one picture (height, width, 3) uint8."""
    from PIL import Image

    Image.fromarray(_picture(image)).save(path, optimize=True)


def save_video(path: str | Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write an endless animation: .webp (small, full colour) or .gif (256 colours, shown anywhere)."""
    from PIL import Image

    suffix, ticks = Path(path).suffix.lower(), {".webp": 1000, ".gif": 100}  # clock ticks per second
    if suffix not in ticks:
        raise ValueError(f"animation {Path(path).name} ends in '{suffix}': use one of {', '.join(ticks)}.")
    if not 0 < fps <= 50:
        raise ValueError(f"fps = {fps} is outside 0..50, what browsers play: use 25 or so.")
    images = [Image.fromarray(_picture(frame)) for frame in frames]
    if not images or len({image.size for image in images}) > 1:
        raise ValueError(f"animation got {len(images)} frames: give at least one, all of one size.")
    if suffix == ".gif":  # one palette for all frames, else every grain flickers
        some = [np.asarray(image) for image in images[:: max(1, len(images) // 8)]]
        palette = Image.fromarray(np.concatenate(some)).quantize(256, method=Image.Quantize.MEDIANCUT)
        images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    tick = np.round(np.arange(len(images) + 1) / fps * ticks[suffix]).astype(int)  # rounding never adds up
    duration = (np.diff(tick) * 1000 // ticks[suffix]).tolist()
    options = {"quality": 82, "method": 4} if suffix == ".webp" else {"optimize": False}
    images[0].save(path, save_all=True, append_images=images[1:], duration=duration, loop=0, **options)


def _picture(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"picture is {image.dtype} {image.shape}: give uint8 (height, width, 3).")
    return image
