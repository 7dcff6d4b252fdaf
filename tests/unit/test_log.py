"""What the recorder promises: everything comes back exact, and what cannot be recorded is one sentence."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from mpm_env import log, log_look

REPOSITORY = Path(__file__).resolve().parents[2]
BOX = ((-0.5, -0.3, 0.0), (0.5, 0.3, 0.4))
RECIPE = {
    "kind": "episode",
    "scene": "dig",
    "seed": 2**70,
    "config": {"control_dt": 0.1, "box": [1.0, 0.6], "view": None, "name": "Sand, fein: Ä | 砂"},
    "mjcf": "<mujoco/>" * 100,
    "versions": {"mpm_env": "0.1.0"},
}
EVERY_SHAPE = """
<mujoco>
  <asset>
    <material name="steel" rgba="0.5 0.6 0.7 1"/>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1" scale="0.1 0.1 0.1"/>
    <hfield name="hill" nrow="3" ncol="4" size="0.2 0.1 0.05 0.01"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <geom name="glass" type="box" size="0.1 0.1 0.1" rgba="1 1 1 0.2"/>
    <geom name="hidden" type="box" size="0.1 0.1 0.1" group="4"/>
    <geom type="hfield" hfield="hill"/>
    <body name="tool" pos="0 0 0.3">
      <freejoint/>
      <geom name="blade/edge" type="box" size="0.1 0.05 0.02" material="steel"/>
      <geom type="capsule" fromto="0 0 0 0.1 0 0.1" size="0.01"/>
      <geom type="sphere" size="0.02"/>
      <geom type="ellipsoid" size="0.02 0.03 0.04"/>
      <geom type="cylinder" size="0.02 0.1"/>
      <geom type="mesh" mesh="wedge" material="steel"/>
    </body>
    <body name="hand" mocap="true"><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""


def _sand(frame: int, count: int) -> np.ndarray:
    """(count, 3) float32 with bits to lose: tiny, huge and negative zero among them."""
    x = np.random.default_rng(frame).normal(size=(count, 3)).astype(np.float32)
    x[:1] = [[1e-40, -0.0, 3.4e38]]
    return x


def _record(path: Path, counts: tuple[int, ...] = (7, 7, 7), **changed: Any) -> list[np.ndarray]:
    """A small run in which frame i is step 2 i at 0.1 i s."""
    grains = [_sand(i, count) for i, count in enumerate(counts)]
    with log.Recorder(path, **{"recipe": RECIPE, "model": None, "box": BOX, **changed}) as recorder:
        for i, x in enumerate(grains):
            recorder.action(2 * i, np.array([0.1, np.pi, i / 3]))
            _frame(recorder, 2 * i, x, time=i * 0.1, scalars={"reward/deliver": i / 7, "budget/mass_kg": np.nan})
    return grains


def _posed(path: Path) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A recording of one frame with every shape, turned."""
    model = mujoco.MjModel.from_xml_string(EVERY_SHAPE)
    data = mujoco.MjData(model)
    data.qpos[3:7] = np.array([0.8, 0.4, 0.2, -0.4])
    mujoco.mj_forward(model, data)
    with log.Recorder(path, recipe=RECIPE, model=model, box=BOX) as recorder:
        _frame(recorder, 0, _sand(0, 2), geom_pos=data.geom_xpos, geom_mat=data.geom_xmat)
    return model, data


def _frame(recorder: log.Recorder, step: int, grains: np.ndarray, **more: Any) -> None:
    given = {"time": 0.1 * step, "values": np.zeros(len(grains)), "grain_radius": 0.004}
    recorder.frame(step=step, grains=grains, **{**given, **more})


def _bits(array: np.ndarray) -> bytes:
    return array.tobytes()


def test_grains_come_back_to_the_bit(tmp_path: Path) -> None:
    grains = _record(tmp_path / "run.rrd")
    back = log.read(tmp_path / "run.rrd").grains
    assert [x.dtype for x in back] == [np.float32] * 3
    assert [_bits(x) for x in back] == [_bits(x) for x in grains]


def test_actions_and_times_come_back_to_the_bit(tmp_path: Path) -> None:
    _record(tmp_path / "run.rrd")
    back = log.read(tmp_path / "run.rrd")
    assert _bits(back.actions) == _bits(np.array([[0.1, np.pi, i / 3] for i in range(3)]))
    assert back.action_steps.tolist() == back.steps.tolist() == [0, 2, 4]
    assert back.times.tolist() == [i * 0.1 for i in range(3)]


def test_a_recipe_comes_back_equal(tmp_path: Path) -> None:
    _record(tmp_path / "run.rrd")
    back = log.read(tmp_path / "run.rrd")
    assert back.recipe == RECIPE
    assert back.complete


def test_scalars_come_back_with_nan_kept(tmp_path: Path) -> None:
    _record(tmp_path / "run.rrd")
    scalars = log.read(tmp_path / "run.rrd").scalars
    assert list(scalars) == ["budget/mass_kg", "reward/deliver"]
    steps, values = scalars["reward/deliver"]
    assert (steps.tolist(), values.tolist()) == ([0, 2, 4], [0.0, 1 / 7, 2 / 7])
    assert np.isnan(scalars["budget/mass_kg"][1]).all()


@pytest.mark.parametrize("counts", [(5, 0, 12), (0, 3, 3), ()])
def test_the_number_of_grains_may_change(tmp_path: Path, counts: tuple[int, ...]) -> None:
    grains = _record(tmp_path / "run.rrd", counts)
    back = log.read(tmp_path / "run.rrd")
    assert [x.shape for x in back.grains] == [(count, 3) for count in counts]
    assert [_bits(x) for x in back.grains] == [_bits(x) for x in grains]
    assert back.complete


def test_nan_grains_are_kept_as_they_are(tmp_path: Path) -> None:
    x = _sand(0, 4)
    x[1] = np.nan, np.inf, 0.0
    with log.Recorder(tmp_path / "run.rrd", recipe=RECIPE, model=None, box=BOX) as recorder:
        _frame(recorder, 0, x, values=np.array([0.0, np.nan, 1.0, -np.inf]))
    assert _bits(log.read(tmp_path / "run.rrd").grains[0]) == _bits(x)


def test_every_geom_can_be_drawn_and_wrenches_are_plotted(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(EVERY_SHAPE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with log.Recorder(tmp_path / "run.rrd", recipe=RECIPE, model=model, box=BOX) as recorder:
        wrench = np.zeros(3), np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0])
        poses = {"geom_pos": data.geom_xpos, "geom_mat": data.geom_xmat}
        _frame(recorder, 0, _sand(0, 2), wrenches={"tool": wrench}, **poses)
        with pytest.raises(ValueError, match=r"geom_pos is .* the model has geoms"):
            _frame(recorder, 1, _sand(0, 2))
    scalars = log.read(tmp_path / "run.rrd").scalars
    assert [scalars[f"wrench/tool/{name}"][1].item() for name in log.WRENCH_NAMES] == [1, 2, 3, 4, 5, 6]


def test_a_pose_is_stored_in_the_viewers_order(tmp_path: Path) -> None:
    """Rerun keeps matrices by columns; R x + p must come out as MuJoCo means it."""
    from rerun.chunk import RrdReader

    model, data = _posed(tmp_path / "run.rrd")
    geom = model.geom("blade/edge").id
    (chunk,) = (
        batch
        for chunk in RrdReader(tmp_path / "run.rrd").stream()
        if "blade" in str(chunk.entity_path) and "Transform3D:mat3x3" in (batch := chunk.to_record_batch()).schema.names
    )
    columns = np.ravel(chunk.column("Transform3D:mat3x3")[0].as_py()).reshape(3, 3)
    np.testing.assert_array_equal(columns.T, data.geom_xmat[geom].reshape(3, 3).astype(np.float32))


def test_poses_of_all_geoms_come_back_to_the_bit(tmp_path: Path) -> None:
    """Hidden and fixed ones too, in float64: a replay compares them."""
    _, data = _posed(tmp_path / "run.rrd")
    back = log.read(tmp_path / "run.rrd").poses
    assert [_bits(x) for x in back] == [_bits(np.concatenate([data.geom_xpos, data.geom_xmat], axis=1))]


def test_grains_alone_have_no_poses(tmp_path: Path) -> None:
    _record(tmp_path / "run.rrd")
    assert [x.shape for x in log.read(tmp_path / "run.rrd").poses] == [(0, 12)] * 3


def test_an_interrupted_run_is_closed(tmp_path: Path) -> None:
    with (
        pytest.raises(KeyboardInterrupt),
        log.Recorder(tmp_path / "run.rrd", recipe=RECIPE, model=None, box=BOX) as recorder,
    ):
        _frame(recorder, 0, _sand(0, 2))
        raise KeyboardInterrupt
    assert log.read(tmp_path / "run.rrd").complete


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"path": "run.log"}, "does not end in .rrd"),
        ({"path": "no/such/run.rrd"}, "has no folder to go into"),
        ({"path": "folder.rrd"}, "cannot be written: Is a directory"),
        ({"box": ((0, 0), (1, 1))}, "give \\(3,\\) corners"),
        ({"box": ((1, 1, 1), (0, 0, 0))}, "is empty"),
        ({"quantity": "warmth"}, r"quantity 'warmth' is none of \['speed', 'height', 'material'\]"),
        ({"quantity": "warmth", "value_range": (1.0, 1.0)}, "value_range = .* is empty"),
        ({"metres_per_newton": 0.0}, "metres_per_newton = 0.0 draws no arrow"),
    ],
)
def test_what_cannot_be_recorded_is_refused_before_a_file_exists(
    tmp_path: Path, changed: dict[str, Any], sentence: str
) -> None:
    (tmp_path / "folder.rrd").mkdir()
    path = tmp_path / changed.pop("path", "run.rrd")
    with pytest.raises(ValueError, match=sentence):
        log.Recorder(path, **{"recipe": RECIPE, "model": None, "box": BOX, **changed})
    assert not path.is_file()


def test_a_recipe_that_is_not_json_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="recipe cannot be stored as JSON"):
        log.Recorder(tmp_path / "run.rrd", recipe={"array": np.zeros(2)}, model=None, box=BOX)
    assert not (tmp_path / "run.rrd").exists()


def test_rerun_switched_off_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(ValueError, match="RERUN=off is set in the environment"):
        log.Recorder(tmp_path / "run.rrd", recipe=RECIPE, model=None, box=BOX)
    assert not (tmp_path / "run.rrd").exists()


@pytest.mark.parametrize(
    ("changed", "kind", "sentence"),
    [
        ({"grains": np.zeros((3, 3))}, TypeError, "grains are float64 and recorded as float32"),
        ({"grains": np.zeros((3, 2), np.float32)}, ValueError, "give \\(n, 3\\) and \\(n,\\)"),
        ({"values": np.zeros(4)}, ValueError, "give \\(n, 3\\) and \\(n,\\)"),
        ({"step": 4}, ValueError, "frame of step 4 follows step 4"),
        ({"time": np.nan}, ValueError, "time = nan s of step 5 is not finite"),
        ({"scalars": {"reward/what?": 1.0}}, ValueError, "is not words joined by '/'"),
        ({"scalars": {"reward": np.zeros(2)}}, ValueError, "give one number per name"),
        ({"wrenches": {"tool": (np.zeros(3), 0.0, np.zeros(3))}}, ValueError, "wrench 'tool' has shapes"),
    ],
)
def test_a_bad_frame_is_refused_and_the_next_one_is_recorded(
    tmp_path: Path, changed: dict[str, Any], kind: type[Exception], sentence: str
) -> None:
    good: dict[str, Any] = {"step": 5, "grains": _sand(0, 3), "values": np.zeros(3)}
    with log.Recorder(tmp_path / "run.rrd", recipe=RECIPE, model=None, box=BOX) as recorder:
        _frame(recorder, 4, _sand(0, 3))
        with pytest.raises(kind, match=sentence):
            _frame(recorder, **{**good, **changed})
        _frame(recorder, **good)
    assert log.read(tmp_path / "run.rrd").steps.tolist() == [4, 5]


def test_a_bad_action_is_refused(tmp_path: Path) -> None:
    with log.Recorder(tmp_path / "run.rrd", recipe=RECIPE, model=None, box=BOX) as recorder:
        recorder.action(0, np.zeros(2))
        for bad in (np.zeros(3), np.zeros((1, 2)), np.array([1, 2])):
            with pytest.raises(ValueError, match="give floats"):
                recorder.action(1, bad)
    with pytest.raises(ValueError, match="is closed"):
        recorder.action(2, np.zeros(2))
    recorder.close()


def test_names_and_types_used_elsewhere_in_the_process_change_nothing(tmp_path: Path) -> None:
    """Rerun keeps the first type it sees under a name, and converts what comes later to it."""
    import rerun as rr

    elsewhere = rr.RecordingStream("someone_else")
    elsewhere.log("a", rr.AnyValues(action=np.ones(2, np.float32), time_s=1, recipe=2, seed=3, frames="four"))
    for seed in (7, "seven", 7.5, None, True):
        recipe = {"seed": seed, "action": seed, "frames": seed, "format": seed}
        grains = _record(tmp_path / "run.rrd", recipe=recipe)
        back = log.read(tmp_path / "run.rrd")
        assert back.recipe == recipe
        assert back.actions[2].tolist() == [0.1, np.pi, 2 / 3]
        assert (len(back.grains), back.times[1]) == (len(grains), 0.1)


def test_recording_leaves_reruns_strictness_as_it_was(tmp_path: Path) -> None:
    import rerun as rr

    assert not rr.strict_mode()
    _record(tmp_path / "run.rrd")
    assert not rr.strict_mode()


def test_the_file_has_an_arrangement_and_two_clocks(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    _record(tmp_path / "run.rrd")
    assert len(RrdReader(tmp_path / "run.rrd").blueprints()) == 1
    names = {name for c in RrdReader(tmp_path / "run.rrd").stream() for name in c.to_record_batch().schema.names}
    assert {"step", "sim_time"} <= names
    assert not {"log_time", "log_tick"} & names


def test_force_arrows_are_scaled_by_what_moves() -> None:
    """A heavy base that stands still once shrank them to a dot."""
    moving = '<body><freejoint/><geom size="0.1" mass="7"/></body>'
    scales = []
    for still in ("", '<body><geom size="0.1" mass="500"/></body>'):
        model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{moving}{still}</worldbody></mujoco>")
        scales.append(log_look.arrow_scale(model, 1.0))
    assert scales[0] == scales[1]


def test_lighter_means_more() -> None:
    """The ramp's lightness grows strictly, so the order of values survives in grey."""
    luminance = log.RAMP_RGB @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance[::8]) > 0).all()


def test_importing_log_does_not_import_rerun() -> None:
    code = "import sys, mpm_env.log; sys.exit(any(m.split('.')[0] == 'rerun' for m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
