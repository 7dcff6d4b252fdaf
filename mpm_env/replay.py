"""Simulating a recording again, and holding it against what was recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from mpm_env import native
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.log import Recording
from mpm_env.run import versions
from mpm_env.scene import build, initial
from mpm_env.scene_config import SceneConfig
from mpm_env.sim import advance, scripted
from mpm_env.tasks import TaskConfig, make_task, reset, step
from mpm_env.view import View

Frames = Iterator[tuple[int, View]]  # step, and what is to be seen then
T = TypeVar("T", int, dict)


class Difference(NamedTuple):
    """Where a recording and its re-simulation differ most."""

    size: float  # 0: equal to the bit; inf where one of the two lacks what the other has
    step: int  # rigid step of the frame where that is
    time: float  # s
    where: str  # which grain or geom, as in "the geom 'ball'"; "" where that is not known


@dataclass(frozen=True)
class Comparison:
    """A recording against its re-simulation."""

    frames: int  # compared
    grains: Difference  # m, the distance of a grain's two positions
    bodies: Difference  # the difference of two numbers of a geom's pose: m of its position, entries of its rotation
    versions: dict[str, tuple[str, str]]  # name -> (then, now), where they differ

    @property
    def identical(self) -> bool:
        """Every grain and every geom of every frame to the bit."""
        return self.grains.size == 0.0 and self.bodies.size == 0.0


def scene_frames(recording: Recording) -> Frames:
    """The frames of a scene, simulated again from its recipe."""
    entry = partial(_entry, recording.recipe)
    per_frame, seed = entry("steps_per_frame", int), entry("seed", int)
    scene = build(parse(SceneConfig, entry("config", dict), "the recorded scene"), _fidelity(recording.recipe))
    state = jax.jit(partial(initial, scene))(jax.random.key(seed))  # as in a run: to the bit
    program = jax.jit(partial(advance, scene))
    yield 0, View.of(scene, state)
    for k in range(len(recording.steps) - 1):
        state, _ = program(state, scripted(scene, k * per_frame, per_frame))
        yield int(state.steps), View.of(scene, state)


def task_frames(recording: Recording) -> Frames:
    """The frames of an episode, simulated again from its recipe and its recorded actions."""
    entry = partial(_entry, recording.recipe)
    key = entry("key", int)
    task = make_task(parse(TaskConfig, entry("config", dict), "the recorded task"), _fidelity(recording.recipe))
    count = len(recording.steps) - 1
    if recording.actions.shape != (len(recording.actions), task.rates.size) or len(recording.actions) < count:
        raise ValueError(
            f"The recording has actions {recording.actions.shape} for {count} frames after the first: it needs"
            f" ({count}, {task.rates.size})."
        )
    episode = jax.jit(partial(reset, task))(jax.random.key(key))
    act = jax.jit(partial(step, task))
    yield 0, View.of(task.scene, episode.state)
    for action in recording.actions[:count]:
        episode = act(episode, jnp.asarray(action, jnp.float32))
        yield int(episode.state.steps), View.of(task.scene, episode.state)


# How each kind of recording is simulated again: recipe["kind"] -> its frames, in the order of the recording's.
REPLAYS: dict[str, Callable[[Recording], Frames]] = {"scene": scene_frames, "task": task_frames}


def compare(recording: Recording, *, progress: bool = True) -> Comparison:
    """Simulate a recording again and compare every frame: the grains, and the poses of all geoms.

    Raises:
        ValueError: a recording without frames, of a kind that is not known, whose recipe lacks something, or whose
            scene cannot be built any more.
    """
    kind = recording.recipe.get("kind")
    if kind not in REPLAYS:
        raise ValueError(f"A recording of kind {kind!r} cannot be simulated again; known kinds: {', '.join(REPLAYS)}.")
    if not len(recording.steps):
        raise ValueError("The recording holds no frame: there is nothing to compare.")
    nothing = Difference(0.0, int(recording.steps[0]), float(recording.times[0]), "")
    worst = {"grains": nothing, "bodies": nothing}
    recorded = zip(recording.steps, recording.times, recording.grains, recording.poses, strict=True)
    frames = tqdm(REPLAYS[kind](recording), total=len(recording.steps), unit="frame", disable=not progress)
    for (step_then, time_then, grains, poses), (step_now, view) in zip(recorded, frames, strict=True):
        found = {"grains": _of_grains(grains, view), "bodies": _of_bodies(poses, view)}
        for what, (size, where) in found.items():
            size = size if step_then == step_now else np.inf
            if size > worst[what].size:
                worst[what] = Difference(size, int(step_then), float(time_then), where)
    before, after = recording.recipe.get("versions", {}), versions(native.chosen(_fidelity(recording.recipe).kernels))
    changed = {
        k: (before.get(k, "none"), after.get(k, "none")) for k in {**before, **after} if before.get(k) != after.get(k)
    }
    return Comparison(len(recording.steps), **worst, versions=changed)


def _fidelity(recipe: dict[str, Any]) -> Fidelity:
    """The recorded fidelity, without native kernels where this machine has none: they change the rounding only."""
    fidelity = parse(Fidelity, _entry(recipe, "fidelity", dict), "the recorded fidelity")
    if fidelity.kernels == "native" and native.why_not():
        return fidelity.model_copy(update={"kernels": "auto"})
    return fidelity


def _entry(recipe: dict[str, Any], name: str, kind: type[T]) -> T:
    """An entry of the recipe. Raises ValueError where it is missing or of another kind."""
    if name not in recipe:
        raise ValueError(f"The recording's recipe lacks {name!r}: it cannot be simulated again.")
    value = recipe[name]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise ValueError(f"The recording's recipe has {name!r} = {value!r}: it cannot be simulated again.")
    return value


def _of_grains(then: np.ndarray, view: View) -> tuple[float, str]:
    """The largest distance in m of grains at (n, 3) m from where they are in the view, and which that is."""
    now = view.grains
    if then.shape != now.shape:
        return np.inf, ""
    size, worst = _largest(then, now, lambda a: np.linalg.norm(a, axis=1))
    return size, "the grain at ({:.4g}, {:.4g}, {:.4g}) m".format(*then[worst]) if size else ""


def _of_bodies(then: np.ndarray, view: View) -> tuple[float, str]:
    """The largest difference of a number in poses (g, 12) from the view's, and the geom that has it."""
    now = view.poses
    if then.shape != now.shape:
        return np.inf, ""
    size, worst = _largest(then, now, lambda a: np.max(np.abs(a), axis=1))
    if not size or view.scene.bodies is None:
        return size, ""
    return size, f"the geom {view.scene.bodies.model.geom(worst).name or worst!r}"


def _largest(then: np.ndarray, now: np.ndarray, size_of: Callable[[np.ndarray], np.ndarray]) -> tuple[float, int]:
    """The largest size (n,) of the rows of a difference, and its row; 0 only where the two agree to the bit."""
    if then.tobytes() == now.tobytes():  # values that are not finite included
        return 0.0, 0
    size = size_of(then.astype(float) - now)
    size[~np.isfinite(size)] = np.inf
    worst = int(np.argmax(size))
    return max(float(size[worst]), np.finfo(float).tiny), worst
