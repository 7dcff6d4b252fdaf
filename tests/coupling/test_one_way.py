"""One way: bodies go as if there were no grains, grains as around bodies of any weight, and nothing is solved."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from benchmarks.coupling.scenes import Bed, Steps, run, shifted, trouble
from mpm_env import State, advance, scripted

DX, WIDE = 0.025, 0.1  # m
SPEED = 0.5  # m/s, of the blade, along the bed
STEPS = 50  # rigid steps of 4 ms
HEAVY = 1e7  # kg: the sand takes nothing from it that f32 could tell
LIGHT = 0.5  # kg, of the blade that grains would stop

BY_MUJOCO = 1e-5  # m and m/s
SAME_GRAINS = 1e-4  # cells, until grains part at kinks
SAME_FORCE = 1e-3  # of the largest


@cache
def bed(mass: float, two_way: bool) -> Bed:
    """A blade on a damped, sprung slide with a motor, in the furrow that it stands in."""
    model = f"""<worldbody><body pos=".2 {WIDE / 2} .25">
        <joint name="slide" type="slide" axis="1 0 0" damping="{0.1 * mass}" stiffness="{2 * mass}"/>
        <geom name="blade" type="box" size=".025 {WIDE / 2} .1" mass="{mass}"/></body></worldbody>
      <actuator><motor joint="slide" name="motor" gear="{mass}"/></actuator>"""
    fills = ((0, 0.175, 0, 0.2), (0.225, 0.6, 0, 0.2), (0.175, 0.225, 0, 0.15))
    return Bed(
        model,
        ("blade",),
        (0.6, WIDE, 0.4),
        tuple(((a, 0.0, c), (b, WIDE, d)) for a, b, c, d in fills),
        DX,
        2,
        fidelity={"two_way": two_way},
        bodies={"controls": {"motor": [(0.0, 1.0)]}},
    )


@cache
def ran(mass: float, two_way: bool) -> tuple[State, Steps]:
    scene = bed(mass, two_way).scene()
    return run(scene, shifted(scene, bed(mass, two_way).start(), qvel=np.array([SPEED])), STEPS)


def test_the_blade_goes_as_in_mujoco_without_sand() -> None:
    _, steps = ran(LIGHT, False)
    model = bed(LIGHT, False).scene().bodies.model
    d = mujoco.MjData(model)
    d.qvel[:], d.ctrl[:] = SPEED, 1.0
    path = []
    for _ in range(STEPS):
        mujoco.mj_step(model, d)
        path.append((d.qpos[0], d.qvel[0]))
    np.testing.assert_allclose(np.column_stack([steps.qpos, steps.qvel]), path, atol=BY_MUJOCO)
    assert np.abs(steps.reaction[:, 0, 0]).max() > 10 * LIGHT, "no sand was in its way"  # N
    assert trouble(steps) == []


def test_two_ways_the_sand_stops_it() -> None:
    """Negative control."""
    _, steps = ran(LIGHT, True)
    assert steps.qvel[-1, 0] < SPEED / 5


def test_grains_move_as_around_a_blade_of_infinite_weight() -> None:
    one, two = ran(LIGHT, False), ran(HEAVY, True)
    apart = np.abs(np.asarray(one[0].grains.x) - np.asarray(two[0].grains.x)).max()
    assert apart < SAME_GRAINS * DX
    force = two[1].reaction[:, 0, :3]
    np.testing.assert_allclose(one[1].reaction[:, 0, :3], force, atol=SAME_FORCE * np.abs(force).max())


def primitives(jaxpr: Any, loops: int = 0) -> Iterator[tuple[str, int]]:
    """Names of all operations of a program, with the number of loops that each stands in."""
    for line in jaxpr.eqns:
        yield line.primitive.name, loops
        deeper = loops + (line.primitive.name in ("scan", "while"))
        for inner in jax.tree.leaves(list(line.params.values()), is_leaf=lambda p: hasattr(p, "eqns")):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from primitives(inner, deeper)


@pytest.mark.parametrize("two_way", [True, False])
def test_no_exchange_is_compiled(two_way: bool) -> None:
    """It needs the inverse of a matrix, by LU, in each substep: a loop within that over rigid steps."""
    scene = replace(bed(LIGHT, two_way).scene(), kernels="xla")
    drives = scripted(scene, 0, 1)
    program = jax.make_jaxpr(partial(advance, scene))(bed(LIGHT, two_way).start(), drives)
    assert any(name == "lu" and loops > 1 for name, loops in primitives(program.jaxpr)) == two_way
