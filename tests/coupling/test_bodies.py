"""A rigid step cut in two is MuJoCo's own step, and what grains see of the bodies is where MuJoCo puts them."""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from coupling import bodies as rigid
from coupling.bodies import Bodies, couple
from coupling.constraints import settled
from coupling.reach import points_near

STEPS = 50
FORWARD_TOLERANCE = 1e-4  # of each field's largest: the same float32 sums in another order, then a solver
# Float32 over 50 steps against MuJoCo's float64; the arm moves with 1 rad/s. 3e-7 and 4e-6 observed.
ARM_TOLERANCE = {"qpos": 2e-6, "qvel": 2e-5}
# Two solutions of one equation in float32. 2e-7 observed.
LANDING_TOLERANCE = 1e-6  # of the fastest
PLANE_TOLERANCE = 1e-6  # m and m/s over 50 steps of the same arithmetic in float32
POSE_TOLERANCE = 1e-6  # m and radians, float32
HELD_TOLERANCE = 1e-3  # m/s
FORESEEN_TOLERANCE = 1e-4  # of the fastest joint: MJX ends its own solution at 1e-8 of a cost
COUNT_TOLERANCE = 0.15  # of a shell's volume in lattice cells: points are counted on half the spacing

ARM = """
<mujoco>
  <option timestep="0.004" integrator="{integrator}"/>
  <worldbody>
    <body pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="4" armature="0.01"/>
      <geom name="upper" type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".3"/>
      <body pos=".3 0 0">
        <joint name="elbow" axis="0 1 0" damping="2"/>
        <geom name="paddle" type="box" size=".02 .06 .05" pos=".1 0 -.05" mass=".5"/>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="shoulder" kp="60" kv="1"/><position joint="elbow" kp="30"/></actuator>
</mujoco>"""

BOX_ON_PLANE = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body pos="0 0 .052"><freejoint/><geom name="box" type="box" size=".1 .1 .05" mass="2"/></body>
  </worldbody>
</mujoco>"""

TOOL = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="tool" mocap="true" pos=".1 .2 .3" quat=".9 .1 -.3 .2">
      <geom name="blade" type="box" size=".1 .02 .05" pos=".08 0 .1" euler="20 10 5"/>
      <site name="edge" pos="0 0 .2" euler="30 0 0"/>
      <body pos="0 .1 0" euler="0 40 0"><geom name="tip" type="sphere" size=".02" pos=".05 0 0" mass="3"/></body>
    </body>
    <geom name="floor" type="plane" size="1 1 1"/>
    <geom name="ball" type="sphere" size=".1" pos="0 0 .5"/>
  </worldbody>
</mujoco>"""


EVERYTHING = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <camera name="eye" pos="0 -1 1"/>
    <body name="hand" mocap="true" pos="0 0 .5"><geom name="palm" type="box" size=".02 .02 .02"/></body>
    <body name="held" pos="0 0 .4"><freejoint/><geom name="held" type="box" size=".05 .04 .03" mass=".5"/></body>
    <body name="link" pos=".5 0 .3" gravcomp=".5">
      <joint name="hinge" axis="0 1 0" range="-1 .1" limited="true" frictionloss=".1" stiffness="2" armature=".01"/>
      <geom name="link" type="capsule" size=".02" fromto="0 0 0 .2 0 0" mass=".3"/>
      <body pos=".2 0 0">
        <joint name="slide" type="slide" axis="1 0 0" damping="3"/>
        <geom name="tip" type="sphere" size=".03" mass=".2"/><site name="tip"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="rope" armature=".02" damping=".3">
      <joint joint="hinge" coef=".7"/><joint joint="slide" coef="1"/>
    </fixed>
  </tendon>
  <equality><weld body1="held" body2="hand"/></equality>
  <actuator>
    <position joint="hinge" kp="20"/><motor tendon="rope" gear="2"/>
    <general site="tip" gear="0 0 1 0 0 0" dyntype="filter" dynprm=".1"/>
  </actuator>
  <sensor><framepos objtype="site" objname="tip"/><jointvel joint="hinge"/><accelerometer site="tip"/></sensor>
</mujoco>"""


class Step(NamedTuple):
    """One rigid step under a load."""

    qpos: jax.Array
    qvel: jax.Array
    expected: jax.Array  # (nv,) where the exchange leaves the joint velocities
    oracle_qpos: jax.Array  # mjx.step's
    oracle_qvel: jax.Array


def model_of(xml: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


def coupled(model: mujoco.MjModel, *names: str) -> Bodies:
    return couple(model, {model.geom(n).id: (0.4,) for n in names})


def at_rest(b: Bodies) -> Any:
    d = rigid.posed(b, b.model.qpos0, np.zeros(b.model.nv), np.zeros(b.model.nu), mocap_poses(b.model))
    return jax.jit(lambda: rigid.start(b, d))()


def mocap_poses(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    ids = [i for i in range(model.nbody) if model.body_mocapid[i] >= 0]
    return model.body_pos[ids].reshape(-1, 3), model.body_quat[ids].reshape(-1, 4)


def run(b: Bodies, control: np.ndarray, impulses: np.ndarray, *, oracle: bool = False) -> Step:
    """Rigid steps under the grains' impulses (steps, nv); with an oracle, mjx.step under the same beside it."""
    still = jnp.zeros((len(b.bodies), 6))

    def one(both: tuple[Any, Any], impulse: jax.Array) -> tuple[tuple[Any, Any], Step]:
        d, twin = both
        d, stance = rigid.open_step(b, d, still)
        expected = landing(b, stance, d.qvel, impulse)
        d = rigid.refresh(b, rigid.close_step(b, d, impulse))
        if oracle:
            twin = mjx.step(b.mjx_model, twin.replace(qfrc_applied=impulse / b.model.opt.timestep))
        return (d, twin), Step(d.qpos, d.qvel, expected, twin.qpos, twin.qvel)

    d = at_rest(b).replace(ctrl=jnp.asarray(control, jnp.float32))
    return jax.tree.map(np.asarray, jax.jit(lambda d, rows: jax.lax.scan(one, (d, d), rows)[1])(d, impulses))


def landing(b: Bodies, stance: rigid.Stance, q: jax.Array, impulse: jax.Array) -> jax.Array:
    """Joint velocities (nv,) that the exchange would leave at the end of a step under one impulse (nv,)."""
    dt = b.model.opt.timestep
    free = q + dt * stance.acceleration
    rows = rigid.twists(stance, stance.centre, jnp.asarray(dt), jnp.zeros_like(stance.laws.D)).rows
    if rows is None:
        return free + jnp.linalg.solve(stance.M, impulse)
    return free + settled(stance.M, rows, free, impulse, jnp.zeros_like(q)).change


def loads(nv: int, size: float) -> np.ndarray:
    return (size * np.random.default_rng(0).normal(size=(STEPS, nv))).astype(np.float32)


@cache
def arm_run(integrator: str) -> tuple[Bodies, np.ndarray, Step]:
    b = coupled(model_of(ARM.format(integrator=integrator)), "paddle")
    impulses = loads(2, 0.01)
    return b, impulses, run(b, np.array([0.5, -0.8]), impulses)


@cache
def plane_run() -> Step:
    """A box that falls 2 mm onto a plane and is pushed down and aside by 30 N all the time."""
    b = coupled(model_of(BOX_ON_PLANE), "box")
    push = np.tile(np.array([0.02, 0, -0.12, 0, 0, 0], np.float32), (STEPS, 1))
    return run(b, np.zeros(0), push, oracle=True)


each_integrator = pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])


@each_integrator
def test_an_arm_under_load_moves_as_in_mujoco(integrator: str) -> None:
    b, impulses, found = arm_run(integrator)
    data = mujoco.MjData(b.model)
    data.ctrl[:] = [0.5, -0.8]
    for k, impulse in enumerate(impulses):
        data.qfrc_applied[:] = impulse / b.model.opt.timestep
        mujoco.mj_step(b.model, data)
        np.testing.assert_allclose(found.qpos[k], data.qpos, rtol=0, atol=ARM_TOLERANCE["qpos"])
        np.testing.assert_allclose(found.qvel[k], data.qvel, rtol=0, atol=ARM_TOLERANCE["qvel"])
    assert np.abs(found.qvel).max() > 0.5, "it hardly moved"


@each_integrator
def test_the_integrator_lands_on_the_velocity_of_the_exchange(integrator: str) -> None:
    found = arm_run(integrator)[2]
    fastest = np.abs(found.qvel).max()
    np.testing.assert_allclose(found.qvel, found.expected, rtol=0, atol=LANDING_TOLERANCE * fastest)


def test_a_box_on_a_plane_moves_as_by_mjx_step() -> None:
    found = plane_run()
    np.testing.assert_allclose(found.qpos, found.oracle_qpos, rtol=0, atol=PLANE_TOLERANCE)
    np.testing.assert_allclose(found.qvel, found.oracle_qvel, rtol=0, atol=PLANE_TOLERANCE)
    assert found.qpos[-1, 2] < 0.0501, "it did not reach the plane"


def test_a_box_between_grains_and_a_plane_is_held_in_the_exchange_too() -> None:
    """The plane answers the grains' load while they act, not a step later: 30 N would move 2 kg by 6 cm/s each step."""
    found = plane_run()
    np.testing.assert_allclose(found.qvel[-10:], found.expected[-10:], rtol=0, atol=HELD_TOLERANCE)


def test_a_step_from_fresh_data_is_mjx_step() -> None:
    """With a tendon, a weld, limits, friction, contact, activations and sensors: no stage of MJX is forgotten."""
    b = coupled(model_of(EVERYTHING), "palm", "link")
    d, load = everything_moving(b)
    still = jnp.zeros((len(b.bodies), 6))

    def stepped(d: Any) -> Any:
        opened, _ = rigid.open_step(b, rigid.refresh(b, d.replace(qfrc_applied=7 * load)), still)
        return rigid.close_step(b, opened, load * b.model.opt.timestep)

    found = jax.jit(stepped)(d)
    oracle = jax.jit(lambda d: mjx.step(b.mjx_model, d.replace(qfrc_applied=load)))(d)
    assert np.abs(oracle.qfrc_constraint).max() > 1 and np.abs(oracle.sensordata).max() > 1, "little happens"
    for (path, is_so), should in zip(
        jax.tree_util.tree_flatten_with_path(found)[0], jax.tree.leaves(oracle), strict=True
    ):
        largest = np.abs(np.asarray(should)).max(initial=0)
        np.testing.assert_allclose(
            is_so, should, rtol=0, atol=FORWARD_TOLERANCE * largest, err_msg=jax.tree_util.keystr(path)
        )


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_the_exchange_foresees_what_all_constraints_of_mujoco_do(integrator: str) -> None:
    """With a weld, limits, dry friction, contact, damping: joints end a step where the grains last saw them."""
    b = coupled(model_of(EVERYTHING.replace("<option", f'<option integrator="{integrator}"')), "palm", "link")
    d, load = everything_moving(b)
    still = jnp.zeros((len(b.bodies), 6))

    def both(d: Any, load: Any) -> tuple[Any, Any, Any]:
        opened, stance = rigid.open_step(b, rigid.refresh(b, d), still)
        impulse = load * b.model.opt.timestep
        ended = rigid.close_step(b, opened, impulse)
        return ended.qvel, landing(b, stance, d.qvel, impulse), ended.qfrc_constraint

    for size in (1.0, -1.0, 30.0):
        found, expected, constraint = map(np.asarray, jax.jit(both)(d, size * load))
        assert np.abs(constraint).max() > 1, "no constraint acts"
        np.testing.assert_allclose(found, expected, rtol=0, atol=FORESEEN_TOLERANCE * np.abs(found).max())


def everything_moving(b: Bodies) -> tuple[Any, jax.Array]:
    """Data in motion, and a load (nv,) N."""
    d, rng = at_rest(b), np.random.default_rng(0)
    d = d.replace(qpos=d.qpos + 0.05 * rng.random(b.model.nq, np.float32), qvel=rng.random(b.model.nv, np.float32))
    d = d.replace(ctrl=jnp.asarray([0.3, -0.5, 2.0]), act=jnp.asarray([0.4]), mocap_pos=d.mocap_pos + 0.01)
    return d, jnp.asarray(rng.random(b.model.nv, np.float32))


@pytest.mark.parametrize("xml", [EVERYTHING, TOOL], ids=["joints", "mocap only"])
def test_bodies_start_as_fresh_data(xml: str) -> None:
    b = coupled(model_of(xml), "palm" if xml is EVERYTHING else "blade")
    d = at_rest(b)
    again = jax.jit(lambda d: rigid.refresh(b, d))(d)
    assert [(a.shape, a.dtype) for a in jax.tree.leaves(d)] == [(a.shape, a.dtype) for a in jax.tree.leaves(again)]
    for is_so, should in zip(jax.tree.leaves(d), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(is_so, should, rtol=0, atol=POSE_TOLERANCE)


def test_coasting_brings_mocap_bodies_to_their_next_pose() -> None:
    b = coupled(model_of(TOOL), "blade", "tip", "ball")
    d = at_rest(b)
    position, quaternion = np.array([[0.103, 0.201, 0.296]]), np.array([[0.88, 0.13, -0.32, 0.17]])
    quaternion /= np.linalg.norm(quaternion)
    substeps = 5
    h = b.model.opt.timestep / substeps

    @jax.jit
    def coasted(d: Any) -> tuple[jax.Array, ...]:
        same_turn = -quaternion  # a quaternion's other sign
        twist = rigid.drift(b, d, *(jnp.asarray(a, jnp.float32) for a in (position, same_turn)))
        _, stance = rigid.open_step(b, d, twist)
        centre, turn = stance.centre, jnp.broadcast_to(jnp.eye(3), (len(b.bodies), 3, 3))
        for _ in range(substeps):
            centre, turn = centre + h * twist[:, :3], rigid.turned(turn, twist[:, 3:], h)
        return twist, stance.centre, *rigid.poses(b, stance, centre, turn)

    twist, start, pos, mat = map(np.asarray, coasted(d))
    oracle = mujoco.MjData(b.model)
    oracle.mocap_pos[:], oracle.mocap_quat[:] = position, quaternion
    mujoco.mj_forward(b.model, oracle)
    geoms = list(b.geoms)
    assert np.abs(start[0] - oracle.xipos[b.bodies[0]]).max() > 1e-3, "it hardly moved"
    np.testing.assert_allclose(pos, oracle.geom_xpos[geoms], rtol=0, atol=POSE_TOLERANCE)
    np.testing.assert_allclose(mat, oracle.geom_xmat[geoms].reshape(-1, 3, 3), rtol=0, atol=POSE_TOLERANCE)
    np.testing.assert_array_equal(twist[b.body_of[2]], 0)


def test_without_joints_all_that_hangs_on_a_mocap_body_goes_with_it() -> None:
    b = coupled(model_of(TOOL), "blade")
    position, quaternion = np.array([[0.3, -0.2, 0.6]]), np.array([[0.5, 0.5, -0.5, 0.5]])
    oracle = mujoco.MjData(b.model)
    oracle.mocap_pos[:], oracle.mocap_quat[:] = position, quaternion
    mujoco.mj_forward(b.model, oracle)
    d = rigid.refresh(b, rigid.place(at_rest(b), position, 3 * quaternion))  # MuJoCo normalises, and so do we
    for field in ("xpos", "xmat", "xipos", "ximat", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat"):
        found, expected = np.asarray(getattr(d, field)), getattr(oracle, field)
        np.testing.assert_allclose(found, expected.reshape(found.shape), rtol=0, atol=POSE_TOLERANCE, err_msg=field)
    turned = np.abs(np.sum(np.asarray(d.xquat) * oracle.xquat, axis=1))  # 1 where it is the same turn
    np.testing.assert_allclose(turned, 1, atol=POSE_TOLERANCE)


def test_only_bodies_with_joints_yield() -> None:
    tool, arm = coupled(model_of(TOOL), "blade", "ball"), coupled(model_of(ARM.format(integrator="Euler")), "paddle")
    assert not tool.yields
    assert not tool.steps
    assert arm.yields
    assert arm.steps


def test_points_near_a_ball_fill_its_shell() -> None:
    b = coupled(model_of(TOOL), "ball")
    bands = (-0.02, 0.03), (-0.01, 0.01)
    for (low, high), count in zip(bands, points_near(b, bands, 0.01), strict=True):
        volume = 4 / 3 * np.pi * ((0.1 + high) ** 3 - (0.1 + low) ** 3)
        assert count == pytest.approx(volume / 0.01**3, rel=COUNT_TOLERANCE)
    for (low, high), count in zip(bands, points_near(b, bands, 0.01, middle=0.0), strict=True):
        area = np.pi * ((0.1 + high) ** 2 - (0.1 + low) ** 2)
        assert count == pytest.approx(area / 0.01**2, rel=COUNT_TOLERANCE)
    assert points_near(b, bands, 0.01, middle=0.5) == (0, 0)


@pytest.mark.parametrize("thick", [0.1, 0.5, 1.0, 2.0])
def test_points_near_a_plate_along_the_axes_fill_its_shell(thick: float) -> None:
    """No layer is lost on the edge of the band: its volume is counted, within the lattice's half cells."""
    dx, wide = 0.01, 0.2
    size = f"{thick * dx / 2} {wide / 2} {wide / 2}"
    body = f'<body mocap="true"><geom name="plate" type="box" size="{size}"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    (count,) = points_near(coupled(model, "plate"), ((-2 * dx, 0.5 * dx),), dx)
    assert count >= 0.95 * (thick + 1) * (wide / dx) ** 2


def test_points_near_bodies_add_up_and_planes_count_as_none() -> None:
    model = model_of(TOOL)
    band = ((-0.02, 0.02),)
    each = [points_near(coupled(model, n), band, 0.01)[0] for n in ("blade", "tip", "floor")]
    assert each[2] == 0
    assert points_near(coupled(model, "blade", "tip", "floor"), band, 0.01) == (sum(each),)


@pytest.mark.parametrize("integrator", ["implicit", "RK4"])
def test_an_integrator_that_grains_cannot_join_is_refused(integrator: str) -> None:
    with pytest.raises(ValueError, match=r"integrator is mjINT_.* choose Euler or implicitfast"):
        coupled(model_of(ARM.format(integrator=integrator)), "paddle")


def test_a_model_that_mjx_cannot_run_is_refused() -> None:
    model = model_of("""
        <mujoco><worldbody>
          <body><freejoint/><geom name="a" type="box" size=".1 .1 .1"/></body>
          <body pos="1 0 0"><freejoint/><geom name="b" type="cylinder" size=".1 .1"/></body>
        </worldbody></mujoco>""")
    with pytest.raises(ValueError, match=r"MJX cannot run this model: .* Remove that feature or those contacts\."):
        coupled(model, "a")


def test_a_joint_below_a_mocap_body_is_refused() -> None:
    model = model_of("""
        <mujoco><worldbody>
          <body mocap="true"><geom type="sphere" size=".1"/>
            <body name="flap" pos="0 0 1"><joint/><geom name="flap" type="box" size=".1 .1 .1"/></body>
          </body>
        </worldbody></mujoco>""")
    with pytest.raises(ValueError, match=r"'flap' hangs by a joint on a mocap body, .* or no joint"):
        coupled(model, "flap")
