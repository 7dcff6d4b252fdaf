"""Sand at rest bears its weight, stands at its slope, and in f32 ends where f64 does."""

import numpy as np
import pytest

from benchmarks.validation.rest import LAWS, Column, at_rest_pressure, collapse, column, heap

CELLS = 16
OFF = 0.02  # of rho g H, stress on level planes; 0.005 observed
LATERAL = 0.02  # of K0; 0.002 observed (the strain of 1 % is finite)
SETTLES = 0.1  # of the closed form: windows at the floor and the surface reach beyond; 0.03 observed
STILL = 1e-3  # of sqrt(g H); 2.4e-4 observed
CREEPS = 0.5  # cells in 100 000 substeps, by the thin toe; 0.18 observed
PRECISION = 1e-3  # of H; 2e-5 observed


@pytest.fixture(scope="module")
def started() -> Column:
    return column(CELLS)


def test_column_bears_its_weight_in_its_depth_and_stands_still(started: Column) -> None:
    assert started.off < OFF
    assert started.noise < STILL
    # The control: were it a tenth lighter, stress would be off by more.
    assert np.sqrt(np.mean((0.9 * started.stress[1] - started.depth) ** 2)) > 2 * OFF


@pytest.mark.parametrize("law", LAWS)
def test_column_loaded_from_nothing_has_k0_and_the_settlement_of_its_modulus(law: str) -> None:
    loaded, other = column(CELLS, law, loaded=True), next(name for name in LAWS if name != law)
    assert loaded.lateral == pytest.approx(at_rest_pressure(law), rel=LATERAL)
    assert loaded.settled == pytest.approx(1, abs=SETTLES)
    assert loaded.off < 2 * OFF
    assert abs(at_rest_pressure(other) / at_rest_pressure(law) - 1) > 5 * LATERAL, "the two are told apart"


def test_k0_is_that_of_the_walls_or_of_failure() -> None:
    assert at_rest_pressure("elastic") == pytest.approx(3 / 7)
    assert at_rest_pressure("yielding") == pytest.approx(0.4903, abs=1e-4)


def test_heap_below_its_friction_angle_stands_and_one_above_flows() -> None:
    left = heap(CELLS // 2)
    assert left.noise < STILL
    assert left.creep < CREEPS
    assert left.typical < 0.01 * CREEPS
    assert heap(CELLS // 2, slope_deg=40.0, steps=0).noise > 2 * STILL  # 4.8e-3 observed


def test_collapse_in_f32_ends_where_it_does_in_f64() -> None:
    narrow, wide = (collapse(CELLS // 2, dtype)[0] for dtype in ("float32", "float64"))
    assert np.hypot(*(narrow - wide)).max() < PRECISION
    # The control: half a degree of friction is told apart.
    assert np.hypot(*(collapse(CELLS // 2, "float64", friction_deg=29.5)[0] - wide)).max() > 2 * PRECISION
