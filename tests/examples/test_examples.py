"""Every example runs, small, and prints numbers that make sense."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import Any

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent.parent / "examples"
SMALL: dict[str, dict[str, Any]] = {
    "a0_quickstart": {"task": "mpm_env/PushSand-v0", "actions": 2},
    "a1_own_scene": {"cells": 3, "dimension": 2},
    "a2_batch": {"count": 2, "actions": 12},
    "a3_mesh_bucket": {"dimension": 2},
}


def run(name: str, **arguments: Any) -> dict[str, float]:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return dict(module.main(**(arguments or SMALL[name])))


def test_every_example_is_run_here() -> None:
    assert {p.stem for p in EXAMPLES.glob("*.py")} == set(SMALL)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SMALL))
def test_an_example_prints_finite_numbers(name: str) -> None:
    assert all(math.isfinite(v) for v in run(name).values())


@pytest.mark.slow
def test_the_light_box_is_carried_by_the_sand() -> None:
    end = run("a1_own_scene")
    assert end["push_N"] == pytest.approx(end["weight_N"], rel=0.02)  # 1 % in a longer run
    assert end["speed_m_per_s"] < 0.02
    assert end["health"] == 0


@pytest.mark.slow
def test_the_bucket_comes_up_with_sand_and_feels_its_weight() -> None:
    end = run("a3_mesh_bucket", fidelity="draft", dimension=3)
    assert end["held_kg"] > 1.5  # of 2.8 that it holds struck; 2.24 observed
    assert end["felt_N"] == pytest.approx(9.81 * end["held_kg"], rel=0.05)  # some grains on its rims; 0.02 observed
    assert end["health"] == 0
