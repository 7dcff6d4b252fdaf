"""What sand does to a body hardly depends on how time is cut: rigid steps of 1, 4 or 16 substeps, or of halved ones.

Two scenes in plane strain: a box as dense as sand that falls on a bed, and an arm that presses its paddle into
one. Other schemes hand MJX a force that is a rigid step old, or pay a rigid step's impulse at once: there the number of
substeps changes the answer. Half a second: while an arm moves, MuJoCo's own answer to its motors differs by more (its
speed by a quarter between steps of 4 ms and of 0.25 ms, without any sand).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.coupling import tell_apart as ta
from benchmarks.coupling.drop import drop
from benchmarks.coupling.scenes import Bed, run, trouble

H = 2.5e-4  # s, of a substep: half of what the sound speed allows
SECONDS = 0.5
FALL = 0.05  # m, of the box
# Of the impulse, and of the way, against 16 substeps a rigid step; 0.011 and 0.008, and with half the substep 0.0002
# of the box and 0.064 of the arm observed: each transfer between grains and grid dissipates, twice as many do so more.
ALIKE = {"1": 0.02, "4": 0.02, "half": 0.08}
SCATTER = 0.1 * 0.025  # m, a tenth of a cell: by that a box wanders aside


def dropped() -> Bed:
    """The box above its bed."""
    return drop(2, 0.025, E=1e6, gap=FALL)


def pressing() -> Bed:
    """The arm above its bed, heavy enough to plough."""
    controls = {"shoulder": [(0.0, 0.0), (0.4, 0.6)], "elbow": [(0.0, 0.0), (0.4, -0.3)]}
    return ta.bed(ta.arm(0.5), ("paddle",), (0, 0.6, 0, 0.2), bodies={"controls": controls})


SCENES: dict[str, Callable[[], Bed]] = {"dropped box": dropped, "pressing arm": pressing}
TIMES = {"16": (H, 16), "4": (H, 4), "1": (H, 1), "half": (H / 2, 16)}  # substep, and substeps a rigid step


class Done(NamedTuple):
    """What became of the body."""

    impulse: np.ndarray  # (3,) N s, by the sand, all in all
    moved: np.ndarray  # (nq,) from the start
    trouble: list[str]


@cache
def done(name: str, how: str) -> Done:
    base = SCENES[name]()
    h, substeps = TIMES[how]
    bed = replace(base, rigid_dt=h * substeps, fidelity=base.fidelity | {"mpm_dt": h})
    scene, state = bed.scene(), bed.start()
    assert scene.mpm_per_rigid == substeps
    start = np.asarray(state.rigid.qpos, np.float64)
    count = round(SECONDS / bed.rigid_dt)
    _, steps = run(scene, state, count)
    impulse = steps.reaction[:count, :, :3].sum(axis=(0, 1)) * bed.rigid_dt
    return Done(impulse, steps.qpos[count - 1] - start, trouble(steps))


@pytest.mark.slow
@pytest.mark.parametrize("how", ALIKE)
@pytest.mark.parametrize("name", SCENES)
def test_impulse_and_pose_do_not_depend_on_how_time_is_cut(name: str, how: str) -> None:
    one, other = done(name, "16"), done(name, how)
    assert one.trouble == other.trouble == []
    assert np.linalg.norm(one.impulse) > 1, "they hardly met"  # N s
    assert np.linalg.norm(other.impulse - one.impulse) < ALIKE[how] * np.linalg.norm(one.impulse)
    assert np.linalg.norm(other.moved - one.moved) < ALIKE[how] * np.linalg.norm(one.moved) + SCATTER
