"""Pictures of a scene without OpenGL: MuJoCo's own ray casting for bodies, numpy for grains.

One ray per pixel finds the nearest body (`mujoco.mj_multiRay`, on the CPU); every grain is then drawn as a
small sphere where it lies nearer. A distant sun casts shadows, the sky lights the rest, creases are darker.
No display, driver or GL library is needed, and the same call gives the same bytes. Textures are not drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mpm_env.render_light import cover, shade
from mpm_env.render_surface import FAR, Rays, colour_of_geoms, only, see_bodies, shown_geoms, splat

__all__ = ["Camera", "camera_for", "render", "save_png", "save_video"]

SAND = np.array([[184, 142, 88], [236, 204, 150]], np.float32)  # a grain without a colour lies between these
SAND_SEED = 61_803  # not one that a scene would draw its grains from: places and colours would go together


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
    opaque, glass = model, np.array([], int)
    if model is not None:
        shown, alpha = shown_geoms(model), colour_of_geoms(model)[:, 3]
        opaque, glass = only(model, shown & (alpha >= 1)), np.flatnonzero(shown & (alpha < 1))
    seen = see_bodies(opaque, data, rays, ground_z)
    if len(x):
        splat(seen, x, color, grain_radius, rays)
    light = shade(seen, opaque, data, x, grain_radius, rays)
    for geom in glass:
        cover(light, seen.distance, model, data, geom, rays)
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
    if colors is None:  # by its number, so that a grain keeps its look from frame to frame
        color = SAND[0] + (SAND[1] - SAND[0]) * np.random.default_rng(SAND_SEED).random((len(x), 1))
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
