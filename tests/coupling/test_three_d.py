"""Grains and a free box together in 3-D: the books of momentum and angular momentum, and a weight.

One small scene, compiled once: a box on a bed. The toss cuts a block out of that bed, with the box on it, and throws
both against each other in the air, far from all walls.
"""

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from coupling import bodies as rigid
from mpm_env import sim
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.health import Health
from mpm_env.scene import Scene, State, build, initial
from mpm_env.scene_config import SceneConfig
from mpm_env.wrench import wrench_at

DX = 0.05  # m
DT = 0.004  # s, a rigid step
G = 9.81
RHO = 1500.0
SIDE, HEIGHT = 0.5, 0.6  # m, of the box that is simulated
DEPTH = 0.2  # m, of the bed
HALF = 0.1, 0.1, 0.05  # m, of the free box: flat, so that it does not tip on the few nodes under it
SENSOR = 0.2, 0.1, 0.05  # m, of a site from the middle of the box
SAND = {"model": "sand", "E": 1e6, "nu": 0.3, "rho": RHO, "friction_deg": 35.0}

LIFT = 4 * DX  # m, from the bed to where the toss starts
BLOCK = 3 * DX  # m, half the width of the block that is tossed
TOSS = 15  # rigid steps: no sand has come near a wall
RATIO = 4.0  # of the box's density to the tossed sand's
THROWN = np.array([0.1, 0, 0.9])  # m/s, the block
DROPPED = np.array([-0.2, 0.1, -0.6])  # m/s, the box
SPIN = np.array([2.0, -1.0, 3.0])  # rad/s, of the box about its own axes

REST, MEAN = 150, 75  # rigid steps on the bed, and the last of them that are averaged

EXCHANGED_TOLERANCE = {"f32": 1e-5, "f64": 1e-11}  # of the impulse exchanged so far; 3e-7 observed in f32
PAID_TOLERANCE = {"f32": 1e-5, "f64": 1e-11}  # of the step's impulse; 1e-6 observed in f32 while they collide
PAID_DIGITS = {"f32": 5e-7, "f64": 1e-13}  # N s: the last digits of the box's 3.6 N s; 1.4e-7 observed in f32
TURNING_DIGITS = 1e-4  # N m s, before they meet: the box's free turning by a step's end; 6e-5 observed
# Of the angular impulse exchanged. As in MuJoCo, a step's torque and inertia are those of its start, while the box
# turns on by this angle: O(dt). Half of it observed.
ANGULAR_TOLERANCE = DT * float(np.linalg.norm(SPIN))
WEIGHT_TOLERANCE = 0.01  # of the box's weight; 6e-4 observed
CALM = 1e-3  # m/s and rad/s; 1.4e-4 observed
REACH = 1.5 * DX  # m from a grain to the farthest node that it feels


@cache
def scene(precision: str = "f32") -> Scene:
    """A free box, as dense as the sand, on a level bed."""
    middle = SIDE / 2
    config = {
        "name": "small",
        "box": {"lower": (0, 0, 0), "upper": (SIDE, SIDE, HEIGHT)},
        "feature": 4 * DX,
        "duration": 1.0,
        "gravity": (0, 0, -G),
        "grains": [{"material": SAND, "fill": [{"shape": "box", "lower": (0, 0, 0), "upper": (SIDE, SIDE, DEPTH)}]}],
        "bodies": {
            "mjcf": f"""<mujoco><worldbody><body pos="{middle} {middle} {DEPTH + HALF[2]}"><freejoint/>
              <geom name="box" type="box" size="{HALF[0]} {HALF[1]} {HALF[2]}" density="{RHO}"/>
              <site name="sensor" pos="{" ".join(map(str, SENSOR))}" euler="0 0 90"/></body></worldbody></mujoco>""",
            "couple": ["box"],
            "friction": 0.4,
        },
    }
    return build(parse(SceneConfig, config, "test"), Fidelity(cells=4, rigid_dt=DT, precision=precision))


@cache
def started(precision: str = "f32") -> State:
    state = jax.jit(partial(initial, scene(precision)))(jax.random.key(0))
    return jax.device_put(state, jax.devices()[0])  # where a step leaves it, so that the first one compiles no twin


@cache
def program(precision: str = "f32") -> Any:
    return jax.jit(partial(sim.advance, scene(precision)))


def tossed(scene: Scene, state: State) -> State:
    """The block under the box, thrown up from above the bed, and the box thrown down onto it, aside and turning."""
    (sand,) = state.materials
    sand = replace(sand, rho=sand.rho / RATIO, E=sand.E / RATIO)
    dtype = state.grains.x.dtype
    x = state.grains.x + jnp.asarray([[0], [0], [LIFT]], dtype)
    across = jnp.abs(scene.world(x)[:2] - SIDE / 2)
    m = jnp.where(jnp.all(across < BLOCK, axis=0), state.grains.m / RATIO, 0)
    v = jnp.where(m > 0, jnp.asarray(THROWN, dtype)[:, None], 0)
    at = state.rigid.qpos.at[:3].add(jnp.asarray([0.03, -0.02, LIFT + 0.01], dtype))
    d = state.rigid.replace(qpos=at, qvel=jnp.asarray([*DROPPED, *SPIN], dtype))
    d = rigid.refresh(scene.bodies, d)
    return replace(state, rigid=d, materials=(sand,), grains=replace(state.grains, x=x, v=v, m=m))


class Books(NamedTuple):
    """Momentum, and angular momentum as seen from the common centre of mass, where gravity turns nothing; float64."""

    grains: np.ndarray  # (3,) N s
    body: np.ndarray  # (3,)
    body_turning: np.ndarray  # (3,) N m s, of the box
    turning: np.ndarray  # (3,) of both


def books(state: State) -> Books:
    model, g, d = scene().bodies.model, state.grains, state.rigid
    m, v, C, x = (np.asarray(a, np.float64) for a in (g.m, g.v, g.C, scene().world(g.x)))
    at, w = np.asarray(d.xipos[1], np.float64), np.asarray(d.qvel, np.float64)
    mass = model.body_mass[1]
    centre = (x @ m + mass * at) / (m.sum() + mass)
    drift = (v @ m + mass * w[:3]) / (m.sum() + mass)
    frame, inertial = (np.asarray(a[1], np.float64).reshape(3, 3) for a in (d.xmat, d.ximat))
    spin = inertial @ (model.body_inertia[1] * (inertial.T @ frame @ w[3:]))  # MuJoCo turns about the box's own axes
    body_turning = np.cross(at - centre, mass * (w[:3] - drift)) + spin
    affine = [DX**2 / 4 * np.sum(m * (C[j, i] - C[i, j])) for i, j in ((1, 2), (2, 0), (0, 1))]
    arms = x - centre[:, None]
    return Books(
        grains=v @ m,
        body=mass * w[:3],
        body_turning=body_turning,
        turning=np.cross(arms.T, (m * (v - drift[:, None])).T).sum(axis=0) + affine + body_turning,
    )


class Flight(NamedTuple):
    """The toss: what both had at each time, gravity's part taken out of momentum."""

    total: np.ndarray  # (steps + 1, 3) N s
    body: np.ndarray  # (steps + 1, 3)
    paid: np.ndarray  # (steps, 3) N s, by the reactions
    body_turning: np.ndarray  # (steps + 1, 3) N m s
    turning: np.ndarray  # (steps + 1, 3)
    last: State


@cache
def flight(precision: str = "f32") -> Flight:
    with jax.enable_x64(precision == "f64"):
        return flown(precision)


def flown(precision: str) -> Flight:
    state, one = jax.jit(partial(tossed, scene(precision)))(started(precision)), sim.scripted(scene(precision), 0, 1)
    kept, paid = [books(state)], []
    for _ in range(TOSS):
        state, reaction = program(precision)(state, one)
        kept.append(books(state))
        paid.append(np.asarray(reaction, np.float64)[0, 0, :3] * DT)
    fallen = np.array([0, 0, -G]) * DT * np.arange(TOSS + 1)[:, None]  # m/s
    grains, body, body_turning, turning = (np.array(rows) for rows in zip(*kept, strict=True))
    mass, sand = scene().bodies.model.body_mass[1], np.sum(np.asarray(state.grains.m, np.float64))
    body = body - mass * fallen
    return Flight(grains - sand * fallen + body, body, np.array(paid), body_turning, turning, state)


def size(rows: np.ndarray) -> np.ndarray:
    return np.linalg.norm(rows, axis=1)


each_precision = pytest.mark.parametrize("precision", ["f32", "f64"])


@each_precision
def test_sand_and_a_box_thrown_at_each_other_keep_momentum(precision: str) -> None:
    f = flight(precision)
    exchanged = np.cumsum(size(np.diff(f.body, axis=0)))
    assert exchanged[-1] > 1, "they hardly met"  # N s
    assert np.all(size(f.total[1:] - f.total[0]) < EXCHANGED_TOLERANCE[precision] * exchanged + PAID_DIGITS[precision])


@each_precision
def test_each_step_pays_the_box_what_its_reaction_says(precision: str) -> None:
    f = flight(precision)
    change = np.diff(f.body, axis=0)
    assert np.all(size(f.paid - change) < PAID_TOLERANCE[precision] * size(change) + PAID_DIGITS[precision])


def test_sand_and_a_box_thrown_at_each_other_keep_angular_momentum() -> None:
    f = flight()
    exchanged = np.cumsum(size(np.diff(f.body_turning, axis=0)))
    assert exchanged[-1] > 0.05, "they hardly turned each other"  # N m s
    assert np.all(size(f.turning[1:] - f.turning[0]) < ANGULAR_TOLERANCE * exchanged + TURNING_DIGITS)


def test_the_toss_is_well_and_away_from_the_walls() -> None:
    last = flight().last
    assert int(last.health) == Health.WELL
    x = np.asarray(scene().world(last.grains.x))[:, np.asarray(last.grains.m) > 0]
    assert np.all(x.min(axis=1) > REACH)
    assert np.all(x.max(axis=1) < np.array([SIDE, SIDE, HEIGHT]) - REACH)


@cache
def rest() -> tuple[State, np.ndarray]:
    """The box let down on the bed: the end, and the reactions (steps, 6)."""
    state, reactions = started(), []
    one = sim.scripted(scene(), 0, 1)
    for _ in range(REST):
        state, reaction = program()(state, one)
        reactions.append(np.asarray(reaction, np.float64)[0, 0])
    return state, np.array(reactions)


def test_a_box_at_rest_on_sand_weighs_what_it_weighs() -> None:
    state, reactions = rest()
    weight = scene().bodies.model.body_mass[1] * G
    mean = reactions[-MEAN:].mean(axis=0)
    assert mean[2] == pytest.approx(weight, rel=WEIGHT_TOLERANCE)
    assert np.abs(mean[:2]).max() < WEIGHT_TOLERANCE * weight
    assert np.abs(np.asarray(state.rigid.qvel)).max() < CALM
    assert int(state.health) == Health.WELL


@pytest.mark.parametrize("frame", ["world", "site"])
def test_a_sensor_beside_the_box_tells_its_weight_and_the_torque_of_it(frame: Any) -> None:
    state, reactions = rest()
    told = wrench_at(scene(), state, reactions[-MEAN:, None], "sensor", frame)
    force = np.array([0, 0, scene().bodies.model.body_mass[1] * G])
    torque = -np.cross(SENSOR, force)
    if frame == "site":  # turned by a quarter about z
        torque = np.array([torque[1], -torque[0], torque[2]])
    np.testing.assert_allclose(told.force.mean(axis=0), force, atol=WEIGHT_TOLERANCE * force[2])
    size = np.linalg.norm(torque)
    np.testing.assert_allclose(told.torque.mean(axis=0), torque, atol=WEIGHT_TOLERANCE * size)


def test_the_scene_compiles_once() -> None:
    flight(), rest()
    assert program()._cache_size() == 1
