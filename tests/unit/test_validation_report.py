"""docs/validation.md is what the results say, whatever parts there are; and what a case says of itself."""

import math

import pytest

from benchmarks import case, machine
from benchmarks.case import Case, at_least, at_most, within
from benchmarks.validation import report

KEPT = report.kept()
WEIGHT = {"measure": "weight", "low": 0.99, "high": 1.01, "note": "It is known why", "where": {"ratio": 1}}


def told(value: float, *, note: str = "", health: int = 0) -> dict:
    return Case("a bar: pitch", "Euler", 2.0, within(2.0, 0.1), value, "8 cells", 1.5, health, note).told()


def test_the_page_is_what_the_kept_results_give() -> None:
    assert report.OUT.read_text() == report.render(*KEPT), "run python -m benchmarks.validation.report"


@pytest.mark.parametrize("name", report.SECTIONS)
def test_a_part_without_results_is_said_to_be_missing(name: str) -> None:
    parts, coupling = KEPT
    assert f"Not measured yet: `python -m benchmarks.validation {name}`." in report.render(
        parts | {name: None}, coupling
    )


def test_the_page_needs_no_results() -> None:
    text = report.render({}, {})
    assert text.count("Not measured yet") == len(report.SECTIONS)
    assert report.CONTACT.title not in text


@pytest.mark.parametrize(("value", "holds"), [(2.1, True), (2.3, False), (math.nan, False), (math.inf, False)])
def test_a_case_holds_within_its_band_only(value: float, holds: bool) -> None:
    assert told(value)["verdict"] == ("holds" if holds else "misses")
    assert told(2.0, health=1)["verdict"] == "misses"


def test_a_missed_case_is_marked_in_the_table_and_told_below_it_with_its_note() -> None:
    wrong = [told(2.5, note="It is known why"), told(2.0)]
    assert "| 1.8 to 2.2 | **2 to 2.5** (missed) | +0.0 % to +25 % | 3.0 |" in case.table_of(wrong)
    assert "1 of 2 cases lie" in case.missed(wrong)
    assert "- **Missed**: a bar: pitch (8 cells), not 1.8 to 2.2: 2.5. It is known why." in case.missed(wrong)
    assert "Why is not known." in case.missed([told(2.5)])
    assert "**not finite** (missed)" in case.table_of([told(math.nan)])


def test_measures_of_contact_that_are_cited_are_those_with_bands() -> None:
    cited = list(report.contact({"drop": {"rows": [{"weight": 1.1, "ratio": 1}, {"weight": 1.0}], "bands": [WEIGHT]}}))
    assert [(one["value"], one["verdict"], one["note"]) for one in cited] == [(1.1, "misses", "It is known why")]


def test_bounds_of_one_side_are_told_as_such() -> None:
    few, many = (Case("a", "b", 0, band, 1.0, "c", 0).told() for band in (at_most(0.5), at_least(0.5)))
    assert "at most 0.5" in case.table_of([few]) and few["verdict"] == "misses"
    assert "at least 0.5" in case.table_of([many]) and many["verdict"] == "holds"


def test_the_plots_that_are_shown_are_there() -> None:
    for name, told in report.SECTIONS.items():
        for plot in told.plots if KEPT[0][name] else ():
            assert (machine.ROOT / "docs" / "validation" / plot).stat().st_size < 300_000, plot
