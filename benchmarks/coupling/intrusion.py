"""A square plate pushed, dragged and pulled slowly through a bed of dry sand in 3-D, wherever it is told to go.

Forces are held against resistive force theory (Li, Zhang & Goldman, Science 339, 2013), where they grow in proportion
to depth and area, with a factor for how the plate lies and which way it goes. The plane y = 0 is a mirror, so that half
a plate is simulated. One scene serves all: the plate starts wherever it is planted, and the sand there is taken out.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from benchmarks.coupling.beds import RHO, G, at_rest, sand, with_sand, without
from benchmarks.coupling.fits import smooth
from benchmarks.coupling.scenes import Bed, about, planted, ride, soft_travel

SIDE = 0.1  # m, of the plate
THICK = 0.2  # of SIDE
HALF_LENGTH, HALF_WIDTH, DEPTH, ABOVE = 2.5, 2.0, 3.0, 1.0  # times SIDE, of the bed and of the space above it
FRICTION_DEG = 30.0
FRICTION = 0.4  # of sand and plate
E = 1e6  # Pa
SPEED, RAMP = 0.1, 0.05  # m/s and s: the pressure rho v^2 of moving sand is 15 Pa, of kilopascals on the plate
RIGID_DT = 0.004  # s
UNIT = RHO * G * SIDE**3  # N, in which forces are told: the weight of a cube of sand on the plate
HOLDING = (0.3, 0.6)  # of SIDE, the travel over which a drag's force is averaged: it has risen, and not yet piled up
BURIED = 0.4  # of SIDE, a depth from which on a plate pushed down is under the sand


@cache
def bed(cells: int) -> Bed:
    """Sand with half a plate at its mirror y = 0, so many cells to a side of the plate; the plate waits above."""
    x, y, z = HALF_LENGTH * SIDE, HALF_WIDTH * SIDE, DEPTH * SIDE
    size = f"{SIDE / 2} {SIDE / 2} {THICK * SIDE / 2}"
    return Bed(
        f"""<worldbody><body name="plate" mocap="true" pos="0 0 {z + SIDE}">
          <geom name="plate" type="box" size="{size}"/></body></worldbody>""",
        ("plate",),
        (2 * x, y, z + ABOVE * SIDE),
        (((-x, 0, 0), (x, y, z)),),
        SIDE / cells,
        friction=FRICTION,
        rigid_dt=RIGID_DT,
        material=sand(FRICTION_DEG, E),
        lower=(-x, 0, 0),
        speed=1.0,
    )


class Motion(NamedTuple):
    """How a plate lies and goes."""

    lean_deg: float  # about y: 0 lies flat, 90 stands upright across its way along x
    way: tuple[float, float]  # along x and z
    depth: float  # times SIDE, of its middle at the start, negative above the bed
    travel: float  # times SIDE


DOWN = Motion(0, (0, -1), -THICK / 2, 1.6)
ALONG_UPRIGHT = Motion(90, (1, 0), 1.0, 0.65)
ALONG_FLAT = Motion(0, (1, 0), 1.0, 0.65)
UP = Motion(0, (0, 1), 1.0, 0.3)
UP_DEEPER = Motion(0, (0, 1), 2.0, 0.3)


class Push(NamedTuple):
    """What the sand did to the whole plate; rows are rigid steps."""

    travel: np.ndarray  # (k,) of SIDE
    depth: np.ndarray  # (k,) of SIDE, of the plate's middle
    force: np.ndarray  # (k, 2) of UNIT along x and z, smoothed over a cell of travel
    health: int
    cpu_s: float

    def at(self, depth: float) -> np.ndarray:
        """The force (2,) where a plate that goes down has come to this depth."""
        return self.force[np.argmin(np.abs(self.depth - depth))]

    @property
    def holding(self) -> np.ndarray:
        """The mean force (2,) on a plate that is dragged."""
        return self.force[(self.travel >= HOLDING[0]) & (self.travel <= HOLDING[1])].mean(axis=0)


def push(cells: int, motion: Motion, friction_deg: float = FRICTION_DEG, speed: float = SPEED) -> Push:
    """Move a plate through a bed, so many cells to a side of the plate."""
    scene, surface = bed(cells).scene(), DEPTH * SIDE
    turn = about("y", motion.lean_deg)
    way = np.array([motion.way[0], 0, motion.way[1]])
    begin = np.array([0, 0, surface - motion.depth * SIDE])

    def pose(travel: float) -> tuple[np.ndarray, np.ndarray]:
        return (begin + travel * way)[None], turn[None]

    state = with_sand(bed(cells).start(), friction_deg=friction_deg)
    lean = np.radians(motion.lean_deg)
    x, y, z = scene.world(state.grains.x)
    in_plane = np.cos(lean) * x - np.sin(lean) * (z - begin[2])
    off_plane = np.sin(lean) * x + np.cos(lean) * (z - begin[2])
    inside = (abs(in_plane) < SIDE / 2) & (y < SIDE / 2) & (abs(off_plane) < THICK * SIDE / 2)
    state = planted(scene, at_rest(scene, without(state, inside), surface), *pose(0.0))
    steps = int((motion.travel * SIDE / speed + RAMP / 2) / RIGID_DT)
    done = ride(scene, state, soft_travel(RIGID_DT * np.arange(1, 1 + steps), speed, RAMP), pose)
    whole = 2 * done.force(0)[:, [0, 2]] / UNIT
    force = np.stack([smooth(done.travel, f, SIDE / cells) for f in whole.T], axis=-1)
    travel = done.travel / SIDE
    return Push(travel, motion.depth - travel * motion.way[1], force, int(done.last.health), done.cpu_s)


FOOTING = 0.025  # m, a cell
FOOTING_WIDTH = 0.1  # m, of the slice
FOOTING_BED = (1.0, 0.4)  # m, across and deep
PRESSED, HELD = 0.05, 0.5  # m/s, and s after it has halted


@cache
def footing_bed(half_width: float) -> Bed:
    """A long footing over sand in plane strain, half as many cells wide; a node of the grid lies under its middle."""
    (across, deep), y, half = FOOTING_BED, FOOTING_WIDTH, half_width * FOOTING
    return Bed(
        f"""<worldbody><body mocap="true" pos="0 {y / 2} {deep}">
          <geom name="footing" type="box" pos="0 0 .1" size="{half} {y} .1"/></body></worldbody>""",
        ("footing",),
        (across, y, 1.5 * deep),
        (((-across / 2, 0, 0), (across / 2, y, deep)),),
        FOOTING,
        2,
        friction=FRICTION,
        rigid_dt=RIGID_DT,
        material=sand(FRICTION_DEG, E),
        lower=(-across / 2, 0, 0),
        walls={},
        speed=1.0,
    )


class Footing(NamedTuple):
    """What a footing bears that was pressed in and then held still."""

    held: float  # N
    health: int
    cpu_s: float


def footing(half_width: float, depth: float) -> Footing:
    """Press a footing in to a depth and hold it there; both in cells. The bed's surface is a plane of nodes."""
    scene, deep = footing_bed(half_width).scene(), FOOTING_BED[1]

    def pose(travel: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([[0, FOOTING_WIDTH / 2, deep - travel]]), about("y", 0)[None]

    state = planted(scene, at_rest(scene, footing_bed(half_width).start(), deep), *pose(0.0))
    goal = depth * FOOTING
    times = RIGID_DT * np.arange(1, 1 + int((goal / PRESSED + RAMP + HELD) / RIGID_DT))
    done = ride(scene, state, np.minimum(soft_travel(times, PRESSED, RAMP), goal), pose)
    return Footing(float(done.force(0)[-10:, 2].mean()), int(done.last.health), done.cpu_s)


def breakout(depth: float, friction_deg: float = FRICTION_DEG) -> float:
    """What pulls a flat square plate out from a depth (of SIDE), over the weight of sand on it.

    The upper bound of limit analysis, a block that widens upward with the angle of friction (Murray & Geddes,
    J. Geotech. Eng. 113, 1987).
    """
    widens = depth * np.tan(np.radians(friction_deg))
    return float(1 + 2 * widens + np.pi / 3 * widens**2)
