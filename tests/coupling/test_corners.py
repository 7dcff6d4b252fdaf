"""Corners and edges: normals around those of a box, and blocks that lie in a notch of two boxes and stay there.

The notches are of 90 degrees and open upward; two of them stand side by side, one with an elastic block and one with a
block of sand, so that both compile once. They stand on mocap bodies: where they are told, tilted or not.
"""

import itertools
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coupling import bodies as rigid
from coupling.contact import nearest_geom
from coupling.geoms import Shape
from mpm_env import sim
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.health import Health
from mpm_env.scene import Scene, State, build, initial
from mpm_env.scene_config import SceneConfig

BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
SIZE = np.array([0.3, 0.15, 0.1])  # m
PLACE, TURN = np.array([0.2, -0.1, 0.3]), Rotation.from_rotvec([0.5, -0.8, 1.1])  # of the box that normals are asked of
PROBE = 1e-6  # m, radius of the sphere with which MuJoCo is asked
NEAREST = 1e-3  # m, of a point to an edge, or to where two faces are equally near: below, digits turn the normal
# Rounding of positions turns a normal by as much over the distance.
NORMAL_TOLERANCE = {"float32": 1.5e-4, "float64": 5e-11}  # 4e-5 and 1.3e-11 observed
STEP = 1e-6  # m, of central differences
STEP_TOLERANCE = 1e-6  # an edge's curvature at NEAREST times the step, squared: 2e-7 observed
UNIT_TOLERANCE = {"float32": 5e-7, "float64": 1e-15}  # rounding of a norm; 1.2e-7 and 3e-16 observed

DX = 0.025  # m
DT = 0.004  # s, a rigid step
WIDTH = 0.1  # m, of the slice
SIDE, GRAINS = 0.1, 8  # m, and grains along it: 4 cells
ARM, HALF = 0.25, 0.03  # m, length and half thickness of a notch's sides
APEX = np.array([(0.3, WIDTH / 2, 0.1), (0.9, WIDTH / 2, 0.1)])  # m
FRICTION = 0.5  # 26.6 degrees
G = 9.81
MATERIALS = {
    "elastic": {"model": "elastic", "E": 1e5, "nu": 0.3, "rho": 1500.0},
    "sand": {"model": "sand", "E": 1e6, "nu": 0.3, "rho": 1500.0, "friction_deg": 35.0},
}
ROWS = 125  # rigid steps of a call, 0.5 s
SETTLING = 4  # calls

# Cells that a grain moves in 0.5 s, after 2 s to settle: digits of its position, and the sand still creeps together.
# Nodes feel their neighbours' grains come and go by parts of a cell, so contact there comes and goes too.
STAYS = {"elastic": 0.015, "sand": 0.1}  # 3.7e-3 and 0.033 observed
GOES = 2.0  # cells that a block moves at least where it must slide; 5.7 and 4.1 observed
WEIGHT_TOLERANCE = 8e-5  # of the weight, mean over 0.5 s; 1.5e-5 observed


@cache
def points_around() -> np.ndarray:
    """Points (n, 3) m around all edges and corners of the box, in its frame: outside, before its faces and inside."""
    rng = np.random.default_rng(0)
    signs = np.array(list(itertools.product((-1, 1), repeat=3))).repeat(500, axis=0)
    along = np.eye(4, 3)[rng.integers(0, 4, len(signs))] * rng.uniform(0.1, 1, (len(signs), 1))  # the edge, or none
    off = rng.normal(size=signs.shape) * 10 ** rng.uniform(-3, -1, (len(signs), 1))
    points = signs * (1 - along) * SIZE + off
    q = np.sort(np.abs(points) - SIZE, axis=1)
    outside, gap = np.linalg.norm(np.maximum(q, 0), axis=1), q[:, 2] - q[:, 1]
    return points[np.where(q[:, 2] > 0, outside, gap) > NEAREST]


class Faced(NamedTuple):
    """Signed distances and normals."""

    phi: np.ndarray  # (n,) m
    n: np.ndarray  # (n, 3)


def faced(shapes: tuple[Shape, ...], pos: np.ndarray, mat: np.ndarray, points: np.ndarray, dtype: str) -> Faced:
    """What world points (n, 3) m face, in this precision."""
    with jax.enable_x64(dtype == "float64"):
        phi, n, _ = nearest_geom(shapes, *(jnp.asarray(a, dtype) for a in (points.T, pos, mat)))
        return Faced(np.asarray(phi), np.asarray(n).T)


def the_box(points: np.ndarray, dtype: str) -> Faced:
    """What points (n, 3) m of the box's frame face, asked in the world."""
    return faced((Shape(BOX, tuple(SIZE)),), PLACE[None], TURN.as_matrix()[None], TURN.apply(points) + PLACE, dtype)


@cache
def mujocos_normals() -> np.ndarray:
    """The oracle: C MuJoCo's directions (n, 3) from the box to the points in the world, away from it inside too."""
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><worldbody>
          <body mocap="true"><geom type="box" size="{SIZE[0]} {SIZE[1]} {SIZE[2]}"/></body>
          <body mocap="true"><geom type="sphere" size="{PROBE}"/></body>
        </worldbody></mujoco>""")
    data, found = mujoco.MjData(model), []
    data.mocap_pos[0], data.mocap_quat[0] = PLACE, TURN.as_quat(scalar_first=True)
    for point in TURN.apply(points_around()) + PLACE:
        data.mocap_pos[1], ends = point, np.zeros(6)
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, ends)
        found.append((ends[3:] - ends[:3]) / distance)
    return np.array(found)


def test_points_lie_around_edges_and_corners_outside_and_inside() -> None:
    beyond = np.sum(np.abs(points_around()) > SIZE, axis=1)
    assert np.bincount(beyond).min() > 100  # inside, before faces, beyond edges, beyond corners


@pytest.mark.parametrize("dtype", NORMAL_TOLERANCE)
def test_normals_around_edges_and_corners_are_mujocos_own(dtype: str) -> None:
    n = the_box(points_around(), dtype).n
    np.testing.assert_allclose(n, mujocos_normals(), rtol=0, atol=NORMAL_TOLERANCE[dtype])
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, rtol=0, atol=UNIT_TOLERANCE[dtype])


def test_normals_beyond_edges_and_corners_are_radial_and_those_inside_are_of_the_nearest_face() -> None:
    p = points_around()
    out = p - np.clip(p, -SIZE, SIZE)
    face = np.eye(3)[np.argmax(np.abs(p) - SIZE, axis=1)] * np.sign(p)
    expected = np.where(out.any(axis=1)[:, None], out, face)
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    np.testing.assert_allclose(the_box(p, "float64").n, TURN.apply(expected), atol=NORMAL_TOLERANCE["float64"])


def test_normals_are_the_differences_of_distances() -> None:
    p = points_around()
    ahead, behind = ([the_box(p + s * STEP * e, "float64").phi for e in np.eye(3)] for s in (1, -1))
    slope = (np.array(ahead) - np.array(behind)).T / (2 * STEP)
    np.testing.assert_allclose(the_box(p, "float64").n, TURN.apply(slope), rtol=0, atol=STEP_TOLERANCE)


@pytest.mark.parametrize("dtype", UNIT_TOLERANCE)
def test_normals_on_edges_and_corners_lie_between_those_of_the_faces_there(dtype: str) -> None:
    """Where the distance is zero and has no gradient."""
    signs = np.array([s for s in itertools.product((-1, 0, 1), repeat=3) if np.abs(s).sum() >= 2])
    found = faced((Shape(BOX, tuple(SIZE)),), np.zeros((1, 3)), np.eye(3)[None], signs * SIZE, dtype)
    np.testing.assert_array_equal(found.phi, 0)
    np.testing.assert_allclose(np.linalg.norm(found.n, axis=1), 1, rtol=0, atol=UNIT_TOLERANCE[dtype])
    assert np.all(np.where(signs == 0, found.n == 0, found.n * signs >= 0))


@cache
def notches() -> Scene:
    """Two notches, and two blocks high above them: `laid` puts those in."""
    # The sides reach as far below the apex as they are thick, so that no gap is left there.
    middle = np.array([ARM / 2, ARM / 2 - 2 * HALF]) * np.sqrt(0.5)
    geoms = (
        "<body name='notch{i}' mocap='true' pos='{x} {y} {z}'>"
        + "".join(
            f"<geom name='{side}{{i}}' type='box' size='{ARM / 2 + HALF} {WIDTH} {HALF}'"
            f" pos='{sign * middle[0]} 0 {middle[1]}' euler='0 {-45 * sign} 0'/>"
            for side, sign in (("right", 1), ("left", -1))
        )
        + "</body>"
    )
    bodies = "".join(geoms.format(i=i, x=x, y=y, z=z) for i, (x, y, z) in enumerate(APEX))
    config = {
        "name": "notches",
        "plane_strain": True,
        "box": {"lower": (0, 0, 0), "upper": (1.2, WIDTH, 0.5)},
        "feature": 4 * DX,
        "duration": 1.0,
        "grains": [
            {
                "material": material,
                "fill": [{"shape": "box", "lower": (x - SIDE / 2, 0, 0.3), "upper": (x + SIDE / 2, WIDTH, 0.3 + SIDE)}],
            }
            for material, (x, _, _) in zip(MATERIALS.values(), APEX, strict=True)
        ],
        "bodies": {"mjcf": f"<mujoco><worldbody>{bodies}</worldbody></mujoco>", "couple": ["*"], "friction": FRICTION},
    }
    return build(parse(SceneConfig, config, "test"), Fidelity(cells=4, rigid_dt=DT))


def tilted(deg: float) -> Rotation:
    """The notches' turn: their right sides go down."""
    return Rotation.from_euler("y", deg, degrees=True)


def laid(deg: float) -> State:
    """The start with tilted notches, and the blocks in their corners."""
    scene = notches()
    assert scene.bodies is not None
    state = initial(scene, jax.random.key(0))
    x = np.array(state.grains.x)
    sites = (np.indices((GRAINS, 1, GRAINS)).reshape(3, -1).T + np.array([0.5, 0, 0.5])) * SIDE / GRAINS
    for (first, _), apex in zip(scene.spans, APEX, strict=True):
        block = tilted(deg - 45).apply(sites) + apex
        x[:, first : first + len(block)] = (block[:, ::2] - scene.grid.origin).T
    drive = jax.tree.map(lambda a: a[0], told(deg))
    d = rigid.refresh(scene.bodies, rigid.place(state.rigid, drive.position, drive.quaternion))
    return replace(state, grains=replace(state.grains, x=jnp.asarray(x)), rigid=d)


def told(deg: float) -> sim.Drive:
    """The notches stay where they are, for a call."""
    turns = np.tile(tilted(deg).as_quat(scalar_first=True), (ROWS, len(APEX), 1))
    places = np.tile(APEX, (ROWS, 1, 1))
    return sim.Drive(jnp.zeros((ROWS, 0)), jnp.asarray(places, jnp.float32), jnp.asarray(turns, jnp.float32))


@cache
def program() -> Any:
    return jax.jit(partial(sim.advance, notches()))


class Lain(NamedTuple):
    """How a block lies in its notch over 0.5 s."""

    moved: np.ndarray  # (n,) cells, of its grains
    force: np.ndarray  # (2, 3) of its weight, on the right and the left side
    health: int


@cache
def lain(deg: float, calls: int) -> dict[str, Lain]:
    """The blocks in notches tilted by so much, after so many calls to settle."""
    scene, state = notches(), laid(deg)
    for _ in range(calls):
        state, _ = program()(state, told(deg))
    after, reactions = program()(state, told(deg))
    force = np.asarray(reactions, np.float64).mean(axis=0)[:, :3].reshape(-1, 2, 3)
    out = {}
    for name, (first, last), f in zip(MATERIALS, scene.spans, force, strict=True):
        m, x, y = (np.asarray(a)[..., first:last] for a in (after.grains.m, state.grains.x, after.grains.x))
        assert np.count_nonzero(m) == GRAINS**2
        moved = np.linalg.norm(y - x, axis=0)[m > 0] / DX
        out[name] = Lain(moved, f / (m.sum(dtype=np.float64) * G), int(after.health))
    return out


each_material = pytest.mark.parametrize("material", MATERIALS)


@each_material
def test_a_block_in_a_notch_stays(material: str) -> None:
    block = lain(0.0, SETTLING)[material]
    assert block.moved.max() < STAYS[material]
    assert block.health == Health.WELL


@each_material
def test_a_notch_carries_its_blocks_weight(material: str) -> None:
    right, left = lain(0.0, SETTLING)[material].force
    np.testing.assert_allclose(right + left, [0, 0, -1], rtol=0, atol=WEIGHT_TOLERANCE)


@each_material
def test_each_side_of_a_notch_is_pressed_within_its_cone_of_friction(material: str) -> None:
    """How they share the weight is left open by friction."""
    for force, out in zip(lain(0.0, SETTLING)[material].force, (-1, 1), strict=True):
        pressed, rubbed = force @ np.array([(-out, 0, -1), (1, 0, -out)]).T * np.sqrt(0.5)
        assert pressed > 0.3
        assert abs(rubbed) < FRICTION * pressed


def test_a_block_in_a_notch_tilted_below_the_friction_angle_stays() -> None:
    """It lies on the right side, 15 degrees steep, and hardly leans on the left one."""
    block = lain(60.0, SETTLING)["elastic"]
    assert block.moved.max() < STAYS["elastic"]
    np.testing.assert_allclose(block.force.sum(axis=0), [0, 0, -1], rtol=0, atol=WEIGHT_TOLERANCE)


@each_material
def test_a_block_in_a_notch_tilted_beyond_the_friction_angle_goes(material: str) -> None:
    """Negative control: the same program with a side 35 degrees steep."""
    assert lain(80.0, 0)[material].moved.mean() > GOES


def test_points_in_a_notch_face_the_nearer_side() -> None:
    """Up to its corner, and in the walls too: a blend of both normals would be of neither."""
    scene = notches()
    assert scene.bodies is not None
    data = mujoco.MjData(scene.bodies.model)
    mujoco.mj_kinematics(scene.bodies.model, data)
    rng = np.random.default_rng(0)
    beside, over = rng.uniform(-0.08, 0.08, 2000), rng.uniform(-HALF / 2, 0.08, 2000)
    x = APEX[0] + np.column_stack([beside, np.zeros(2000), over])
    x = x[np.abs(beside) > NEAREST]
    found = faced(scene.bodies.shapes[:2], data.geom_xpos[:2], data.geom_xmat[:2].reshape(-1, 3, 3), x, "float64")
    side = np.sign(x[:, 0] - APEX[0, 0])
    before = np.sqrt(0.5) * (x[:, 2] - APEX[0, 2] - np.abs(x[:, 0] - APEX[0, 0]))
    free, within = before > 0, (before < 0) & (before > -HALF)
    np.testing.assert_allclose(found.phi[free], before[free], rtol=0, atol=1e-12)
    expected = np.sqrt(0.5) * np.column_stack([-side, 0 * side, np.ones_like(side)])
    np.testing.assert_allclose(found.n[free], expected[free], rtol=0, atol=1e-12)
    assert np.all(found.n[within, 2] > 0), "in the walls, they lead back into the notch"
