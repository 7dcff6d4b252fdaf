"""mpm-env: sand and snow that robots can dig into and push, and that push back.

    read_scene, load_fidelity    what is simulated, and how finely, from files
    build, initial               a checked Scene, and its first State
    step, advance, scripted      the coupled simulation as pure functions
    run                          a scene to a folder of results
    make_task                    a task as pure functions: reset(key), step(state, action)

Importing registers the Gymnasium environments mpm_env/DigSand-v0, DigSnow-v0, PushSand-v0 and PushSnow-v0.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

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
    "repeat": "sim",
    "scripted": "sim",
    "step": "sim",
    "Health": "health",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mpm_env' has no attribute {name!r}")
    return getattr(import_module(f"mpm_env.{_HOMES[name]}"), name)
