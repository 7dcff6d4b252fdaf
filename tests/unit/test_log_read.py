"""What reading promises: a killed or cut file gives what it holds, and what is no recording is one sentence."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpm_env import log, log_read

REPOSITORY = Path(__file__).resolve().parents[2]


def _record(path: Path, count: int = 7) -> list[np.ndarray]:
    """A run of three frames and actions."""
    grains = [np.random.default_rng(i).normal(size=(count, 3)).astype(np.float32) for i in range(3)]
    with log.Recorder(path, recipe={"seed": 3}, model=None, box=((0, 0, 0), (1, 1, 1))) as recorder:
        for i, x in enumerate(grains):
            recorder.action(i, np.array([0.1, i / 3]))
            reward = {"reward/deliver": i / 7}
            recorder.frame(step=i, time=0.1 * i, grains=x, values=x[:, 0], grain_radius=0.01, scalars=reward)
    return grains


KILLED = """
import os, signal, sys
import numpy as np
from mpm_env import log
recorder = log.Recorder(sys.argv[1], recipe={"seed": 3}, model=None, box=((0, 0, 0), (1, 1, 1)))
for step in range(4):
    recorder.action(step, np.full(2, step / 3))
    x = np.full((2000, 3), step / 7, np.float32)
    recorder.frame(step=step, time=step * 0.1, grains=x, values=x[:, 0], grain_radius=0.01)
os.kill(os.getpid(), signal.SIGKILL) if sys.argv[2] == "kill" else os._exit(3)
"""


@pytest.mark.parametrize(("how", "code"), [("kill", -signal.SIGKILL), ("exit", 3)])
def test_a_killed_writer_leaves_every_flushed_frame(tmp_path: Path, how: str, code: int) -> None:
    path = tmp_path / "killed.rrd"
    assert subprocess.run([sys.executable, "-c", KILLED, str(path), how], cwd=REPOSITORY, timeout=60).returncode == code
    back = log.read(path)
    assert not back.complete
    assert back.recipe == {"seed": 3}
    assert [x[0, 0] for x in back.grains] == [np.float32(step / 7) for step in range(4)]
    assert back.actions[:, 0].tolist() == [step / 3 for step in range(4)]


def test_a_cut_file_gives_what_is_whole_or_says_that_nothing_is(tmp_path: Path) -> None:
    grains = _record(tmp_path / "run.rrd", 300)
    whole = (tmp_path / "run.rrd").read_bytes()
    cut = tmp_path / "cut.rrd"
    seen = set()
    for length in np.linspace(4, len(whole) - 1, 16).astype(int):
        cut.write_bytes(whole[:length])
        try:
            back = log.read(cut)
        except ValueError as error:
            assert str(error) == f"{cut} was cut before the end of its recipe: too little is left to read."
            seen.add("nothing")
            continue
        assert not back.complete
        assert [x.tobytes() for x in back.grains] == [x.tobytes() for x in grains[: len(back.grains)]]
        seen.add(len(back.grains))
    assert {"nothing", 0, 3} <= seen


def test_a_missing_file_is_said_to_be_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no recording .*gone\.rrd"):
        log.read(tmp_path / "gone.rrd")
    with pytest.raises(ValueError, match="is a folder"):
        log.read(tmp_path)


@pytest.mark.parametrize("content", [b"", b"RR", b"a text", bytes(range(256)) * 40])
def test_foreign_bytes_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "foreign.rrd").write_bytes(content)
    for function in (log.read, log.open_viewer):
        with pytest.raises(ValueError, match="is not a Rerun recording"):
            function(tmp_path / "foreign.rrd")


def _foreign(path: Path, **properties: Any) -> None:
    import rerun as rr

    recording = rr.RecordingStream("someone_else")
    recording.save(path)
    if properties:
        recording.send_property("run", rr.DynamicArchetype("mpm_env", components=properties))
    recording.log("world/grains", rr.Points3D(np.zeros((3, 3))))
    recording.log("plots/loss", rr.Scalars([1.0, 2.0]))
    recording.flush()
    recording.disconnect()


def test_another_applications_rrd_is_refused(tmp_path: Path) -> None:
    for properties in ({}, {"seed": 3}, {"recipe": "Apfelkuchen"}):
        _foreign(tmp_path / "other.rrd", **properties)
        with pytest.raises(ValueError, match="without an mpm_env recipe: something else recorded it"):
            log.read(tmp_path / "other.rrd")


def test_a_newer_format_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log, "FORMAT", log.FORMAT + 1)
    _record(tmp_path / "newer.rrd")
    with pytest.raises(ValueError, match="has mpm_env log format 2, and this version reads up to 1: update"):
        log.read(tmp_path / "newer.rrd")


def test_an_altered_recipe_is_refused(tmp_path: Path) -> None:
    _foreign(tmp_path / "altered.rrd", recipe='{"seed": 8}', format=1, recipe_sha256="0" * 64)
    with pytest.raises(ValueError, match="damaged: its recipe does not match"):
        log.read(tmp_path / "altered.rrd")


def test_damaged_bytes_are_one_sentence_or_read_as_they_are(tmp_path: Path) -> None:
    """Rerun panics or aborts on some; none may reach the reader as anything but a ValueError."""
    _record(tmp_path / "run.rrd")
    whole = (tmp_path / "run.rrd").read_bytes()
    random = np.random.default_rng(1)
    for _ in range(10):
        damaged = bytearray(whole)
        for place in random.integers(12, len(whole), 4):
            damaged[place] = random.integers(256)
        (tmp_path / "damaged.rrd").write_bytes(damaged)
        try:
            log.read(tmp_path / "damaged.rrd")
        except ValueError as error:
            assert "\n" not in str(error)


def test_a_viewer_without_a_screen_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _record(tmp_path / "run.rrd")
    script = "import sys; print('no: DISPLAY.', file=sys.stderr); sys.exit(1)"
    monkeypatch.setattr(log_read, "RERUN_COMMAND", (sys.executable, "-c", script))
    with pytest.raises(RuntimeError, match=r"cannot open a window here \(DISPLAY\): open .*run\.rrd"):
        log.open_viewer(tmp_path / "run.rrd")


def test_the_viewer_listens_on_this_machine_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _record(tmp_path / "run.rrd")
    script = f"import sys; open({str(tmp_path / 'said')!r}, 'w').write(' '.join(sys.argv[1:]))"
    monkeypatch.setattr(log_read, "RERUN_COMMAND", (sys.executable, "-c", script))
    log.open_viewer(tmp_path / "run.rrd")
    assert (tmp_path / "said").read_text() == f"{tmp_path / 'run.rrd'} --bind 127.0.0.1 --port auto"


def test_rerun_is_told_not_to_collect_analytics() -> None:
    log_read.rerun()
    assert os.environ["RERUN_ANALYTICS"] == "0"
