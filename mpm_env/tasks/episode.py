"""A task as pure functions: reset(key) -> Episode, step(Episode, action) -> Episode. Both jit, vmap and lax.map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mpm_env.health import Health
from mpm_env.scene import State
from mpm_env.sim import Drive, advance
from mpm_env.tasks.protocol import Task
from mpm_env.wrench import Wrench


@partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "state",
        "actions",
        "reactions",
        "observation",
        "reward",
        "terms",
        "facts",
        "tool",
        "terminated",
        "truncated",
    ],
    meta_fields=[],
)
@dataclass(frozen=True)
class Episode:
    """A moment of an episode, with what an agent is told of it."""

    state: State
    actions: Array  # () int32, how many were taken
    reactions: Array  # (G, 6) N and N m on each coupled geom about its body's centre, mean over the last action
    observation: dict[str, Array]  # float32
    reward: Array  # () float32, in [0, 1]
    terms: dict[str, Array]  # () each, in [0, 1]
    facts: dict[str, Array]  # () each
    tool: Wrench
    terminated: Array  # () bool, the goal is reached
    truncated: Array  # () bool, out of time or unwell


def reset(task: Task, key: Array) -> Episode:
    """The start of an episode: everything random comes from the key."""
    state = task.initial(key)
    return _told(task, state, jnp.zeros((), jnp.int32), state.reaction)


def step(task: Task, episode: Episode, action: Array) -> Episode:
    """One action (a,), each element in [-1, 1], held for the task's control_dt.

    Actuator targets move there in even steps, since a jump would be a blow.
    """
    state = episode.state
    count = rigid_per_action(task)
    now, then = state.rigid.ctrl, task.targets(state, action)
    share = (jnp.arange(count, dtype=now.dtype) + 1) / count
    still = [jnp.broadcast_to(a, (count, *a.shape)) for a in (state.rigid.mocap_pos, state.rigid.mocap_quat)]
    state, reactions = advance(task.scene, state, Drive(now + share[:, None] * (then - now), *still))
    return _told(task, state, episode.actions + 1, jnp.mean(reactions, axis=0))


def scripted_action(task: Task, episode: Episode) -> np.ndarray:
    """The action (a,) f32 that follows the task's script from here; the script's end is held."""
    script = task.script()
    times, targets = [t for t, _ in script], np.asarray([q for _, q in script])
    dt = task.config.control_dt
    then = (int(episode.actions) + 1) * dt
    wanted = np.asarray([np.interp(then, times, column) for column in targets.T])
    rate = (wanted - np.asarray(episode.state.rigid.ctrl)) / (dt * task.rates)
    return np.clip(rate, -1, 1).astype(np.float32)


def rigid_per_action(task: Task) -> int:
    """Rigid steps in one action; `make_task` has checked that it is a whole number."""
    return round(task.config.control_dt / task.scene.rigid_dt)


def actions_per_episode(task: Task) -> int:
    """Actions until the time limit."""
    return round(task.config.time_limit / task.config.control_dt)


def _told(task: Task, state: State, actions: Array, reactions: Array) -> Episode:
    """What an agent is told of a state. A sick state is no success, is truncated, and its numbers are kept finite."""
    tool = task.wrench(state, reactions)
    f32 = partial(jnp.asarray, dtype=jnp.float32)
    facts = {k: f32(v) for k, v in task.facts(state).items()}
    terms = {k: f32(v) for k, v in task.terms(facts, tool).items()}
    reward = sum((task.term_weights[k] * v for k, v in terms.items()), start=f32(0.0))
    lost = (state.health & int(Health.NOT_FINITE)) != 0
    episode = Episode(
        state=state,
        actions=actions,
        reactions=reactions,
        observation={k: f32(v) for k, v in task.observation(state, tool).items()},
        reward=reward,
        terms=terms,
        facts=facts,
        tool=tool,
        terminated=task.success(facts) & (state.health == 0),
        truncated=(actions >= actions_per_episode(task)) | (state.health != 0),
    )
    episode = replace(episode, truncated=episode.truncated & ~episode.terminated)
    clean = partial(jax.tree.map, lambda a: jnp.where(lost & ~jnp.isfinite(a), 0, a))
    return replace(
        episode,
        observation=clean(episode.observation),
        reward=clean(episode.reward),
        terms=clean(episode.terms),
        facts=clean(episode.facts),
    )
