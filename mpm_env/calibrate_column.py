"""The friction of sand from how far a column of it runs out, by short simulations in plane strain."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mpm_env.calibrate_friction import ACROSS, Found, Slice, find, refuse_without_friction
from mpm_env.scene_config import MaterialConfig

BETWEEN = (12.0, 50.0)  # degrees searched
REACH = 6.0  # heights that the box leaves beyond the column: more than sand of the least friction runs
LASTS = 4.0  # in sqrt(height / gravity); a column stands still after 3.3 (Lube et al., Phys. Rev. E 72, 2005)
FRONT = 0.99  # share of the grains behind what counts as the front: a few roll on alone


class Column(NamedTuple):
    """A column that stood against a wall on a rough floor, and how far from the wall it came to lie."""

    width: float  # m
    height: float  # m
    runout: float  # m from the wall to the front

    def slice(self, config: MaterialConfig, across: int) -> Slice:
        """The column so many cells high."""
        long = self.width + REACH * self.height
        return Slice(config, across, wide=self.width, high=self.height, long=long, lasts=LASTS)


def fit_column(config: MaterialConfig, column: Column) -> Found:
    """The friction angle with which a column runs as far as measured, on the material's own friction fit.

    Raises ValueError for a material without a friction angle, senseless lengths, or a runout that no angle gives.
    """
    refuse_without_friction(config, "The runout of a column")
    if not all(math.isfinite(a) and a > 0 for a in column) or column.runout <= column.width:
        raise ValueError(
            f"A column needs positive lengths and a runout beyond its width, got {column.width} m wide,"
            f" {column.height} m high, runout {column.runout} m."
        )
    slices = {n: column.slice(config, n) for n in ACROSS}
    low, high = BETWEEN
    return find(
        lambda angle, seed, across: front(slices[across], angle, seed),
        column.runout,
        BETWEEN,
        lambda most, least: (
            f"No friction from {low:g} to {high:g} degrees lets this column run to {column.runout:g} m: it comes to"
            f" {most:.3g} m at the least and {least:.3g} m at the most of them."
        ),
    )


def front(slice: Slice, angle: float, seed: int) -> float:
    """How far from the wall, m, the front of a column of this friction angle (degrees) comes to lie."""
    return float(np.quantile(slice.rests(angle, seed)[0], FRONT))
