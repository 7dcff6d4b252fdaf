"""Dig: an excavator arm fills its bucket from a bed and empties it into a bin."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.interpolate import PchipInterpolator

from mpm_env.mpm.budgets import height_map
from mpm_env.scene import Scene, State, initial
from mpm_env.tasks.protocol import (
    TaskConfig,
    in_body,
    kilograms,
    moved_targets,
    site_twist,
    within,
)
from mpm_env.wrench import Wrench, wrench_at

BED_TOP = 0.20  # m, mean height of the bed
BED_UNTIL = 0.82  # m, x where the partition begins
BIN_FROM = 0.85  # m, x beyond which the bin is
BIN_TOP = 0.3  # m, below which sand behind the partition is in the bin
MAP_LOWER, MAP_UPPER, MAP_COLUMNS = (0.0, -0.2), (1.2, 0.2), (24, 8)
RATES = np.array([1.0, 1.25, 2.75])  # rad/s of boom, stick and bucket at full action
STRONG = 400.0  # N on the bucket that counts as rough
CARRY_HEIGHT = 0.45  # m, bucket height that clears the partition

# The bucket's inside in its own frame, seen from the side: half planes n . (x, z) <= c, with a heap over the rim.
RIM = ((0.02, -0.05), (0.02, 0.108), (0.05, 0.147), (0.145, 0.147), (0.245, 0.0), (0.245, -0.05))
HALF_WIDTH = 0.12  # m


@dataclass(frozen=True, eq=False)
class Dig:
    """Fill the bucket from the bed and bring at least the target mass into the bin behind the partition.

    Action (3,), each in [-1, 1]: rates of the boom, stick and bucket targets, in units of RATES. Targets stop at the
    joints' ranges.

    Observation, all float32:
        joints      (6,)     rad, rad/s: boom, stick and bucket, then their rates
        targets     (3,)     rad: where the actuators are told to be
        tool        (6,)     m, m, rad, m/s, m/s, rad/s: cutting edge x, z, tilt of the bucket, and their rates
        wrench      (3,)     N, N, N m: what the material does to the bucket along x, along z and about its middle,
                             mean over the last action
        height_map  (24, 8)  m: top of the material over x 0..1.2, y -0.2..0.2
        mass        (4,)     kg: in the bucket, moved out of the bed, spilled (moved, but neither in the bucket nor
                             beyond the partition), in the bin
    """

    config: TaskConfig
    scene: Scene
    term_weights: ClassVar[dict[str, float]] = {
        "approach": 0.05,
        "load": 0.15,
        "lift": 0.15,
        "deliver": 0.55,
        "keep": 0.05,
        "gentle": 0.05,
    }
    rates: ClassVar[np.ndarray] = RATES

    @cached_property
    def _ids(self) -> tuple[int, int]:
        assert self.scene.bodies is not None
        model = self.scene.bodies.model
        return int(model.body("bucket").id), int(model.site("bucket_tip").id)

    def initial(self, key: Array) -> State:
        """A bed whose relief the key decides; the arm ready above it."""
        return initial(self.scene, key)

    def targets(self, state: State, action: Array) -> Array:
        """Joint targets after an action, inside the actuators' ranges."""
        return moved_targets(self, state, action)

    def observation(self, state: State, tool: Wrench) -> dict[str, Array]:
        """See the class."""
        d = state.rigid
        body, tip = self._ids
        v, w = site_twist(self.scene, state, "bucket_tip")
        R, at = d.xmat[body], d.site_xpos[tip]
        tilt = jnp.arctan2(-R[2, 0], -R[0, 0])
        grains = state.grains
        facts = self.facts(state)
        return {
            "joints": jnp.concatenate([d.qpos, d.qvel]),
            "targets": d.ctrl,
            "tool": jnp.stack([at[0], at[2], tilt, v[0], v[2], -w[1]]),
            "wrench": jnp.stack([tool.force[0], tool.force[2], tool.torque[1]]),
            "height_map": height_map(
                self.scene.world(grains.x), grains.m, lower=MAP_LOWER, upper=MAP_UPPER, columns=MAP_COLUMNS, floor=0.0
            ),
            "mass": jnp.stack([facts[k] for k in ("bucket_kg", "moved_kg", "spilled_kg", "bin_kg")]),
        }

    def facts(self, state: State) -> dict[str, Array]:
        """Masses in the bucket, moved, spilled and in the bin, in kg; where the bucket's edge is, in m."""
        grains = state.grains
        body, tip = self._ids
        x = self.scene.world(grains.x)
        local = in_body(state, body, x)
        inside = jnp.abs(local[1]) < HALF_WIDTH
        for (x0, z0), (x1, z1) in zip(RIM, (*RIM[1:], RIM[0]), strict=True):
            inside &= (x1 - x0) * (local[2] - z0) - (z1 - z0) * (local[0] - x0) <= 0
        inside &= x[2] > BED_TOP  # sand in the bed around a lowered bucket is not a load
        bucket, past = kilograms(grains.m, inside), ~inside & (x[0] > BED_UNTIL)
        return {
            "bucket_kg": bucket,
            "moved_kg": bucket + kilograms(grains.m, past) + state.left,
            "spilled_kg": kilograms(grains.m, past & (x[0] < BIN_FROM)) + state.left,
            "bin_kg": kilograms(grains.m, past & (x[0] > BIN_FROM) & (x[2] < BIN_TOP)),
            "edge_z_m": state.rigid.site_xpos[tip][2],
            "edge_x_m": state.rigid.site_xpos[tip][0],
        }

    def terms(self, facts: dict[str, Array], tool: Wrench) -> dict[str, Array]:
        """approach: the edge over the bed. load: bucket and bin against target. lift: load brought up or
        delivered. deliver: bin against target. keep: nothing spilled. gentle: low forces."""
        target = self.config.target_kg
        load = within(facts["bucket_kg"] + facts["bin_kg"], target)
        delivered = within(facts["bin_kg"], target)
        over_bed = jnp.maximum(facts["edge_x_m"] - 0.8, 0) + jnp.maximum(0.1 - facts["edge_x_m"], 0)
        away = jnp.hypot(over_bed, jnp.maximum(facts["edge_z_m"] - BED_TOP, 0))
        return {
            "approach": jnp.maximum(1 - within(away, 0.5), load),
            "load": load,
            "lift": jnp.maximum(load * within(facts["edge_z_m"] - BED_TOP, CARRY_HEIGHT - BED_TOP), delivered),
            "deliver": delivered,
            "keep": 1 - within(facts["spilled_kg"], target),
            "gentle": 1 - within(jnp.linalg.norm(tool.force), STRONG),
        }

    def success(self, facts: dict[str, Array]) -> Array:
        """The target mass is in the bin."""
        return facts["bin_kg"] >= self.config.target_kg

    def wrench(self, state: State, reaction: Array) -> Wrench:
        """The bucket's wrench from the reactions on its geoms."""
        return wrench_at(self.scene, state, reaction, "wrench")

    def script(self) -> list[tuple[float, np.ndarray]]:
        """One dig at a good place."""
        return waypoints(dig_x=0.5, depth=0.12)


# The scripted dig: where the bucket goes, and the joint angles that take it there, in the x-z plane.

PIVOT = np.array([-0.05, 0.50])  # boom hinge (x, z) m
BOOM, STICK, TIP = 0.75, 0.60, 0.25  # m, hinge to hinge, and bucket hinge to cutting edge
DRAG = 0.25  # m, length of the cut
KNOT_STEP = 0.1  # s between joint waypoints


class Edge(NamedTuple):
    """The cutting edge, m, and the bucket's tilt: 0 opens straight up, positive is uncurled, rad."""

    x: float
    z: float
    tilt: float


def joint_angles(edge: Edge) -> np.ndarray:
    """Boom, stick and bucket angles (3,) rad that put the cutting edge there, elbow up.

    Law of cosines for the two links; the bucket takes up the rest. Raises ValueError out of reach.
    """
    along = np.pi + edge.tilt
    hinge = np.array([edge.x, edge.z]) - TIP * np.array([np.cos(along), np.sin(along)]) - PIVOT
    far = float(np.hypot(*hinge))
    if not abs(BOOM - STICK) < far < BOOM + STICK:
        raise ValueError(
            f"The bucket's hinge would be {far:.3f} m from the boom's pivot, outside {abs(BOOM - STICK):.2f}.."
            f"{BOOM + STICK:.2f} m: move the cutting edge or change its tilt."
        )
    bend = np.arccos((far**2 - BOOM**2 - STICK**2) / (2 * BOOM * STICK))
    boom = np.arctan2(hinge[1], hinge[0]) + np.arctan2(STICK * np.sin(bend), BOOM + STICK * np.cos(bend))
    bucket = np.remainder(along - (boom - bend) + np.pi, 2 * np.pi) - np.pi
    return np.array([boom, -bend, bucket])


def edge_path(dig_x: float, depth: float) -> list[tuple[float, Edge]]:
    """A dig as timed poses: enter at dig_x, cut `depth` deep towards the base, lift, carry over the bin, empty.

    The edge stays under 0.5 m/s; a cut nearer to the base takes longer to carry.
    """
    low, end = BED_TOP - depth, dig_x - DRAG
    over = 4.0 + 2.8 * (0.82 - end)
    return [
        (0.0, Edge(dig_x + 0.04, BED_TOP + 0.10, np.radians(105))),  # ready
        (0.9, Edge(dig_x, low, np.radians(103))),  # edge in
        (2.0, Edge(end + 0.05, low, np.radians(80))),  # cut
        (2.6, Edge(end - 0.02, low + 0.05, np.radians(52))),  # curl
        (3.3, Edge(end - 0.04, BED_TOP + 0.08, np.radians(5))),  # opening up
        (4.0, Edge(end + 0.08, 0.50, np.radians(-4))),  # clear of the partition
        (over, Edge(0.90, 0.57, np.radians(-2))),  # over the bin
        (over + 0.7, Edge(0.91, 0.51, np.radians(48))),  # sand leaves over the edge
        (over + 1.6, Edge(0.98, 0.44, np.radians(125))),  # empty
        (over + 2.2, Edge(0.98, 0.44, np.radians(125))),
    ]


def waypoints(dig_x: float = 0.5, depth: float = 0.1) -> list[tuple[float, np.ndarray]]:
    """Joint targets (time s, angles (3,) rad) of one dig with dig_x in 0.35..0.6 m and depth in 0.03..0.15 m.

    Raises ValueError outside these ranges: the path was checked against partition and floor only there.
    """
    if not 0.35 <= dig_x <= 0.6 or not 0.03 <= depth <= 0.15:
        raise ValueError(f"A dig needs dig_x in 0.35..0.6 m and depth in 0.03..0.15 m, got {dig_x} and {depth}.")
    path = edge_path(dig_x, depth)
    curve = PchipInterpolator([t for t, _ in path], [tuple(edge) for _, edge in path])
    stops = np.linspace(0.0, path[-1][0], round(path[-1][0] / KNOT_STEP) + 1)
    return [(float(t), joint_angles(Edge(*curve(t)))) for t in stops]
