"""The numbers of a run against closed forms and sums over space."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mpm_env.cli import report
from mpm_env.fidelity import Fidelity
from mpm_env.ledger import Ledger
from mpm_env.scene import Scene, build, initial
from mpm_env.scene_config import BodiesConfig
from mpm_env.view import View, body_data
from tests.unit.slices import F32, NUMERICS, SAND, slice_of_sand


def thrown(dimension: int) -> tuple[Scene, Any]:
    """A block of sand thrown and turning, off the world's origin, before any step."""
    fill = {"shape": "box", "lower": [0.1, 0.05, 0.05], "upper": [0.2, 0.15, 0.15], "velocity": [0.3, 0.0, -0.2]}
    config = slice_of_sand(bodies=False, plane_strain=dimension == 2, grains=[{"material": SAND, "fill": [fill]}])
    config = config.model_copy(update={"box": config.box.model_copy(update={"lower": (-0.2, 0.0, -0.1)})})
    built = build(config, Fidelity(cells=4, dimension=dimension))
    state = initial(built, jax.random.key(0))
    spin = 5.0  # rad/s about +y
    x, z = state.grains.x[0] + built.grid.origin[0], state.grains.x[-1] + built.grid.origin[-1]
    there = state.grains.m > 0
    v = state.grains.v.at[0].add(jnp.where(there, spin * z, 0)).at[-1].add(jnp.where(there, -spin * x, 0))
    C = state.grains.C.at[0, -1].set(spin).at[-1, 0].set(-spin)
    return built, replace(state, grains=replace(state.grains, v=v, C=jnp.where(there, C, 0)))


@pytest.mark.parametrize("dimension", [2, 3])
def test_ledger_of_grains_agrees_with_sums_over_space(dimension: int) -> None:
    built, state = thrown(dimension)
    ledger = Ledger(built)
    view = View.of(built, state)
    ledger.note(state, view, np.zeros((1, 0, 6)))
    row = {k: v[0] for k, v in ledger.frames.items()}
    m = np.asarray(state.grains.m, float)[view.slots, None]
    v = np.zeros((len(m), 3))
    v[:, [0, 2] if dimension == 2 else [0, 1, 2]] = np.asarray(state.grains.v, float).T[view.slots]
    x = view.grains.astype(float)
    inertia = float(m.sum()) * built.grid.cell_size**2 / 4  # of the affine part, per axis
    assert row["mass"] == pytest.approx(1600 * 0.1 * 0.1 * 0.1, rel=F32)
    assert row["momentum"] == pytest.approx((m * v).sum(0), abs=F32)
    turning = (m * np.cross(x, v)).sum(0) + np.array([0, 2 * 5.0 * inertia, 0])
    assert row["angular_momentum"] == pytest.approx(turning, abs=F32)
    assert row["kinetic"] == pytest.approx(0.5 * (m * v**2).sum() + 0.5 * 2 * 25.0 * inertia, rel=F32)
    assert row["potential"] == pytest.approx(9.81 * (m[:, 0] * x[:, 2]).sum(), rel=F32)
    assert row["elastic"] == pytest.approx(0, abs=1e-9)


def test_mass_there_and_mass_gone_make_up_the_start_exactly() -> None:
    """Grains of two masses leave; sums in f32 would be off in their last digits."""
    built, state = thrown(3)
    m = state.grains.m.at[::3].multiply(0.7)
    state = replace(state, grains=replace(state.grains, m=m))
    gone = replace(state, grains=replace(state.grains, m=m.at[::7].set(0)))
    ledger = Ledger(built)
    for s in (state, gone):
        ledger.note(s, View.of(built, s), np.zeros((1, 0, 6)))
    mass, left = ledger.frames["mass"], ledger.frames["mass_left"]
    assert left[0] == 0 and left[1] == np.asarray(m, float)[::7].sum() > 0
    assert mass[1] + left[1] == mass[0] == np.asarray(m, float).sum()


def test_ledger_of_bodies_agrees_with_a_rigid_body() -> None:
    mjcf = '<mujoco><worldbody><body name="b" pos=".2 .1 .15"><freejoint/><geom name="g" type="box" size=".04 .03 .02"'
    mjcf += ' mass="2"/></body></worldbody></mujoco>'
    coupled = BodiesConfig(mjcf=mjcf, couple=["g"])
    built = build(slice_of_sand(bodies=False, grains=[]).model_copy(update={"bodies": coupled}), NUMERICS)
    state = initial(built, jax.random.key(0))
    v, w = np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, -3.0])
    state = replace(state, rigid=state.rigid.replace(qvel=jnp.asarray([*v, *w])))
    ledger = Ledger(built)
    ledger.note(state, View.of(built, state), np.zeros((1, 1, 6)))
    row = {k: v[0] for k, v in ledger.frames.items()}
    inertia = 2 / 3 * np.array([0.03**2 + 0.02**2, 0.04**2 + 0.02**2, 0.04**2 + 0.03**2])
    assert row["bodies_momentum"] == pytest.approx(2 * v, rel=F32)
    assert row["bodies_angular_momentum"] == pytest.approx(np.cross([0.2, 0.1, 0.15], 2 * v) + inertia * w, rel=F32)
    assert row["bodies_kinetic"] == pytest.approx(v @ v + 0.5 * (inertia * w) @ w, rel=F32)
    assert row["bodies_potential"] == pytest.approx(2 * 9.81 * 0.15, rel=F32)
    assert row["body_twist"][1] == pytest.approx([*v, *w], rel=F32)


def test_view_of_bodies_has_their_poses() -> None:
    built = build(slice_of_sand(bodies=True), NUMERICS)
    data = body_data(built, initial(built, jax.random.key(0)))
    assert isinstance(data, mujoco.MjData) and built.bodies is not None
    assert data.body("hand").xpos == pytest.approx([0.08, 0.1, 0.09])
    assert body_data(build(slice_of_sand(bodies=False), NUMERICS), None) is None  # type: ignore[arg-type]


# Snow: what its hardening has come to.

SNOW = {"model": "snow", "E": 1.4e5, "nu": 0.2, "rho": 400.0, "theta_c": 2.5e-2, "theta_s": 7.5e-3, "xi": 10.0}


def packed(Jp_min: float, J_P: float) -> dict[str, Any]:
    """The figures of a bed of snow, one grain of which is packed to J_P."""
    fill = [{"shape": "box", "lower": [0.1, 0.0, 0.0], "upper": [0.2, 0.2, 0.1]}]
    grains = [{"material": SAND, "fill": [{**fill[0], "lower": [0.2, 0, 0], "upper": [0.3, 0.2, 0.1]}]}]
    grains.append({"material": {**SNOW, "Jp_min": Jp_min}, "fill": fill})
    built = build(slice_of_sand(bodies=False, grains=grains), NUMERICS)
    state = initial(built, jax.random.key(0))
    history = state.grains.history.at[0, built.spans[1][0]].set(np.log(J_P))
    state = replace(state, grains=replace(state.grains, history=history))
    ledger, view = Ledger(built), View.of(built, state)
    ledger.note(state, view, np.zeros((1, 0, 6)))
    ledger.snapshot(state, view)
    arrays = ledger.arrays()
    assert arrays["J_P"].shape == (1, 1, 2)
    assert arrays["snapshot_history"][0].tobytes() == np.asarray(history).tobytes()
    return ledger.figures()


def test_figures_say_how_far_snow_was_packed() -> None:
    (snow,) = packed(0.8, 0.7)["snow"]
    assert snow == {"J_P_least": pytest.approx(0.7, rel=F32), "J_P_greatest": 1.0, "Jp_min": 0.8}


@pytest.mark.parametrize(("J_P", "capped"), [(0.7, True), (0.85, False)])
def test_report_says_where_snow_hardened_to_its_cap(J_P: float, capped: bool) -> None:
    numerics = {"grains": 1, "cell_size_m": 0.01, "mpm_dt_s": 1e-4, "kernels": "xla"}
    wall = dict.fromkeys(("build", "compile", "run", "log", "picture", "total"), 0.0)
    summary = {"scene": "snow", "ended": "complete", "numerics": numerics, "wall_s": wall}
    said = "\n".join(report({**summary, "health": {"sentences": []}, "figures": packed(0.8, J_P)}))
    assert ("J_P = 0.7, below its Jp_min = 0.8" in said) == capped
