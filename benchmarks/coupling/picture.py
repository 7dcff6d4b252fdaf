"""Small plots as PNG, with pillow: enough to see how measured points lie to their reference."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

SIZE = (640, 440)  # pixels
EDGE = (74, 34, 20, 52)  # pixels left, above, right and below of the axes
COLOURS = ("#1b6ca8", "#c8553d", "#3a7d44", "#8e5ea2", "#b8860b", "#555555", "#d1478c", "#12908e")
MANY = 4  # decades, from which on ticks are at powers of ten alone
INK, PALE = "#222222", "#dddddd"


class Series(NamedTuple):
    """Points of one colour; joined where they are a line, else dots."""

    name: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    joined: bool = False
    colour: int | None = None  # of COLOURS, if not the next: that of what belongs to it


def plot(
    path: Path, title: str, x: str, y: str, series: Sequence[Series], *, log: bool = False, names: str = "above"
) -> None:
    """Write a plot; axes named x and y, both logarithmic where asked for.

    Names of series stand "above" at the left, or at the right in the "middle" or "below".
    """
    scale = np.log10 if log else np.asarray
    points = [np.stack([scale(np.asarray(a, float)) for a in (s.x, s.y)]) for s in series]
    low, high = (f(np.concatenate(points, axis=1), axis=1) for f in (np.min, np.max))
    room = 0.05 * (high - low)
    low, high = low - room, high + room
    left, top, right, bottom = EDGE[0], EDGE[1], SIZE[0] - EDGE[2], SIZE[1] - EDGE[3]

    def place(at: np.ndarray) -> list[tuple[float, float]]:
        share = (at.T - low) / (high - low)
        return [(left + u * (right - left), bottom - v * (bottom - top)) for u, v in share]

    image = Image.new("RGB", SIZE, "white")
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(13)
    for axis in (0, 1):
        for tick in _ticks(low[axis], high[axis], log):
            value = np.log10(tick) if log else tick
            at = np.array([[value], [low[1]]]) if axis == 0 else np.array([[low[0]], [value]])
            ((u, v),) = place(at)
            draw.line([(u, top), (u, bottom)] if axis == 0 else [(left, v), (right, v)], fill=PALE)
            spot, anchor = ((u, bottom + 6), "mt") if axis == 0 else ((left - 6, v), "rm")
            draw.text(spot, f"{tick:g}", fill=INK, font=font, anchor=anchor)
    draw.rectangle([left, top, right, bottom], outline=INK)
    draw.text((right, 8), title, fill=INK, font=font, anchor="rt")
    draw.text(((left + right) / 2, SIZE[1] - 8), x, fill=INK, font=font, anchor="mb")
    draw.text((8, 8), y, fill=INK, font=font, anchor="lt")
    named = [s.name for s in series if s.name]
    rooms = {"above": top + 8, "middle": (top + bottom) / 2 - 8 * len(named), "below": bottom - 10 - 16 * len(named)}
    first, right_hand = rooms[names], names != "above"
    for k, (s, at) in enumerate(zip(series, points, strict=True)):
        colour, spots = COLOURS[(k if s.colour is None else s.colour) % len(COLOURS)], place(at)
        if s.joined:
            draw.line(spots, fill=colour, width=2)
        for u, v in [] if s.joined else spots:
            draw.ellipse([u - 4, v - 4, u + 4, v + 4], fill=colour)
        if s.name:
            spot, anchor = ((right - 10, 0), "rt") if right_hand else ((left + 10, 0), "lt")
            draw.text((spot[0], first + 16 * named.index(s.name)), s.name, fill=colour, font=font, anchor=anchor)
    image.save(path, optimize=True)


def _ticks(low: float, high: float, log: bool) -> list[float]:
    """Round numbers between the ends of an axis."""
    if log:
        steps = (1, 2, 5) if high - low < MANY else (1,)
        rounds = [m * 10.0**e for e in range(int(np.floor(low)), int(np.ceil(high)) + 1) for m in steps]
        return [t for t in rounds if low <= np.log10(t) <= high]
    step = 10.0 ** np.floor(np.log10(high - low))
    step *= next(m for m in (0.1, 0.2, 0.5, 1, 2, 5) if (high - low) / (m * step) <= 8)
    first = int(np.ceil(low / step))
    return [round(k * step, 10) for k in range(first, int(np.floor(high / step)) + 1)]
