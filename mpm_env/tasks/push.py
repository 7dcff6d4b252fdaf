"""Push: a plough blade brings a pile into a goal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.interpolate import PchipInterpolator

from mpm_env.mpm.budgets import height_map
from mpm_env.scene import Scene, State, initial
from mpm_env.tasks.protocol import TaskConfig, kilograms, moved_targets, site_twist, within
from mpm_env.wrench import Wrench, wrench_at

GOAL_LOWER, GOAL_UPPER = (0.80, -0.20), (1.15, 0.20)  # m
PILE_UNTIL = 0.55  # m, x beyond which no grain starts
PILE_FROM, GOAL_MIDDLE = 0.4, 0.95  # m along x: where the pile's middle starts, and where it should be
PILE_SHIFT = 0.03  # m, how far to either side a seed puts the pile
MAP_LOWER, MAP_UPPER, MAP_COLUMNS = (0.0, -0.3), (1.2, 0.3), (24, 12)
RATES = np.array([0.3, 0.3, 0.8])  # m/s, m/s, rad/s of slide x, slide y and yaw at full action
STRONG = 150.0  # N on the blade that counts as rough


@dataclass(frozen=True, eq=False)
class Push:
    """Push at least the target mass of a pile into the goal rectangle on the floor.

    Action (3,), each in [-1, 1]: rates of the targets of slide x, slide y and yaw, in units of RATES. Targets stop at
    the joints' ranges.

    Observation, all float32:
        joints      (6,)      m, m, rad, m/s, m/s, rad/s: slide x, slide y, yaw, then their rates
        targets     (3,)      m, m, rad: where the actuators are told to be
        tool        (6,)      m, m, rad, m/s, m/s, rad/s: middle of the blade's lower edge x, y, yaw, and their rates
        wrench      (4,)      N, N, N, N m: what the material does to the blade along x, y and z, and about z, mean over
                              the last action
        height_map  (24, 12)  m: top of the material over x 0..1.2, y -0.3..0.3
        mass        (3,)      kg: moved out of the pile's place, spilled (behind the blade, not in the goal; or gone),
                              in the goal
    """

    config: TaskConfig
    scene: Scene
    term_weights: ClassVar[dict[str, float]] = {
        "approach": 0.05,
        "progress": 0.3,
        "deliver": 0.55,
        "keep": 0.05,
        "gentle": 0.05,
    }
    rates: ClassVar[np.ndarray] = RATES

    @cached_property
    def _ids(self) -> tuple[int, int]:
        assert self.scene.bodies is not None
        model = self.scene.bodies.model
        return int(model.body("blade").id), int(model.site("blade_edge").id)

    def initial(self, key: Array) -> State:
        """A pile whose relief and place the key decides; the blade ready before it."""
        key_grains, key_shift = jax.random.split(key)
        state = initial(self.scene, key_grains)
        if self.scene.dimension == 2:
            return state
        shift = jax.random.uniform(key_shift, (), state.grains.x.dtype, -PILE_SHIFT, PILE_SHIFT)
        return replace(state, grains=replace(state.grains, x=state.grains.x.at[1].add(shift)))

    def targets(self, state: State, action: Array) -> Array:
        """Joint targets after an action, inside the actuators' ranges."""
        return moved_targets(self, state, action)

    def observation(self, state: State, tool: Wrench) -> dict[str, Array]:
        """See the class."""
        d = state.rigid
        body, edge = self._ids
        v, w = site_twist(self.scene, state, "blade_edge")
        R, at = d.xmat[body], d.site_xpos[edge]
        facts = self.facts(state)
        return {
            "joints": jnp.concatenate([d.qpos, d.qvel]),
            "targets": d.ctrl,
            "tool": jnp.stack([at[0], at[1], jnp.arctan2(R[1, 0], R[0, 0]), v[0], v[1], w[2]]),
            "wrench": jnp.concatenate([tool.force, tool.torque[2:]]),
            "height_map": height_map(
                self.scene.world(state.grains.x),
                state.grains.m,
                lower=MAP_LOWER,
                upper=MAP_UPPER,
                columns=MAP_COLUMNS,
                floor=0.0,
            ),
            "mass": jnp.stack([facts[k] for k in ("moved_kg", "spilled_kg", "goal_kg")]),
        }

    def facts(self, state: State) -> dict[str, Array]:
        """Masses moved, spilled and in the goal, in kg; the pile's mean x and distance to the blade, in m."""
        grains, d = state.grains, state.rigid
        x = self.scene.world(grains.x)
        at = d.site_xpos[self._ids[1]].astype(x.dtype)
        in_goal = jnp.ones(grains.m.shape, bool)
        for a in range(2):
            in_goal &= (x[a] > GOAL_LOWER[a]) & (x[a] < GOAL_UPPER[a])
        ahead = d.xmat[self._ids[0]].astype(x.dtype)[:, 0] @ (x - at[:, None])
        mass = jnp.maximum(jnp.sum(grains.m), 1e-9)
        middle = jnp.sum(grains.m * x, axis=1) / mass
        return {
            "moved_kg": kilograms(grains.m, x[0] > PILE_UNTIL) + state.left,
            "spilled_kg": kilograms(grains.m, (ahead < 0) & ~in_goal) + state.left,
            "goal_kg": kilograms(grains.m, in_goal),
            "pile_x_m": middle[0],
            "reach_m": jnp.linalg.norm(middle[:2] - at[:2]),
        }

    def terms(self, facts: dict[str, Array], tool: Wrench) -> dict[str, Array]:
        """approach: blade near the pile. progress: pile's middle on its way. deliver: goal against target. keep: little
        left behind or lost. gentle: low forces."""
        target = self.config.target_kg
        return {
            "approach": 1 - within(jnp.maximum(facts["reach_m"] - 0.15, 0), 0.5),
            "progress": within(facts["pile_x_m"] - PILE_FROM, GOAL_MIDDLE - PILE_FROM),
            "deliver": within(facts["goal_kg"], target),
            "keep": 1 - within(facts["spilled_kg"], target),
            "gentle": 1 - within(jnp.linalg.norm(tool.force), STRONG),
        }

    def success(self, facts: dict[str, Array]) -> Array:
        """The target mass is in the goal."""
        return facts["goal_kg"] >= self.config.target_kg

    def wrench(self, state: State, reaction: Array) -> Wrench:
        """The blade's wrench, wings included, from the reactions on its geoms."""
        return wrench_at(self.scene, state, reaction, "wrench")

    def script(self) -> list[tuple[float, np.ndarray]]:
        """One straight push."""
        return waypoints()


def waypoints(start_x: float = 0.15, end_x: float = 0.95, y: float = 0.0, yaw: float = 0.0) -> list:
    """Joint targets (time s, slide x, slide y, yaw (3,)) of one straight push, then 0.1 m back."""
    path = [(0.0, start_x), (0.3, start_x), (0.8, start_x + 0.06), (4.3, end_x), (4.6, end_x), (5.4, end_x - 0.1)]
    curve = PchipInterpolator([t for t, _ in path], [x for _, x in path])
    return [(float(t), np.array([float(curve(t)), y, yaw])) for t in np.arange(0, 5.41, 0.1)]
