"""The largest time step that an explicit substep bears, and what sets it."""

from __future__ import annotations

import math
from typing import NamedTuple

from mpm_env.mpm.materials import Material

MOST_CELLS_PER_SUBSTEP = 0.5  # grains and tools may cross half a cell: the window must see them pass
# Of the lone grain's limit. A strained lone grain meets the resonances of symplectic Euler: the third-order one, at
# sin 60 deg = 0.866, blows it up from a few per cent of strain. Up to 0.8 it bears a stretch of 7 %; up to 0.68, below
# the fourth-order resonance at sin 45 deg, one of 15 % (measured, elastic; sand and snow yield long before).
SAFETY = 0.8


class DtBound(NamedTuple):
    """A bound on the substep and its reason."""

    dt: float  # s
    reason: str


def courant_limit(nu: float, dimension: int) -> float:
    """Largest c dt / dx of a lone grain, times SAFETY: the weakest spot of explicit MLS-MPM.

    A lone grain oscillates on its own window with dt < dx / sqrt(d K' / rho), K' = lam + 2 mu / d, wherever it sits in
    its cell; with c^2 = (lam + 2 mu) / rho the Courant number is sqrt((lam + 2 mu) / (d lam + 2 mu)). Derived for
    quadratic B-splines. Ragged blocks bear a little more: at one grain per cell the weakest of those measured (nu 0 to
    0.45, 2-D and 3-D) broke at 1.03 times this, with 2^d grains per cell at 1.12.
    """
    lam, mu = nu / (1 - 2 * nu), 0.5  # both over E / (1 + nu)
    return SAFETY * math.sqrt((lam + 2 * mu) / (dimension * lam + 2 * mu))


def largest_dt(materials: tuple[Material, ...], cell_size: float, dimension: int, speed: float) -> DtBound:
    """The binding bound of all materials and of the fastest expected speed (grains or tools) in m/s."""
    bounds = [
        DtBound(
            courant_limit(float(mat.nu), dimension) * cell_size / float(mat.wave_speed()),
            f"the sound speed {float(mat.wave_speed()):.3g} m/s of {type(mat).__name__.lower()}",
        )
        for mat in materials
    ]
    if speed > 0:
        bounds.append(
            DtBound(MOST_CELLS_PER_SUBSTEP * cell_size / speed, f"the speed {speed:.3g} m/s of grains and tools")
        )
    return min(bounds, default=DtBound(math.inf, "nothing"))
