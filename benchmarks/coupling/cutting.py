"""Blades through the full depth of a bed, in plane strain: passive earth pressure, and the earth-moving equation.

A wall or an inclined blade goes through a bed on a rough floor, its tip on the floor. Behind it there is nothing. One
scene serves all angles, frictions of sand and kinds of blade: the smooth one and the rough one take turns, the other
waits far away.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from benchmarks.coupling.beds import RHO, G, at_rest, sand, with_sand, without
from benchmarks.coupling.scenes import Bed, about, planted, ride, soft_travel

DEPTH = 0.2  # m, of the bed
LENGTH = 5 * DEPTH  # of the box
TIP = 1.2 * DEPTH  # where the tip starts: a blade at 45 degrees leans back over DEPTH
WIDTH = 0.1  # m, of the slice
E = 2e6  # Pa: the bottom is strained by 0.1 % under the sand's weight
SPEED, RAMP = 0.1, 0.05  # m/s and s: far slower than sound (42 m/s), which crosses the bed ten times in the ramp
RIGID_DT = 0.002  # s
BLADES = {"smooth": 0.0, "rough": 20.0}  # angle of friction between sand and blade, degrees
AWAY = np.array([-5.0, WIDTH / 2, 0.0])  # m, of the blade that waits
WINDOW = (0.05, 0.1)  # of DEPTH, the travel over which forces are averaged


@cache
def bed(cells: int) -> Bed:
    """Sand on a floor, so many cells deep, and two blades that are told where to go, their tips at their origins."""
    dx = DEPTH / cells
    thick, under, high = 6 * dx, 3 * dx, 2 * DEPTH
    blades = "".join(
        f"""<body name="{name}" mocap="true" pos="{AWAY[0]} {AWAY[1]} {AWAY[2]}"><geom name="{name}" type="box"
          pos="{-thick / 2} 0 {(high - under) / 2}" size="{thick / 2} {WIDTH} {(high + under) / 2}"/></body>"""
        for name in BLADES
    )
    return Bed(
        f"<worldbody>{blades}</worldbody>",
        tuple(BLADES),
        (LENGTH, WIDTH, 2 * DEPTH),
        (((0, 0, 0), (LENGTH, WIDTH, DEPTH)),),
        dx,
        2,
        rigid_dt=RIGID_DT,
        material=sand(30.0, E),
        bodies={"friction_of": {name: float(np.tan(np.radians(delta))) for name, delta in BLADES.items()}},
        speed=1.0,
    )


class Cut(NamedTuple):
    """What the sand did to a blade; rows are rigid steps."""

    travel: np.ndarray  # (k,) of DEPTH
    push: np.ndarray  # (k,) the force over rho g DEPTH^2, all of it
    draft: np.ndarray  # (k,) its part against the travel, so scaled
    health: int
    cpu_s: float

    def mean(self, values: np.ndarray) -> float:
        """Values (k,) averaged over the window of travel."""
        return float(values[(self.travel >= WINDOW[0]) & (self.travel <= WINDOW[1])].mean())

    @property
    def pressure(self) -> float:
        """Rankine's K, of an upright wall."""
        return 2 * self.mean(self.draft)

    @property
    def resistance(self) -> float:
        """N_gamma of the earth-moving equation."""
        return self.mean(self.push)


def cut(cells: int, friction_deg: float, rake_deg: float = 90.0, blade: str = "smooth", speed: float = SPEED) -> Cut:
    """Push a blade through a bed so many cells deep; the rake is measured from the floor."""
    scene = bed(cells).scene()
    mine = list(BLADES).index(blade)
    leaning = about("y", rake_deg - 90)

    def pose(travel: float) -> tuple[np.ndarray, np.ndarray]:
        at = np.stack([AWAY, AWAY])
        at[mine] = (TIP + travel, WIDTH / 2, 0)
        return at, np.stack([leaning, leaning])

    state = with_sand(bed(cells).start(), friction_deg=friction_deg)
    x, z = scene.world(state.grains.x)[::2]
    rake = np.radians(rake_deg)
    behind = (x - TIP) * np.sin(rake) + z * np.cos(rake) < 0
    state = planted(scene, at_rest(scene, without(state, behind), DEPTH), *pose(0.0))
    enough = WINDOW[1] * DEPTH / speed + RAMP
    travel = soft_travel(RIGID_DT * np.arange(1, 1 + int(enough / RIGID_DT)), speed, RAMP)
    done = ride(scene, state, travel, pose)
    force = done.force(mine)
    scale = RHO * G * DEPTH**2 * WIDTH
    push = np.hypot(force[:, 0], force[:, 2])
    return Cut(done.travel / DEPTH, push / scale, -force[:, 0] / scale, int(done.last.health), done.cpu_s)


def passive(friction_deg: float) -> float:
    """Rankine's coefficient of passive earth pressure on a smooth upright wall."""
    s = np.sin(np.radians(friction_deg))
    return float((1 + s) / (1 - s))


def earth_moving(friction_deg: float, rake_deg: float, blade_friction_deg: float) -> float:
    """N_gamma of Reece's earth-moving equation with McKyes' plane wedge: the least over the wedge's angle.

    The force is the whole one between blade and sand, not its horizontal part.
    """
    phi, rake, delta = np.radians([friction_deg, rake_deg, blade_friction_deg])
    wedge = np.radians(np.arange(5, 85, 0.05))
    lifting = np.cos(rake + delta) + np.sin(rake + delta) / np.tan(wedge + phi)
    N = (1 / np.tan(rake) + 1 / np.tan(wedge)) / (2 * np.where(lifting > 0, lifting, np.nan))
    return float(np.nanmin(N))
