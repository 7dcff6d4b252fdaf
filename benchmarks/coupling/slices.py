"""Slices through beds as PNG, with pillow: grains in colours, the outlines of bodies, axes in metres, a scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mpm_env.log import RAMP_RGB
from mpm_env.plot import INK
from mpm_env.view import View

SHARP = 3  # grains are drawn so many times larger, and then made small
LEFT, ABOVE, BETWEEN, BELOW = 54, 48, 16, 44  # pixels beside all panels, above each, between and below
SCALE = 56  # pixels below all panels, for the scale of colours
BODY_RGB, EDGE_RGB, SKY_RGB = (172, 178, 188), (20, 24, 30), (246, 247, 249)
LARGE, SMALL = 15, 12  # letters, pixels


class Panel(NamedTuple):
    """What one slice shows."""

    title: str
    view: View
    values: np.ndarray  # (n,) what colours the grains
    note: str = ""  # a second line under the title


class Window(NamedTuple):
    """The part of the slice that is shown, m."""

    x: tuple[float, float]
    z: tuple[float, float]
    pixels_per_m: float

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        (x0, x1), (z0, z1) = self.x, self.z
        return round((x1 - x0) * self.pixels_per_m), round((z1 - z0) * self.pixels_per_m)

    def place(self, x: Any, z: Any) -> tuple[Any, Any]:
        """Pixels from the upper left corner."""
        return (x - self.x[0]) * self.pixels_per_m, (self.z[1] - z) * self.pixels_per_m


def draw(
    path: Path,
    panels: Sequence[Panel],
    window: Window,
    span: tuple[float, float],
    legend: str,
    columns: int | None = None,
) -> None:
    """Write panels side by side, or in so many columns; `span` is what the ends of the colours mean."""
    columns = columns or len(panels)
    rows = -(-len(panels) // columns)
    w, h = window.size
    image = Image.new("RGB", (LEFT + columns * (w + BETWEEN), rows * (h + ABOVE + BELOW) + SCALE), "white")
    pen = ImageDraw.Draw(image)
    for k, panel in enumerate(panels):
        row, column = divmod(k, columns)
        x, y = LEFT + column * (w + BETWEEN), row * (h + ABOVE + BELOW) + ABOVE
        image.paste(_slice(panel, window, span), (x, y))
        pen.text((x, y - ABOVE + 8), panel.title, fill=INK, font=letters(LARGE), anchor="lt")
        pen.text((x, y - 6), panel.note, fill=INK, font=letters(SMALL), anchor="lb")
        _axes(image, x, y, window, names=(column == 0, row == rows - 1))
    _scale(image, span, legend)
    image.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def _slice(panel: Panel, window: Window, span: tuple[float, float]) -> Image.Image:
    """Grains and bodies, without axes."""
    w, h = (SHARP * a for a in window.size)
    image = Image.new("RGB", (w, h), SKY_RGB)
    pen = ImageDraw.Draw(image)
    share = np.clip((np.nan_to_num(panel.values, nan=span[1]) - span[0]) / (span[1] - span[0]), 0, 1)
    colours = RAMP_RGB[(255 * share).astype(int)]
    u, v = (SHARP * a for a in window.place(panel.view.grains[:, 0], panel.view.grains[:, 2]))
    r = SHARP * window.pixels_per_m * panel.view.scene.spacing * 0.48
    for a, b, colour in zip(u, v, colours, strict=True):
        if np.isfinite(a + b) and -r < a < w + r and -r < b < h + r:
            pen.ellipse([a - r, b - r, a + r, b + r], fill=tuple(int(c) for c in colour))
    for corners in outlines(panel.view):
        spots = [tuple(SHARP * c for c in window.place(*corner)) for corner in corners]
        pen.polygon(spots, fill=BODY_RGB, outline=EDGE_RGB, width=SHARP)
    return image.resize(window.size, Image.Resampling.LANCZOS)


def outlines(view: View) -> list[np.ndarray]:
    """Corners (4, 2) m in x and z of the boxes of a slice, as far as their places are numbers."""
    if view.scene.bodies is None or view.data is None:
        return []
    model, out = view.scene.bodies.model, []
    for geom in np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_BOX)):
        half = model.geom_size[geom]
        corners = np.array([(a * half[0], 0, b * half[2]) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        at = corners @ view.data.geom_xmat[geom].reshape(3, 3).T + view.data.geom_xpos[geom]
        if np.isfinite(at).all() and np.abs(at).max() < 10:
            out.append(at[:, [0, 2]])
    return out


def _axes(image: Image.Image, x: int, y: int, window: Window, names: tuple[bool, bool]) -> None:
    """Frame, ticks every 0.1 m, and the axes' names where asked for: at the left, below."""
    pen, (w, h) = ImageDraw.Draw(image), window.size
    pen.rectangle([x, y, x + w - 1, y + h - 1], outline=INK)
    for axis, (low, high) in enumerate((window.x, window.z)):
        for k in range(int(np.ceil(10 * low - 1e-6)), int(np.floor(10 * high + 1e-6)) + 1):
            u, v = window.place(k / 10, k / 10)
            if axis == 0:
                pen.line([(x + u, y + h), (x + u, y + h + 4)], fill=INK)
                pen.text((x + u, y + h + 7), f"{k / 10:g}", fill=INK, font=letters(SMALL), anchor="mt")
            elif names[0]:
                pen.line([(x - 4, y + v), (x, y + v)], fill=INK)
                pen.text((x - 7, y + v), f"{k / 10:g}", fill=INK, font=letters(SMALL), anchor="rm")
    if names[0]:
        _upright(image, x - 50, y + h // 2, "z, m")
    if names[1]:
        pen.text((x + w / 2, y + h + 24), "x, m", fill=INK, font=letters(SMALL), anchor="mt")


def _upright(image: Image.Image, x: int, middle: int, text: str) -> None:
    """A text that is read from below to above."""
    low, top, high, bottom = letters(SMALL).getbbox(text)
    label = Image.new("RGB", (round(high - low) + 2, round(bottom - top) + 2), "white")
    ImageDraw.Draw(label).text((1 - low, 1 - top), text, fill=INK, font=letters(SMALL))
    label = label.rotate(90, expand=True)
    image.paste(label, (x, middle - label.height // 2))


def _scale(image: Image.Image, span: tuple[float, float], legend: str) -> None:
    """What the colours mean, at the foot of the picture."""
    pen, font = ImageDraw.Draw(image), letters(SMALL)
    width = min(256, image.width // 3)
    bar = Image.fromarray(RAMP_RGB[np.linspace(0, 255, width).astype(int)][None].repeat(12, axis=0))
    words = pen.textlength(legend, font=font) + 16
    x, y = round((image.width - width + words) / 2), image.height - 38
    image.paste(bar, (x, y))
    pen.text((x - 12, y + 6), legend, fill=INK, font=font, anchor="rm")
    for at, value in ((x, span[0]), (x + width // 2, sum(span) / 2), (x + width, span[1])):
        pen.text((at, y + 17), f"{value:g}", fill=INK, font=font, anchor="mt")


def letters(size: int) -> Any:
    """The letters of all pictures here, so many pixels high."""
    return ImageFont.load_default(size)
