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
import mujoco
import numpy as np
import pytest

from mpm_env import log
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.ledger import Ledger
from mpm_env.replay import compare
from mpm_env.run import FILES, prepare, rhythm_of, run, versions
from mpm_env.scene import Scene, build, initial
from mpm_env.scene_config import BodiesConfig, SceneConfig
from mpm_env.view import View, body_data, camera_of

REPOSITORY = Path(__file__).resolve().parents[2]
SAND = {"model": "sand", "E": 1e5, "nu": 0.3, "rho": 1600.0, "friction_deg": 35.0}
MODEL = """
<mujoco>
  <worldbody>
    <body name="hand" mocap="true" pos=".08 .1 .09"><geom name="paddle" type="box" size=".02 .1 .06"/></body>
    <geom name="kerb" type="box" pos=".36 .1 .01" size=".02 .1 .02"/>
  </worldbody>
</mujoco>
"""
SPEED = 0.5  # m/s of the paddle
NUMERICS = Fidelity(cells=3, rigid_dt=0.004)
STEPS_PER_FRAME = 10  # at 25 frames per second
F32 = 1e-5  # share that sums over some hundred numbers of f32 may be off


def slice_of_sand(bodies: bool, **changed: Any) -> SceneConfig:
    """Sand in a slice 0.4 m long, 0.2 m thick; with bodies, a paddle moves through it towards a kerb."""
    data: dict[str, Any] = {
        "name": "slice",
        "plane_strain": True,
        "box": {"lower": [0.0, 0.0, 0.0], "upper": [0.4, 0.2, 0.2]},
        "feature": 0.1,
        "duration": 0.2,
        "walls": {"z_lower": {"kind": "separate", "friction": 0.5}},
        "grains": [
            {"material": SAND, "fill": [{"shape": "box", "lower": [0.13, 0.0, 0.0], "upper": [0.33, 0.2, 0.1]}]}
        ],
        **changed,
    }
    if bodies:
        path = [{"t": t, "position": [0.08 + SPEED * t, 0.1, 0.09]} for t in (0.0, 0.2)]
        data["bodies"] = {"mjcf": MODEL, "couple": ["paddle", "kerb"], "motion": {"hand": path}}
    return parse(SceneConfig, data, "slice")


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
    assert set(summary["versions"]) == {"python", "jax", "mujoco", "mjx", "numpy", "rerun", "mpm_env"}
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
    assert recipe["config"] == summary["config"] and recipe["versions"] == versions()
    with np.load(out / "run.npz") as data:
        present = data["snapshot_mass"][-1] > 0
        assert recording.grains[-1].tobytes() == data["snapshot_x"][-1][present].tobytes()
        assert recording.scalars["mass/present_kg"][1] == pytest.approx(data["mass"])
        mean = data["reaction"][-STEPS_PER_FRAME:, 1, 0].mean()
    assert recording.scalars["wrench/hand/force_x_N"][1][-1] == pytest.approx(mean)


def test_replay_of_a_run_gives_the_same_bits(pushed: tuple[Path, dict[str, Any]]) -> None:
    found = compare(log.read(pushed[0] / "run.rrd"), progress=False)
    assert found.identical and found.largest == 0 and found.frames == 6 and found.versions == {}


def test_replay_finds_the_grain_that_differs(pushed: tuple[Path, dict[str, Any]]) -> None:
    recording = log.read(pushed[0] / "run.rrd")
    grains = [x.copy() for x in recording.grains]
    grains[2][7] += np.float32(0.01)
    recipe = {**recording.recipe, "versions": {**recording.recipe["versions"], "jax": "0.0"}}
    found = compare(replace(recording, grains=grains, recipe=recipe), progress=False)
    assert not found.identical
    assert found.largest == pytest.approx(0.01 * np.sqrt(3), rel=1e-3)
    assert (found.step, found.at) == (20, tuple(map(float, grains[2][7])))
    assert found.versions == {"jax": ("0.0", versions()["jax"])}


def test_replay_refuses_what_it_cannot_simulate(pushed: tuple[Path, dict[str, Any]]) -> None:
    recording = log.read(pushed[0] / "run.rrd")
    with pytest.raises(ValueError, match="of kind 'other' cannot be simulated again; known kinds: scene"):
        compare(replace(recording, recipe={"kind": "other"}))
    with pytest.raises(ValueError, match="holds no frame"):
        compare(replace(recording, steps=recording.steps[:0]))


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


def test_recording_that_cannot_be_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(*args: Any, **kwargs: Any) -> None:
        raise ValueError("not today.")

    monkeypatch.setattr("mpm_env.run.Recorder", refuses)
    with pytest.raises(ValueError, match="not today"):
        prepare(slice_of_sand(bodies=False), NUMERICS, tmp_path / "out")
    assert not (tmp_path / "out").exists()


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


# The ledger against closed forms.


def thrown(dimension: int) -> tuple[Scene, Any]:
    """A block of sand thrown and turning, off the world's origin, before any step."""
    fill = {"shape": "box", "lower": [0.1, 0.05, 0.05], "upper": [0.2, 0.15, 0.15], "velocity": [0.3, 0.0, -0.2]}
    config = slice_of_sand(bodies=False, plane_strain=dimension == 2, grains=[{"material": SAND, "fill": [fill]}])
    config = config.model_copy(update={"box": config.box.model_copy(update={"lower": (-0.2, 0.0, -0.1)})})
    built = build(config, Fidelity(cells=4, dimension=dimension))
    state = initial(built, jax.random.key(0))
    spin = 5.0  # rad/s about +y
    x, z = state.grains.x[0] + built.grid.origin[0], state.grains.x[-1] + built.grid.origin[-1]
    there = state.grains.m > 0
    v = state.grains.v.at[0].add(jnp.where(there, spin * z, 0)).at[-1].add(jnp.where(there, -spin * x, 0))
    C = state.grains.C.at[0, -1].set(spin).at[-1, 0].set(-spin)
    return built, replace(state, grains=replace(state.grains, v=v, C=jnp.where(there, C, 0)))


@pytest.mark.parametrize("dimension", [2, 3])
def test_ledger_of_grains_agrees_with_sums_over_space(dimension: int) -> None:
    built, state = thrown(dimension)
    ledger = Ledger(built)
    view = View.of(built, state)
    ledger.note(state, view, np.zeros((1, 0, 6)))
    row = {k: v[0] for k, v in ledger.frames.items()}
    m = np.asarray(state.grains.m, float)[view.slots, None]
    v = np.zeros((len(m), 3))
    v[:, [0, 2] if dimension == 2 else [0, 1, 2]] = np.asarray(state.grains.v, float).T[view.slots]
    x = view.grains.astype(float)
    inertia = float(m.sum()) * built.grid.cell_size**2 / 4  # of the affine part, per axis
    assert row["mass"] == pytest.approx(1600 * 0.1 * 0.1 * 0.1, rel=F32)
    assert row["momentum"] == pytest.approx((m * v).sum(0), abs=F32)
    turning = (m * np.cross(x, v)).sum(0) + np.array([0, 2 * 5.0 * inertia, 0])
    assert row["angular_momentum"] == pytest.approx(turning, abs=F32)
    assert row["kinetic"] == pytest.approx(0.5 * (m * v**2).sum() + 0.5 * 2 * 25.0 * inertia, rel=F32)
    assert row["potential"] == pytest.approx(9.81 * (m[:, 0] * x[:, 2]).sum(), rel=F32)
    assert row["elastic"] == pytest.approx(0, abs=1e-9)


def test_ledger_of_bodies_agrees_with_a_rigid_body() -> None:
    mjcf = '<mujoco><worldbody><body name="b" pos=".2 .1 .15"><freejoint/><geom name="g" type="box" size=".04 .03 .02"'
    mjcf += ' mass="2"/></body></worldbody></mujoco>'
    coupled = BodiesConfig(mjcf=mjcf, couple=["g"])
    built = build(slice_of_sand(bodies=False, grains=[]).model_copy(update={"bodies": coupled}), NUMERICS)
    state = initial(built, jax.random.key(0))
    v, w = np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, -3.0])
    state = replace(state, rigid=state.rigid.replace(qvel=jnp.asarray([*v, *w])))
    ledger = Ledger(built)
    ledger.note(state, View.of(built, state), np.zeros((1, 1, 6)))
    row = {k: v[0] for k, v in ledger.frames.items()}
    inertia = 2 / 3 * np.array([0.03**2 + 0.02**2, 0.04**2 + 0.02**2, 0.04**2 + 0.03**2])
    assert row["bodies_momentum"] == pytest.approx(2 * v, rel=F32)
    assert row["bodies_angular_momentum"] == pytest.approx(np.cross([0.2, 0.1, 0.15], 2 * v) + inertia * w, rel=F32)
    assert row["bodies_kinetic"] == pytest.approx(v @ v + 0.5 * (inertia * w) @ w, rel=F32)
    assert row["bodies_potential"] == pytest.approx(2 * 9.81 * 0.15, rel=F32)
    assert row["body_twist"][1] == pytest.approx([*v, *w], rel=F32)


def test_view_of_bodies_has_their_poses() -> None:
    built = build(slice_of_sand(bodies=True), NUMERICS)
    data = body_data(built, initial(built, jax.random.key(0)))
    assert isinstance(data, mujoco.MjData) and built.bodies is not None
    assert data.body("hand").xpos == pytest.approx([0.08, 0.1, 0.09])
    assert body_data(build(slice_of_sand(bodies=False), NUMERICS), None) is None  # type: ignore[arg-type]
