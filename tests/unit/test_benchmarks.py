"""The benchmarks' arithmetic, and one of them run small, so that they do not rot."""

import json
import math
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from benchmarks import box, goals, guard, limits, report, stages
from benchmarks.clock import in_turns, spread
from benchmarks.coupled import DIG_STEPS, Run, digging
from benchmarks.throughput import HEAPS, fit, merged, same_job
from mpm_env.mpm import linalg3, sorting

ROOT = Path(__file__).resolve().parent.parent.parent


def test_fit_finds_the_line_that_made_the_times() -> None:
    ns, fixed, size, base = 50e-9, 20e-6, 400, 300.0
    rows = []
    for grains in (2_000, 60_000, 1_000_000):
        rate = grains / (fixed + ns * grains) / 1e6
        memory = base + size * grains / 2**20
        rows.append({"grains": grains, "Mpss_cpu": spread([rate], 12), "rss_mb": spread([memory], 12)})
    found = fit(rows)
    assert found["ns_per_grain"] == pytest.approx(50, rel=0.01)
    assert found["fixed_us"] == pytest.approx(20, rel=0.02)
    assert found["bytes_per_grain"] == pytest.approx(size, rel=0.01)
    assert 0.8 < found["exponent"] < 1


def test_same_job_is_the_worst_of_the_heap_s_numbers() -> None:
    row = {"n": 10} | HEAPS[10]
    assert same_job(row) == 0
    assert same_job(row | {"zcom": 1.01 * HEAPS[10]["zcom"]}) == pytest.approx(0.01)


def test_sweeps_taken_again_stand_in_for_the_kept_ones_and_say_so() -> None:
    kept = {"sweeps": {"size": {"native": 1}, "batch": {"native": 2}}, "retaken": {"size": "old"}}
    done = merged(kept, {"batch": {"native": 3}}, "new")
    assert done == {
        "sweeps": {"size": {"native": 1}, "batch": {"native": 3}},
        "retaken": {"size": "old", "batch": "new"},
    }


@pytest.mark.parametrize(("late", "settled"), [(0.0, True), (0.1, False)])
def test_box_that_keeps_moving_has_not_settled(late: float, settled: bool) -> None:
    speeds = [-0.5, -0.9, -0.3, *[0.0] * 40, *[late * (-1) ** k for k in range(10)]]
    assert box.verdict(speeds, 0.02)["settled"] is settled


def test_box_that_bounces_has_not_settled() -> None:
    assert box.verdict([-0.9] * 6 + [1.2] + [0.0] * 43, 0.02)["settled"] is False


def test_rivals_take_turns_after_one_unmeasured_round() -> None:
    seen: list[str] = []
    times = in_turns({name: lambda name=name: seen.append(name) for name in "ab"}, rounds=2)
    assert "".join(seen) == "ababab"
    assert {name: len(values) for name, values in times.items()} == {"a": 2, "b": 2}


def test_stage_on_the_same_values_is_run_each_time() -> None:
    calls: list[float] = []

    def on_host(x: jax.Array) -> np.ndarray:
        calls.append(float(x))
        return np.float32(2 * x)

    run = stages.anew(lambda x: jax.pure_callback(on_host, jax.ShapeDtypeStruct((), jnp.float32), x), jnp.float32(3))
    assert run(7)[1] == 6
    assert calls == [3] * 7
    run(0)
    assert len(calls) == 7


@pytest.mark.parametrize(("share", "disorder"), [(0.0, 0.0), (0.05, 0.05), (1.0, 0.5)])
def test_strewn_grains_are_as_disordered_as_asked(share: float, disorder: float) -> None:
    cell = stages.strewn(jnp.arange(20_000), share)
    assert float(sorting.disorder(cell)) == pytest.approx(disorder, abs=0.005)
    np.testing.assert_array_equal(np.sort(cell), np.arange(20_000))


def test_sort_pays_when_what_it_saves_comes_to_what_it_costs() -> None:
    times = {"whole substep, sorted": 40.0, "whole substep, nearly sorted": 42.0, "sort, if it were done": 30.0}
    assert "after 15 substeps" in report.sort_pays(times, "dig", 0.05)
    assert "does not pay" in report.sort_pays(times | {"whole substep, nearly sorted": 39.0}, "dig", 0.05)


def test_operations_in_loops_count_as_often_as_they_run() -> None:
    rows, at = jnp.ones((10, 3)), jnp.zeros(10, jnp.int32)

    def job(rows: jax.Array) -> jax.Array:
        rows = lax.fori_loop(0, 7, lambda _, now: jnp.sqrt(now) + 1, rows)  # 7 x 2 x 30
        sums = jnp.zeros((4, 3)).at[at].add(rows)  # 30
        return jnp.sum(sums @ rows.T)  # 2 x 4 x 10 x 3, and 40; whole numbers and gathers are none

    assert limits.operations(jax.make_jaxpr(job)(rows).jaxpr) == 7 * 2 * 30 + 30 + 240 + 40


def test_more_sweeps_are_more_operations(monkeypatch: pytest.MonkeyPatch) -> None:
    few = limits.substep_needs(4)["operations_per_grain"]
    monkeypatch.setattr(linalg3, "SWEEPS", 2 * linalg3.SWEEPS)
    assert limits.substep_needs(4)["operations_per_grain"] > 1.1 * few


def test_best_of_several_looks_is_the_most_of_each() -> None:
    assert limits.best([{"a": 1.0, "b": 4.0}, {"a": 2.0, "b": 3.0}]) == {"a": 2.0, "b": 4.0}


def test_cost_of_a_call_is_no_part_of_a_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    call, once = 3e-3, 2e-5
    monkeypatch.setattr(stages, "in_turns", lambda jobs, _: {key: [call + key[1] * once] for key in jobs})
    assert stages.seconds({"stage": lambda times: None}, 1)["stage"] == pytest.approx(once)


@pytest.mark.parametrize(("share", "verdict"), [(0.125, "yes"), (0.5, "MISSED")])
def test_goal_for_bodies_is_that_of_standard_fidelity(
    share: float, verdict: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(goals.results, "FOLDER", tmp_path)
    steps = {"draft": {"share on top of grains": 0.875}, "standard": {"share on top of grains": share}}
    (tmp_path / "stages.json").write_text(json.dumps({"kernels": {"native": {"dig, rigid step": steps}}}))
    assert f"| native: bodies in the dig scene, on top of grains | <= 0.3 | {share} | {verdict} |" in goals.section()


@pytest.mark.parametrize(
    ("wanted", "value", "verdict"),
    [("< 5", 5.0, "MISSED"), ("<= 5", 5.0, "yes"), ("> 1", 1.1, "yes"), (">= 2", 1, "MISSED"), ("< 5", None, "-")],
)
def test_goals_are_met_or_missed(wanted: str, value: float | None, verdict: str) -> None:
    assert goals.met(wanted, value) == verdict


def test_goal_of_a_word_is_met_by_it() -> None:
    assert (goals.met("yes", "yes"), goals.met("yes", "no")) == ("yes", "MISSED")


def test_report_needs_no_results(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(goals.results, "FOLDER", tmp_path)
    assert "| - |" in goals.section()


def test_missed_goal_is_explained_with_the_numbers_of_the_results(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(goals.results, "FOLDER", tmp_path)
    rates = {"f32": {"Mpss_cpu": {"median": 20.0}}, "f64": {"Mpss_cpu": {"median": 6.5}}}
    (tmp_path / "throughput.json").write_text(json.dumps({"sweeps": {"precision": {"native": rates}}}))
    assert "f64 itself runs at 6.5 M/s" in goals.section()
    rates["f64"] = {"Mpss_cpu": {"median": 9.0}}
    (tmp_path / "throughput.json").write_text(json.dumps({"sweeps": {"precision": {"native": rates}}}))
    assert "Why some were missed" not in goals.section()


def test_empty_room_s_cost_is_that_of_the_largest_box_over_the_usual_one() -> None:
    rows = {str(k): {"nodes": 100 * k**3, "Mpss_cpu": {"median": 6.0 / k}} for k in (1, 2, 4)}
    assert "- xla: with 64 times as many nodes 4 times the cost" in report.room({"xla": rows})
    assert "times" not in report.room({"xla": {"1": rows["1"]}})


def test_box_that_only_sinks_is_not_said_to_move_up() -> None:
    assert report.upwards(-0.0022) == "never moves up"
    assert report.upwards(0.0279) == "moves up at 0.0279 m/s at most"


def guarded(ratio: float, *options: str) -> int:
    """The exit status of the guard for a ratio of native kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guard, "ratio", lambda kernels: ratio)
        patch.setattr(guard, "kernels_here", lambda: (["native"], []))
        patch.setattr(guard.job, "pin", lambda cores: None)
        patch.setattr(sys, "argv", ["guard", *options])
        try:
            guard.main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0


def test_guard_compares_with_the_ratio_kept_and_keeps_another_only_when_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(guard.results, "FOLDER", tmp_path)
    monkeypatch.setattr(guard.machine, "ROOT", tmp_path)
    assert guarded(1.0) == 0  # the first run keeps
    assert guarded(1.2) == 0
    assert guarded(1.3) == 1  # and has not kept 1.2
    assert guarded(1.3, "--keep") == 0
    assert guarded(1.5) == 0


@pytest.mark.slow
def test_stages_of_a_rigid_step_are_those_of_today_s_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """They call the package's inner functions, so they are traced here, though not run."""
    monkeypatch.setattr(stages, "repeated", lambda stage, start: jax.eval_shape(stage, start))
    run = Run(digging("auto", "draft"), DIG_STEPS)
    assert {*stages.rigid(run)} == {"whole", "grains", *stages.PER_SUBSTEP, "lookup", "MJX", "health check"}


@pytest.mark.slow
def test_column_prints_the_line_that_all_codes_print() -> None:
    command = [sys.executable, "-m", "benchmarks.column", "--n", "4", "--tend", "0.05", "--kernels", "xla"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["grains"] == 8 * 4**3
    assert record["Mpss_cpu"] == pytest.approx(record["grains"] * record["substeps"] / record["cpu"] / 1e6, rel=0.01)
    assert record["zcom"] < 0.1 and record["r99"] > 0.1 * math.sqrt(2) * 0.8
