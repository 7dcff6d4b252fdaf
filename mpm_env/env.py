"""Any task as a Gymnasium environment, alone or as a batch: thin adapters over the pure functions of an episode."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from jax import Array, lax

from mpm_env.fidelity import Fidelity
from mpm_env.health import sentences
from mpm_env.tasks import Task, TaskConfig, make_task
from mpm_env.tasks.episode import Episode, actions_per_episode, reset, step
from mpm_env.view import View

LARGEST = np.float32(1e6)  # bound of observations: far beyond any healthy value, and finite as check_env likes it


def spaces(task: Task, start: Episode) -> tuple[gym.spaces.Dict, gym.spaces.Box]:
    """Observation and action space of a task; the shapes are those of its episodes' start, not from a second list."""
    shapes = start.observation
    observation = gym.spaces.Dict(
        {k: gym.spaces.Box(-LARGEST, LARGEST, v.shape, np.float32) for k, v in sorted(shapes.items())}
    )
    return observation, gym.spaces.Box(-1.0, 1.0, task.rates.shape, np.float32)


def checked(action: Any, space: gym.spaces.Box) -> np.ndarray:
    """The action as f32. Raises ValueError for a wrong shape, a value that is not finite, or one outside the space."""
    try:
        a = np.asarray(action, np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"An action is numbers of shape {space.shape}, got {action!r}.") from None
    if a.shape != space.shape:
        raise ValueError(f"An action has shape {space.shape}, got {a.shape}.")
    if not np.isfinite(a).all():
        raise ValueError(f"An action must be finite, got {a}.")
    if (a < space.low).any() or (a > space.high).any():
        raise ValueError(f"An action lies in [-1, 1], got {a}: clip or rescale it.")
    return a


class GrainsEnv(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """One task. `info` holds the reward's terms, masses and lengths, the reason of a truncation, and health sentences.

    fidelity: a shipped name, a .yaml file or a Fidelity; None takes the task's own. The observation and the action are
    described by the task's class (`env.unwrapped.task`). A step writes over the arrays of `episode` (they are donated):
    to keep one, copy it, as in jax.tree.map(jnp.copy, env.unwrapped.episode).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self, task: str | TaskConfig, fidelity: str | Fidelity | None = None, render_mode: str | None = None
    ) -> None:
        self.render_mode = _known_mode(render_mode)
        self.task = make_task(task, fidelity)
        self.metadata = {**type(self).metadata, "render_fps": round(1 / self.task.config.control_dt)}
        self._reset = jax.jit(partial(reset, self.task))
        self._step = jax.jit(partial(step, self.task), donate_argnums=0)
        observation_space, self._actions = spaces(self.task, self._reset.eval_shape(jax.random.key(0)))
        self.observation_space, self.action_space = observation_space, self._actions  # type: ignore[assignment]
        self.episode: Episode | None = None  # what the last call left, for logs and for the curious
        self.key_number: int | None = None  # jax.random.key(key_number) made this episode's start

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """A new episode; the same seed gives the same one."""
        super().reset(seed=seed)
        self.key_number = int(self.np_random.integers(2**31 - 1))
        self.episode = self._reset(jax.random.key(self.key_number))
        return _host(self.episode.observation), self._info(self.episode)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """One action. Raises ValueError for a bad action, RuntimeError before the first reset."""
        if self.episode is None:
            raise RuntimeError("Call reset() before step().")
        self.episode = e = self._step(self.episode, jnp.asarray(checked(action, self._actions)))
        return _host(e.observation), float(e.reward), bool(e.terminated), bool(e.truncated), self._info(e)

    def render(self) -> np.ndarray | None:
        """An RGB image (320, 480, 3) uint8 in render mode rgb_array."""
        if self.render_mode is None or self.episode is None:
            return None
        return View.of(self.task.scene, self.episode.state).picture()

    def _info(self, e: Episode) -> dict[str, Any]:
        health = int(e.state.health)
        info: dict[str, Any] = {
            "terms": {k: float(v) for k, v in e.terms.items()},
            "facts": {k: float(v) for k, v in e.facts.items()},
            "force_N": np.array(e.tool.force, np.float32),
            "is_success": bool(e.terminated),
            "health": health,
        }
        if e.truncated:
            info["truncated_because"] = _why(health)
        return info


class GrainsVectorEnv(gym.vector.VectorEnv[dict[str, np.ndarray], np.ndarray, np.ndarray]):
    """A batch of one task: one program runs the environments one after the other, each to the end of its action.

    On a CPU that keeps one environment's grid in cache. An environment that ended is reset by the next step, whose
    action it ignores (AutoresetMode.NEXT_STEP). A step writes over the arrays of `episodes`, as in GrainsEnv.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int,
        task: str | TaskConfig,
        fidelity: str | Fidelity | None = None,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs is at least 1, got {num_envs}.")
        self.num_envs = num_envs
        self.render_mode = _known_mode(render_mode)
        self.task = make_task(task, fidelity)
        self.metadata = {**type(self).metadata, "render_fps": round(1 / self.task.config.control_dt)}
        limit = actions_per_episode(self.task)
        if max_episode_steps not in (None, limit):
            raise ValueError(f"The task ends after {limit} steps, got max_episode_steps = {max_episode_steps}.")

        def reset_all(keys: Array) -> Episode:
            return lax.map(partial(reset, self.task), keys)

        def step_all(episodes: Episode, actions: Array, keys: Array) -> Episode:
            def one(args: tuple[Episode, Array, Array]) -> Episode:
                e, action, key = args
                ended = e.terminated | e.truncated
                return lax.cond(ended, lambda: reset(self.task, key), lambda: step(self.task, e, action))

            return lax.map(one, (episodes, actions, keys))

        self._reset, self._step = jax.jit(reset_all), jax.jit(step_all, donate_argnums=0)
        start = self._reset.eval_shape(_keys_of([0] * num_envs))
        one_start = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), start)
        self.single_observation_space, self.single_action_space = spaces(self.task, one_start)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self.episodes: Episode | None = None

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """All environments anew; a list seeds them one by one, a number n seeds them n, n + 1, ..."""
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + i for i in range(self.num_envs)]
        super().reset(seed=seed[0] if seed else None)
        if seed is not None:
            if len(seed) != self.num_envs:
                raise ValueError(f"There are {self.num_envs} environments, got {len(seed)} seeds.")
            self._randoms = [gym.utils.seeding.np_random(s)[0] for s in seed]
        elif not hasattr(self, "_randoms"):
            self._randoms = [np.random.default_rng(self.np_random.integers(2**63 - 1)) for _ in range(self.num_envs)]
        self.episodes = self._reset(self._keys(np.ones(self.num_envs, bool)))
        return _host(self.episodes.observation), self._info(self.episodes)

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One action each, (num_envs, a)."""
        if self.episodes is None:
            raise RuntimeError("Call reset() before step().")
        a = checked(actions, self.action_space)  # type: ignore[arg-type]
        ended = np.asarray(self.episodes.terminated | self.episodes.truncated)
        self.episodes = e = self._step(self.episodes, jnp.asarray(a), self._keys(ended))
        reward = np.where(ended, 0.0, np.asarray(e.reward, np.float64))
        return _host(e.observation), reward, np.array(e.terminated), np.array(e.truncated), self._info(e)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One RGB image per environment in render mode rgb_array."""
        if self.render_mode is None or self.episodes is None:
            return None
        states = [jax.tree.map(lambda a, i=i: a[i], self.episodes.state) for i in range(self.num_envs)]
        return tuple(View.of(self.task.scene, s).picture() for s in states)

    def _keys(self, wanted: np.ndarray) -> Array:
        """A fresh key for each environment that starts anew; the others' random streams stay where they are."""
        numbers = [int(r.integers(2**31 - 1)) if w else 0 for r, w in zip(self._randoms, wanted, strict=True)]
        return _keys_of(numbers)

    def _info(self, e: Episode) -> dict[str, Any]:
        all_of = np.ones(self.num_envs, bool)
        health = np.array(e.state.health)
        info: dict[str, Any] = {
            "terms": _host(e.terms),
            "facts": _host(e.facts),
            "force_N": np.array(e.tool.force, np.float32),
            "is_success": np.array(e.terminated),
            "health": health,
        }
        info |= {f"_{k}": all_of for k in info}
        ended = np.array(e.truncated)
        if ended.any():
            info["truncated_because"] = np.asarray(
                [_why(h) if end else "" for h, end in zip(health, ended, strict=True)]
            )
            info["_truncated_because"] = ended
        return info


def _keys_of(numbers: list[int]) -> Array:
    return jax.vmap(jax.random.key)(jnp.asarray(numbers, jnp.int32))


def _known_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode is None or 'rgb_array', got {render_mode!r}.")
    return render_mode


def _why(health: int) -> str:
    """Why an episode was truncated."""
    return " ".join(sentences(int(health))) if health else "The time limit is reached."


def _host(tree: dict[str, Array]) -> dict[str, np.ndarray]:
    """Arrays as fresh, writable numpy ones."""
    return {k: np.array(v) for k, v in sorted(tree.items())}
