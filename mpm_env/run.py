"""A scene from its start to its end, and what is left of it: a recording, time series, a summary, a picture."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from mpm_env import native
from mpm_env.fidelity import Fidelity
from mpm_env.health import Health, names, sentences
from mpm_env.ledger import Ledger
from mpm_env.log import COLOUR_RANGES, Recorder
from mpm_env.render import save_png
from mpm_env.scene import Scene, State, build, initial
from mpm_env.scene_config import SceneConfig
from mpm_env.scene_grains import whole
from mpm_env.sim import advance, scripted
from mpm_env.view import View, camera_of, no_reactions, write_frame

RECORDING = "run.rrd"
FILES = (RECORDING, "run.npz", "run.png", "summary.json")
PICTURE = 960, 640  # pixels
CUT_SHORT = "cut short: the process ended before the run did"
MOST_SEED = 2**32 - 1


class Rhythm(NamedTuple):
    """Whole numbers that a run is counted in."""

    steps_per_frame: int  # rigid steps
    frames: int
    frames_per_snapshot: int | None  # None: only the first and the last


def rhythm_of(scene: Scene, fps: float, snapshots_fps: float | None = None) -> Rhythm:
    """Frames of a run at fps, in Hz. Raises ValueError where they are no whole numbers of rigid steps."""
    dt, duration = scene.rigid_dt, scene.config.duration
    if not 0 < fps < math.inf:
        raise ValueError(f"fps = {fps:.6g} is no number of frames per second: use 25 or so.")
    per_frame = whole(1 / (fps * dt))
    if per_frame is None:
        at_most = max(math.floor(1 / (fps * dt)), 1)
        raise ValueError(
            f"A frame at fps = {fps:.6g} is not a whole number of rigid steps of {dt:.6g} s: use fps ="
            f" {1 / (at_most * dt):.6g}."
        )
    frames = whole(duration * fps)
    if frames is None:
        raise ValueError(
            f"duration = {duration:.6g} s is {duration * fps:.4g} frames at fps = {fps:.6g}: make it a whole"
            f" number, such as {max(round(duration * fps), 1) / fps:.6g} s."
        )
    per_snapshot = None
    if snapshots_fps is not None and not (snapshots_fps > 0 and (per_snapshot := whole(fps / snapshots_fps))):
        raise ValueError(
            f"snapshots_fps = {snapshots_fps:.6g} does not divide fps = {fps:.6g}: use {fps:.6g} or half of it."
        )
    return Rhythm(per_frame, frames, per_snapshot)


def run(
    config: SceneConfig,
    fidelity: Fidelity,
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    fps: float = 25.0,
    snapshots_fps: float | None = None,
    quantity: str = "speed",
    progress: bool = True,
    record: bool = True,
) -> dict[str, Any]:
    """Simulate a scene and leave in the folder `out` run.rrd, run.npz, run.png and summary.json; returns the summary.

    Args:
        seed: places the grains and shapes the relief, 0 to 2^32 - 1.
        fps: frames per simulated second; a frame is a whole number of rigid steps.
        snapshots_fps: how often run.npz keeps every grain; None: only the first and the last frame.
        quantity: what colours the grains in the recording, a key of `mpm_env.log.COLOUR_RANGES`.
        progress: show a bar.
        record: write run.rrd.

    What is in run.npz: see `mpm_env.ledger.Ledger.arrays`. A crash or Ctrl-C leaves what was reached so far, and the
    summary says so. A state that is not finite ends the run.

    Raises:
        ValueError, TypeError: one sentence on what cannot be simulated; nothing is written then.
    """
    session = prepare(
        config, fidelity, out, seed=seed, fps=fps, snapshots_fps=snapshots_fps, quantity=quantity, record=record
    )
    return session.go(progress=progress)


def prepare(
    config: SceneConfig,
    fidelity: Fidelity,
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    fps: float = 25.0,
    snapshots_fps: float | None = None,
    quantity: str = "speed",
    record: bool = True,
) -> Session:
    """A run checked and ready to go, its files opened; see `run`."""
    began = perf_counter()
    scene = build(config, fidelity)
    rhythm = rhythm_of(scene, fps, snapshots_fps)
    if quantity not in COLOUR_RANGES:
        raise ValueError(f"quantity = {quantity!r} colours no grains: use one of {', '.join(COLOUR_RANGES)}.")
    if not 0 <= seed <= MOST_SEED:
        raise ValueError(f"seed = {seed} is outside 0..{MOST_SEED}: use a seed in that range.")
    camera = camera_of(scene)
    state = jax.jit(partial(initial, scene))(jax.random.key(seed))  # arrays of its own: the run writes over them
    with folder(out, FILES) as path:
        recorder = None
        if record:
            recorder = Recorder(
                path / RECORDING,
                recipe=recipe(scene, seed=seed, steps_per_frame=rhythm.steps_per_frame),
                model=scene.bodies.model if scene.bodies else None,
                box=(config.box.lower, config.box.upper),
                quantity=quantity,
                view=(camera.eye, camera.target),
            )
    for name in FILES:
        if recorder is None or name != RECORDING:
            (path / name).unlink(missing_ok=True)
    session = Session(scene, state, rhythm, path, recorder, seed, fps, quantity)
    session.wall["build"] = perf_counter() - began
    session.summarise(CUT_SHORT)
    return session


@dataclass(eq=False)
class Session:
    """One run under way: what it was told, what it has reached, where it goes."""

    scene: Scene
    state: State
    rhythm: Rhythm
    out: Path
    recorder: Recorder | None
    seed: int
    fps: float
    quantity: str

    def __post_init__(self) -> None:
        self.wall = dict.fromkeys(("build", "compile", "run", "log", "picture"), 0.0)
        self.ledger = Ledger(self.scene)
        self.view: View | None = None
        self.unwell: dict[str, float] = {}  # name of a health bit -> s when first seen
        self.summary: dict[str, Any] = {}

    def go(self, *, progress: bool = True) -> dict[str, Any]:
        """Run to the end, however it comes, and write what there is then; returns the summary."""
        ended = "crashed"
        try:
            ended = self._simulate(progress)
        except KeyboardInterrupt:
            ended = "interrupted"
            raise
        except Exception as error:
            ended = f"crashed: {type(error).__name__}: {error}"
            raise
        finally:
            if self.recorder is not None:
                self.recorder.close()
            self._finish(ended)
        return self.summary

    def _simulate(self, progress: bool) -> str:
        """Run to the end; returns how it ended."""
        scene, per_frame = self.scene, self.rhythm.steps_per_frame
        started = perf_counter()
        stepping = jax.jit(partial(advance, scene), donate_argnums=0)
        program = stepping.lower(self.state, scripted(scene, 0, per_frame)).compile()
        self.wall["compile"] = perf_counter() - started
        self._note(no_reactions(scene), keep=True)
        every = self.rhythm.frames_per_snapshot
        for k in tqdm(range(1, self.rhythm.frames + 1), unit="frame", disable=not progress):
            started = perf_counter()
            drives = scripted(scene, (k - 1) * per_frame, per_frame)
            # First the new state, then the wait for it: Ctrl-C may come meanwhile, and the old one is written over.
            self.state, reactions = program(self.state, drives)
            jax.block_until_ready(self.state)
            self.wall["run"] += perf_counter() - started
            lost = bool(int(self.state.health) & Health.NOT_FINITE)
            last = lost or k == self.rhythm.frames
            self._note(np.asarray(reactions), keep=last or (every is not None and k % every == 0))
            if lost:
                return "not finite"
        return "complete"

    def _note(self, reactions: np.ndarray, *, keep: bool) -> None:
        """Log a frame with the reactions since the last one; keep all its grains if asked."""
        started = perf_counter()
        state = self.state
        view = self.view = View.of(self.scene, state)
        scalars = self.ledger.note(state, view, reactions)
        for name in names(int(state.health)):
            self.unwell.setdefault(name, round(view.time, 9))
        if self.recorder is not None:
            step = int(state.steps)
            write_frame(self.recorder, view, step=step, reactions=reactions, quantity=self.quantity, scalars=scalars)
        if keep:
            self.ledger.snapshot(state, view)
        self.wall["log"] += perf_counter() - started

    def _finish(self, ended: str) -> None:
        """Write what the run has come to."""
        if self.view is not None:
            started = perf_counter()
            np.savez_compressed(self.out / "run.npz", **self.ledger.arrays())  # type: ignore[arg-type]
            self.wall["log"] += perf_counter() - started
            started = perf_counter()
            save_png(self.out / "run.png", self.view.picture(width=PICTURE[0], height=PICTURE[1]))
            self.wall["picture"] += perf_counter() - started
        self.summarise(ended)

    def summarise(self, ended: str) -> None:
        """Write summary.json."""
        scene = self.scene
        bits = sum((Health[name] for name in self.unwell), Health.WELL)
        self.summary = {
            "scene": scene.config.name,
            "ended": ended,
            "health": {
                "bits": int(bits),
                "names": names(bits),
                "sentences": sentences(bits),
                "first_seen_s": self.unwell,
            },
            "figures": self.ledger.figures() if self.ledger.snapshots else {},
            "numerics": self._numerics(),
            "wall_s": {**self.wall, "total": sum(self.wall.values())},
            "machine": {
                "backend": jax.default_backend(),
                "device": jax.devices()[0].device_kind,
                "processor": platform.machine(),
                "cores": os.cpu_count(),
            },
            "versions": versions(scene.kernels),
            "seed": self.seed,
            "config": scene.config.model_dump(mode="json"),
            "fidelity": scene.fidelity.model_dump(mode="json"),
        }
        partly = self.out / "summary.json.part"
        partly.write_text(json.dumps(_finite(self.summary), indent=2) + "\n", encoding="utf-8")
        partly.replace(self.out / "summary.json")  # whole or not at all, also when killed here

    def _numerics(self) -> dict[str, Any]:
        """What the numbers came to, and how fast they were worked off."""
        scene = self.scene
        grains = int(np.count_nonzero(np.asarray(self.state.grains.m)))
        steps = int(self.ledger.frames["step"][-1]) if self.ledger.frames else 0
        seconds = self.wall["run"]
        return {
            "dimension": scene.dimension,
            "cell_size_m": scene.grid.cell_size,
            "cells": list(scene.grid.cells),
            "nodes": scene.grid.nodes,
            "grains": grains,
            "slots": scene.slots,
            "rigid_dt_s": scene.rigid_dt,
            "mpm_dt_s": scene.mpm_dt,
            "mpm_per_rigid": scene.mpm_per_rigid,
            "fps": self.fps,
            "frames": len(self.ledger.reactions),
            "rigid_steps": steps,
            "grain_substeps_per_s": steps * scene.mpm_per_rigid * grains / seconds if seconds else None,
            "room_near_bodies": scene.sizes._asdict(),
            "kernels": native.spoken(scene.kernels),
        }


def recipe(scene: Scene, *, seed: int, steps_per_frame: int) -> dict[str, Any]:
    """Everything that a re-simulation of a scene needs."""
    return {
        "kind": "scene",
        "scene": scene.config.name,
        "seed": seed,
        "steps_per_frame": steps_per_frame,
        "cell_size_m": scene.grid.cell_size,
        "mpm_dt_s": scene.mpm_dt,
        "rigid_dt_s": scene.rigid_dt,
        "config": scene.config.model_dump(mode="json"),
        "fidelity": scene.fidelity.model_dump(mode="json"),
        "versions": versions(scene.kernels),
    }


def versions(kernels: str) -> dict[str, str]:
    """Versions of what decides the numbers, the grains' kernels among them."""
    packages = {"jax": "jax", "mujoco": "mujoco", "mjx": "mujoco-mjx", "numpy": "numpy", "rerun": "rerun-sdk"}
    return {
        "python": platform.python_version(),
        **{k: version(v) for k, v in packages.items()},
        "mpm_env": _own_version(),
        "kernels": native.spoken(kernels),
    }


def _own_version() -> str:
    try:
        return version("mpm-env")
    except PackageNotFoundError:  # a checkout on the path
        return "not installed"


@contextmanager
def folder(out: str | os.PathLike[str], files: Sequence[str]) -> Iterator[Path]:
    """The folder for results, made if need be, and gone again if what is done in the block is refused.

    Raises ValueError where these files cannot go into it. Those of an earlier run stay as they are.
    """
    path = Path(out)
    made = [p for p in (path, *path.parents) if not p.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"The folder {path} cannot be written: {error.strerror}.") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise ValueError(f"The folder {path} cannot be written: you lack the permission.")
    for name in files:
        if (path / name).is_dir():
            raise ValueError(f"{path / name} is a folder, and a file is to go there: remove it or use another folder.")
    try:
        yield path
    except (ValueError, TypeError):
        for p in made:
            p.rmdir()
        raise


def _finite(value: Any) -> Any:
    """The same with null for numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
