"""What is asked of a robot. A new task is a file beside these, a line in TASKS, and a file in configs/tasks."""

from __future__ import annotations

from typing import Any

from mpm_env.config import find, overlay, parse, read_yaml
from mpm_env.fidelity import Fidelity, load_fidelity
from mpm_env.scene import build
from mpm_env.scene_config import resolve
from mpm_env.scene_grains import whole
from mpm_env.tasks.dig import Dig
from mpm_env.tasks.episode import Episode, reset, step
from mpm_env.tasks.protocol import Task, TaskConfig
from mpm_env.tasks.push import Push

TASKS: dict[str, Any] = {"dig": Dig, "push": Push}


def read_task(name: str, settings: tuple[str, ...] = ()) -> TaskConfig:
    """A shipped task by name, or one from a .yaml file, with settings like "target_kg=3" on top."""
    path = find("tasks", name)
    data = read_yaml(path)
    scene = data.get("scene")
    if isinstance(scene, dict):
        scene.setdefault("name", path.stem)
        resolve(scene, path.parent)
    overlay(data, settings)
    if isinstance(scene, dict):
        resolve(scene, path.parent)
    return parse(TaskConfig, data, path.name)


def make_task(config: TaskConfig | str, fidelity: Fidelity | str | None = None) -> Task:
    """A task ready for `reset` and `step`, at a fidelity or the one that its scene names.

    Raises ValueError, in one sentence, for whatever does not fit together.
    """
    config = read_task(config) if isinstance(config, str) else config
    fidelity = fidelity or config.scene.fidelity
    fidelity = load_fidelity(fidelity) if isinstance(fidelity, str) else fidelity
    if config.model not in TASKS:
        raise ValueError(f"There is no task model {config.model!r}. Known: {', '.join(TASKS)}.")
    for what, time, part in (
        ("control_dt", config.control_dt, fidelity.rigid_dt),
        ("time_limit", config.time_limit, config.control_dt),
    ):
        if whole(time / part) is None:
            raise ValueError(
                f"{what} = {time:.6g} s is {time / part:.4g} times {part:.6g} s: make it a whole number of times."
            )
    return TASKS[config.model](config, build(config.scene, fidelity))


__all__ = ["TASKS", "Dig", "Episode", "Push", "Task", "TaskConfig", "make_task", "read_task", "reset", "step"]
