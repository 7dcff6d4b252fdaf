"""docs/coupling.md is what the results say, whatever parts there are: no number in it is typed by hand."""

import copy
import re

import pytest

from benchmarks import machine, results
from benchmarks.coupling import report
from benchmarks.part import Band, kept

ABOUT = {"commit": "abc1234", "date": "2026-01-01", "cpu": "a core", "cores": 1, "versions": "jax 0"}


def held(name: str, scheme: str, fastest: float | None) -> dict:
    return {
        "name": name,
        "scheme": scheme,
        "told": False,
        "ratio": 0.01,
        "fastest": fastest,
        "force_N": 1.0,
        "noise": 0.03,
        "astray_cells": 1e-4,
        "unpaid": 1e-8,
        "trouble": [],
    }


def part(rows: list[dict], bands: list[dict]) -> dict:
    return {"about": ABOUT, "quick": False, "rows": rows, "bands": bands}


CALM = {"measure": "fastest", "low": 0.0, "high": 0.5, "note": "", "where": {"scheme": "together"}}
KEPT = {name: results.read(f"coupling_{name}") for name in report.SECTIONS}


def test_the_page_is_what_the_kept_results_give() -> None:
    assert report.OUT.read_text() == report.render(KEPT), "run python -m benchmarks.coupling.report"


@pytest.mark.parametrize("name", report.SECTIONS)
def test_a_part_without_results_is_said_to_be_missing(name: str) -> None:
    text = report.render(KEPT | {name: None})
    assert f"Not measured yet: `python -m benchmarks.coupling {name}`." in text


def test_the_page_needs_no_results() -> None:
    text = report.render({})
    assert text.count("Not measured yet") == len(report.SECTIONS)
    assert "## Limits" in text


def test_a_missed_band_is_marked_in_its_table_and_told_below_it() -> None:
    bands = [CALM | {"note": "It is known why"}]
    text = report.tell_apart(part([held("buried", "together", 0.7), held("squeezed", "together", 0.1)], bands))
    assert "| box buried flush | solved together | **0.7** (missed) |" in text
    assert "- **Missed**: fastest, m/s or rad/s, in 1 of 2 runs (box buried flush). It is known why." in text
    assert "| solved together | 0.1 |" in text


def test_a_miss_that_no_one_understands_is_told_as_such() -> None:
    assert "Why is not known." in report.tell_apart(part([held("buried", "together", 0.7)], [CALM]))


def test_a_number_that_is_not_finite_is_told_and_misses_its_band() -> None:
    text = report.tell_apart(part([held("buried", "together", kept(float("nan")))], [CALM]))
    assert "**not finite** (missed)" in text


def test_negative_controls_are_held_to_no_band() -> None:
    text = report.tell_apart(part([held("buried", "explicit", 6000.0)], [CALM]))
    assert "| explicit (control) | 6000 |" in text
    assert "No band is missed." in text


@pytest.mark.parametrize(
    ("row", "missed"),
    [
        ({"up": 0.5}, True),
        ({"up": 0.1}, False),
        ({}, False),
        ({"up": {"a": 0.1, "b": 0.5}}, True),
        ({"up": None}, True),
    ],
)
def test_a_band_is_missed_by_any_number_outside_it(row: dict, missed: bool) -> None:
    assert Band("up", 0.0, 0.2).misses(row) is missed
    assert not Band("up", 0.0, 0.2, where={"ratio": 1.0}).misses(row | {"ratio": 2.0})


@pytest.mark.parametrize("name", [name for name, result in KEPT.items() if result and "bands" in result])
def test_results_outside_their_bands_are_told_in_each_section(name: str) -> None:
    """The kept results with one number each made wrong: every band can be missed, and is then told."""
    _, section, _ = report.SECTIONS[name]
    result = KEPT[name]
    assert result is not None
    for band in report.bands_of(result):
        wrong = copy.deepcopy(result)
        for row in wrong["rows"]:
            if band.measure in row and all(row.get(k) == v for k, v in band.where.items()):
                value = row[band.measure]
                row[band.measure] = dict.fromkeys(value, 1e9) if isinstance(value, dict) else 1e9
        assert f"- **Missed**: {report.MEASURES[band.measure]}" in section(wrong)


def test_a_case_against_experiments_that_misses_is_marked_with_its_note() -> None:
    result = KEPT["penetration"]
    assert result is not None
    wrong = copy.deepcopy(result)
    case = wrong["cases"][0] | {"name": "a wall of its own", "verdict": "misses", "note": "It is known why"}
    wrong["cases"] = [case]
    text = report.penetration(wrong)
    assert "(missed) |" in text
    assert "0 of 1 cases lie in the band" in text
    assert re.search(r"- \*\*Missed\*\*: a wall of its own .* It is known why\.", text)


def test_the_pictures_that_are_shown_are_there() -> None:
    shown = re.findall(r"\]\((coupling/[^)]*)\)", report.render(KEPT))
    assert shown
    for name in shown:
        picture = machine.ROOT / "docs" / name
        assert picture.stat().st_size < 300_000, f"{name} is too large for a page"
