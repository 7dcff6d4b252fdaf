"""A blade driven through a bed: how much sand passes through it, and how far its force is from a fine grid's.

The blade reaches 10 cm into a bed of 20 cm and moves at 0.3 m/s after a soft start. In plane strain the reference is
the same blade on a grid so fine that it is at least two cells thick.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.coupling.beds import ROWS
from benchmarks.coupling.scenes import Bed, run, settled, trouble
from mpm_env import State
from mpm_env.sim import Drive

LENGTH, DEPTH, INTO = 0.8, 0.2, 0.1  # m
HALF_HEIGHT = 0.15  # m, of the blade, well above any heap
START = 0.25  # m, along x
SPEED, RAMP = 0.3, 0.05  # m/s, s
DT = 0.004  # s
WIDE = {2: 0.1, 3: 0.2}  # m, of the bed


@cache
def bed(thickness: float, dx: float, dimension: int = 2, offset: float = 0.0, yaw: float = 0.0, **fidelity: Any) -> Bed:
    """A blade of this thickness (m) above its place in the bed, `offset` cells on and turned by yaw degrees."""
    wide = WIDE[dimension]
    turn = Rotation.from_euler("z", yaw, degrees=True).as_quat(scalar_first=True)
    at = START + offset * dx
    across = wide if dimension == 2 else wide / 4  # m, half the blade's width
    geom = f'<geom name="blade" type="box" size="{thickness / 2} {across} {HALF_HEIGHT}"/>'
    pose = f'pos="{at} {wide / 2} {DEPTH - INTO + HALF_HEIGHT}" quat="{" ".join(map(str, turn))}"'
    free = at - thickness  # m, sand leaves room for the blade, and flows in while the bed settles
    fills = ((0.0, free, 0.0, DEPTH), (at + thickness, LENGTH, 0.0, DEPTH), (free, at + thickness, 0.0, DEPTH - INTO))
    if dimension == 3:
        fills = ((0.0, LENGTH, 0.0, DEPTH),)
    return Bed(
        f'<worldbody><body name="blade" mocap="true" {pose}>{geom}</body></worldbody>',
        ("blade",),
        (LENGTH, wide, 0.4),
        tuple(((a, 0.0, c), (b, wide, d)) for a, b, c, d in fills),
        dx,
        dimension,
        friction=0.4,
        rigid_dt=DT,
        fidelity=fidelity,
    )


def travelled(time: np.ndarray) -> np.ndarray:
    """Way (k,) m of the blade after times (k,) s."""
    return SPEED * np.where(time < RAMP, time**2 / (2 * RAMP), time - RAMP / 2)


class Drag(NamedTuple):
    """What a drag did."""

    way: np.ndarray  # (k,) m
    force: np.ndarray  # (k,) N per m of the slice or of the blade's width, along x
    leaked: float  # of the mass that the blade swept, to its other side
    trouble: list[str]

    def mean(self, first: float, last: float) -> float:
        """Mean force between two places, m."""
        return float(self.force[(self.way > first) & (self.way <= last)].mean())


def dragged(some: Bed, way: float) -> Drag:
    """Drive the blade this far (m), through a bed at rest."""
    scene, state = some.scene(), settled(some.scene(), some.start(), 2)
    pos, quat = (np.asarray(a) for a in (state.rigid.mocap_pos, state.rigid.mocap_quat))
    count = ROWS * int(np.ceil((way / SPEED + RAMP / 2) / DT / ROWS))
    gone = travelled((np.arange(count) + 1) * DT)
    positions = pos[None] + gone[:, None, None] * np.eye(3)[0]
    drives = Drive(jnp.zeros((count, 0)), jnp.asarray(positions, pos.dtype), jnp.asarray(np.tile(quat, (count, 1, 1))))
    last, steps = run(scene, state, count, drives)
    width = WIDE[2] if some.dimension == 2 else WIDE[3] / 2
    force = steps.reaction[:, 0, 0] / width
    return Drag(gone, force, leak(some, state, last), trouble(steps))


def leak(some: Bed, first: State, last: State) -> float:
    """Mass that was in front of the blade, at its depth, and is behind it now, over what it swept."""
    scene = some.scene()
    x0, x1 = (np.asarray(scene.world(s.grains.x)) for s in (first, last))
    m = np.asarray(last.grains.m, np.float64)
    sides = []
    for x, s in ((x0, first), (x1, last)):
        pos, quat = np.asarray(s.rigid.mocap_pos[0]), np.asarray(s.rigid.mocap_quat[0])
        local = Rotation.from_quat(quat, scalar_first=True).inv().apply(x.T - pos)
        beside = np.abs(local[:, 1]) < scene.bodies.shapes[0].size[1] - 2 * some.dx if some.dimension == 3 else True
        sides.append((local[:, 0], (x[2] > DEPTH - INTO + 1.5 * some.dx) & beside))
    (s0, in0), (s1, in1) = sides
    went = np.asarray(last.rigid.mocap_pos[0] - first.rigid.mocap_pos[0])[0]
    swept = (s0 > 0) & (s0 < went) & in0
    return float(m @ ((s0 > 0) & (s1 < 0) & in0 & in1) / (m @ swept))
