"""What a task is: a scene, an action that moves its robot, and what is observed and rewarded."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Protocol

import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field

from mpm_env.config import Section
from mpm_env.scene import Scene, State
from mpm_env.scene_config import SceneConfig
from mpm_env.wrench import Wrench


class TaskConfig(Section):
    """A task file: goals in kg, m and s, never in grains, so that every fidelity runs the same task."""

    about: str = ""
    model: str  # which code in TASKS
    target_kg: Annotated[float, Field(gt=0)]  # mass to deliver
    control_dt: Annotated[float, Field(gt=0)] = 0.1  # s between actions
    time_limit: Annotated[float, Field(gt=0)]  # s, then the episode is truncated
    scene: SceneConfig


class Task(Protocol):
    """A task over one scene. Pure: everything that changes is in the state."""

    term_weights: ClassVar[dict[str, float]]  # reward = sum of weight times term; weights sum to 1
    rates: ClassVar[np.ndarray]  # (a,) change of the actuator targets per second at full action, whose elements are +-1

    @property
    def config(self) -> TaskConfig:
        """What is asked."""

    @property
    def scene(self) -> Scene:
        """What is simulated, and how finely."""

    def initial(self, key: Array) -> State:
        """A seeded start."""

    def targets(self, state: State, action: Array) -> Array:
        """Actuator targets (nu,) that the action (a,) asks for by the end of its time."""

    def observation(self, state: State, tool: Wrench) -> dict[str, Array]:
        """Named observations."""

    def facts(self, state: State) -> dict[str, Array]:
        """Scalars worth a plot: masses in kg, lengths in m."""

    def terms(self, facts: dict[str, Array], tool: Wrench) -> dict[str, Array]:
        """Reward terms, each in [0, 1]."""

    def success(self, facts: dict[str, Array]) -> Array:
        """Whether the goal is reached, () bool."""

    def wrench(self, state: State, reaction: Array) -> Wrench:
        """What the grains did to the tool, in world axes, from the mean reactions (G, 6) on the coupled geoms."""

    def script(self) -> list[tuple[float, np.ndarray]]:
        """A scripted solution: (time s, actuator targets (nu,))."""


def moved_targets(task: Task, state: State, action: Array) -> Array:
    """Actuator targets (nu,) after an action that sets their rates, inside the actuators' ranges."""
    assert task.scene.bodies is not None
    low, high = task.scene.bodies.model.actuator_ctrlrange.T
    return jnp.clip(state.rigid.ctrl + task.config.control_dt * task.rates * action, low, high)


def site_twist(scene: Scene, state: State, site: str) -> tuple[Array, Array]:
    """Velocity (3,) m/s of a site and angular velocity (3,) rad/s of its body, in world axes.

    MuJoCo's cvel is taken at the centre of mass of the kinematic tree.
    """
    assert scene.bodies is not None
    model, d = scene.bodies.model, state.rigid
    at = model.site(site)
    body = int(at.bodyid[0])
    w = d.cvel[body, :3]
    return d.cvel[body, 3:] + jnp.cross(w, d.site_xpos[at.id] - d.subtree_com[int(model.body_rootid[body])]), w


def within(x: Array, bound: float) -> Array:
    """x over its bound, clipped to [0, 1]: the common shape of reward terms."""
    return jnp.clip(x / bound, 0.0, 1.0)


def kilograms(m: Array, where: Array) -> Array:
    """Mass () in kg of the grains (n,) for which `where` (n,) holds."""
    return jnp.sum(jnp.where(where, m, 0))


def in_body(state: State, body: int, x: Array) -> Array:
    """Points x (3, n) m of the world in the frame of a body, (3, n) m."""
    d: Any = state.rigid
    return d.xmat[body].astype(x.dtype).T @ (x - d.xpos[body].astype(x.dtype)[:, None])
