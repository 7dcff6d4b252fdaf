"""A demo reaches its goal, leaves what it promises, and its recording can be simulated again to the bit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpm_env.demo import FILES, demo, prepare
from mpm_env.log import Recording, read
from mpm_env.replay import compare

TASKS = ("push_sand", "dig_sand")
F32 = 1e-5  # share that a sum over geoms in f32 may be off from one in f64


@pytest.fixture(scope="module", params=TASKS)
def shown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """One demo per task for all tests of this file."""
    out = tmp_path_factory.mktemp(request.param) / "new" / "out"
    return out, demo(request.param, "draft", out, progress=False)


@pytest.fixture(scope="module")
def recording(shown: tuple[Path, dict[str, Any]]) -> Recording:
    return read(shown[0] / "demo.rrd")


@pytest.mark.slow
def test_demo_reaches_its_goal_in_good_health(shown: tuple[Path, dict[str, Any]]) -> None:
    _, summary = shown
    assert summary["success"]
    assert summary["health"] == {"names": [], "sentences": []}


@pytest.mark.slow
def test_demo_leaves_its_files(shown: tuple[Path, dict[str, Any]]) -> None:
    out, summary = shown
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    assert all((out / name).stat().st_size > 1000 for name in FILES)
    assert json.loads((out / "summary.json").read_text()) == json.loads(json.dumps(summary))


@pytest.mark.slow
def test_recording_shows_forces_as_means_over_an_action(
    shown: tuple[Path, dict[str, Any]], recording: Recording
) -> None:
    """The largest in the recording is the largest in the summary; that of a rigid step would be larger."""
    (tool,) = {name.split("/")[1] for name in recording.scalars if name.startswith("wrench/")}
    force = [recording.scalars[f"wrench/{tool}/force_{axis}_N"][1] for axis in "xyz"]
    largest = float(np.max(np.linalg.norm(force, axis=0)))
    assert largest == pytest.approx(shown[1]["force_largest_mean_of_an_action_N"], rel=F32)


@pytest.mark.slow
def test_replay_of_a_demo_gives_the_same_bits(recording: Recording) -> None:
    found = compare(recording, progress=False)
    assert found.identical, found
    assert found.frames == len(recording.actions) + 1 > 40


def test_seed_that_cannot_be_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="seed = -1 is negative"):
        prepare("push_sand", "draft", tmp_path / "out", seed=-1)
    assert not (tmp_path / "out").exists()
