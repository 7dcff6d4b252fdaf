"""A box dropped on sand, as a job for any code: its numbers, and whether the box came to rest as it should.

20 x 20 x 10 cm, as dense as sand, it falls 5 cm on a bed of 48 672 grains: 26 x 26 x 9 cells, eight grains each. This
file needs numpy only, as benchmarks/job.py.
"""

from __future__ import annotations

import numpy as np

from benchmarks import job

DX = 0.025  # m
BED = (26 * DX, 26 * DX, 9 * DX)  # m, between upright walls without friction
HALF = (0.1, 0.1, 0.05)  # m
DROP = 0.05  # m
FRICTION = 0.5  # of sand on the box, and on the floor
E = 3e6  # Pa: softer sand stores enough of the blow to throw a light box back
DURATION = 1.0  # s
SETTLED = 0.02  # m/s, root mean square of the box's speed over its last fifth of a second
BOUNCE = 0.1  # m/s, fastest way up after it has landed


def verdict(speeds: list[float], interval: float) -> dict[str, float | bool]:
    """What became of the box, from its upward speeds (m/s) every `interval` s of a whole run."""
    v = np.array(speeds)
    landed = round(float(np.sqrt(2 * DROP / job.GRAVITY)) / interval) + 1
    late = v[-max(round(0.2 / interval), 2) :]
    up, rms = float(v[landed:].max()), float(np.sqrt((late**2).mean()))
    return {
        "impact_m_s": round(float(np.sqrt(2 * job.GRAVITY * DROP)), 3),
        "fastest_up_m_s": round(up, 4),
        "rms_at_the_end_m_s": round(rms, 4),
        "settled": bool(up < BOUNCE and rms < SETTLED),
    }
