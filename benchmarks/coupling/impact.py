"""Bodies dropped on a deep bed of dry sand in 3-D: how far they go in.

By symmetry a quarter is enough: the ball or cone stands over a corner of the box, whose walls without friction are
mirrors, and slides along the edge with a quarter of its mass. `whole` simulates all of it, the body free to turn.

A body's density and the height it falls from are no part of the scene: sand as many times denser and stiffer is the
same sand under a body so much lighter, and the fall is done before the run begins.
"""

from __future__ import annotations

import time
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np

from benchmarks.coupling.beds import RHO, G, at_rest, sand, with_sand
from benchmarks.coupling.fits import exponent, line
from benchmarks.coupling.scenes import ROWS, Bed, run, shifted

SIZE = 0.1  # m, diameter of the ball
HALF_ANGLE_DEG = 30.0  # of the cone
CONE = 0.22  # m, its height: more than it ever goes in
WALLS, DEPTH, ABOVE = 2.0, 2.5, 1.0  # times SIZE: from the axis to the far walls, of the bed, of the space above it
REPOSE = 0.45  # tangent of the angle of friction, of Uehara's glass beads: 24.2 degrees, in triaxial compression
E = 1e6  # Pa
FRICTION = 0.4  # between sand and body
RIGID_DT = 0.0005  # s
STILL = 0.01  # m/s, a body slower than this at two looks in a row has come to rest
LONGEST = 0.8  # s, of a run

HEIGHTS = (0.05, 0.2, 0.8)  # m, from which balls are dropped
RATIOS = (1.0, 2.3, 5.2)  # of their density to the sand's; the last is steel
CONE_DROPS = ((0.05, 0.25), (0.2, 0.25), (0.8, 0.25), (0.1, 1.0), (0.1, 2.0), (0.4, 2.0))  # heights, m, and ratios


def _geom(kind: str, rho: float) -> tuple[str, str]:
    """MJCF of a body's shape, its lowest point at the origin: assets, and the geom."""
    if kind == "ball":
        return "", f'<geom name="body" type="sphere" size="{SIZE / 2}" pos="0 0 {SIZE / 2}" density="{rho}"/>'
    turn, radius = np.linspace(0, 2 * np.pi, 32, endpoint=False), CONE * np.tan(np.radians(HALF_ANGLE_DEG))
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, CONE)], axis=-1)
    points = " ".join(f"{v:.6g}" for v in (0, 0, 0, *ring.ravel()))
    mesh = f'<asset><mesh name="cone" vertex="{points}"/></asset>'
    return mesh, f'<geom name="body" type="mesh" mesh="cone" density="{rho}"/>'


@cache
def bed(kind: str, cells: int, courant: float, whole: bool) -> Bed:
    """A "ball" or "cone" as dense as the sand, a cell above a bed with so many cells to SIZE."""
    side, surface = WALLS * SIZE, DEPTH * SIZE
    low = -side if whole else 0.0
    asset, geom = _geom(kind, RHO if whole else RHO / 4)
    joint = "<freejoint/>" if whole else '<joint type="slide" axis="0 0 1"/>'
    return Bed(
        f"""{asset}<worldbody><body name="body" pos="0 0 {surface + SIZE / cells}">{joint}{geom}</body></worldbody>""",
        ("body",),
        (side - low, side - low, surface + ABOVE * SIZE),
        (((low, low, 0), (side, side, surface)),),
        SIZE / cells,
        friction=FRICTION,
        rigid_dt=RIGID_DT,
        material=sand(float(np.degrees(np.arctan(REPOSE))), E, "triaxial"),
        fidelity={"courant": courant},
        lower=(low, low, 0),
        speed=5.0,
    )


class Drop(NamedTuple):
    """What became of a body that was dropped."""

    depth: float  # m, of its lowest point under the first surface, at the end
    at_rest: bool
    health: int
    cpu_s: float  # without compiling


def drop(
    kind: str,
    cells: int,
    height: float,
    ratio: float,
    *,
    courant: float = 0.5,
    whole: bool = False,
    friction_deg: float | None = None,
    longest: float = LONGEST,
) -> Drop:
    """Drop a body `ratio` times as dense as the sand from this height (m) over the bed, until it lies still.

    courant is the fidelity's; friction_deg of the sand, if not REPOSE's.
    """
    dropped = bed(kind, cells, courant, whole)
    scene, surface = dropped.scene(), DEPTH * SIZE
    gap, up = SIZE / cells, 2 if whole else 0
    state = at_rest(scene, with_sand(dropped.start(), denser=1 / ratio, friction_deg=friction_deg), surface)
    speed = np.sqrt(2 * G * (height - gap))
    state = shifted(scene, state, qvel=np.asarray(state.rigid.qvel) - speed * np.eye(len(state.rigid.qvel))[up])
    first = float(state.rigid.qpos[up])
    run(scene, state, ROWS)  # compiles
    began, slow = time.process_time(), 0
    for _ in range(round(longest / RIGID_DT / ROWS)):
        state, _ = run(scene, state, ROWS)
        slow = slow + 1 if abs(float(state.rigid.qvel[up])) < STILL else 0
        if slow == 2:
            break
    cpu = time.process_time() - began
    return Drop(first - gap - float(state.rigid.qpos[up]), slow == 2, int(state.health), cpu)


class Sweep(NamedTuple):
    """Balls dropped at one resolution: from all HEIGHTS with the middle ratio, from the middle one with all RATIOS."""

    depths: dict[tuple[float, float], float]  # (height m, ratio) -> m
    health: int
    cpu_s: float

    @property
    def power_of_height(self) -> float:
        """The exponent of depth over the whole fall, H = height + depth."""
        depth = np.array([self.depths[h, RATIOS[1]] for h in HEIGHTS])
        return exponent(np.array(HEIGHTS) + depth, depth)

    @property
    def power_of_density(self) -> float:
        """The exponent of depth over the ball's density."""
        return exponent(np.array(RATIOS), np.array([self.depths[HEIGHTS[1], r] for r in RATIOS]))

    @property
    def over_uehara(self) -> dict[tuple[float, float], float]:
        """Depths over those of Uehara's law."""
        return {key: depth / uehara(*key) for key, depth in self.depths.items()}


def sweep(cells: int) -> Sweep:
    """Drop all balls."""
    keys = [(h, RATIOS[1]) for h in HEIGHTS] + [(HEIGHTS[1], r) for r in RATIOS if r != RATIOS[1]]
    done = {key: drop("ball", cells, *key) for key in keys}
    health = int(np.bitwise_or.reduce([d.health for d in done.values()]))
    return Sweep({key: d.depth for key, d in done.items()}, health, sum(d.cpu_s for d in done.values()))


def uehara(height: float, ratio: float) -> float:
    """Depth (m) of a ball of SIZE in beads: (.14/mu) ratio^1/2 SIZE^2/3 (height + depth)^1/3.

    Uehara, Ambroso, Ojha & Durian, Low-speed impact craters in loose granular media, Phys. Rev. Lett. 90, 2003.
    """
    scale, depth = 0.14 / REPOSE * np.sqrt(ratio) * SIZE ** (2 / 3), 0.0
    for _ in range(60):  # a contraction: each round is three times nearer
        depth = scale * (height + depth) ** (1 / 3)
    return float(depth)


class Cones(NamedTuple):
    """Cones dropped at one resolution."""

    depths: dict[tuple[float, float], float]  # (height m, ratio) -> m
    health: int
    cpu_s: float

    @property
    def power_of_load(self) -> float:
        """The exponent of depth over load, the whole fall times the ratio.

        It is 1/4 where force is in proportion to depth and area, so to depth cubed, and work to depth to the fourth.
        """
        depth = np.array(list(self.depths.values()))
        height, ratio = np.array(list(self.depths)).T
        return exponent(ratio * (height + depth), depth)


def cones(cells: int) -> Cones:
    """Drop all cones."""
    done = {key: drop("cone", cells, *key) for key in CONE_DROPS}
    health = int(np.bitwise_or.reduce([d.health for d in done.values()]))
    return Cones({key: d.depth for key, d in done.items()}, health, sum(d.cpu_s for d in done.values()))


Dropped = TypeVar("Dropped", Sweep, Cones)


def limit(runs: dict[int, Dropped]) -> Dropped:
    """What runs with these cells to SIZE tend to for ever finer ones.

    At one Courant number the viscosity of transfers is in proportion to cells, as is how far bodies stand off sand.
    """
    cell, of = 1 / np.array(list(runs)), next(iter(runs.values()))
    depths = {key: line(cell, np.array([r.depths[key] for r in runs.values()])).start for key in of.depths}
    health = int(np.bitwise_or.reduce([r.health for r in runs.values()]))
    return of._replace(depths=depths, health=health, cpu_s=sum(r.cpu_s for r in runs.values()))
