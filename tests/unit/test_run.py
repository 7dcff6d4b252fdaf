"""A run leaves what it promises, however it ends, and a recording of it can be simulated again to the bit."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpm_env import log, native
from mpm_env.cli import report
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.health import ContactReport
from mpm_env.ledger import Ledger
from mpm_env.replay import compare
from mpm_env.run import FILES, prepare, rhythm_of, run, versions
from mpm_env.scene import build
from mpm_env.scene_config import BodiesConfig, SceneConfig
from mpm_env.view import camera_of
from tests.unit.slices import F32, NUMERICS, SPEED, slice_of_sand

REPOSITORY = Path(__file__).resolve().parents[2]
STEPS_PER_FRAME = 10  # at 25 frames per second


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The one coupled run of this file."""
    out = tmp_path_factory.mktemp("pushed") / "out"
    summary = run(slice_of_sand(bodies=True), NUMERICS, out, seed=3, snapshots_fps=12.5, progress=False)
    return out, summary


def test_run_leaves_its_files_and_its_summary(pushed: tuple[Path, dict[str, Any]]) -> None:
    out, summary = pushed
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    assert json.loads((out / "summary.json").read_text()) == json.loads(json.dumps(summary))
    assert (summary["ended"], summary["health"]["names"], summary["seed"]) == ("complete", [], 3)
    assert set(summary["wall_s"]) == {"build", "compile", "run", "log", "picture", "total"}
    assert summary["wall_s"]["compile"] > 0 and summary["numerics"]["grain_substeps_per_s"] > 0
    assert summary["numerics"]["cells"] == [12, 6]
    assert summary["numerics"]["rigid_steps"] == 50 and summary["numerics"]["frames"] == 6
    assert summary["numerics"]["mpm_dt_s"] * summary["numerics"]["mpm_per_rigid"] == pytest.approx(0.004)
    assert set(summary["versions"]) == {"python", "jax", "mujoco", "mjx", "numpy", "rerun", "mpm_env", "kernels"}
    assert parse(SceneConfig, summary["config"], "again") == slice_of_sand(bodies=True)
    assert parse(Fidelity, summary["fidelity"], "again") == NUMERICS.model_copy(update={"dimension": 2})


def test_figures_are_in_kilograms_newtons_and_seconds(pushed: tuple[Path, dict[str, Any]]) -> None:
    figures = pushed[1]["figures"]
    assert figures["simulated_s"] == pytest.approx(0.2)
    assert figures["mass_start_kg"] == pytest.approx(1600 * 0.2 * 0.2 * 0.1, rel=F32)
    assert figures["mass_end_kg"] == figures["mass_start_kg"] and figures["mass_left_kg"] == 0
    assert set(figures["forces_of_grains"]) == {"paddle", "kerb"}
    assert figures["forces_of_grains"]["paddle"]["mean_N"][0] < 0  # the sand pushes back
    assert figures["body_end_m"]["hand"] == pytest.approx([0.18, 0.1, 0.09], abs=1e-6)


def test_time_series_have_the_promised_names_and_shapes(pushed: tuple[Path, dict[str, Any]]) -> None:
    with np.load(pushed[0] / "run.npz") as data:
        series = dict(data)
    frames, slots = 6, pushed[1]["numerics"]["slots"]
    expected: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(("step", "time", "health", "mass", "mass_left"), (frames,)),
        **dict.fromkeys(("kinetic", "elastic", "potential", "bodies_kinetic", "bodies_potential"), (frames,)),
        **dict.fromkeys((f"contact_{key}" for key in ContactReport._fields), (frames,)),
        **dict.fromkeys(("momentum", "angular_momentum", "bodies_momentum", "bodies_angular_momentum"), (frames, 3)),
        "qpos": (frames, 0),
        "qvel": (frames, 0),
        "control": (frames, 0),
        "body_position": (frames, 2, 3),
        "body_quaternion": (frames, 2, 4),
        "body_twist": (frames, 2, 6),
        "reaction": (50, 2, 6),
        "reaction_time": (50,),
        "geom_names": (2,),
        "body_names": (2,),
        "snapshot_time": (4,),
        "snapshot_x": (4, slots, 3),
        "snapshot_v": (4, slots, 3),
        "snapshot_mass": (4, slots),
        "snapshot_history": (4, 1, slots),
        "snapshot_material": (slots,),
    }
    assert {k: v.shape for k, v in series.items()} == expected
    assert series["snapshot_time"] == pytest.approx([0, 0.08, 0.16, 0.2])  # and the end, whatever the rate
    assert series["geom_names"].tolist() == ["kerb", "paddle"] and series["body_names"].tolist() == ["world", "hand"]
    assert series["body_twist"][3, 1] == pytest.approx([SPEED, 0, 0, 0, 0, 0], abs=1e-3)
    assert np.isfinite(series["reaction"]).all()
    present = series["snapshot_mass"] > 0
    assert np.isfinite(series["snapshot_x"][present]).all() and np.isnan(series["snapshot_x"][~present]).all()


def test_recording_holds_the_run_and_its_recipe(pushed: tuple[Path, dict[str, Any]]) -> None:
    out, summary = pushed
    recording = log.read(out / "run.rrd")
    assert recording.complete
    assert recording.steps.tolist() == [0, 10, 20, 30, 40, 50]
    assert recording.times == pytest.approx([0, 0.04, 0.08, 0.12, 0.16, 0.2])
    recipe = recording.recipe
    assert (recipe["kind"], recipe["seed"], recipe["steps_per_frame"]) == ("scene", 3, STEPS_PER_FRAME)
    assert recipe["config"] == summary["config"] and recipe["versions"] == versions(native.chosen("auto"))
    with np.load(out / "run.npz") as data:
        present = data["snapshot_mass"][-1] > 0
        assert recording.grains[-1].tobytes() == data["snapshot_x"][-1][present].tobytes()
        assert recording.scalars["mass/present_kg"][1] == pytest.approx(data["mass"])
        mean = data["reaction"][-STEPS_PER_FRAME:, 1, 0].mean()
    assert recording.scalars["wrench/hand/force_x_N"][1][-1] == pytest.approx(mean)


def test_replay_of_a_run_gives_the_same_bits(pushed: tuple[Path, dict[str, Any]]) -> None:
    found = compare(log.read(pushed[0] / "run.rrd"), progress=False)
    assert found.identical and found.frames == 6 and found.versions == {}
    assert found.grains.size == found.bodies.size == 0


def test_replay_finds_the_grain_that_differs(pushed: tuple[Path, dict[str, Any]]) -> None:
    recording = log.read(pushed[0] / "run.rrd")
    grains = [x.copy() for x in recording.grains]
    grains[2][7] += np.float32(0.01)
    recipe = {**recording.recipe, "versions": {**recording.recipe["versions"], "jax": "0.0"}}
    found = compare(replace(recording, grains=grains, recipe=recipe), progress=False)
    assert not found.identical
    assert found.grains.size == pytest.approx(0.01 * np.sqrt(3), rel=1e-3)
    x, y, z = grains[2][7]
    assert (found.grains.step, found.grains.where) == (20, f"the grain at ({x:.4g}, {y:.4g}, {z:.4g}) m")
    assert found.bodies.size == 0
    assert found.versions == {"jax": ("0.0", jax.__version__)}


def test_replay_refuses_what_it_cannot_simulate(pushed: tuple[Path, dict[str, Any]]) -> None:
    recording = log.read(pushed[0] / "run.rrd")
    with pytest.raises(ValueError, match="of kind 'other' cannot be simulated again; known kinds: scene"):
        compare(replace(recording, recipe={"kind": "other"}))
    with pytest.raises(ValueError, match="holds no frame"):
        compare(replace(recording, steps=recording.steps[:0]))


@pytest.mark.parametrize(
    ("recipe", "words"),
    [
        ({"kind": "scene"}, "recipe lacks 'steps_per_frame': it cannot be simulated again."),
        ({"kind": "scene", "steps_per_frame": 1, "seed": 0}, "recipe lacks 'config'"),
        ({"kind": "scene", "steps_per_frame": 1, "seed": "x"}, "recipe has 'seed' = 'x'"),
        ({"kind": "task"}, "recipe lacks 'key'"),
        ({"kind": "task", "key": 1, "config": []}, "recipe has 'config' = []"),
    ],
)
def test_recipe_that_lacks_something_is_one_sentence(
    pushed: tuple[Path, dict[str, Any]], recipe: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError) as refusal:
        compare(replace(log.read(pushed[0] / "run.rrd"), recipe=recipe), progress=False)
    assert words in str(refusal.value)


@pytest.fixture(scope="module")
def falling(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A ball that falls where no grain is."""
    out = tmp_path_factory.mktemp("falling")
    mjcf = '<mujoco><worldbody><body name="b" pos=".2 .1 .15"><freejoint/><geom name="ball" size=".02"/></body>'
    ball = BodiesConfig(mjcf=mjcf + "</worldbody></mujoco>", couple=["ball"])
    config = slice_of_sand(bodies=False, grains=[], duration=0.08).model_copy(update={"bodies": ball})
    return out, run(config, NUMERICS, out, progress=False)


def test_replay_without_grains_compares_the_bodies(falling: tuple[Path, dict[str, Any]]) -> None:
    recording = log.read(falling[0] / "run.rrd")
    assert recording.poses[-1][0, 2] < recording.poses[0][0, 2] - 0.01  # it falls
    assert compare(recording, progress=False).identical
    poses = [x.copy() for x in recording.poses]
    poses[1][0, 2] = np.nextafter(poses[1][0, 2], 1)  # one bit
    found = compare(replace(recording, poses=poses), progress=False)
    assert not found.identical and found.grains.size == 0
    assert 0 < found.bodies.size < 1e-15
    assert (found.bodies.step, found.bodies.where) == (10, "the geom 'ball'")


def test_replay_of_another_number_of_geoms_differs(falling: tuple[Path, dict[str, Any]]) -> None:
    recording = log.read(falling[0] / "run.rrd")
    found = compare(replace(recording, poses=[np.zeros((0, 12)) for _ in recording.poses]), progress=False)
    assert not found.identical and found.bodies.size == np.inf


def test_scene_without_grains_has_no_top_of_grains(falling: tuple[Path, dict[str, Any]]) -> None:
    assert falling[1]["figures"]["top_of_grains_m"] is None
    said = "\n".join(report(falling[1]))
    assert "top" not in said and "inf" not in said and "mass" not in said


# Runs without bodies compile in a second.


def test_interrupted_run_keeps_its_frames_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = prepare(slice_of_sand(bodies=False), NUMERICS, tmp_path)
    note, calls = Ledger.note, []

    def interrupted(*args: Any) -> dict[str, float]:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return note(*args)

    monkeypatch.setattr(Ledger, "note", interrupted)
    with pytest.raises(KeyboardInterrupt):
        session.go(progress=False)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["ended"] == "interrupted" and summary["numerics"]["frames"] == 2
    assert log.read(tmp_path / "run.rrd").steps.tolist() == [0, 10]
    with np.load(tmp_path / "run.npz") as data:
        assert data["time"] == pytest.approx([0, 0.04])


def test_run_ends_where_a_number_is_not_finite(tmp_path: Path) -> None:
    session = prepare(slice_of_sand(bodies=False), NUMERICS, tmp_path)
    grains = session.state.grains
    session.state = replace(session.state, grains=replace(grains, v=grains.v.at[0, 0].set(jnp.nan)))
    summary = session.go(progress=False)
    assert summary["ended"] == "not finite"
    assert "NOT_FINITE" in summary["health"]["names"] and summary["health"]["first_seen_s"]["NOT_FINITE"] == 0.04
    assert any("not finite" in sentence for sentence in summary["health"]["sentences"])
    assert "NaN" not in (tmp_path / "summary.json").read_text()  # which no JSON reader would take
    assert log.read(tmp_path / "run.rrd").steps.tolist() == [0, 10]


def test_killed_run_leaves_a_readable_log_and_a_summary_that_says_so(tmp_path: Path) -> None:
    out = tmp_path / "out"
    scene = tmp_path / "long.yaml"
    scene.write_text(slice_of_sand(bodies=False, duration=4000.0).model_dump_json())  # JSON is YAML
    command = [sys.executable, "-m", "mpm_env.cli", "run", str(scene), "--fidelity", "draft", "--out", str(out)]
    process = subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        size, patience = 0, time.monotonic() + 60
        while size < 100_000 and process.poll() is None and time.monotonic() < patience:
            time.sleep(0.1)
            size = (out / "run.rrd").stat().st_size if (out / "run.rrd").exists() else 0
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    recording = log.read(out / "run.rrd")
    assert not recording.complete and len(recording.steps) > 2
    assert json.loads((out / "summary.json").read_text())["ended"].startswith("cut short")
    assert os.path.getsize(out / "run.rrd") >= size > 0


def test_later_run_replaces_an_earlier_one(tmp_path: Path) -> None:
    (tmp_path / "run.npz").write_text("old")
    (tmp_path / "mine.txt").write_text("kept")
    prepare(slice_of_sand(bodies=False), NUMERICS, tmp_path, record=False)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.txt", "summary.json"]


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"fps": 30}, "fps = 30 is not a whole number of rigid steps of 0.004 s: use fps = 31.25."),
        ({"fps": 0}, "fps = 0 is no number of frames per second"),
        ({"fps": float("nan")}, "fps = nan is no number of frames per second"),
        ({"fps": 1.25}, "duration = 0.2 s is 0.25 frames at fps = 1.25: make it a whole number, such as 0.8 s."),
        ({"snapshots_fps": 10}, "snapshots_fps = 10 does not divide fps = 25"),
        ({"snapshots_fps": 0}, "snapshots_fps = 0 does not divide fps = 25"),
        ({"snapshots_fps": float("nan")}, "snapshots_fps = nan does not divide fps = 25"),
        ({"quantity": "colour"}, "quantity = 'colour' colours no grains: use one of speed, height, material."),
        ({"seed": -1}, "seed = -1 is outside 0..4294967295"),
    ],
)
def test_run_that_cannot_be_is_refused_and_leaves_nothing(tmp_path: Path, asked: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError) as refusal:
        prepare(slice_of_sand(bodies=False), NUMERICS, tmp_path / "out", **asked)
    assert words in str(refusal.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("refused", ["environment", "recorder"])
def test_recording_that_is_refused_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: str
) -> None:
    def refuses(*args: Any, **kwargs: Any) -> None:
        raise ValueError("RERUN=off, or so.")

    if refused == "environment":
        monkeypatch.setenv("RERUN", "off")
    else:
        monkeypatch.setattr("mpm_env.run.Recorder", refuses)
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    for name in FILES:
        (earlier / name).write_text(name)
    for out in (earlier, tmp_path / "new" / "out"):
        with pytest.raises(ValueError, match="RERUN=off"):
            prepare(slice_of_sand(bodies=False), NUMERICS, out)
    assert {p.name: p.read_text() for p in earlier.iterdir()} == {name: name for name in FILES}
    assert not (tmp_path / "new").exists()


def test_file_name_taken_by_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.npz").mkdir()
    (tmp_path / "run.png").write_text("earlier")
    with pytest.raises(ValueError, match=r"run\.npz is a folder, and a file is to go there"):
        prepare(slice_of_sand(bodies=False), NUMERICS, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.npz", "run.png"]


def test_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"The folder .*file cannot be written"):
        prepare(slice_of_sand(bodies=False), NUMERICS, tmp_path / "file")


def test_camera_that_cannot_look_is_refused() -> None:
    config = slice_of_sand(bodies=False, camera={"eye": [0, 0, 1], "target": [0, 0, 0]})
    with pytest.raises(ValueError, match="camera looks along up"):
        camera_of(build(config, NUMERICS))


def test_rhythm_counts_in_whole_numbers() -> None:
    built = build(slice_of_sand(bodies=False), NUMERICS)
    assert rhythm_of(built, 25) == (10, 5, None)
    assert rhythm_of(built, 125, 25) == (2, 25, 5)
