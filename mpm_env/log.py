"""Recordings: what a run did, as one Rerun file that can be looked at, read back and simulated again.

A file holds the recipe of the run (everything a re-simulation needs), every action in float64, and per frame
the grains in float32, the bodies' poses in float64, the wrenches on the tools, and named scalars. It is flushed
frame by frame, so a killed run leaves a readable file. Only the modules called log import rerun, and only when used.
"""

import hashlib
import json
import os
import re
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import mujoco
import numpy as np

from mpm_env import log_look
from mpm_env.log_look import COLOUR_RANGES, RAMP_RGB
from mpm_env.log_read import APPLICATION, FORMAT, Recording, open_viewer, read, rerun

__all__ = ["COLOUR_RANGES", "FORMAT", "RAMP_RGB", "WRENCH_NAMES", "Recorder", "Recording", "open_viewer", "read"]

SUFFIX = ".rrd"
WRENCH_NAMES = ("force_x_N", "force_y_N", "force_z_N", "torque_x_Nm", "torque_y_Nm", "torque_z_Nm")
KEY = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")  # parts that Rerun keeps unescaped in an entity path


class Recorder:
    """Writes one run into a Rerun file, frame by frame; use it in a `with` block.

    Everything is checked before the file is opened (an existing file is replaced). `close` marks the file as
    complete; without it, all frames whose `frame` call returned are still readable.

    Args:
        path: the file, ending in `.rrd`, in a folder that exists.
        recipe: a dict for JSON with everything a re-simulation needs; `seed`, `scene`, `kind`, `versions` and
            other short entries are shown beside the picture.
        model: the rigid bodies; their visible geoms are drawn. None: grains only.
        box: lower and upper corner of the scene, (3,) m each.
        quantity: what `values` are and so what colours the grains: a key of `COLOUR_RANGES`, or any name when
            `value_range` is given.
        value_range: the values at the dark and the light end of the colours.
        view: eye and target of the 3-D view, (3,) m each. None: from the front right, above.
        metres_per_newton: length of the force arrows. None: from the weight of the bodies and the box.

    Raises:
        ValueError, TypeError: one sentence on what cannot be recorded, or where it cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        recipe: Mapping[str, Any],
        model: mujoco.MjModel | None,
        box: tuple[Sequence[float], Sequence[float]],
        quantity: str = "speed",
        value_range: tuple[float, float] | None = None,
        view: tuple[Sequence[float], Sequence[float]] | None = None,
        metres_per_newton: float | None = None,
    ) -> None:
        self._path = Path(path)
        self._model = model
        lower, upper = _box_corners(box)
        diagonal = float(np.linalg.norm(upper - lower))
        self._range = log_look.colour_range(quantity, value_range, lower[2], upper[2])
        self._view = log_look.eye_and_target(view, lower, upper)
        self._scale = log_look.arrow_scale(model, diagonal) if metres_per_newton is None else metres_per_newton
        if not self._scale > 0:
            raise ValueError(f"metres_per_newton = {metres_per_newton} draws no arrow: give a length > 0 m/N.")
        self._arrow_radius = log_look.ARROW_RADIUS_SHARE * diagonal
        self._plotted: set[str] = set()
        self._last_step: int | None = None
        self._last_action_step: int | None = None
        self._action_size: int | None = None
        self._frames = 0
        self._open = True

        text = _recipe_text(recipe)
        self._rec = rerun().RecordingStream(APPLICATION, recording_id=uuid.uuid4())
        if not self._rec.is_enabled():
            raise ValueError("RERUN=off is set in the environment, so nothing would be recorded: unset it.")
        _check_writable(self._path)
        self._rec.set_log_time_enabled(False)
        self._rec.set_log_tick_enabled(False)
        with _strict(self._path):
            self._rec.save(self._path)
            digest = hashlib.sha256(text.encode()).hexdigest()
            self._rec.send_property("run", _own(recipe=text, recipe_sha256=digest, format=FORMAT))
            self._rec.send_recording_name(str(recipe.get("scene", self._path.stem)))
            panel = log_look.panel(recipe, quantity, self._range, self._scale)
            self._rec.log("facts", panel, static=True)
            self._moving_geoms = log_look.draw_scene(self._rec, model, lower, upper)  # geom -> entity path
            self._rec.flush()

    def frame(
        self,
        *,
        step: int,
        time: float,
        grains: np.ndarray,
        values: np.ndarray,
        grain_radius: float,
        geom_pos: np.ndarray | None = None,
        geom_mat: np.ndarray | None = None,
        wrenches: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]] | None = None,
        scalars: Mapping[str, float] | None = None,
    ) -> None:
        """Record the state at one step, and flush it to the file.

        Args:
            step: counts up from frame to frame; gaps are fine.
            time: simulated time, s.
            grains: (n, 3) float32 m, kept to the bit; n may change; NaN is kept, and its colour is magenta.
            values: (n,) the quantity that colours the grains.
            grain_radius: drawn radius, m.
            geom_pos, geom_mat: (g, 3) m and (g, 3, 3) of all geoms of the model, as `MjData.geom_xpos`; kept to the
                bit in float64. Needed where the model has geoms.
            wrenches: name -> point (3,) m, force (3,) N, torque (3,) N m about the point, in the world frame.
            scalars: "group/name_unit" -> value, such as "reward/deliver" or "budget/mass_kg"; NaN is kept.

        Raises:
            ValueError, TypeError: a wrong shape or dtype, a step that does not grow, a closed recorder.
            OSError: the file cannot be written any further.
        """
        self._check_open()
        _check_grows("frame", step, self._last_step)
        if not np.isfinite(time):
            raise ValueError(f"time = {time} s of step {step} is not finite: record a frame at a finite time.")
        grains, values = np.asarray(grains), np.asarray(values)
        if grains.dtype != np.float32:
            raise TypeError(f"grains are {grains.dtype} and recorded as float32: pass grains.astype(np.float32).")
        if grains.ndim != 2 or grains.shape[1] != 3 or values.shape != grains.shape[:1]:
            raise ValueError(f"grains are {grains.shape} and values {values.shape}: give (n, 3) and (n,).")
        wrenches = wrenches or {}
        plots = _wrench_scalars(wrenches) | {k: _scalar(k, v) for k, v in (scalars or {}).items()}
        poses = self._poses(geom_pos, geom_mat)
        exact = {"time_s": float(time)} | ({} if poses is None else {"pose": poses.ravel()})

        rr = rerun()
        with _strict(self._path):
            if not self._frames:
                self._rec.send_blueprint(log_look.blueprint(list(plots), self._view))
            self._rec.set_time("step", sequence=int(step))
            self._rec.set_time("sim_time", duration=float(time))
            # The timeline counts nanoseconds and a drawn pose is f32, so the exact ones travel with the grains.
            points = rr.Points3D(grains, colors=log_look.colours(values, self._range), radii=[grain_radius])
            self._rec.log("world/grains", points, _own(**exact))
            for geom, path in self._moving_geoms.items():
                assert poses is not None
                position, rotation = poses[geom, :3], poses[geom, 3:].reshape(3, 3)
                self._rec.log(path, rr.Transform3D(translation=position, mat3x3=rotation))
            for name, (point, force, _) in wrenches.items():
                arrow = np.asarray(force) * self._scale
                look = {"radii": [self._arrow_radius], "colors": [log_look.ARROW_RGB]}
                self._rec.log(f"world/wrench/{name}", rr.Arrows3D(origins=[point], vectors=[arrow], **look))
            for key, value in plots.items():
                if key not in self._plotted:
                    self._rec.log(f"plots/{key}", log_look.line(key, self._plotted), static=True)
                    self._plotted.add(key)
                self._rec.log(f"plots/{key}", rr.Scalars(value))
            self._rec.flush()
        self._last_step = int(step)
        self._frames += 1

    def action(self, step: int, action: np.ndarray) -> None:
        """Record the action applied from `step` on, (a,) float64 to the bit; the next frame flushes it."""
        self._check_open()
        _check_grows("action", step, self._last_action_step)
        given = np.asarray(action)
        exact = given.astype(np.float64)
        size = exact.size if self._action_size is None else self._action_size
        if given.dtype.kind != "f" or exact.shape != (size,) or not size:
            raise ValueError(f"action of step {step} is {given.dtype} {given.shape}: give floats ({size},).")
        self._action_size, self._last_action_step = size, int(step)
        with _strict(self._path):
            self._rec.set_time("step", sequence=int(step))
            self._rec.disable_timeline("sim_time")  # it still shows the frame before
            self._rec.log("control/action", _own(action=exact))

    def close(self) -> None:
        """Mark the file as complete and let go of it; a second call does nothing."""
        if not self._open:
            return
        self._open = False
        with _strict(self._path):
            self._rec.send_property("end", _own(frames=self._frames))
            self._rec.flush()
            self._rec.disconnect()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _check_open(self) -> None:
        if not self._open:
            raise ValueError(f"the recorder of {self._path} is closed: start another one to record more.")

    def _poses(self, geom_pos: Any, geom_mat: Any) -> np.ndarray | None:
        """Position and rotation by rows of every geom, (g, 12) float64; None without geoms."""
        if self._model is None or not self._model.ngeom:
            return None
        count = self._model.ngeom
        position = np.asarray(geom_pos if geom_pos is not None else (), np.float64)
        rotation = np.asarray(geom_mat if geom_mat is not None else (), np.float64)
        if position.shape != (count, 3) or rotation.shape not in ((count, 3, 3), (count, 9)):
            raise ValueError(
                f"geom_pos is {position.shape} and geom_mat {rotation.shape}: the model has geoms, "
                f"so give ({count}, 3) and ({count}, 3, 3)."
            )
        return np.concatenate([position, rotation.reshape(count, 9)], axis=1)


@contextmanager
def _strict(path: Path) -> Iterator[None]:
    """Rerun raises where it would warn and drop data, in this thread only; a failing file is an OSError."""
    from rerun.error_utils import catch_and_log_exceptions

    with catch_and_log_exceptions(strict=True):
        try:
            yield
        except RuntimeError as error:
            raise OSError(f"recording {str(path)!r} cannot be written ({error}): is the disk full?") from None


def _own(**values: Any) -> Any:
    """Values of our own kind: Rerun settles a type per name and process, so the names must be ours alone."""
    return rerun().DynamicArchetype(APPLICATION, components=values)


def _check_writable(path: Path) -> None:
    if path.suffix != SUFFIX:
        raise ValueError(f"recording {str(path)!r} does not end in {SUFFIX}, as Rerun asks: rename it.")
    if not path.parent.is_dir():
        raise ValueError(f"recording {str(path)!r} has no folder to go into: create {str(path.parent)!r} first.")
    try:
        path.open("ab").close()
    except OSError as error:
        raise ValueError(f"recording {str(path)!r} cannot be written: {error.strerror}.") from None


def _recipe_text(recipe: Mapping[str, Any]) -> str:
    try:
        return json.dumps(dict(recipe))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"the recipe cannot be stored as JSON ({error}): use only dicts, lists, text, numbers and None."
        ) from None


def _box_corners(box: tuple[Sequence[float], Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = (np.asarray(corner, float) for corner in box)
    if lower.shape != (3,) or upper.shape != (3,) or not np.all(lower <= upper) or np.all(lower == upper):
        raise ValueError(f"box {lower.tolist()} to {upper.tolist()} is empty: give (3,) corners, lower <= upper.")
    return lower, upper


def _check_grows(what: str, step: int, last: int | None) -> None:
    if last is not None and step <= last:
        raise ValueError(f"{what} of step {step} follows step {last}: steps grow, so use a file per episode.")


def _scalar(key: str, value: float) -> float:
    if not KEY.fullmatch(key):
        raise ValueError(f"name {key!r} is not words joined by '/': use letters, digits, '_', '.' and '-'.")
    if np.ndim(value):
        raise ValueError(f"scalar {key!r} has shape {np.shape(value)}: give one number per name.")
    return float(value)


def _wrench_scalars(wrenches: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> dict[str, float]:
    plots: dict[str, float] = {}
    for name, wrench in wrenches.items():
        shapes = [np.shape(vector) for vector in wrench]
        if shapes != [(3,)] * 3:
            raise ValueError(f"wrench {name!r} has shapes {shapes}: give point, force and torque, (3,) each.")
        numbers = zip(WRENCH_NAMES, np.concatenate(wrench[1:]), strict=True)
        plots |= {f"wrench/{name}/{part}": _scalar(f"wrench/{name}/{part}", number) for part, number in numbers}
    return plots
