"""Recordings: what a run did, as one Rerun file that can be looked at, read back and simulated again.

A file holds the recipe of the run (everything a re-simulation needs), every action in float64, and per frame
the grains in float32, the bodies' poses, the wrenches on the tools, and named scalars. It is flushed frame by
frame, so a killed run leaves a readable file. This is the only module that imports rerun, and only when used.
"""

import hashlib
import json
import os
import re
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import mujoco
import numpy as np

from mpm_env.log_read import APPLICATION, FORMAT, Recording, open_viewer, read, rerun

__all__ = ["FORMAT", "Recorder", "Recording", "open_viewer", "read"]

SUFFIX = ".rrd"
WRENCH_NAMES = ("force_x_N", "force_y_N", "force_z_N", "torque_x_Nm", "torque_y_Nm", "torque_z_Nm")

# What colours the grains: the values from the dark to the light end. None: from the scene, or categories.
COLOUR_RANGES: dict[str, tuple[float, float] | None] = {"speed": (0.0, 0.5), "height": None, "material": None}
QUANTITY_UNITS = {"speed": "m/s", "height": "m"}
NOT_A_NUMBER_RGB = (255, 0, 255)  # loud on purpose: no ramp colour comes near it
MATERIAL_RGB = np.array([(214, 178, 112), (150, 200, 235), (120, 170, 95), (200, 105, 90), (165, 130, 200)], np.uint8)
ARROW_RGB = (235, 70, 50)
LINE_RGB = [(235, 90, 80), (95, 200, 110), (90, 150, 245), (240, 190, 70), (190, 130, 235), (80, 205, 205)]
BOX_RGB = (110, 115, 125)
FLAT_SHARE = 0.1  # a box thinner than this in y, as in plane strain, is looked at from the front
SLAB_SHARE = 0.005  # thickness of a drawn plane, as a share of the box diagonal
ARROW_RADIUS_SHARE = 0.006
ARROW_SHARE = 0.4  # an arrow of the moving bodies' weight is this share of the box diagonal
MUJOCO_SHOWN_GROUPS = 3  # MuJoCo's own viewer shows geom groups 0, 1, 2 and hides the others
MUJOCO_DEFAULT_RGBA = 0.5, 0.5, 0.5, 1.0

KEY = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")  # parts that Rerun keeps unescaped in an entity path
SHORT_TEXT = 80  # longer texts of a recipe (MJCF) are stored, but not spread over the panel of facts


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
        self._lower, self._upper = _box_corners(box)
        self._quantity = quantity
        self._range = _colour_range(quantity, value_range, self._lower[2], self._upper[2])
        self._view = _eye_and_target(view, self._lower, self._upper)
        if metres_per_newton is None:
            metres_per_newton = _arrow_scale(model, self._lower, self._upper)
        if not metres_per_newton > 0:
            raise ValueError(f"metres_per_newton = {metres_per_newton} draws no arrow: give a length > 0 m/N.")
        self._scale = metres_per_newton
        self._arrow_radius = ARROW_RADIUS_SHARE * float(np.linalg.norm(self._upper - self._lower))
        self._lines: dict[str, int] = {}  # plot -> lines in it so far
        self._plotted: set[str] = set()
        self._last_step: int | None = None
        self._last_action_step: int | None = None
        self._action_size: int | None = None
        self._grain_radius: float | None = None
        self._frames = 0
        self._open = True

        text = _recipe_text(recipe)
        rr = rerun()
        self._rec = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
        if not self._rec.is_enabled():
            raise ValueError("RERUN=off is set in the environment, so nothing would be recorded: unset it.")
        _check_writable(self._path)
        self._rec.set_log_time_enabled(False)
        self._rec.set_log_tick_enabled(False)
        with _strict(self._path):
            self._rec.save(self._path)
            self._begin(recipe, text)

    def _begin(self, recipe: Mapping[str, Any], text: str) -> None:
        """What holds for the whole run: the recipe, the facts, the box and the shapes of the bodies."""
        rr = rerun()
        facts = _facts(recipe)
        digest = hashlib.sha256(text.encode()).hexdigest()
        self._rec.send_property("run", _own(recipe=text, recipe_sha256=digest, format=FORMAT))
        if facts:
            self._rec.send_property("facts", rr.DynamicArchetype("run", components=facts))
        self._rec.send_recording_name(str(recipe.get("scene", self._path.stem)))
        panel = rr.TextDocument(self._markdown(facts, digest), media_type="text/markdown")
        self._rec.log("facts", panel, static=True)
        self._rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        edges = rr.Boxes3D(
            mins=[self._lower],
            sizes=[self._upper - self._lower],
            colors=[BOX_RGB],
            fill_mode=rr.components.FillMode.MajorWireframe,
        )
        self._rec.log("world/box", edges, static=True)
        self._moving_geoms: dict[int, str] = {}
        if self._model is not None:
            for geom in _shown_geoms(self._model):
                self._log_shape(geom)
        self._rec.flush()

    def _log_shape(self, geom: int) -> None:
        """The shape of one geom, and its place if that never changes."""
        rr, model = rerun(), self._model
        assert model is not None
        body = model.geom_bodyid[geom]
        names = [model.body(body).name or f"body {body}", model.geom(geom).name or f"geom {geom}"]
        path = rr.new_entity_path(["world", "bodies", *names])
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        position, rotation = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
        corners = np.stack(np.meshgrid(*zip(self._lower, self._upper, strict=True)), axis=-1).reshape(-1, 3)
        self._rec.log(path, _shape(model, geom, (corners - position) @ rotation), static=True)
        if _moves(model, body):
            self._moving_geoms[geom] = path
        else:
            self._rec.log(path, rr.Transform3D(translation=position, mat3x3=rotation), static=True)

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
            geom_pos, geom_mat: (g, 3) m and (g, 3, 3) of all geoms of the model, as `MjData.geom_xpos`.
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

        rr = rerun()
        with _strict(self._path):
            if not self._frames:
                self._rec.send_blueprint(_blueprint(list(plots), self._view))
            self._rec.set_time("step", sequence=int(step))
            self._rec.set_time("sim_time", duration=float(time))
            if grain_radius != self._grain_radius:
                self._rec.log("world/grains", rr.Points3D.from_fields(radii=[grain_radius]))
                self._grain_radius = grain_radius
            # The timeline counts nanoseconds, so the exact time travels with the grains.
            points = rr.Points3D(grains, colors=_colours(values, self._range))
            self._rec.log("world/grains", points, _own(time_s=float(time)))
            for path, position, rotation in poses:
                self._rec.log(path, rr.Transform3D(translation=position, mat3x3=rotation))
            for name, (point, force, _) in wrenches.items():
                arrow = np.asarray(force) * self._scale
                drawn = rr.Arrows3D(origins=[point], vectors=[arrow], radii=[self._arrow_radius], colors=[ARROW_RGB])
                self._rec.log(f"world/wrench/{name}", drawn)
            for key, value in plots.items():
                if key not in self._plotted:
                    self._begin_line(key)
                self._rec.log(f"plots/{key}", rr.Scalars(value))
            self._rec.flush()
        self._last_step = int(step)
        self._frames += 1

    def _begin_line(self, key: str) -> None:
        """Name and colour of a plot's line; Rerun's own colours may come out alike."""
        plot = _plot_of(key)
        order = self._lines[plot] = self._lines.get(plot, -1) + 1
        line = rerun().SeriesLines(colors=[LINE_RGB[order % len(LINE_RGB)]], names=[key.rpartition("/")[2]])
        self._rec.log(f"plots/{key}", line, static=True)
        self._plotted.add(key)

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

    def _poses(self, geom_pos: Any, geom_mat: Any) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """Entity path, position and rotation of every moving geom."""
        if not self._moving_geoms:
            return []
        assert self._model is not None
        count = self._model.ngeom
        position = np.asarray(geom_pos if geom_pos is not None else ())
        rotation = np.asarray(geom_mat if geom_mat is not None else ())
        if position.shape != (count, 3) or rotation.shape not in ((count, 3, 3), (count, 9)):
            raise ValueError(
                f"geom_pos is {position.shape} and geom_mat {rotation.shape}: the model has moving bodies, "
                f"so give ({count}, 3) and ({count}, 3, 3)."
            )
        rotation = rotation.reshape(count, 3, 3)
        return [(path, position[geom], rotation[geom]) for geom, path in self._moving_geoms.items()]

    def _markdown(self, facts: Mapping[str, str], digest: str) -> str:
        """The panel of facts."""
        unit = QUANTITY_UNITS.get(self._quantity, "")
        colour = self._quantity
        if self._range is not None:
            colour += f", {self._range[0]:.3g} (dark) to {self._range[1]:.3g} {unit} (light)"
        rows = {**facts, "grain colour": colour, "force arrow": f"1 m = {1.0 / self._scale:.3g} N"}
        rows |= {"recipe sha256": f"`{digest[:16]}`", "log format": f"mpm_env log format {FORMAT}"}
        lines = [f"| {name} | {str(value).replace('|', ' ')} |" for name, value in rows.items()]
        return "\n".join([lines[0], "|---|---|", *lines[1:]])


def _check_writable(path: Path) -> None:
    if path.suffix != SUFFIX:
        raise ValueError(f"recording {str(path)!r} does not end in {SUFFIX}, as Rerun asks: rename it.")
    if not path.parent.is_dir():
        raise ValueError(f"recording {str(path)!r} has no folder to go into: create {str(path.parent)!r} first.")
    try:
        path.open("ab").close()
    except OSError as error:
        raise ValueError(f"recording {str(path)!r} cannot be written: {error.strerror}.") from None


@contextmanager
def _strict(path: Path) -> Iterator[None]:
    """Rerun raises where it would warn and drop data, in this thread only; a failing file is an OSError."""
    from rerun.error_utils import catch_and_log_exceptions

    with catch_and_log_exceptions(strict=True):
        try:
            yield
        except RuntimeError as error:
            raise OSError(f"recording {str(path)!r} cannot be written ({error}): is the disk full?") from None


def _recipe_text(recipe: Mapping[str, Any]) -> str:
    try:
        return json.dumps(dict(recipe))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"the recipe cannot be stored as JSON ({error}): use only dicts, lists, text, numbers and None."
        ) from None


def _own(**values: Any) -> Any:
    """Values of our own kind: Rerun settles a type per name and process, so the names must be ours alone."""
    return rerun().DynamicArchetype(APPLICATION, components=values)


def _facts(recipe: Mapping[str, Any]) -> dict[str, str]:
    """The entries of a recipe short enough to show; all text, as their types differ from run to run."""
    facts: dict[str, str] = {}
    for name, value in recipe.items():
        if name == "versions" and isinstance(value, Mapping):
            facts[name] = ", ".join(f"{package} {version}" for package, version in value.items())
        elif isinstance(value, str | bool | int | float) and len(str(value)) <= SHORT_TEXT:
            facts[re.sub(r"\W", "_", name)] = str(value)
    return facts


def _box_corners(box: tuple[Sequence[float], Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = (np.asarray(corner, float) for corner in box)
    if lower.shape != (3,) or upper.shape != (3,) or not np.all(lower <= upper) or np.all(lower == upper):
        raise ValueError(f"box {lower.tolist()} to {upper.tolist()} is empty: give (3,) corners, lower <= upper.")
    return lower, upper


def _eye_and_target(
    view: tuple[Sequence[float], Sequence[float]] | None, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    if view is not None:
        return np.asarray(view[0], float), np.asarray(view[1], float)
    target, size = (lower + upper) / 2, upper - lower
    flat = size[1] < FLAT_SHARE * float(np.linalg.norm(size))
    aside = np.array([0.0, -0.9, 0.1] if flat else [0.4, -0.8, 0.5])
    return target + float(np.linalg.norm(size)) * aside, target


def _arrow_scale(model: mujoco.MjModel | None, lower: np.ndarray, upper: np.ndarray) -> float:
    """Metres of arrow per newton, to one digit."""
    weight = 0.0 if model is None else float(model.body_mass.sum() * np.linalg.norm(model.opt.gravity))
    newtons_per_metre = max(weight, 1.0) / (ARROW_SHARE * float(np.linalg.norm(upper - lower)))
    return 1.0 / float(f"{newtons_per_metre:.0e}")


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
        for part, number in zip(WRENCH_NAMES, np.concatenate(wrench[1:]), strict=True):
            key = f"wrench/{name}/{part}"
            plots[key] = _scalar(key, number)
    return plots


# ---- colours


def _oklab_to_srgb(lab: np.ndarray) -> np.ndarray:
    """(k, 3) Oklab to (k, 3) uint8 sRGB (Ottosson, "A perceptual color space for image processing", 2020)."""
    to_cones = np.array(
        [[1, 0.3963377774, 0.2158037573], [1, -0.1055613458, -0.0638541728], [1, -0.0894841775, -1.291485548]]
    )
    to_rgb = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.707614701],
        ]
    )
    linear = np.clip((lab @ to_cones.T) ** 3 @ to_rgb.T, 0.0, 1.0)
    gamma = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * gamma).astype(np.uint8)


def _ramp() -> np.ndarray:
    """(256, 3) uint8: even steps of lightness, so that equal differences look equal; blue, red, yellow."""
    t = np.linspace(0.0, 1.0, 256)
    hue = np.radians(265 + 200 * t)
    chroma = 0.06 + 0.10 * np.sin(np.pi * t) ** 0.8
    return _oklab_to_srgb(np.stack([0.48 + 0.46 * t, chroma * np.cos(hue), chroma * np.sin(hue)], axis=1))


RAMP_RGB = _ramp()


def _colour_range(
    quantity: str, given: tuple[float, float] | None, floor: float, ceiling: float
) -> tuple[float, float] | None:
    """The values at the dark and the light end; None for a category."""
    if given is not None:
        if not given[0] < given[1]:
            raise ValueError(f"value_range = {given} is empty: give (low, high) with low < high.")
        return float(given[0]), float(given[1])
    if quantity not in COLOUR_RANGES:
        raise ValueError(f"quantity {quantity!r} is none of {[*COLOUR_RANGES]}: give a value_range with it.")
    return (float(floor), float(ceiling)) if quantity == "height" else COLOUR_RANGES[quantity]


def _colours(values: np.ndarray, span: tuple[float, float] | None) -> np.ndarray:
    """(n, 3) uint8."""
    finite = np.isfinite(values)
    known = np.where(finite, values, 0)
    if span is None:
        colours = MATERIAL_RGB[known.astype(int) % len(MATERIAL_RGB)]
    else:
        share = np.clip((known - span[0]) / (span[1] - span[0]), 0.0, 1.0)
        colours = RAMP_RGB[(255 * share).astype(int)]
    return np.where(finite[:, None], colours, np.array(NOT_A_NUMBER_RGB, np.uint8))


# ---- shapes


def _shown_geoms(model: mujoco.MjModel) -> list[int]:
    shown = model.geom_group < MUJOCO_SHOWN_GROUPS
    return [geom for geom in range(model.ngeom) if shown[geom] and _rgba(model, geom)[3] > 0]


def _moves(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body is not fixed to the world; a mocap body has no joint and moves all the same."""
    return bool(model.body_weldid[body] or model.body_mocapid[model.body_rootid[body]] >= 0)


def _rgba(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """(4,) uint8; as in MuJoCo, a material counts unless the geom has a colour of its own."""
    rgba, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material >= 0 and np.allclose(rgba, MUJOCO_DEFAULT_RGBA):
        rgba = model.mat_rgba[material]
    return np.round(255 * rgba).astype(np.uint8)


def _shape(model: mujoco.MjModel, geom: int, box: np.ndarray) -> Any:
    """The Rerun shape of a geom, in the geom's frame; `box` (8, 3) are the corners of the scene there."""
    rr, kind, size = rerun(), mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    rgba = _rgba(model, geom)
    if kind in MESH_OF:
        vertices, triangles = MESH_OF[kind](model, model.geom_dataid[geom])
        return rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, albedo_factor=rgba)
    fill = rr.components.FillMode.Solid if rgba[3] == 255 else rr.components.FillMode.TransparentFillMajorWireframe
    look = {"colors": [rgba], "fill_mode": fill}
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        # An endless plane is drawn as a thin slab below it, as far as the scene reaches.
        half = np.where(size[:2] > 0, size[:2], np.inf)
        lower, upper = np.maximum(box.min(axis=0)[:2], -half), np.minimum(box.max(axis=0)[:2], half)
        thickness = SLAB_SHARE * float(np.linalg.norm(np.ptp(box, axis=0)))
        return rr.Boxes3D(mins=[[*lower, -thickness]], sizes=[[*(upper - lower), thickness]], **look)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        # Rerun's capsule starts at one end, MuJoCo's is centred.
        ends = [[0.0, 0.0, -size[1]]]
        return rr.Capsules3D(lengths=[2 * size[1]], radii=[size[0]], translations=ends, **look)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], **look)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return rr.Boxes3D(half_sizes=[size], **look)
    return rr.Ellipsoids3D(half_sizes=[size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[[0, 0, 0]]], **look)


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) m and triangles (t, 3)."""
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
    return vertices, model.mesh_face[face : face + model.mesh_facenum[mesh]]


def _height_field(model: mujoco.MjModel, hfield: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) m and triangles (t, 3) of its upper side."""
    rows, columns, start = model.hfield_nrow[hfield], model.hfield_ncol[hfield], model.hfield_adr[hfield]
    half_x, half_y, top, _ = model.hfield_size[hfield]
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    z = top * model.hfield_data[start : start + rows * columns]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, behind, across = corner + 1, corner + columns, corner + columns + 1
    triangles = np.concatenate([np.stack([corner, right, across], 1), np.stack([corner, across, behind], 1)])
    return np.stack([x.ravel(), y.ravel(), z], axis=1), triangles


MESH_OF: dict[mujoco.mjtGeom, Callable[[mujoco.MjModel, int], tuple[np.ndarray, np.ndarray]]] = {
    mujoco.mjtGeom.mjGEOM_MESH: _mesh,
    mujoco.mjtGeom.mjGEOM_SDF: _mesh,
    mujoco.mjtGeom.mjGEOM_HFIELD: _height_field,
}


# ---- arrangement


def _blueprint(keys: list[str], view: tuple[np.ndarray, np.ndarray]) -> Any:
    """The scene large, facts and the plots to watch beside it, the balances in a row below."""
    rerun()
    import rerun.blueprint as rrb

    eye, target = view
    scene = rrb.Spatial3DView(
        origin="world",
        name="Scene",
        background=[24, 27, 33],
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0.0, 0.0, 1.0)),
    )
    beside: list[Any] = [rrb.TextDocumentView(origin="facts", name="Run")]
    wrench: list[Any] = []
    below: list[Any] = []
    for name in dict.fromkeys(_plot_of(key) for key in keys):
        contents = [f"plots/{key}" for key in keys if _plot_of(key) == name]
        plot = rrb.TimeSeriesView(origin="plots", contents=contents, name=name, plot_legend=rrb.Corner2D.LeftTop)
        (wrench if name in ("Force", "Torque") else beside if name == "Reward" else below).append(plot)
    if wrench:
        beside.append(rrb.Tabs(*wrench))
    column = rrb.Vertical(*beside, row_shares=[1.4, 1, 1][: len(beside)])
    rows: list[Any] = [rrb.Horizontal(scene, column, column_shares=[5, 3])]
    if below:
        rows.append(rrb.Horizontal(*below))
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=[3, 1][: len(rows)]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="sim_time"),
    )


def _plot_of(key: str) -> str:
    """The plot a scalar belongs to: one per group; budgets apart by what balances, forces from torques."""
    group, _, rest = key.partition("/")
    if group == "budget":
        return re.split(r"[_/]", rest)[0].capitalize() + " balance"
    if group == "wrench":
        return "Force" if "/force_" in key else "Torque"
    return group.capitalize()
