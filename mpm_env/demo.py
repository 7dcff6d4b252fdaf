"""A scripted policy at work: through the Gymnasium environment, into a recording, a moving picture and a summary."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from tqdm import tqdm

from mpm_env.env import GrainsEnv
from mpm_env.fidelity import Fidelity
from mpm_env.health import names, sentences
from mpm_env.log import Recorder
from mpm_env.render import save_png, save_video
from mpm_env.run import folder, versions
from mpm_env.tasks import TaskConfig
from mpm_env.tasks.episode import actions_per_episode, scripted_action
from mpm_env.view import View, camera_of, write_frame

RECORDING = "demo.rrd"
FILES = (RECORDING, "demo.webp", "demo.png", "summary.json")
SKIP = 2  # actions per frame of the moving picture
SETTLE = 5  # actions after the script's end, for what still falls


def demo(
    task: str | TaskConfig,
    fidelity: str | Fidelity | None,
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    progress: bool = True,
) -> dict[str, Any]:
    """Follow a task's script for one episode; leave demo.rrd, demo.webp, demo.png and summary.json in `out`.

    Returns the summary; each of its forces is a mean over an action, so a blow shorter than that counts for less. The
    episode runs to the end of its script, past success, so that what is delivered can come to rest. Raises ValueError,
    in one sentence, for what cannot be simulated; nothing is written then.
    """
    return prepare(task, fidelity, out, seed=seed).go(progress=progress)


def prepare(
    task: str | TaskConfig, fidelity: str | Fidelity | None, out: str | os.PathLike[str], *, seed: int = 0
) -> Demo:
    """A demo that is ready to go: everything that can be refused has been checked. Arguments as for `demo`."""
    began = perf_counter()
    if seed < 0:
        raise ValueError(f"seed = {seed} is negative: use 0 or more.")
    env = GrainsEnv(task, fidelity)
    built = perf_counter()
    env.reset(seed=seed)
    started = perf_counter()
    with folder(out, FILES) as path:
        recorder = _recorder(env, path / RECORDING, seed)
    for name in FILES:
        if name != RECORDING:
            (path / name).unlink(missing_ok=True)
    return Demo(env, path, seed, recorder, {"build": built - began, "compile": started - built})


@dataclass(eq=False)
class Demo:
    """A scripted episode, built and about to start."""

    env: GrainsEnv  # just reset
    out: Path
    seed: int
    recorder: Recorder
    spent: dict[str, float]  # s, on what

    def go(self, *, progress: bool = True) -> dict[str, Any]:
        """Run it, write the files, return the summary."""
        env, scene = self.env, self.env.task.scene
        dt = env.task.config.control_dt
        wall = {**self.spent, "run": 0.0, "log": 0.0}
        count = min(round(env.task.script()[-1][0] / dt) + SETTLE, actions_per_episode(env.task))
        views: list[View] = []
        rewards, forces, interest = [], [], []
        with self.recorder as recorder:
            _frame(recorder, env)
            for k in tqdm(range(count), unit="action", disable=not progress):
                assert env.episode is not None
                action = scripted_action(env.task, env.episode)
                recorder.action(int(env.episode.state.steps), action.astype(np.float64))
                started = perf_counter()
                _, reward, _, _, info = env.step(action)
                wall["compile" if k == 0 else "run"] += perf_counter() - started
                started = perf_counter()
                rewards.append(reward)
                forces.append(float(np.linalg.norm(info["force_N"])))
                interest.append(sum(info["terms"].values()))
                _frame(recorder, env)
                views.append(View.of(scene, env.episode.state))
                wall["log"] += perf_counter() - started
        started = perf_counter()
        save_video(self.out / "demo.webp", [v.picture() for v in views[::SKIP]], 1 / (SKIP * dt))
        save_png(self.out / "demo.png", views[int(np.argmax(interest))].picture(width=960, height=640, samples=2))
        wall["pictures"] = perf_counter() - started
        e = env.episode
        assert e is not None
        summary = {
            "task": scene.config.name,
            "success": bool(e.terminated),
            "target_kg": env.task.config.target_kg,
            "facts": {k: float(v) for k, v in e.facts.items()},
            "return": float(np.sum(rewards)),
            "force_mean_N": float(np.mean(forces)),
            "force_largest_mean_of_an_action_N": float(np.max(forces)),
            "time_s": count * dt,
            "grains": int(np.count_nonzero(np.asarray(e.state.grains.m))),
            "health": {"names": names(int(e.state.health)), "sentences": sentences(int(e.state.health))},
            "wall_s": wall,
            "seed": self.seed,
            "fidelity": scene.fidelity.model_dump(mode="json"),
            "versions": versions(scene.kernels),
        }
        (self.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        return summary


def _recorder(env: GrainsEnv, path: Path, seed: int) -> Recorder:
    """The recording of an environment that was just reset, open, with all that a re-simulation needs."""
    scene = env.task.scene
    assert scene.bodies is not None
    box, camera = scene.config.box, camera_of(scene)
    recipe = {
        "kind": "task",
        "scene": scene.config.name,
        "seed": seed,
        "key": env.key_number,
        "config": env.task.config.model_dump(mode="json"),
        "fidelity": scene.fidelity.model_dump(mode="json"),
        "versions": versions(scene.kernels),
    }
    return Recorder(
        path, recipe=recipe, model=scene.bodies.model, box=(box.lower, box.upper), view=(camera.eye, camera.target)
    )


def _frame(recorder: Recorder, env: GrainsEnv) -> None:
    """One frame of the recording: the state, wrenches as means over the last action, reward terms, masses, places."""
    e, scene = env.episode, env.task.scene
    assert e is not None
    scalars = {f"reward/{k}": float(v) for k, v in e.terms.items()} | {"reward/total": float(e.reward)}
    for k, v in e.facts.items():
        group, unit = ("budget", "kg") if k.endswith("_kg") else ("place", "m")
        scalars[f"{group}/{'mass_' if unit == 'kg' else ''}{k}"] = float(v)
    write_frame(
        recorder,
        View.of(scene, e.state),
        step=int(e.state.steps),
        reactions=np.asarray(e.reactions)[None],
        quantity="speed",
        scalars=scalars,
    )
