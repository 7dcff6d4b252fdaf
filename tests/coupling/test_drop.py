"""A box dropped on sand, from a hundredth to a hundred times as dense: it does not bounce, settles, weighs itself."""

from functools import cache

import pytest

from benchmarks.coupling.drop import RATIOS, Drop, drop, dropped

DX = 0.025  # m
SECONDS = 1.25
RISE = 0.01  # of the impact's energy, as is asked; 7e-3 observed, of a box of foam at one of the grid's phases
CALM = {0.01: 0.01, 0.1: 0.01, 1.0: 0.002}  # m/s over the last 0.25 s; 5e-3, 2e-3 and 3e-4 observed
WEIGHT_TOLERANCE = 0.01
TOLD = {0.01: {"NOT_CONVERGED"}}  # of a box of foam, a substep of the impact may stay unsolved, and is told
DEEPEST = 0.25  # cells
# Of the impact speed, at E = 3e6; 0.003 (in space 0.054), 0.05 and 0.28 observed: sand gives back what it stored.
REBOUND = {0.01: 0.07, 0.1: 0.1, 1.0: 0.4}
REST = 0.5  # cells above the sand's surface, or below it; 0.16 to 0.29 observed
SCATTER = 0.2  # cells, between places of the surface in its cell; 0.06 to 0.09 observed, 0.75 where nodes tell no gaps
CONVERGES = 0.8  # of the gap in m, when cells are halved
PHASES = (0.0, 0.25, 0.5, 0.75)


@cache
def done(ratio: float, phase: float = 0.0, dx: float = DX, dimension: int = 2) -> Drop:
    return dropped(drop(dimension, dx, phase=phase), ratio, SECONDS)[0]


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_dropped_box_never_raises_the_energy(ratio: float) -> None:
    assert done(ratio).rise < RISE
    assert done(ratio).depth < DEEPEST
    assert set(done(ratio).trouble) <= TOLD.get(ratio, set())


@pytest.mark.parametrize("ratio", REBOUND)
def test_a_dropped_box_comes_to_rest_on_the_surface_and_weighs_itself(ratio: float) -> None:
    box = done(ratio)
    assert box.up < REBOUND[ratio] * box.impact
    assert box.rms < CALM[ratio]
    assert box.weight == pytest.approx(1, rel=WEIGHT_TOLERANCE)
    assert abs(box.gap) < REST


@pytest.mark.slow
@pytest.mark.parametrize("ratio", REBOUND)
def test_where_a_box_rests_hardly_depends_on_where_the_grid_lies(ratio: float) -> None:
    gaps = [done(ratio, phase).gap for phase in PHASES]
    assert max(gaps) - min(gaps) < SCATTER


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.1, 1.0])
def test_where_a_box_rests_converges_with_the_cell_size(ratio: float) -> None:
    """In metres: its gap to the surface is a part of a cell."""
    assert abs(done(ratio, dx=DX / 2).gap) * DX / 2 < CONVERGES * abs(done(ratio).gap) * DX


@pytest.mark.slow
@pytest.mark.parametrize("ratio", RATIOS)
def test_a_box_dropped_in_space_does_as_one_in_plane_strain(ratio: float) -> None:
    box = done(ratio, dimension=3)
    assert box.rise < RISE
    assert box.depth < DEEPEST
    assert set(box.trouble) <= TOLD.get(ratio, set())
    if ratio in REBOUND:
        assert box.up < REBOUND[ratio] * box.impact
        assert box.rms < CALM[ratio]
        assert box.weight == pytest.approx(1, rel=WEIGHT_TOLERANCE)
        assert abs(box.gap) < REST
