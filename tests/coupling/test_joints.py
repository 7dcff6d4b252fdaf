"""All kinds of joints in one bed of sand: a paddle on a ball joint with motors, a pusher on a slide, a gate on a hinge
that meets its limit, and two free bodies, one of two geoms, that lie on each other and on a rigid floor.

One small 3-D scene, in both precisions. Bodies get what their Jacobians make of what the grains lost, whatever their
joints are; MJX's own contacts and limits hold under the sand, and are not paid twice.
"""

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import jax
import mujoco
import numpy as np
import pytest

from benchmarks.coupling.scenes import Bed
from mpm_env import Drive, Scene, State, scripted
from mpm_env.health import ContactReport, names
from mpm_env.sim import rigid_step

DX = 0.05  # m
SIDE, HEIGHT, DEPTH = 0.8, 0.5, 0.2  # m
STEPS = 100  # rigid steps of 4 ms
PUSH, TURN = 60.0, 3.0  # N on the pusher, N m on the paddle
LIMIT = 0.15  # rad, of the gate
HARD = 'solimp=".9999 .9999 .001"'

UNPAID = {"f32": 1e-6, "f64": 1e-14}  # of the impulse exchanged in a rigid step; 9e-8 and 2e-16 observed
GENERALISED = {"f32": 1e-5, "f64": 1e-11}  # of the largest generalised force so far; 1e-8 and 1e-17 observed
ASTRAY = 0.01  # cells that MJX's step may end apart from where the grains saw the bodies
OVERLAP = 1e-3  # m, of bodies pressed on each other or on the floor
CALM = 12.0  # m/s or rad/s; 4 observed, of the gate on its way
SAME = 2e-3  # m, rad and parts of quaternions, between precisions

MODEL = f"""<compiler angle="radian"/><worldbody>
  <geom name="floor" type="plane" size="1 1 1" {HARD}/>
  <body name="hung" pos=".2 .2 .42"><joint name="ball" type="ball" damping=".05" armature=".01"/>
    <geom name="paddle" type="box" size=".06 .06 .15" pos="0 0 -.2" density="800"/></body>
  <body name="pushing" pos=".55 .2 .1"><joint name="slide" type="slide" axis="1 0 0" damping="5" armature=".5"/>
    <geom name="pusher" type="box" size=".06 .12 .1" density="1500"/></body>
  <body name="swinging" pos=".2 .6 .35"><joint name="hinge" axis="0 1 0" limited="true" range="-1 {LIMIT}"
      damping=".02" frictionloss=".05"/>
    <geom name="gate" type="box" size=".06 .1 .12" pos="0 0 -.14" density="600"/></body>
  <body name="lower" pos=".58 .6 .06"><freejoint/>
    <geom name="slab" type="box" size=".12 .1 .06" density="1200" {HARD}/>
    <geom name="knob" type="sphere" size=".06" pos="-.1 0 .08" density="1200" {HARD}/></body>
  <body name="upper" pos=".63 .6 .181"><freejoint/>
    <geom name="block" type="box" size=".06 .1 .06" density="1200" {HARD}/></body>
</worldbody>
<actuator>
  <motor name="twist" joint="ball" gear="0 1 0"/>
  <motor name="push" joint="slide"/>
  <position name="swing" joint="hinge" kp="60"/>
</actuator>"""
GEOMS = ("paddle", "pusher", "gate", "slab", "knob", "block")


@cache
def bed(precision: str) -> Bed:
    """Sand around what stands in it, close to it on some sides."""
    holes = ((0.1, 0.3, 0.1, 0.3), (0.45, 0.65, 0.05, 0.35), (0.1, 0.26, 0.5, 0.7), (0.4, 0.7, 0.5, 0.7))
    xs, ys = (sorted({0.0, SIDE, *(h[k] for h in holes for k in pair)}) for pair in ((0, 1), (2, 3)))
    fills = []
    for x0, x1 in pairwise(xs):
        for y0, y1 in pairwise(ys):
            free = all(x1 <= a or x0 >= b or y1 <= c or y0 >= d for a, b, c, d in holes)
            if free:
                fills.append(((x0, y0, 0.0), (x1, y1, DEPTH)))
    return Bed(
        MODEL,
        GEOMS,
        (SIDE, SIDE, HEIGHT),
        tuple(fills),
        DX,
        fidelity={"precision": precision, "contact_iterations": 8},
        bodies={
            "controls": {"twist": [(0.0, 0.0), (0.1, TURN)], "push": [(0.0, 0.0), (0.1, PUSH)], "swing": [(0.0, 0.5)]}
        },
    )


class Done(NamedTuple):
    """What became of it; rows are rigid steps."""

    model: mujoco.MjModel
    qpos: np.ndarray  # (k, nq)
    qvel: np.ndarray  # (k, nv)
    applied: np.ndarray  # (k, nv) generalised force by the sand, as MJX was handed it
    by_jacobian: np.ndarray  # (k, nv) the same from the reactions on the geoms, by C MuJoCo's Jacobians
    contact: ContactReport  # (k,) each
    trouble: list[str]


@cache
def done(precision: str) -> Done:
    with jax.enable_x64(precision == "f64"):
        return ran(bed(precision).scene(), bed(precision).start())


def ran(scene: Scene, state: State) -> Done:
    def one(state: State, drive: Drive) -> tuple[State, tuple]:
        state = rigid_step(scene, state, drive)
        d = state.rigid
        return state, (d.qpos, d.qvel, d.qfrc_applied, state.reaction, state.contact)

    start = np.asarray(state.rigid.qpos, np.float64)
    state, rows = jax.jit(lambda s, drives: jax.lax.scan(one, s, drives))(state, scripted(scene, 0, STEPS))
    qpos, qvel, applied, reactions, contact = jax.tree.map(lambda a: np.asarray(a, np.float64), rows)
    model = scene.bodies.model
    oracle, by_jacobian = mujoco.MjData(model), np.zeros((STEPS, model.nv))
    for k, q in enumerate([start, *qpos[:-1]]):  # the poses at the starts of steps
        oracle.qpos[:] = q
        mujoco.mj_kinematics(model, oracle)
        mujoco.mj_comPos(model, oracle)
        for geom, wrench in zip(scene.bodies.geoms, reactions[k], strict=True):
            body = model.geom_bodyid[geom]
            jacp, jacr = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jac(model, oracle, jacp, jacr, oracle.xipos[body], body)
            by_jacobian[k] += jacp.T @ wrench[:3] + jacr.T @ wrench[3:]
    return Done(model, qpos, qvel, applied, by_jacobian, contact, names(int(state.health)))


def joint(qpos: np.ndarray, model: mujoco.MjModel, name: str) -> np.ndarray:
    """Positions (k,) of a joint of one degree of freedom."""
    return qpos[:, model.joint(name).qposadr[0]]


each_precision = pytest.mark.parametrize("precision", ["f32", "f64"])


@each_precision
def test_the_scene_is_well(precision: str) -> None:
    assert done(precision).trouble == []
    assert np.abs(done(precision).qvel).max() < CALM


@each_precision
def test_every_joint_gets_what_its_jacobian_makes_of_the_sands_reaction(precision: str) -> None:
    d = done(precision)
    size = np.maximum.accumulate(np.abs(d.applied), axis=0)
    assert np.all(size[-1] > 1e-3), "the sand did not push along some joint"
    assert np.all(np.abs(d.applied - d.by_jacobian) <= GENERALISED[precision] * size.max(axis=1)[:, None])


@each_precision
def test_grains_get_the_opposite_of_what_bodies_get(precision: str) -> None:
    assert done(precision).contact.unpaid.max() < UNPAID[precision]


@each_precision
def test_bodies_end_each_step_where_the_grains_saw_them_go(precision: str) -> None:
    assert done(precision).contact.astray.max() < ASTRAY * DX


def test_the_gate_is_held_by_its_limit() -> None:
    angle = joint(done("f32").qpos, done("f32").model, "hinge")
    assert angle.max() < LIMIT + 0.01
    assert angle[-25:].min() > LIMIT - 0.01, "it never came there"


def test_motors_move_the_paddle_and_the_pusher_in_the_sand() -> None:
    d = done("f32")
    assert joint(d.qpos, d.model, "slide")[-1] > 0.01
    w = d.qpos[-1, d.model.joint("ball").qposadr[0]]
    assert 2 * np.arccos(min(1, abs(w))) > 0.02  # rad


def test_free_bodies_lie_on_each_other_and_on_the_floor() -> None:
    """MJX's own contacts hold them up, under sand that leans on them."""
    d = done("f32")
    oracle = mujoco.MjData(d.model)
    oracle.qpos[:] = d.qpos[-1]
    mujoco.mj_forward(d.model, oracle)
    touching = {frozenset(d.model.geom(g).name for g in c.geom) for c in oracle.contact}
    assert {frozenset(("floor", "slab")), frozenset(("slab", "block"))} <= touching
    assert min(c.dist for c in oracle.contact) > -OVERLAP


def test_both_precisions_tell_the_same() -> None:
    one, other = done("f32"), done("f64")
    np.testing.assert_allclose(one.qpos[-1], other.qpos[-1], atol=SAME)
