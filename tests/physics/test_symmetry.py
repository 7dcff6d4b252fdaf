"""What a scene does hangs neither on which way nor on where it lies."""

import numpy as np
import pytest

from benchmarks.validation.symmetry import CHANGES, FAR, carried, changed, collapsed, far

ROUNDING = {"float64": 1e-11, "float32": 1e-3}  # cells, 400 substeps; 1e-13 and 1e-4 observed
STEP = 1e-13  # of the frame's speed, f64; 7e-16 observed
GRID = 1e-3  # m, of a block 1 m wide that passed 1.4 cells; 3e-5 observed


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("name", CHANGES)
def test_changed_column_collapses_as_it_did(name: str, dtype: str) -> None:
    assert changed(name, dtype) < ROUNDING[dtype]


def test_a_shift_by_half_a_cell_is_told_apart() -> None:
    """The control: the grid's places matter, so only whole cells are a symmetry."""
    half = np.array([[0.5], [0.0]])
    off = collapsed(lambda x: x + half, "float64") - half - collapsed(lambda x: x, "float64")
    assert np.abs(off).max() > 10 * ROUNDING["float32"]  # 0.04 observed


def test_block_turns_as_it_does_in_a_frame_that_moves() -> None:
    assert carried(1)[0] < STEP
    assert carried(100)[1] < GRID


def test_scene_far_from_the_origin_is_the_same_to_the_bit() -> None:
    assert far(FAR) == 0
