"""Grains and bodies together, in plane strain on small grids: books, balances, and what explicit coupling cannot do.

A scene compiles once. Densities, strengths and speeds differ between tests in the state alone: sand that is denser and
stiffer by one factor is the same sand under a body that is lighter by that factor.
"""

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks.coupling.tell_apart import control, explicit
from mpm_env import sim
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.health import Health, names
from mpm_env.mpm.budgets import budgets
from mpm_env.scene import Scene, State, build, initial
from mpm_env.scene_bodies import Sizes
from mpm_env.scene_config import SceneConfig

DX = 0.025  # m
DT = 0.004  # s, a rigid step
ROWS = 25  # rigid steps of one call, but for the can's
WIDTH = 0.1  # m, of the slice
BOX = (0.6, 0.4)  # m, along x and z
G = 9.81
RHO = 1500.0
SAND = {"model": "sand", "E": 1e6, "nu": 0.3, "rho": RHO, "friction_deg": 35.0}

# The can: 6 kg of sand at 1 m/s in 2 kg at rest, float32.
EXCHANGED_TOLERANCE = 1e-5  # of the impulse exchanged so far; 2e-6 observed
PAID_TOLERANCE = 1e-6  # N s in a step, between the sand's account and the can's: digits of the can's 2 kg m/s; 1e-7
ANGULAR_TOLERANCE = 2e-3  # of the angular impulse exchanged: O(dt), as in MuJoCo; 3e-4 observed
ENERGY_TOLERANCE = 1e-5  # of the energy at the start; it never rose
MERGED_TOLERANCE = 0.01  # m/s of 0.75 after 0.24 s, while the sand still trembles; 1.3e-3 observed

WEIGHT_TOLERANCE = 0.01  # of the box's weight; 3e-4 observed
AFLOAT_TOLERANCE = 0.5  # cells; 0.15 observed
CALM = 0.5  # m/s and rad/s; 0.005 observed
TOLD_TOLERANCE = 1e-4  # cells, after 50 rigid steps; 1.3e-5 observed, and then grains begin to part at kinks
REST_TOLERANCE = 0.03  # of the actuator's torque; 2e-3 observed
JACOBIAN_TOLERANCE = 2e-3  # of the torque: C MuJoCo is asked at the end of the step, the reaction is of its start


def fill(x: tuple[float, float], z: tuple[float, float], speed: float = 0.0) -> dict[str, Any]:
    return {"shape": "box", "lower": (x[0], 0, z[0]), "upper": (x[1], WIDTH, z[1]), "velocity": (speed, 0, 0)}


def scene_of(
    mjcf: str, couple: str, fills: list[dict], *, gravity: float = G, friction: float = 0.4, **bodies: Any
) -> Scene:
    config = {
        "name": "small",
        "box": {"lower": (0, 0, 0), "upper": (BOX[0], WIDTH, BOX[1])},
        "feature": 4 * DX,
        "duration": 1.0,
        "gravity": (0, 0, -gravity),
        "grains": [{"material": SAND, "fill": fills}],
        "bodies": {"mjcf": f"<mujoco>{mjcf}</mujoco>", "couple": [couple], "friction": friction, **bodies},
    }
    return build(parse(SceneConfig, config, "test"), Fidelity(dimension=2, cells=4, rigid_dt=DT))


@cache
def buried() -> Scene:
    """A free box in sand, its top flush with the surface and as dense as the sand."""
    return scene_of(
        f"""<worldbody><body pos=".3 {WIDTH / 2} .15"><freejoint/>
          <geom name="box" type="box" size=".1 {WIDTH / 2} .05" density="{RHO}"/></body></worldbody>""",
        "box",
        [fill((0, 0.2), (0, 0.2)), fill((0.4, 0.6), (0, 0.2)), fill((0.2, 0.4), (0, 0.1))],
    )


@cache
def can() -> Scene:
    """A free can full of sand that flies through it, without gravity and far from the walls."""
    sides = (("left", -0.125, 0), ("right", 0.125, 0)), (("low", 0, -0.125), ("high", 0, 0.125))
    sizes = f".025 {WIDTH / 2} .15", f".1 {WIDTH / 2} .025"
    walls = [
        f'<geom name="{name}" type="box" pos="{x} 0 {z}" size="{size}" mass=".5"/>'
        for pair, size in zip(sides, sizes, strict=True)
        for name, x, z in pair
    ]
    return scene_of(
        f'<worldbody><body pos=".2 {WIDTH / 2} .2"><freejoint/>{"".join(walls)}</body></worldbody>',
        "*",
        [fill((0.1, 0.3), (0.1, 0.3), speed=1.0)],
        gravity=0.0,
        friction=2.0,
    )


SPEED = 0.3  # m/s, of the blades
BLADE = f'<geom name="blade" type="box" size=".025 {WIDTH / 2} .1" mass="1e9"/>'
FURROW = [fill((0, 0.175), (0, 0.2)), fill((0.225, 0.6), (0, 0.2)), fill((0.175, 0.225), (0, 0.15))]


@cache
def told() -> Scene:
    """A blade on a mocap body, driven through a bed."""
    return scene_of(
        f'<worldbody><body name="tool" mocap="true" pos=".2 {WIDTH / 2} .25">{BLADE}</body></worldbody>',
        "blade",
        FURROW,
        motion={"tool": [{"t": t, "position": (0.2 + SPEED * t, WIDTH / 2, 0.25)} for t in (0.0, 1.0)]},
    )


@cache
def weighty() -> Scene:
    """The same blade on a slide, so heavy that the sand cannot slow it."""
    slide = '<joint type="slide" axis="1 0 0"/>'
    return scene_of(
        f'<worldbody><body pos=".2 {WIDTH / 2} .25">{slide}{BLADE}</body></worldbody>',
        "blade",
        FURROW,
    )


@cache
def arm() -> Scene:
    """An arm of two links over a bed, told to press its paddle into it."""
    return scene_of(
        f"""<worldbody><body pos=".1 {WIDTH / 2} .35"><joint name="shoulder" axis="0 1 0" damping="2" armature=".01"/>
          <geom type="capsule" size=".01" fromto="0 0 0 .2 0 0" mass=".3"/>
          <body pos=".2 0 0"><joint name="elbow" axis="0 1 0" damping="1"/>
            <geom name="paddle" type="box" size=".025 {WIDTH / 2} .05" pos="0 0 -.05" mass=".5"/></body>
        </body></worldbody>
        <actuator><position name="shoulder" joint="shoulder" kp="60"/>
          <position name="elbow" joint="elbow" kp="60"/></actuator>""",
        "paddle",
        [fill((0, 0.6), (0, 0.2))],
        controls={"shoulder": [(0.0, 0.0), (0.3, 0.6)], "elbow": [(0.0, 0.0), (0.3, -0.3)]},
    )


@cache
def started(scene: Scene) -> State:
    return jax.jit(partial(initial, scene))(jax.random.key(0))


@cache
def program(scene: Scene) -> Any:
    return jax.jit(partial(sim.advance, scene))


def run(scene: Scene, state: State, calls: int, rows: int = ROWS) -> tuple[list[State], np.ndarray]:
    """So many calls of the scene's program: the state after each, and all reactions (steps, G, 6)."""
    states, reactions = [], []
    for _ in range(calls):
        state, reaction = program(scene)(state, sim.scripted(scene, int(state.steps), rows))
        states.append(state)
        reactions.append(np.asarray(reaction, np.float64))
    return states, np.concatenate(reactions)


def with_sand(state: State, *, ratio: float, friction_deg: float | None = None) -> State:
    """The state with sand whose density is that of the box over this ratio, and as much stiffer."""
    (sand,) = state.materials
    sand = replace(sand, rho=sand.rho / ratio, E=sand.E / ratio)
    if friction_deg is not None:
        sand = replace(sand, friction=jnp.full_like(sand.friction, np.radians(friction_deg)))
    return replace(state, materials=(sand,), grains=replace(state.grains, m=state.grains.m / ratio))


def moving(state: State, qvel: list[float]) -> State:
    return replace(state, rigid=state.rigid.replace(qvel=jnp.asarray(qvel, jnp.float32)))


def fastest(states: list[State]) -> float:
    return max(float(np.abs(s.rigid.qvel).max()) for s in states)


class Books(NamedTuple):
    """Momentum along x and z, angular momentum about y and the origin, and energy; float64."""

    grains: np.ndarray  # (2,) N s
    body: np.ndarray  # (2,)
    grains_turning: float  # N m s
    body_turning: float
    energy: float  # J


@cache
def energy_of_grains(scene: Scene) -> Any:
    def energy(state: State) -> jax.Array:
        kept = budgets(scene.grid, scene.beds(state.materials), state.grains, jnp.zeros(2))
        return kept.kinetic + kept.elastic

    return jax.jit(energy)


def books(scene: Scene, state: State) -> Books:
    """The can's accounts; its frame is at its centre of mass."""
    model, g = scene.bodies.model, state.grains
    m, v, C, x = (np.asarray(a, np.float64) for a in (g.m, g.v, g.C, scene.world(g.x)))
    affine = DX**2 / 4 * np.sum(m * (C[0, 1] - C[1, 0]))
    q, w = (np.asarray(a, np.float64) for a in (state.rigid.qpos, state.rigid.qvel))
    mass, axes = model.body_mass[1], np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[1])
    inertia = (axes.reshape(3, 3) @ np.diag(model.body_inertia[1]) @ axes.reshape(3, 3).T)[1, 1]
    kinetic = (mass * w[:3] @ w[:3] + inertia * w[4] ** 2) / 2
    return Books(
        grains=v @ m,
        body=mass * w[[0, 2]],
        grains_turning=float(np.sum(m * (x[2] * v[0] - x[0] * v[1])) + affine),
        body_turning=float(mass * (q[2] * w[0] - q[0] * w[2]) + inertia * w[4]),
        energy=float(energy_of_grains(scene)(state)) + float(kinetic),
    )


@cache
def flight() -> tuple[list[State], np.ndarray, list[Books]]:
    """The can's first 0.24 s, turning at 3 rad/s at the start: its states, reactions and books, the start's first."""
    state = moving(started(can()), [0, 0, -0.2, 0, 3, 0])
    states, reactions = run(can(), state, 60, rows=1)
    states = [state, *states]
    return states, reactions, [books(can(), s) for s in states]


def test_sand_and_the_can_around_it_keep_momentum() -> None:
    kept = flight()[2]
    total = np.array([b.grains + b.body for b in kept])
    exchanged = np.cumsum(np.abs(np.diff([b.body for b in kept], axis=0)).sum(axis=1))
    assert exchanged[-1] > 2, "they hardly met"
    assert np.all(np.abs(total[1:] - total[0]).sum(axis=1) < EXCHANGED_TOLERANCE * exchanged)


def test_each_step_pays_the_can_what_its_reactions_say() -> None:
    _, reactions, kept = flight()
    paid = reactions[:, :, [0, 2]].sum(axis=1) * DT
    np.testing.assert_allclose(paid, np.diff([b.body for b in kept], axis=0), rtol=0, atol=PAID_TOLERANCE)


def test_sand_and_the_can_around_it_keep_angular_momentum() -> None:
    kept = flight()[2]
    total = np.array([b.grains_turning + b.body_turning for b in kept])
    exchanged = np.cumsum(np.abs(np.diff([b.body_turning for b in kept])))
    assert exchanged[-1] > 0.2, "they hardly turned each other"
    assert np.all(np.abs(total[1:] - total[0]) < ANGULAR_TOLERANCE * exchanged)


def test_sand_and_the_can_around_it_only_lose_energy() -> None:
    states, _, kept = flight()
    energy = np.array([b.energy for b in kept])
    assert np.diff(energy).max() < ENERGY_TOLERANCE * energy[0]
    assert energy[-1] < 0.8 * energy[0], "nothing was lost in the collision"
    assert int(states[-1].health) == Health.WELL


def test_sand_and_the_can_around_it_end_with_their_common_velocity() -> None:
    first, last = flight()[2][0], flight()[2][-1]
    masses = float(np.sum(started(can()).grains.m)), can().bodies.model.body_mass[1]
    common = (first.grains + first.body) / sum(masses)
    assert common[0] == pytest.approx(0.75, rel=1e-6)
    np.testing.assert_allclose(last.grains / masses[0], common, atol=MERGED_TOLERANCE)
    np.testing.assert_allclose(last.body / masses[1], common, atol=MERGED_TOLERANCE)


@pytest.mark.parametrize("ratio", [0.25, 2.0])
def test_a_box_at_rest_in_sand_weighs_what_it_weighs(ratio: float) -> None:
    weight = buried().bodies.model.body_mass[1] * G
    states, reaction = run(buried(), with_sand(started(buried()), ratio=ratio), 10)
    assert reaction[-150:, 0, 2].mean() == pytest.approx(weight, rel=WEIGHT_TOLERANCE)
    assert int(states[-1].health) == Health.WELL


@pytest.mark.parametrize("ratio", [0.25, 0.5, 1.0])
def test_a_box_in_frictionless_sand_floats_as_archimedes_says(ratio: float) -> None:
    states, _ = run(buried(), with_sand(started(buried()), ratio=ratio, friction_deg=0.0), 16)
    across, high = 0.2, 0.1  # m, of the box
    sand = BOX[0] * 0.2 - across * high  # m^2 of slice, and the draught displaces ratio * high more
    surface = (sand + across * ratio * high) / BOX[0]
    height = float(states[-1].rigid.qpos[2])
    assert abs(height - (surface - ratio * high + high / 2)) < AFLOAT_TOLERANCE * DX
    assert int(states[-1].health) == Health.WELL


def light() -> State:
    """The buried box as light as foam."""
    return with_sand(started(buried()), ratio=0.01)


def test_a_light_box_lies_still_in_sand() -> None:
    states, _ = run(buried(), light(), 3)
    assert fastest(states) < CALM
    assert int(states[-1].health) == Health.WELL


def test_explicit_contact_would_throw_the_light_box_out() -> None:
    """Negative control: the same scene, law and momentum, but impulses at the velocity without contact."""
    scene = replace(buried(), kernels="xla")
    with control(explicit):
        thrown, _ = jax.jit(partial(sim.advance, scene))(light(), sim.scripted(scene, 0, ROWS))
    assert not fastest([thrown]) < 100 * CALM  # or not a number


def test_a_body_too_heavy_to_slow_moves_grains_as_one_that_is_told() -> None:
    mocap, _ = run(told(), started(told()), 2)
    slide, _ = run(weighty(), moving(started(weighty()), [SPEED]), 2)
    apart = np.abs(np.asarray(mocap[-1].grains.x) - np.asarray(slide[-1].grains.x))
    assert apart.max() < TOLD_TOLERANCE * DX
    moved = np.abs(np.asarray(mocap[-1].grains.x) - np.asarray(started(told()).grains.x))
    assert moved.max() > DX, "no grain was moved"
    assert int(mocap[-1].health) == int(slide[-1].health) == Health.WELL


def test_an_arm_pressing_into_sand_comes_to_rest_where_torques_balance() -> None:
    states, reaction = run(arm(), started(arm()), 8)
    d, model, body = states[-1].rigid, arm().bodies.model, arm().bodies.bodies[0]
    oracle = mujoco.MjData(model)
    oracle.qpos[:], oracle.qvel[:], oracle.ctrl[:] = d.qpos, d.qvel, d.ctrl
    mujoco.mj_forward(model, oracle)
    from_sand = np.asarray(d.qfrc_applied)
    size = np.abs(oracle.qfrc_actuator).max()
    assert np.abs(from_sand).max() > 10, "it presses on nothing"  # N m
    balance = oracle.qfrc_actuator + oracle.qfrc_passive - oracle.qfrc_bias + from_sand
    np.testing.assert_allclose(balance, 0, atol=REST_TOLERANCE * size)
    jacp, jacr = np.zeros((3, 2)), np.zeros((3, 2))
    mujoco.mj_jac(model, oracle, jacp, jacr, oracle.xipos[body], body)
    by_jacobian = jacp.T @ reaction[-1, 0, :3] + jacr.T @ reaction[-1, 0, 3:]
    np.testing.assert_allclose(by_jacobian, from_sand, atol=JACOBIAN_TOLERANCE * size)
    assert int(states[-1].health) == Health.WELL


def test_buffers_too_small_for_the_points_near_a_body_are_reported() -> None:
    states, _ = run(replace(told(), sizes=Sizes(nodes=2, grains=2)), started(told()), 1)
    assert {Health.NODES_OVERFLOW.name, Health.GRAINS_OVERFLOW.name} <= set(names(int(states[-1].health)))


def test_grains_deep_inside_a_body_are_reported_and_put_out() -> None:
    state = started(told())
    at = jnp.asarray([0.2, 0.25], jnp.float32) - jnp.asarray(told().grid.origin, jnp.float32)
    state = replace(state, grains=replace(state.grains, x=state.grains.x.at[:, 0].set(at)))
    states, _ = run(told(), state, 1)
    assert names(int(states[-1].health))[0] == Health.TOO_DEEP.name
    x, z = np.asarray(told().world(states[-1].grains.x))[[0, 2], 0]
    tool = 0.2 + SPEED * ROWS * DT
    assert max(abs(x - tool) - 0.025, abs(z - 0.25) - 0.1) > -1e-3


def test_a_body_that_jumps_over_cells_is_reported() -> None:
    state = moving(started(weighty()), [2 * DX / DT])
    states, _ = run(weighty(), state, 1)
    assert names(int(states[-1].health)).count(Health.BODY_TOO_FAST.name) == 1


def test_contact_that_is_not_solved_is_reported_and_still_calm() -> None:
    """A box 1e5 times lighter than the sand, kicked: too much for the iterations of this fidelity."""
    state = moving(with_sand(started(buried()), ratio=1e-5), [3, 0, -2, 0, 30, 0])
    states, _ = run(buried(), state, 2)
    assert names(int(states[-1].health)) == [Health.NOT_CONVERGED.name]
    assert fastest(states) < CALM


def test_the_same_start_gives_the_same_run_to_the_bit() -> None:
    (once,), (again,) = (run(can(), moving(started(can()), [0, 0, -0.2, 0, 3, 0]), 1, rows=1)[0] for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, once, again)
    jax.tree.map(np.testing.assert_array_equal, once, flight()[0][1])


def test_a_map_over_copies_gives_the_single_run_to_the_bit() -> None:
    scene = told()
    copies = jax.tree.map(lambda a: jnp.stack([a, a]), started(scene))
    drives = sim.scripted(scene, 0, ROWS)
    mapped = jax.jit(lambda s: jax.lax.map(lambda one: sim.advance(scene, one, drives)[0], s))(copies)
    single = run(scene, started(scene), 1)[0][0]
    for k in range(2):
        jax.tree.map(lambda a, b, k=k: np.testing.assert_array_equal(a[k], b), mapped, single)


def test_a_scene_compiles_once() -> None:
    run(told(), started(told()), 2)
    assert program(told())._cache_size() == 1
