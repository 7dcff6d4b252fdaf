"""The friction of sand from its angle of repose, by short simulations in plane strain.

One side of a bed on a rough floor is opened: what does not stand falls and is gone, and a bank stays. Sand that flows
without dilation stays at about tan(repose) = sin(phi) of plane strain (Davis 1968), less than its friction angle.
"""

from __future__ import annotations

import math

import numpy as np

from mpm_env.calibrate_friction import ACROSS, Found, Slice, find, refuse_without_friction
from mpm_env.scene_config import MaterialConfig

BETWEEN = (10.0, 65.0)  # degrees searched
HIGH = 0.2  # m; a slope of dry sand has no length of its own
LONG = 5.0  # heights: more than a bank of the least friction needs
LASTS = 12.0  # in sqrt(height / gravity); twice as long moves the angle by less than a degree
FACE = (0.1, 0.8)  # of the height: below lies what came last, above is the edge of what stood


def fit_repose(config: MaterialConfig, repose_deg: float) -> Found:
    """The friction angle of sand whose bank stays at this angle of repose, on the material's own friction fit.

    Raises ValueError for a material without a friction angle, and for an angle that no friction gives.
    """
    refuse_without_friction(config, "An angle of repose")
    slices = {
        n: Slice(config, n, wide=LONG * HIGH, high=HIGH, long=LONG * HIGH, lasts=LASTS, opens=True) for n in ACROSS
    }
    low, high = BETWEEN
    return find(
        lambda angle, seed, across: repose(slices[across], angle, seed),
        repose_deg,
        BETWEEN,
        lambda least, most: (
            f"No friction from {low:g} to {high:g} degrees has this sand stand at {repose_deg:g} degrees: it stands at"
            f" {least:.3g} with the least and {most:.3g} with the most of them."
        ),
    )


def repose(slice: Slice, angle: float, seed: int) -> float:
    """The slope, degrees, of the bank of sand with this friction angle (degrees)."""
    x, _ = slice.rests(angle, seed)
    width = 2 * slice.cell
    edges = np.arange(0, LONG * HIGH + width / 2, width)
    grains = np.histogram(x, edges)[0]
    return face((edges[1:] + edges[:-1]) / 2, grains * (slice.scene.spacing**2 / width), HIGH)


def face(x: np.ndarray, h: np.ndarray, high: float) -> float:
    """The slope, degrees, of the line through the face of a bank with heights h (k,) m over x (k,) m, once `high` m."""
    steep = (h > FACE[0] * high) & (h < FACE[1] * high)
    return math.degrees(math.atan(-np.polyfit(x[steep], h[steep], 1)[0]))
