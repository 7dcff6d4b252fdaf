"""Small scenes of bodies and sand, set going by their own motion or along a path, and what is read off them.

Tests run them small, the benchmarks larger.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks.coupling.beds import SAND, G, started
from coupling import bodies as rigid
from mpm_env import Fidelity, Scene, SceneConfig, State, build, scripted
from mpm_env.config import parse
from mpm_env.health import ContactReport, names
from mpm_env.mpm.budgets import budgets
from mpm_env.sim import Drive, rigid_step

FLOOR = {"z_lower": {"kind": "separate", "friction": 0.5}}
ROWS = 25  # rigid steps in one call: one program serves runs of any length

Vec = tuple[float, float, float]
Pose = Callable[[float], tuple[np.ndarray, np.ndarray]]  # travel, m -> positions (nmocap, 3) m, turns (nmocap, 4)


@dataclass(frozen=True, eq=False)
class Bed:
    """A box with walls, some of it full of sand, and a model in it. Lengths in m; plane strain if dimension is 2.

    Equal only to itself, so that what is built and compiled for it is kept.
    """

    mjcf: str  # what stands inside <mujoco>
    couple: tuple[str, ...]
    size: Vec  # of the box
    fills: tuple[tuple[Vec, Vec], ...]  # lower and upper corners
    dx: float
    dimension: int = 3
    friction: float = 0.5  # of bodies
    gravity: float = G
    rigid_dt: float = 0.004
    material: dict[str, Any] = field(default_factory=dict)  # a whole one, or what differs from SAND
    fidelity: dict[str, Any] = field(default_factory=dict)  # what differs from the default
    bodies: dict[str, Any] = field(default_factory=dict)  # more of BodiesConfig
    lower: Vec = (0.0, 0.0, 0.0)  # corner of the box
    walls: dict[str, Any] = field(default_factory=lambda: FLOOR)
    speed: float | None = None  # m/s, the fastest to be expected, if it is not that of a fall

    @cache  # noqa: B019  a process builds few of them
    def scene(self) -> Scene:
        """Built."""
        cells = 2
        config = {
            "name": "bed",
            "box": {"lower": self.lower, "upper": tuple(a + b for a, b in zip(self.lower, self.size, strict=True))},
            "feature": cells * self.dx,
            "gravity": (0, 0, -self.gravity),
            "duration": 1.0,
            "speed": self.speed,
            "walls": self.walls,
            "grains": [
                {
                    "material": self.material if "model" in self.material else SAND | self.material,
                    "fill": [{"shape": "box", "lower": low, "upper": high} for low, high in self.fills],
                }
            ],
            "bodies": {"mjcf": f"<mujoco>{self.mjcf}</mujoco>", "couple": list(self.couple), "friction": self.friction}
            | self.bodies,
        }
        how = {"dimension": self.dimension, "cells": cells, "rigid_dt": self.rigid_dt} | self.fidelity
        return build(parse(SceneConfig, config, "bed"), Fidelity(**how))

    def start(self) -> State:
        """Grains as seeded, bodies as in the model."""
        return started(self.scene())


class Steps(NamedTuple):
    """Numbers after each of k rigid steps."""

    qpos: np.ndarray  # (k, nq)
    qvel: np.ndarray  # (k, nv)
    reaction: np.ndarray  # (k, G, 6) N and N m, mean over the step
    contact: ContactReport  # (k,) each
    grains: np.ndarray | None  # (k,) J, kinetic, elastic and potential energy, where asked for
    health: np.ndarray  # (k,) sticky bits


@cache
def _program(scene: Scene, energy: bool) -> Any:
    gravity = jnp.asarray(scene.gravity, scene.dtype)

    def one(state: State, drive: Drive) -> tuple[State, Steps]:
        state = rigid_step(scene, state, drive)
        all_of_it = None
        if energy:
            b = budgets(scene.grid, scene.beds(state.materials), state.grains, gravity)
            all_of_it = b.kinetic + b.elastic + b.potential
        d = state.rigid
        return state, Steps(d.qpos, d.qvel, state.reaction, state.contact, all_of_it, state.health)

    return jax.jit(lambda state, drives: jax.lax.scan(one, state, drives))


def run(
    scene: Scene,
    state: State,
    count: int,
    drives: Drive | None = None,
    *,
    energy: bool = False,
    rows: int = ROWS,
    look: Callable[[State, Steps], None] | None = None,
) -> tuple[State, Steps]:
    """So many rigid steps, by the scene's own motion, or by these drives (count, ..).

    They are done `rows` at a time, so that a scene compiles once: up to rows - 1 more by the scene's motion, as many
    less by drives. `look` sees each call's last state and its steps.
    """
    parts, first = [], int(state.steps)
    for k in range(0, count if drives is None else count // rows * rows, rows):
        some = (
            scripted(scene, first + k, rows) if drives is None else jax.tree.map(lambda a, k=k: a[k : k + rows], drives)
        )
        state, steps = _program(scene, energy)(state, some)
        parts.append(jax.tree.map(partial(np.asarray, dtype=np.float64), steps))
        if look is not None:
            look(state, parts[-1])
    return state, jax.tree.map(lambda *a: np.concatenate(a), *parts)


def settled(scene: Scene, state: State, rounds: int = 4) -> State:
    """The state with its grains come to rest, by taking all speed out of them now and then; bodies stay in place."""
    there = state.rigid
    stay = scripted(scene, 0, ROWS)._replace(
        position=jnp.tile(there.mocap_pos, (ROWS, 1, 1)), quaternion=jnp.tile(there.mocap_quat, (ROWS, 1, 1))
    )
    for _ in range(rounds):
        state, _ = run(scene, state, ROWS, stay)
        still = replace(state.grains, v=0 * state.grains.v, C=0 * state.grains.C)
        state = replace(state, grains=still, rigid=there)
    return replace(state, steps=0 * state.steps)


def shifted(
    scene: Scene, state: State, qpos: Sequence[float] | None = None, qvel: Sequence[float] | None = None
) -> State:
    """The state with bodies elsewhere, or moving."""
    d, dtype = state.rigid, state.rigid.qpos.dtype
    if qpos is not None:
        d = d.replace(qpos=jnp.asarray(qpos, dtype))
    if qvel is not None:
        d = d.replace(qvel=jnp.asarray(qvel, dtype))
    return replace(state, rigid=rigid.refresh(scene.bodies, d))


def planted(scene: Scene, state: State, position: np.ndarray, turn: np.ndarray) -> State:
    """The state with the mocap bodies at these positions (nmocap, 3) m and quaternions (nmocap, 4)."""
    placed = rigid.place(state.rigid, jnp.asarray(position), jnp.asarray(turn))
    return replace(state, rigid=rigid.refresh(scene.bodies, placed))


def about(axis: str, angle_deg: float) -> np.ndarray:
    """The quaternion (4,) w x y z of a turn about "x", "y" or "z"."""
    half = np.radians(angle_deg) / 2
    return np.array([np.cos(half), *(np.sin(half) * (axis == a) for a in "xyz")])


def soft_travel(t: np.ndarray, speed: float, ramp: float) -> np.ndarray:
    """How far (m) a tool has gone that comes up to speed (m/s) within `ramp` s, without a jerk."""
    early = np.minimum(t, ramp)
    eased = speed / 2 * (early - ramp / np.pi * np.sin(np.pi * early / ramp))
    return eased + speed * np.maximum(t - ramp, 0)


class Ride(NamedTuple):
    """Tools on their way through sand; rows are rigid steps."""

    travel: np.ndarray  # (k,) m
    steps: Steps
    last: State
    cpu_s: float  # without compiling

    def force(self, geom: int) -> np.ndarray:
        """Force (k, 3) N on one coupled geom."""
        return self.steps.reaction[:, geom, :3]


def ride(
    scene: Scene,
    state: State,
    travel: np.ndarray,
    pose: Pose,
    *,
    rows: int = ROWS,
    look: Callable[[State, Steps], None] | None = None,
) -> Ride:
    """Drive mocap bodies along pose(travel), in a scene without actuators.

    Travel (k,) m is told at the end of each rigid step; steps beyond a whole number of calls are left out.
    """
    travel = travel[: len(travel) // rows * rows]
    poses = [pose(s) for s in travel]
    position, turn = (jnp.asarray(np.asarray(each), jnp.float32) for each in zip(*poses, strict=True))
    drives = Drive(jnp.zeros((len(travel), 0)), position, turn)
    run(scene, state, rows, drives, rows=rows)  # compiles
    began = time.process_time()
    state, steps = run(scene, state, len(travel), drives, rows=rows, look=look)
    return Ride(travel, steps, state, time.process_time() - began)


def body_energy(scene: Scene, steps: Steps) -> np.ndarray:
    """Kinetic and potential energy (k,) J of the bodies, by C MuJoCo."""
    assert scene.bodies is not None
    model = scene.bodies.model
    d, out = mujoco.MjData(model), []
    for q, v in zip(steps.qpos, steps.qvel, strict=True):
        d.qpos[:], d.qvel[:] = q, v
        mujoco.mj_fwdPosition(model, d)
        mujoco.mj_fwdVelocity(model, d)
        mujoco.mj_energyPos(model, d)
        mujoco.mj_energyVel(model, d)
        out.append(d.energy.sum())
    return np.asarray(out)


def trouble(steps: Steps) -> list[str]:
    """Health bits that were set."""
    return names(int(steps.health[-1]))
