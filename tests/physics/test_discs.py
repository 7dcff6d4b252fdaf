"""Two elastic discs meet and part; a disc that spins keeps its volume."""

import pytest

from benchmarks.validation.discs import GROWTH, REBOUND, SECONDS_SPUN, SPUN, TOUCH, Meeting, meet, spin

CELLS = 40
STAND_OFF = (0.8, 2.0)  # cells: windows of 1.5 cells to each side meet before edges do; 1.5 observed
REBOUNDS = 0.04  # what another law and another way to fill a disc may change; 0.012 observed
MOMENTUM = 1e-11  # f64; 1e-15 observed
RISE = 1e-12  # of all energy: none, with velocities taken between two positions; 1e-15 observed
SPINS = 0.1  # of the growth: the disc is a lattice cut out; 0.034 observed


@pytest.fixture(scope="module")
def two() -> Meeting:
    return meet(CELLS)


def test_discs_meet_a_cell_or_two_before_their_edges_do(two: Meeting) -> None:
    assert pytest.approx(1.58579, abs=5e-6) == TOUCH
    assert STAND_OFF[0] < two.stand_off < STAND_OFF[1]
    fewer = meet(CELLS // 2)
    assert fewer.stand_off / CELLS < 2 * two.stand_off / CELLS < 2 * fewer.stand_off / CELLS, "it shrinks with cells"


def test_discs_rebound_as_elsewhere_and_less_without_affine_transfers(two: Meeting) -> None:
    assert abs(two.rebound - REBOUND[CELLS]) < REBOUNDS
    assert abs(meet(CELLS, affine=0).rebound - REBOUND[CELLS]) > 2 * REBOUNDS


def test_energy_of_discs_never_rises_and_momentum_stays(two: Meeting) -> None:
    assert two.rise < RISE
    assert two.momentum < MOMENTUM
    assert two.kinetic.min() < 0.1, "they have met"


@pytest.mark.parametrize("name", SPUN)
def test_spinning_disc_grows_by_its_centrifugal_stress_alone(name: str) -> None:
    """16 turns, and 32. Without affine transfers it stops, and so would not have grown."""
    for seconds in (SECONDS_SPUN, 2 * SECONDS_SPUN):
        turned = spin(name, seconds)
        assert turned.growth == pytest.approx(GROWTH, rel=SPINS)
        assert turned.turns == pytest.approx(1, abs=1e-3)
    assert abs(spin(name, SECONDS_SPUN, affine=0).growth) < (1 - SPINS) * GROWTH
