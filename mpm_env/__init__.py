"""mpm-env: sand and snow that robots can dig into and push, and that push back.

    read_scene, load_fidelity    what is simulated, and how finely, from files
    build, initial               a checked Scene, and its first State
    rigid_step, advance, scripted      the coupled simulation as pure functions
    run.run, demo.demo           a scene, or a task's script, to a folder of results
    wrench_at, low_pass          what grains do to a tool, as a force-torque sensor tells it
    make_task                    a task; tasks.reset(task, key) and tasks.step(task, episode, action) are pure

Importing registers the Gymnasium environments mpm_env/DigSand-v0, DigSnow-v0, PushSand-v0 and PushSnow-v0. Building a
scene has JAX keep compiled programs in ~/.cache/mpm_env, unless you decide otherwise: see `scene_cache.keep_programs`.
"""

from __future__ import annotations

import os
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import gymnasium

# XLA hands the many small kernels of a substep to a pool of threads and loses more than it gains: on two cores the same
# run takes 1.7 times as long. JAX reads this when it starts its CPU client; set NPROC yourself to decide otherwise.
# Compiling still uses all cores.
os.environ.setdefault("NPROC", "1")

# Loaded when first asked for, so that `import mpm_env` stays light.
_HOMES = {
    "Fidelity": "fidelity",
    "load_fidelity": "fidelity",
    "SceneConfig": "scene_config",
    "read_scene": "scene_config",
    "Scene": "scene",
    "State": "scene",
    "build": "scene",
    "initial": "scene",
    "Drive": "sim",
    "advance": "sim",
    "scripted": "sim",
    "rigid_step": "sim",
    "Health": "health",
    "wrench_at": "wrench",
    "low_pass": "wrench",
    "make_task": "tasks",
    "read_task": "tasks",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"mpm_env.{_HOMES[name]}"), name)
    if not name.startswith("_") and find_spec(f"mpm_env.{name}"):
        return import_module(f"mpm_env.{name}")
    raise AttributeError(f"module 'mpm_env' has no attribute {name!r}")


for _id, _task in {
    "DigSand": "dig_sand",
    "DigSnow": "dig_snow",
    "PushSand": "push_sand",
    "PushSnow": "push_snow",
}.items():
    gymnasium.register(
        f"mpm_env/{_id}-v0",
        entry_point="mpm_env.env:GrainsEnv",
        vector_entry_point="mpm_env.env:GrainsVectorEnv",
        kwargs={"task": _task},
    )
