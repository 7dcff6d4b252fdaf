"""Small scenes of bodies and sand, and what is read off them. Tests run them small, the benchmarks larger.

Sand that is denser and stiffer by one factor is the same sand under bodies that are lighter by that factor: so one
compiled scene serves all density ratios, see `lighter`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks.coupling.beds import RHO, ROWS, G, started, with_sand
from coupling import bodies as rigid
from mpm_env import Fidelity, Scene, SceneConfig, State, build, scripted
from mpm_env.config import parse
from mpm_env.health import ContactReport, names
from mpm_env.mpm.budgets import budgets
from mpm_env.sim import Drive, rigid_step

SAND = {"model": "sand", "E": 1e6, "nu": 0.3, "rho": RHO, "friction_deg": 35.0}

Vec = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Bed:
    """A box with walls, some of it full of sand, and a model in it. Lengths in m; plane strain if dimension is 2.

    Equal only to itself, so that what is built and compiled for it is kept.
    """

    mjcf: str  # what stands inside <mujoco>
    couple: tuple[str, ...]
    size: Vec  # of the box, from the origin
    fills: tuple[tuple[Vec, Vec], ...]  # lower and upper corners
    dx: float
    dimension: int = 3
    friction: float = 0.5  # of bodies
    gravity: float = G
    rigid_dt: float = 0.004
    material: dict[str, Any] = field(default_factory=dict)  # what differs from SAND
    fidelity: dict[str, Any] = field(default_factory=dict)  # what differs from the default
    bodies: dict[str, Any] = field(default_factory=dict)  # more of BodiesConfig

    @cache  # noqa: B019  a process builds few of them
    def scene(self) -> Scene:
        """Built."""
        cells = 2
        config = {
            "name": "bed",
            "box": {"lower": (0, 0, 0), "upper": self.size},
            "feature": cells * self.dx,
            "gravity": (0, 0, -self.gravity),
            "duration": 1.0,
            "walls": {"z_lower": {"kind": "separate", "friction": 0.5}},
            "grains": [
                {
                    "material": SAND | self.material,
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
    grains: np.ndarray  # (k,) J, kinetic, elastic and potential energy
    health: np.ndarray  # (k,) sticky bits


@cache
def _program(scene: Scene) -> Any:
    gravity = jnp.asarray(scene.gravity, scene.dtype)

    def one(state: State, drive: Drive) -> tuple[State, Steps]:
        state = rigid_step(scene, state, drive)
        b = budgets(scene.grid, scene.beds(state.materials), state.grains, gravity)
        d = state.rigid
        energy = b.kinetic + b.elastic + b.potential
        return state, Steps(d.qpos, d.qvel, state.reaction, state.contact, energy, state.health)

    return jax.jit(lambda state, drives: jax.lax.scan(one, state, drives))


def run(scene: Scene, state: State, count: int, drives: Drive | None = None) -> tuple[State, Steps]:
    """So many rigid steps, up to ROWS more, by the scene's own motion, or by these drives (count, ..)."""
    parts, first = [], int(state.steps)
    for k in range(0, count, ROWS):  # in equal calls, so that a scene compiles once
        some = (
            scripted(scene, first + k, ROWS) if drives is None else jax.tree.map(lambda a, k=k: a[k : k + ROWS], drives)
        )
        state, steps = _program(scene)(state, some)
        parts.append(jax.tree.map(partial(np.asarray, dtype=np.float64), steps))
    return state, jax.tree.map(lambda *a: np.concatenate(a), *parts)


def settled(scene: Scene, state: State, rounds: int = 4) -> State:
    """The state with its grains come to rest, by taking all speed out of them now and then; bodies stay in place."""
    there = state.rigid
    for _ in range(rounds):
        state, _ = run(scene, state, ROWS)
        still = replace(state.grains, v=0 * state.grains.v, C=0 * state.grains.C)
        state = replace(state, grains=still, rigid=there)
    return replace(state, steps=0 * state.steps)


def lighter(state: State, ratio: float) -> State:
    """The state with sand over `ratio` times as dense and stiff: bodies of sand's density are as light as that."""
    return with_sand(state, denser=1 / ratio)


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
