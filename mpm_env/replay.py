"""Simulating a recording again, and holding it against what was recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.log import Recording
from mpm_env.run import versions
from mpm_env.scene import build, initial
from mpm_env.scene_config import SceneConfig
from mpm_env.sim import advance, scripted
from mpm_env.tasks import TaskConfig, make_task, reset, step
from mpm_env.view import View

Frames = Iterator[tuple[int, np.ndarray]]  # step, and grains (n, 3) float32 m


@dataclass(frozen=True)
class Comparison:
    """A recording against its re-simulation."""

    frames: int  # compared
    largest: float  # m, the largest distance of a grain's two positions; inf where one lacks grains
    step: int  # rigid step of the frame where that is
    time: float  # s
    at: tuple[float, float, float] | None  # m, where the grain was recorded
    versions: dict[str, tuple[str, str]]  # name -> (then, now), where they differ

    @property
    def identical(self) -> bool:
        """Every position of every frame to the bit."""
        return self.largest == 0.0


def scene_frames(recording: Recording) -> Frames:
    """The frames of a scene, simulated again from its recipe."""
    recipe = recording.recipe
    scene = build(
        parse(SceneConfig, recipe["config"], "the recorded scene"),
        parse(Fidelity, recipe["fidelity"], "the recorded fidelity"),
    )
    state = initial(scene, jax.random.key(recipe["seed"]))
    per_frame = recipe["steps_per_frame"]
    program = jax.jit(partial(advance, scene))
    yield 0, View.of(scene, state).grains
    for k in range(len(recording.steps) - 1):
        state, _ = program(state, scripted(scene, k * per_frame, per_frame))
        yield int(state.steps), View.of(scene, state).grains


def task_frames(recording: Recording) -> Frames:
    """The frames of an episode, simulated again from its recipe and its recorded actions."""
    recipe = recording.recipe
    task = make_task(
        parse(TaskConfig, recipe["config"], "the recorded task"),
        parse(Fidelity, recipe["fidelity"], "the recorded fidelity"),
    )
    episode = jax.jit(partial(reset, task))(jax.random.key(recipe["key"]))
    act = jax.jit(partial(step, task))
    yield 0, View.of(task.scene, episode.state).grains
    for action in recording.actions[: len(recording.steps) - 1]:
        episode = act(episode, jnp.asarray(action, jnp.float32))
        yield int(episode.state.steps), View.of(task.scene, episode.state).grains


# How each kind of recording is simulated again: recipe["kind"] -> its frames, in the order of the recording's.
REPLAYS: dict[str, Callable[[Recording], Frames]] = {"scene": scene_frames, "task": task_frames}


def compare(recording: Recording, *, progress: bool = True) -> Comparison:
    """Simulate a recording again and compare every frame.

    Raises:
        ValueError: a recording without frames, of a kind that is not known, or whose scene cannot be built any more.
    """
    kind = recording.recipe.get("kind")
    if kind not in REPLAYS:
        raise ValueError(f"A recording of kind {kind!r} cannot be simulated again; known kinds: {', '.join(REPLAYS)}.")
    if not len(recording.steps):
        raise ValueError("The recording holds no frame: there is nothing to compare.")
    recorded = zip(recording.steps, recording.times, recording.grains, strict=True)
    largest, step, time, at = 0.0, int(recording.steps[0]), float(recording.times[0]), None
    frames = tqdm(REPLAYS[kind](recording), total=len(recording.steps), unit="frame", disable=not progress)
    for (step_then, time_then, then), (step_now, now) in zip(recorded, frames, strict=True):
        distance, place = _apart(then, now) if step_then == step_now else (np.inf, None)
        if distance > largest:
            largest, step, time, at = distance, int(step_then), float(time_then), place
    before, after = recording.recipe.get("versions", {}), versions()
    changed = {
        k: (before.get(k, "none"), after.get(k, "none")) for k in {**before, **after} if before.get(k) != after.get(k)
    }
    return Comparison(len(recording.steps), largest, step, time, at, changed)


def _apart(then: np.ndarray, now: np.ndarray) -> tuple[float, tuple[float, float, float] | None]:
    """The largest distance of grains at (n, 3) m from where they were, and where that was."""
    if then.shape != now.shape:
        return np.inf, None
    if then.tobytes() == now.tobytes():  # to the bit, values that are not finite included
        return 0.0, None
    distance = np.linalg.norm(then.astype(float) - now, axis=1)
    distance[~np.isfinite(distance)] = np.inf
    worst = int(np.argmax(distance))
    x, y, z = map(float, then[worst])
    return max(float(distance[worst]), np.finfo(float).tiny), (x, y, z)
