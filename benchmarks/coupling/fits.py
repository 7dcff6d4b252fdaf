"""Lines and powers through what was measured."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


def smooth(travel: np.ndarray, values: np.ndarray, length: float) -> np.ndarray:
    """Values (k,) averaged over a stretch of travel (m) around each: a tool feels the planes of nodes it passes."""
    return np.array([values[np.abs(travel - s) <= length / 2].mean() for s in travel])


class Line(NamedTuple):
    """A straight line through points."""

    slope: float
    start: float
    r2: float  # share of the variance that it explains


def line(x: np.ndarray, y: np.ndarray) -> Line:
    """The line of least squares."""
    slope, start = np.polyfit(x, y, 1)
    rest = y - slope * x - start
    return Line(float(slope), float(start), float(1 - rest.var() / y.var()))


def exponent(x: np.ndarray, y: np.ndarray) -> float:
    """The power n of y ~ x^n that fits best."""
    return line(np.log(x), np.log(y)).slope
