"""Reading recordings back, and opening them in the Rerun viewer. Use it through `mpm_env.log`."""

import hashlib
import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

FORMAT = 1  # "mpm_env log format 1": raised whenever an older reader would misread a file
APPLICATION = "mpm_env"
OWN = APPLICATION + ":"  # how Rerun marks the columns that only we know

RRD_MAGIC = b"RRF2"
RRD_HEADER_BYTES = 12
RRD_MESSAGE = struct.Struct("<QQ")  # kind, payload bytes
RRD_MESSAGE_KINDS = (1, 2, 3)  # store info, data, blueprint activation; 0 comes before the footer
RRD_FOOTER = struct.Struct("<8sI")  # magic, number of entries: the last bytes of a closed file
RRD_FOOTER_MAGIC = b"RRF2FOOT"

RERUN_COMMAND = (sys.executable, "-c", "import sys; from rerun_cli.__main__ import main; sys.exit(main())")
RERUN_EXIT_CODES = (0, 1)  # any other: Rerun did not refuse the file, it died of it
VIEWER_SETTLES_S = 3.0  # a viewer that cannot open a window has given up by then


def rerun() -> ModuleType:
    """Rerun, imported when first needed, with its analytics off."""
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    import rerun

    return rerun


@dataclass(frozen=True)
class Recording:
    """What a recording holds: f frames, k actions."""

    recipe: dict[str, Any]
    steps: np.ndarray  # (f,) int64
    times: np.ndarray  # (f,) float64 s
    grains: list[np.ndarray]  # f times (n_i, 3) float32 m
    poses: list[np.ndarray]  # f times (g, 12) float64, every geom's position in m and rotation by rows; g = 0 without
    action_steps: np.ndarray  # (k,) int64, the step each action was applied from
    actions: np.ndarray  # (k, a) float64
    scalars: dict[str, tuple[np.ndarray, np.ndarray]]  # name -> steps (j,) int64, values (j,) float64
    complete: bool  # False: the writer was killed or the file was cut; what is here is whole


def read(path: str | os.PathLike[str]) -> Recording:
    """Read a recording back: recipe, actions, grains and poses to the bit.

    A file whose writer was killed, or that was cut short, gives what it holds, with `complete` False.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: one sentence: not a Rerun file, not one of mpm_env, of a newer format, or damaged.
    """
    path = _check_is_rerun(path)
    end = _end_of_last_message(path)
    torn = end < path.stat().st_size
    if torn:
        with tempfile.TemporaryDirectory() as folder:
            rows = _read_rows(_copy_up_to(end, path, folder), path)
    else:
        rows = _read_rows(path, path)
    recipe = _checked_recipe(path, rows)
    rows.frames.sort(key=lambda frame: frame.step)
    rows.actions.sort(key=lambda action: action[0])
    size = rows.actions[0][1].size if rows.actions else 0
    return Recording(
        recipe=recipe,
        steps=np.array([frame.step for frame in rows.frames], np.int64),
        times=np.array([frame.time for frame in rows.frames], np.float64),
        grains=[frame.grains for frame in rows.frames],
        poses=[frame.poses for frame in rows.frames],
        action_steps=np.array([step for step, _ in rows.actions], np.int64),
        actions=np.array([action for _, action in rows.actions], np.float64).reshape(len(rows.actions), size),
        scalars={name: _series(pairs) for name, pairs in sorted(rows.scalars.items())},
        complete=not torn and rows.end.get("frames") == len(rows.frames),
    )


def open_viewer(path: str | os.PathLike[str]) -> None:
    """Open a recording in a Rerun window of its own; this returns while the window stays.

    The viewer listens on this machine only (127.0.0.1), on a free port. Of a file that was cut short it shows
    the whole part, as a copy in the system's folder for temporary files.

    Raises:
        FileNotFoundError, ValueError: no such file, or not a Rerun file.
        RuntimeError: the viewer cannot open a window here.
    """
    path = _check_is_rerun(path)
    end = _end_of_last_message(path)
    if end < path.stat().st_size:
        path = _copy_up_to(end, path, tempfile.mkdtemp(prefix="mpm_env_"))
    command = [*RERUN_COMMAND, str(path), "--bind", "127.0.0.1", "--port", "auto"]
    quiet = {"RERUN_ANALYTICS": "0", **os.environ}
    with tempfile.TemporaryFile() as complaints:
        viewer = subprocess.Popen(
            command, env=quiet, stdout=subprocess.DEVNULL, stderr=complaints, start_new_session=True
        )
        try:
            code = viewer.wait(VIEWER_SETTLES_S)
        except subprocess.TimeoutExpired:
            return
        complaints.seek(0)
        reason = complaints.read().decode(errors="replace").strip().rpartition(": ")[2].rstrip(".")
    if code:
        raise RuntimeError(
            f"the Rerun viewer cannot open a window here ({reason}): "
            f"open {path} with `rerun {path.name}` on a machine with a screen."
        )


class _Frame(NamedTuple):
    """A row of world/grains."""

    step: int
    time: float  # s
    grains: np.ndarray  # (n, 3) float32 m
    poses: np.ndarray  # (g, 12) float64


@dataclass
class _Rows:
    """What the chunks of a file held, in the file's order."""

    application: str = APPLICATION
    run: dict[str, Any] = field(default_factory=dict)
    end: dict[str, Any] = field(default_factory=dict)
    frames: list[_Frame] = field(default_factory=list)
    actions: list[tuple[int, np.ndarray]] = field(default_factory=list)
    scalars: dict[str, list[tuple[int, float]]] = field(default_factory=dict)

    def add(self, entity: str, batch: Any) -> None:
        """Take what concerns us from one chunk, a pyarrow record batch."""
        names = batch.schema.names
        if entity in ("/__properties/run", "/__properties/end"):
            kept = self.run if entity.endswith("run") else self.end
            ours = [name for name in names if name.startswith(OWN)]
            kept.update({name.removeprefix(OWN): batch.column(name)[0].as_py()[0] for name in ours})
        elif "step" not in names:
            return
        elif entity == "/world/grains" and OWN + "time_s" in names:
            posed = [OWN + "pose"] if OWN + "pose" in names else []  # a model without geoms has none
            for step, place, time, *pose in _cells(batch, "Points3D:positions", OWN + "time_s", *posed):
                poses = pose[0] if pose else np.zeros(0)
                self.frames.append(_Frame(step, float(time[0]), place.reshape(-1, 3), poses.reshape(-1, 12)))
        elif entity == "/control/action" and OWN + "action" in names:
            self.actions += _cells(batch, OWN + "action")
        elif entity.startswith("/plots/") and "Scalars:scalars" in names:
            pairs = [(step, float(value[0])) for step, value in _cells(batch, "Scalars:scalars")]
            self.scalars.setdefault(entity.removeprefix("/plots/"), []).extend(pairs)


def _cells(batch: Any, *columns: str) -> Iterator[Any]:
    """Row by row: the step, and the numbers of each named column, (m,); rows lacking one are skipped."""
    for row, step in enumerate(batch.column("step").to_pylist()):
        cells = [batch.column(name)[row] for name in columns]
        if all(cell.is_valid for cell in cells):
            yield step, *(_numbers(cell.values) for cell in cells)


def _numbers(values: Any) -> np.ndarray:
    """The numbers of a pyarrow array, points laid flat, as an array of our own."""
    flat = values.flatten() if hasattr(values, "flatten") else values
    return np.array(flat.to_numpy(zero_copy_only=False))


def _series(pairs: list[tuple[int, float]]) -> tuple[np.ndarray, np.ndarray]:
    pairs = sorted(pairs, key=lambda pair: pair[0])
    steps, values = zip(*pairs, strict=True)
    return np.array(steps, np.int64), np.array(values, np.float64)


def _check_is_rerun(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder: name the .rrd file in it.")
    if not path.exists():
        raise FileNotFoundError(f"there is no recording {path}: check the name.")
    with path.open("rb") as file:
        magic = file.read(len(RRD_MAGIC))
    if magic != RRD_MAGIC:
        raise ValueError(f"{path} is not a Rerun recording: it starts with {magic!r}, not {RRD_MAGIC!r}.")
    return path


def _end_of_last_message(path: Path) -> int:
    """Where the last whole message of the file ends; the whole length, if the file was closed."""
    length = path.stat().st_size
    position = min(RRD_HEADER_BYTES, length)
    with path.open("rb") as file:
        if length >= position + RRD_FOOTER.size:
            file.seek(-RRD_FOOTER.size, os.SEEK_END)
            if RRD_FOOTER.unpack(file.read())[0] == RRD_FOOTER_MAGIC:
                return length
        while position + RRD_MESSAGE.size <= length:
            file.seek(position)
            kind, payload = RRD_MESSAGE.unpack(file.read(RRD_MESSAGE.size))
            after = position + RRD_MESSAGE.size + payload
            if kind not in RRD_MESSAGE_KINDS or after > length:
                break
            position = after
    return position


def _copy_up_to(end: int, path: Path, folder: str) -> Path:
    """A copy of the file's first bytes: Rerun refuses a file with a torn last message altogether."""
    whole = Path(folder) / path.name
    shutil.copyfile(path, whole)
    os.truncate(whole, end)
    return whole


def _read_rows(source: Path, path: Path) -> _Rows:
    """Every row of `source`, which stands for `path`."""
    rerun()
    from rerun.chunk import RrdReader

    rows = _Rows()
    if source.stat().st_size <= RRD_HEADER_BYTES:
        return rows
    _check_harmless(source, path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Rerun warns of the missing footer; `complete` says it
        try:
            reader = RrdReader(source)
            for recording in reader.recordings()[:1]:
                rows.application = recording.application_id
                for chunk in reader.stream(store=recording):
                    rows.add(str(chunk.entity_path), chunk.to_record_batch())
        except (RuntimeError, ValueError, KeyError, IndexError, AttributeError, TypeError) as error:
            reason = str(error).partition("\n")[0].removeprefix(f"Failed to read RRD file at {source}: ")
            raise ValueError(f"{path} is damaged: {reason.rstrip('.')}.") from None
    return rows


def _check_harmless(source: Path, path: Path) -> None:
    """Let another process decode the file first: some damaged bytes abort the process that reads them."""
    trial = subprocess.run([*RERUN_COMMAND, "rrd", "stats", str(source)], capture_output=True)
    if trial.returncode not in RERUN_EXIT_CODES:
        raise ValueError(f"{path} is damaged: Rerun cannot decode it.")


def _checked_recipe(path: Path, rows: _Rows) -> dict[str, Any]:
    """The recipe, when the file is ours, not newer than we are, and the recipe is as it was written."""
    text, number = rows.run.get("recipe"), rows.run.get("format")
    if not isinstance(text, str) or not isinstance(number, int):
        if rows.application == APPLICATION:
            raise ValueError(f"{path} was cut before the end of its recipe: too little is left to read.")
        raise ValueError(f"{path} is a Rerun file without an mpm_env recipe: something else recorded it.")
    if number > FORMAT:
        raise ValueError(
            f"{path} has mpm_env log format {number}, and this version reads up to {FORMAT}: update mpm_env."
        )
    if hashlib.sha256(text.encode()).hexdigest() != rows.run.get("recipe_sha256"):
        raise ValueError(f"{path} is damaged: its recipe does not match the sha256 stored beside it.")
    recipe: dict[str, Any] = json.loads(text)
    return recipe
