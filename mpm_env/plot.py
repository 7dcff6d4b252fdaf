"""Small plots as PNG: curves of a test, and how measured points lie to their reference."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

SIZE = (6.4, 4.4)  # inches, at 100 dots each
INK = "#222222"  # of all that is written
_CORNERS: Any = {"above": "upper left", "middle": "center right", "below": "lower right"}


class Series(NamedTuple):
    """Points of one colour; joined where they are a line, else dots."""

    name: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    joined: bool = False
    colour: int | None = None  # in matplotlib's cycle, if not the next: that of what belongs to it


def plot(
    path: Path,
    title: str,
    x: str,
    y: str,
    series: Sequence[Series],
    *,
    log: bool = False,
    names: Literal["above", "middle", "below"] = "above",
) -> None:
    """Write a plot; axes named x and y, both logarithmic where asked for.

    Names of series stand "above" at the left, or at the right in the "middle" or "below".
    """
    from matplotlib.figure import Figure  # not pyplot: no window, no global state

    figure = Figure(SIZE, dpi=100, layout="constrained")
    axes = figure.add_subplot(title=title, xlabel=x, ylabel=y)
    axes.title.set_fontsize("medium")
    for k, s in enumerate(series):
        style = "-" if s.joined else "o"
        axes.plot(s.x, s.y, style, color=f"C{k if s.colour is None else s.colour}", label=s.name or None)
    if log:
        axes.set_xscale("log")
        axes.set_yscale("log")
    axes.grid(color="#dddddd")
    if any(s.name for s in series):
        axes.legend(loc=_CORNERS[names], fontsize="small", framealpha=0.8)
    figure.savefig(path)
