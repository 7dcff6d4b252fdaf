"""The scenes that tell coupling schemes apart: ours is calm in all of them, explicit ones are not."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from benchmarks.coupling import tell_apart as ta
from benchmarks.coupling.beds import RHO, G, lighter
from benchmarks.coupling.scenes import run

STEPS = 250  # rigid steps, a second
CALM = 0.5  # m/s or rad/s of what is not told to move; 0.26 observed, while sand falls against the gate
TOLD = 4.0  # rad/s of the arm, which is told to move by 2; 2.5 observed, as it meets the sand
# A substep as sand first hits the gate may stay unsolved, and is told; at the wall only in the f32 sums of plain XLA.
UNSOLVED = {"at the limit": {"NOT_CONVERGED"}, "at the wall": {"NOT_CONVERGED"}}
NOISE = 0.1  # of the mean force; 0.04 observed, under the buried box
AGREEMENT = 0.01  # cells that MJX's step may end apart from where the grains saw it; 1.3e-3 observed, at the wall
UNPAID = 1e-6  # of the exchanged impulse, float32; 5e-8 observed
WEIGHT_TOLERANCE = 0.05  # of the weight of the sand above; walls carry some of it
HANGING = 2.0  # times the sand above; 1.5 observed
WILD = 10.0  # times as fast as calm: what explicit schemes do


@cache
def held(name: str) -> ta.Held:
    return ta.told_apart(name, None, STEPS)


each_scene = pytest.mark.parametrize("name", ta.SCENES)


@each_scene
def test_light_bodies_held_by_sand_move_calmly(name: str) -> None:
    assert held(name).fastest < (TOLD if name == "light arm" else CALM)
    assert set(held(name).trouble) <= UNSOLVED.get(name, set())


@each_scene
def test_the_force_on_light_bodies_is_steady(name: str) -> None:
    assert held(name).force > 1, "nothing holds it"
    assert held(name).noise < NOISE


@each_scene
def test_bodies_end_a_step_where_the_grains_saw_them_go(name: str) -> None:
    """Also where a wall, a floor or a joint's limit answers the sand: MJX and the substeps solve one equation."""
    assert held(name).astray < AGREEMENT


@each_scene
def test_grains_and_bodies_get_opposite_impulses(name: str) -> None:
    assert held(name).unpaid < UNPAID


def test_a_foam_box_on_a_floor_carries_the_sand_above_it() -> None:
    """And more: it does not give way as the sand beside it does, which hangs on to what is above the box."""
    above = 0.2 * 0.1 * ta.WIDE * RHO * G / ta.SCENES["on the floor"][1]
    assert above < held("on the floor").force < HANGING * above


@pytest.mark.parametrize("ratio", [0.001, 0.1, 1.0])
def test_a_buried_box_of_any_density_lies_still_and_weighs_what_it_weighs(ratio: float) -> None:
    scene = ta.buried().scene()
    _, steps = run(scene, lighter(ta.buried().start(), ratio), STEPS)
    weight = scene.bodies.model.body_mass[1] * G
    assert np.abs(steps.qvel).max() < CALM
    assert steps.reaction[-100:, 0, 2].mean() == pytest.approx(weight, rel=WEIGHT_TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "scheme"),
    [
        ("buried", ta.explicit),
        ("at the wall", ta.explicit),
        ("on the floor", ta.explicit),
        ("buried", ta.staggered),
        ("at the wall", ta.staggered),
        ("on the floor", ta.staggered),
        ("light arm", ta.staggered),
    ],
)
def test_explicit_schemes_throw_light_bodies_about(name: str, scheme: Callable) -> None:
    """Negative controls: impulses by the same law at the velocity without contact, paid at once or after the step.

    Paid at once they do hold the squeezing boxes and the arm: their motors and joints weigh enough.
    """
    fastest = ta.told_apart(name, scheme, 100).fastest
    assert not fastest < WILD * (TOLD if name == "light arm" else CALM)  # also what is not a number; 218 and more seen
