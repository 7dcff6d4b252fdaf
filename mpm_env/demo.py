"""A scripted policy at work: through the Gymnasium environment, into a recording, a moving picture and a summary."""

from __future__ import annotations

import json
import os
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
from mpm_env.tasks.episode import Episode, actions_per_episode, scripted_action
from mpm_env.view import View, camera_of, write_frame

FILES = ("demo.rrd", "demo.webp", "demo.png", "summary.json")
PICTURE = {"width": 480, "height": 320}  # pixels
STILL = {"width": 960, "height": 640, "samples": 2}
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

    Returns the summary. The episode runs to the end of its script, past the moment of success, so that what is delivered
    can come to rest. Raises ValueError, in one sentence, for what cannot be simulated; nothing is written then.
    """
    began = perf_counter()
    env = GrainsEnv(task, fidelity, render_mode="rgb_array")
    scene = env.task.scene
    path = folder(out, FILES)
    built = perf_counter() - began
    env.reset(seed=seed)
    box, camera = scene.config.box, camera_of(scene)
    assert env.episode is not None and scene.bodies is not None
    count = min(round(env.task.script()[-1][0] / env.task.config.control_dt) + SETTLE, actions_per_episode(env.task))
    frames: list[np.ndarray] = []
    rewards: list[float] = []
    forces: list[float] = []
    best, still = 0.0, None
    wall = {"build": built, "compile": 0.0, "run": 0.0, "log": 0.0}
    recipe = {
        "kind": "task",
        "scene": scene.config.name,
        "seed": seed,
        "key": env.key_number,
        "config": env.task.config.model_dump(mode="json"),
        "fidelity": scene.fidelity.model_dump(mode="json"),
        "versions": versions(),
    }
    with Recorder(
        path / "demo.rrd",
        recipe=recipe,
        model=scene.bodies.model,
        box=(box.lower, box.upper),
        view=(camera.eye, camera.target),
    ) as recorder:
        _frame(recorder, env, env.episode)
        for k in tqdm(range(count), unit="action", disable=not progress):
            action = scripted_action(env.task, env.episode)
            recorder.action(int(env.episode.state.steps), action.astype(np.float64))
            started = perf_counter()
            _, reward, _, _, info = env.step(action)
            wall["compile" if k == 0 else "run"] += perf_counter() - started
            started = perf_counter()
            rewards.append(reward)
            forces.append(float(np.linalg.norm(info["force_N"])))
            _frame(recorder, env, env.episode)
            view = View.of(scene, env.episode.state)
            frames.append(view.picture(**PICTURE))
            interest = sum(info["terms"].values())
            if interest > best:
                best, still = interest, view
            wall["log"] += perf_counter() - started
    save_video(path / "demo.webp", frames, round(1 / env.task.config.control_dt))
    if still is not None:
        save_png(path / "demo.png", still.picture(**STILL))
    facts = {k: float(v) for k, v in env.episode.facts.items()}
    health = int(env.episode.state.health)
    summary = {
        "task": scene.config.name,
        "success": bool(env.episode.terminated),
        "target_kg": env.task.config.target_kg,
        "facts": facts,
        "return": float(np.sum(rewards)),
        "force_mean_N": float(np.mean(forces)),
        "force_peak_N": float(np.max(forces)),
        "time_s": count * env.task.config.control_dt,
        "grains": int(np.count_nonzero(np.asarray(env.episode.state.grains.m))),
        "health": {"names": names(health), "sentences": sentences(health)},
        "wall_s": wall,
        "seed": seed,
        "fidelity": scene.fidelity.model_dump(mode="json"),
        "versions": versions(),
    }
    (path / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return summary


def _frame(recorder: Recorder, env: GrainsEnv, e: Episode) -> None:
    """One frame of the recording: the state, the tool's wrench, reward terms and masses."""
    scene = env.task.scene
    scalars = {f"reward/{k}": float(v) for k, v in e.terms.items()}
    scalars |= {"reward/total": float(e.reward)}
    scalars |= {f"budget/{k.replace('_kg', '_mass_kg')}": float(v) for k, v in e.facts.items() if k.endswith("_kg")}
    scalars |= {f"place/{k}": float(v) for k, v in e.facts.items() if k.endswith("_m")}
    write_frame(
        recorder,
        View.of(scene, e.state),
        step=int(e.state.steps),
        reactions=np.asarray(e.state.reaction)[None],
        quantity="speed",
        scalars=scalars,
    )
