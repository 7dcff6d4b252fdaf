"""The command line: what it prints, what it leaves, and its exit status."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mpm_env import cli
from mpm_env.config import known
from mpm_env.log import read

REPOSITORY = Path(__file__).resolve().parents[2]
TINY = """
plane_strain: true
box: {lower: [0, 0, 0], upper: [0.3, 0.1, 0.2]}
feature: 0.1
duration: 0.12
grains: [{material: dry_sand, fill: [{shape: box, lower: [0, 0, 0], upper: [0.1, 0.1, 0.1]}]}]
"""

# Arguments of `mpm-env run`, and what the one line must say.
REFUSED = {
    ("box_drp",): "There is no scene 'box_drp': did you mean 'box_drop'?",
    ("none.yaml",): "There is no file none.yaml.",
    ("box_drop", "--fidelity", "fats"): "There is no fidelity 'fats': did you mean 'fast'?",
    ("box_drop", "--fidelity", "none.yaml"): "There is no file none.yaml.",
    ("box_drop", "--set", "grains.0.material=mud"): "There is no material 'mud'.",
    ("box_drop", "--set", "fidelity.cell=4"): "unknown key 'cell': did you mean 'cells'?",
    ("box_drop", "--set", "two_way=false"): "write --set fidelity.two_way=false",
    ("box_drop", "--set", "duration"): "A setting is key=value, got 'duration'.",
    ("box_drop", "--set", "duration=.nan"): "duration should be a finite number, got nan.",
    ("box_drop", "--set", "bodies.couple=[bax]"): "no geom named 'bax': did you mean 'box'?",
    ("box_drop", "--set", "bodies.mjcf=<mujoco>"): "not a model that MuJoCo can read",
    ("box_drop", "--set", "feature=0.17"): "make it a whole number",
    ("box_drop", "--set", "grains.0.fill.0.upper=[1, 1, 1]"): "outside the simulated box",
    ("box_drop", "--fidelity", "draft", "--set", "fidelity.mpm_dt=0.004"): "exceeds the stable",
    ("column_collapse_2d", "--fidelity", "draft", "--fps", "30"): "fps = 30 is not a whole number of rigid steps",
    ("column_collapse_2d", "--fidelity", "draft", "--seed", "-1"): "seed = -1 is outside",
    ("column_collapse_2d", "--fidelity", "draft", "--quantity", "taste"): "quantity = 'taste' colours no grains",
}


@pytest.mark.parametrize("arguments", REFUSED, ids=" ".join)
def test_refused_run_prints_one_line_and_leaves_nothing(
    arguments: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["run", *arguments, "--out", str(tmp_path / "out")])
    said = capsys.readouterr()
    assert end.value.code == cli.REFUSED
    assert said.err.startswith("mpm-env: ") and said.err.count("\n") == 1 and REFUSED[arguments] in said.err
    assert said.out == "" and not (tmp_path / "out").exists()


@pytest.mark.parametrize("arguments", [[], ["rn"], ["run"], ["run", "box_drop"], ["run", "--out", "x", "--fp", "3"]])
def test_unusable_arguments_end_with_status_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(arguments)
    assert end.value.code == cli.REFUSED and "usage: mpm-env" in capsys.readouterr().err


def test_refusal_of_the_installed_command_has_no_traceback(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mpm_env.cli", "run", "box_drp", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=60)
    assert done.returncode == cli.REFUSED
    assert done.stdout == "" and done.stderr.count("\n") == 1 and "Traceback" not in done.stderr


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiny")
    (folder / "tiny.yaml").write_text(TINY)
    return folder


@pytest.fixture(scope="module")
def ran(tiny: Path) -> Path:
    """A run of the tiny scene, with settings for the scene and for the fidelity."""
    settings = ["--set", "grains.0.material.E=2e5", "--set", "fidelity.courant=0.4"]
    status = cli.main(["run", str(tiny / "tiny.yaml"), "--fidelity", "draft", *settings, "--out", str(tiny / "out")])
    assert status == 0
    return tiny / "out"


def test_settings_go_to_the_scene_and_to_the_fidelity(ran: Path) -> None:
    summary = json.loads((ran / "summary.json").read_text())
    assert summary["config"]["grains"][0]["material"]["E"] == 2e5
    assert (summary["fidelity"]["courant"], summary["fidelity"]["cells"]) == (0.4, 3)


def test_run_prints_what_it_came_to(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    again = ["run", str(tiny / "tiny.yaml"), "--fidelity", "draft", "--out", str(tiny / "again"), "--fps", "125"]
    assert cli.main(again) == 0
    said = capsys.readouterr()
    assert "tiny: 0.12 s simulated, complete" in said.out
    assert "kernels: native (" in said.out or "kernels: xla" in said.out
    assert "mass 1.6 kg of 1.6 kg, 0 kg left the box" in said.out
    assert "run.rrd, run.npz, run.png, summary.json" in said.out
    assert "warp" not in said.out + said.err


def test_replay_says_identical_and_ends_with_status_0(ran: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["replay", str(ran / "run.rrd")]) == 0
    assert "identical: grains and bodies are the same to the bit over 4 frames" in capsys.readouterr().out


def test_replay_that_differs_says_where_and_ends_with_status_1(
    ran: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import mpm_env.replay
    from mpm_env.replay import Comparison, Difference

    grains = Difference(0.003, 20, 0.08, "the grain at (0.1, 0, 0.2) m")
    found = Comparison(4, grains, Difference(0.0, 0, 0.0, ""), {"jax": ("0.1", "0.2")})
    monkeypatch.setattr(mpm_env.replay, "compare", lambda *args, **kwargs: found)
    assert cli.main(["replay", str(ran / "run.rrd")]) == cli.DIFFERS
    said = capsys.readouterr().out
    assert "jax was 0.1 when recorded and is 0.2 now" in said
    assert (
        "grains: the largest difference is 0.003 m, that of the grain at (0.1, 0, 0.2) m, at 0.08 s (step 20)" in said
    )
    assert "bodies: the largest difference is 0" in said


def test_view_only_opens_the_viewer(ran: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []
    monkeypatch.setattr("mpm_env.log.open_viewer", opened.append)
    monkeypatch.setattr("mpm_env.replay.compare", lambda *args, **kwargs: pytest.fail("it simulated"))
    assert cli.main(["replay", str(ran / "run.rrd"), "--view"]) == 0
    assert opened == [str(ran / "run.rrd")]


def test_recording_whose_recipe_lacks_something_is_refused(
    ran: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = replace(read(ran / "run.rrd"), recipe={"kind": "scene", "fidelity": None})
    monkeypatch.setattr("mpm_env.log.read", lambda path: recording)
    with pytest.raises(SystemExit) as end:
        cli.main(["replay", "any.rrd"])
    said = capsys.readouterr().err
    assert end.value.code == cli.REFUSED and "recipe lacks 'steps_per_frame'" in said and said.count("\n") == 1


def test_demo_goes_to_demo_out_in_the_precision_of_its_fidelity(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Any] = []

    def prepare(task: Any, fidelity: Any, out: Any, *, seed: int) -> None:
        asked.extend([task.scene.name, fidelity.precision, out, seed])
        raise ValueError("enough seen.")

    (tmp_path / "exact.yaml").write_text("precision: f64")
    monkeypatch.setattr("mpm_env.demo.prepare", prepare)
    monkeypatch.setattr(cli, "use_precision", asked.append)
    with pytest.raises(SystemExit):
        cli.main(["demo", "push", "--fidelity", str(tmp_path / "exact.yaml")])
    assert asked == ["f64", "push_sand", "f64", "demo_out", 0]


def test_replay_of_no_recording_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.rrd").write_text("hello")
    for file, words in (("none.rrd", "there is no recording"), ("text.rrd", "is not a Rerun recording")):
        with pytest.raises(SystemExit) as end:
            cli.main(["replay", str(tmp_path / file)])
        said = capsys.readouterr().err
        assert end.value.code == cli.REFUSED and words in said and said.count("\n") == 1


def test_interrupt_ends_with_its_status(
    tiny: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mpm_env.run.Session._simulate", stop)
    assert cli.main(["run", str(tiny / "tiny.yaml"), "--out", str(tiny / "stopped")]) == cli.INTERRUPTED
    assert "interrupted" in capsys.readouterr().err
    assert json.loads((tiny / "stopped" / "summary.json").read_text())["ended"] == "interrupted"


def test_list_names_everything_with_what_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["list"]) == 0
    said = capsys.readouterr().out
    for kind in ("scenes", "materials", "fidelities", "tasks"):
        assert f"{kind}:" in said
        assert all(f"  {name} " in said for name in known(kind))


def test_help_names_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--help"])
    said = capsys.readouterr().out
    assert end.value.code == 0
    assert all(word in said for word in ("usage", "demo", "run", "replay", "list", "exit status"))


@pytest.mark.slow
def test_64_bits_are_switched_on_where_asked(tmp_path: Path, tiny: Path) -> None:
    """In a process of its own: the switch is JAX's, and for good."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "mpm_env.cli", "run", str(tiny / "tiny.yaml"), "--fidelity", "draft"]
    command += ["--set", "fidelity.precision=f64", "--out", str(out)]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True, timeout=120)
    assert json.loads((out / "summary.json").read_text())["fidelity"]["precision"] == "f64"
    replay = [sys.executable, "-m", "mpm_env.cli", "replay", str(out / "run.rrd")]
    done = subprocess.run(replay, cwd=REPOSITORY, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
