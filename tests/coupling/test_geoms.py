"""Signed distances of geoms against C MuJoCo, closed forms and samples; what voxels keep; what is refused."""

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coupling import geoms, voxels
from coupling.contact import nearest_geom
from coupling.geoms import BOUNDS, GEOM_SDF, Shape
from coupling.voxels import Voxels

SIZE = (0.3, 0.15, 0.1)  # m; each primitive reads from it what it needs
PLANE, ELLIPSOID, BOX = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{t}")) for t in ("PLANE", "ELLIPSOID", "BOX"))
PROBE = 1e-6  # m, radius of the sphere with which MuJoCo is asked

# Observed: 1e-7 in float32 (digits of 1 m); rounding in float64, but for the ellipsoid, which MuJoCo finds by
# an iteration that stops at 1e-6.
DISTANCE_TOLERANCE = {"float32": 5e-7, "float64": 1e-14}
ELLIPSOID_TOLERANCE = 6e-6
UNIT_TOLERANCE = {"float32": 1e-6, "float64": 1e-14}  # rounding of a norm
STEP = 1e-5  # m, of central differences
STEP_TOLERANCE = 1e-10  # rounding over the step; along a normal a distance has no curvature
SIZE_TOLERANCE = 3e-7  # third derivatives by size times the step squared: 6e-8 observed
SAMPLE_TOLERANCE = 7e-5  # m; half a spacing of 2 mm, squared, over twice a distance of 3 cm: 1.4e-5 observed
VOXEL_TOLERANCE = 0.5  # voxels; a linear sample cuts off 0.29 at sharp edges (observed)
NODE_TOLERANCE = 3e-8  # m; MuJoCo keeps vertices, and we distances, in float32: 6e-9 observed
NORMAL_TOLERANCE = 1e-6  # float32
SAME = 1e-9  # float64; through an ellipsoid's halvings

each_primitive = pytest.mark.parametrize("kind", GEOM_SDF, ids=lambda k: geoms._type_name(k))
each_precision = pytest.mark.parametrize("dtype", ["float32", "float64"])

# The L: a 2 x 2 square without its upper right quarter, 1 high; in dm.
L_CORNERS = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
L_VERTICES = [(x / 10, y / 10, z / 10) for z in (0, 1) for x, y in L_CORNERS]
L_CAP = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
L_FACES = [
    *((c, b, a) for a, b, c in L_CAP),
    *((a + 6, b + 6, c + 6) for a, b, c in L_CAP),
    *((i, (i + 1) % 6, (i + 1) % 6 + 6) for i in range(6)),
    *((i, (i + 1) % 6 + 6, i + 6) for i in range(6)),
]


def model_of(geom: str, asset: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco><asset>{asset}</asset><worldbody>
          <geom name="tool" {geom}/>
          <body mocap="true"><geom name="probe" type="sphere" size="{PROBE}"/></body>
        </worldbody></mujoco>""")


def primitive(kind: int) -> mujoco.MjModel:
    return model_of(f'type="{geoms._type_name(kind)}" size="{SIZE[0]} {SIZE[1]} {SIZE[2]}"')


def mesh_model(vertices: list, faces: list, inertia: str = "exact") -> mujoco.MjModel:
    flat = [" ".join(str(n) for n in itertools.chain(*rows)) for rows in (vertices, faces)]
    return model_of(
        'type="mesh" mesh="m"',
        f'<mesh name="m" inertia="{inertia}" vertex="{flat[0]}" face="{flat[1]}"/>',
    )


def mujoco_distance(model: mujoco.MjModel, points: np.ndarray) -> np.ndarray:
    """The oracle: C MuJoCo's distance (n,) from its first geom to a tiny sphere at world points (n, 3).

    It is false, and so refuses, for meshes, which MuJoCo takes as convex hulls, and for points inside an
    ellipsoid near a mid plane, where its iteration is off by 1e-4 (at the centre it finds 0).
    """
    kind = int(model.geom_type[0])
    if kind not in GEOM_SDF:
        raise ValueError("MuJoCo takes this geom for its convex hull")
    if kind == ELLIPSOID:
        inside = np.sum((points / model.geom_size[0]) ** 2, axis=1) < 1
        if np.any(inside & near_mid_plane(points)):
            raise ValueError("MuJoCo's iteration is not exact inside an ellipsoid near a mid plane")
    data, far, found = mujoco.MjData(model), 10.0, []
    for point in points:
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        found.append(mujoco.mj_geomDistance(model, data, 0, 1, far, None) + PROBE)
    assert max(found) < far
    return np.array(found)


def near_mid_plane(points: np.ndarray) -> np.ndarray:
    return np.any(np.abs(points) < 0.2 * min(SIZE), axis=1)


def points_around(kind: int) -> np.ndarray:
    """Points (n, 3): far and near outside, and inside down to the middle."""
    rng = np.random.default_rng(0)
    spread = np.repeat([1.0, 0.3, 0.1, 0.03], 100)[:, None]
    points = rng.uniform(-0.8, 0.8, (400, 3)) * spread
    return points[~near_mid_plane(points)] if kind == ELLIPSOID else points


def special_points() -> np.ndarray:
    """Points (n, 3) where careless distances divide by zero: origin, axes, mid planes, faces, edges, tips."""
    return np.array(list(itertools.product(*([0, s / 2, s, -s, 2 * s] for s in SIZE))))


def distances(shape: Shape, points: np.ndarray) -> np.ndarray:
    return np.asarray(jax.jit(jax.vmap(lambda p: geoms.distance(shape, p)))(points))


def normals(shape: Shape, points: np.ndarray) -> np.ndarray:
    return np.asarray(jax.jit(jax.vmap(lambda p: geoms.distance_and_normal(shape, p)[1]))(points))


@each_primitive
@each_precision
def test_distance_is_mujocos_own(kind: int, dtype: str) -> None:
    model, points = primitive(kind), points_around(kind)
    oracle = mujoco_distance(model, points)
    assert oracle.min() < -0.02 and oracle.max() > 0.5
    with jax.enable_x64(dtype == "float64"):
        phi = distances(geoms.shape_of(model, 0), points.astype(dtype))
    assert phi.dtype == dtype
    tolerance = ELLIPSOID_TOLERANCE if kind == ELLIPSOID else DISTANCE_TOLERANCE[dtype]
    np.testing.assert_allclose(phi, oracle, rtol=0, atol=tolerance)


@each_precision
def test_ellipsoid_distance_is_the_least_to_its_surface_at_mid_planes_too(dtype: str) -> None:
    theta, z = np.meshgrid(np.linspace(0, 2 * np.pi, 800), np.linspace(-1, 1, 401))
    across = np.sqrt(1 - z**2)
    surface = np.stack([across * np.cos(theta), across * np.sin(theta), z], axis=-1).reshape(-1, 3) * SIZE
    points = special_points()
    points = points[np.abs(np.sum((points / SIZE) ** 2, axis=1) - 1) > 0.2]
    least = np.array([np.sqrt(np.min(np.sum((surface - p) ** 2, axis=1))) for p in points])
    with jax.enable_x64(dtype == "float64"):
        phi = distances(Shape(ELLIPSOID, SIZE), points.astype(dtype))
    np.testing.assert_allclose(np.abs(phi), least, rtol=0, atol=SAMPLE_TOLERANCE)
    np.testing.assert_array_equal(phi < 0, np.sum((points / SIZE) ** 2, axis=1) < 1)


@each_primitive
@each_precision
def test_gradient_is_a_unit_vector_everywhere(kind: int, dtype: str) -> None:
    shape = Shape(kind, SIZE)
    points = np.concatenate([special_points(), points_around(kind)]).astype(dtype)
    with jax.enable_x64(dtype == "float64"):
        gradient = jax.jit(jax.vmap(jax.grad(lambda p: geoms.distance(shape, p))))(points)
        normal = normals(shape, points)
    for vectors in (gradient, normal):
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, rtol=0, atol=UNIT_TOLERANCE[dtype])


@each_primitive
def test_normal_is_the_way_distance_grows(kind: int) -> None:
    shape, points = Shape(kind, SIZE), points_around(kind)
    with jax.enable_x64(True):
        normal = normals(shape, points)
        grown = distances(shape, points + STEP * normal) - distances(shape, points - STEP * normal)
    np.testing.assert_allclose(grown / (2 * STEP), 1, rtol=0, atol=STEP_TOLERANCE)


@each_primitive
def test_gradient_by_size_is_exact(kind: int) -> None:
    def at_size(size: np.ndarray) -> np.ndarray:
        return np.asarray(jax.jit(jax.vmap(lambda p: GEOM_SDF[kind](size, p)))(points))

    points = points_around(kind)
    with jax.enable_x64(True):
        gradient = jax.jit(jax.vmap(jax.grad(GEOM_SDF[kind]), in_axes=(None, 0)))(np.array(SIZE), points)
        steps = STEP * np.eye(3)
        differences = [(at_size(SIZE + d) - at_size(SIZE - d)) / (2 * STEP) for d in steps]
    np.testing.assert_allclose(gradient, np.transpose(differences), rtol=0, atol=SIZE_TOLERANCE)


@each_primitive
def test_bounds_are_mujocos_own(kind: int) -> None:
    model = primitive(kind)
    shape = geoms.shape_of(model, 0)
    np.testing.assert_array_equal(geoms.centre(shape), 0)
    if kind == PLANE:  # MuJoCo writes 0 for endless
        assert np.isposinf([geoms.bounding_radius(shape), *geoms.half_extents(shape)]).all()
    else:
        np.testing.assert_allclose(geoms.half_extents(shape), model.geom_aabb[0, 3:])
        np.testing.assert_allclose(geoms.bounding_radius(shape), model.geom_rbound[0])


def test_tables_hold_the_same_geoms() -> None:
    assert GEOM_SDF.keys() == BOUNDS.keys()
    assert all(type(kind) is int for kind in GEOM_SDF)


def test_oracle_refuses_where_it_is_false() -> None:
    with pytest.raises(ValueError, match="convex hull"):
        mujoco_distance(mesh_model(L_VERTICES, L_FACES), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="mid plane"):
        mujoco_distance(primitive(ELLIPSOID), np.zeros((1, 3)))


def voxels_of(shape: Shape) -> Voxels:
    assert shape.voxels is not None
    return shape.voxels


def far_corner(voxels: Voxels) -> np.ndarray:
    return voxels.origin + voxels.spacing * (np.array(voxels.values.shape) - 1)


def l_distance(points: np.ndarray) -> np.ndarray:
    """Exact distance (n,) from the L to world points (n, 3), out of boxes: outside, to the nearer of the two
    that make it up; inside, to the square without the (endless) notch."""

    def box(low: list[float], high: list[float]) -> np.ndarray:
        q = np.maximum(np.array(low) - points, points - np.array(high))
        return np.where(q.max(axis=1) > 0, np.linalg.norm(np.maximum(q, 0), axis=1), q.max(axis=1))

    union = np.minimum(box([0, 0, 0], [0.2, 0.1, 0.1]), box([0, 0, 0], [0.1, 0.2, 0.1]))
    cut = np.maximum(box([0, 0, 0], [0.2, 0.2, 0.1]), -box([0.1, 0.1, -9], [9, 9, 9]))
    return np.where(union > 0, union, cut)


def in_geom_frame(model: mujoco.MjModel, points: np.ndarray) -> np.ndarray:
    """World points (n, 3) in the first geom's frame, which MuJoCo has put on the mesh's axes of inertia."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return ((points - data.geom_xpos[0]) @ data.geom_xmat[0].reshape(3, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def l_mesh(tmp_path_factory: pytest.TempPathFactory) -> tuple[mujoco.MjModel, Shape]:
    model = mesh_model(L_VERTICES, L_FACES)
    return model, geoms.shape_of(model, 0, cache_dir=tmp_path_factory.mktemp("sdf"))


def test_concave_mesh_keeps_its_notch(l_mesh: tuple[mujoco.MjModel, Shape]) -> None:
    model, shape = l_mesh
    voxels = voxels_of(shape)
    points = np.random.default_rng(0).uniform(-0.01, 0.21, (8000, 3)) * [1, 1, 0.5]
    local = in_geom_frame(model, points)
    sampled = np.all((local > voxels.origin) & (local < far_corner(voxels)), axis=1)
    error = np.abs(distances(shape, local) - l_distance(points))[sampled]
    assert np.sum(np.all(points[sampled, :2] > 0.1, axis=1)) > 500  # many lie in the notch
    assert error.max() < VOXEL_TOLERANCE * voxels.spacing


def test_mesh_distance_is_exact_at_voxel_nodes(l_mesh: tuple[mujoco.MjModel, Shape]) -> None:
    model, shape = l_mesh
    voxels = voxels_of(shape)
    at = np.argwhere(np.isfinite(voxels.values))
    frame = in_geom_frame(model, np.vstack([np.zeros(3), np.eye(3)])).astype(float)
    world = (voxels.origin + voxels.spacing * at - frame[0]) @ (frame[1:] - frame[0]).T
    np.testing.assert_allclose(voxels.values[tuple(at.T)], l_distance(world), rtol=0, atol=NODE_TOLERANCE)


def test_concave_mesh_has_the_normals_of_its_faces(l_mesh: tuple[mujoco.MjModel, Shape]) -> None:
    model, shape = l_mesh
    near_faces = np.array([[0.105, 0.15, 0.05], [0.095, 0.15, 0.05], [0.15, 0.105, 0.05], [0.05, 0.05, 0.11]])
    expected = np.array([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    found = normals(shape, in_geom_frame(model, near_faces))
    turned = in_geom_frame(model, expected) - in_geom_frame(model, np.zeros((4, 3)))
    np.testing.assert_allclose(found, turned, rtol=0, atol=NORMAL_TOLERANCE)


def test_mesh_distance_beyond_its_voxels_goes_on_without_a_step(l_mesh: tuple[mujoco.MjModel, Shape]) -> None:
    shape = l_mesh[1]
    along = np.linspace(0.9, 1.1, 2001)[:, None] * far_corner(voxels_of(shape))
    phi = distances(shape, along.astype(np.float32))
    step = np.linalg.norm(along[1] - along[0])
    assert np.abs(np.diff(phi)).max() < 2 * step  # at the edge, two distances of slope 1 are added


def test_mesh_distance_far_off_is_no_less_than_true(l_mesh: tuple[mujoco.MjModel, Shape]) -> None:
    model, shape = l_mesh
    points = np.random.default_rng(0).normal(size=(500, 3))
    points += np.sign(points) * 0.3
    excess = distances(shape, in_geom_frame(model, points)) - l_distance(points)
    assert excess.min() > -VOXEL_TOLERANCE * voxels_of(shape).spacing


def test_mesh_normal_is_finite_at_every_node(l_mesh: tuple[mujoco.MjModel, Shape]) -> None:
    voxels = voxels_of(l_mesh[1])
    nodes = voxels.origin + voxels.spacing * np.argwhere(np.isfinite(voxels.values))[::7]
    length = np.linalg.norm(normals(l_mesh[1], nodes.astype(np.float32)), axis=1)
    np.testing.assert_allclose(length, 1, atol=UNIT_TOLERANCE["float32"])


def test_mesh_bounds_hold_its_vertices_within_two_voxels(l_mesh: tuple[mujoco.MjModel, Shape]) -> None:
    model, shape = l_mesh
    vertices = in_geom_frame(model, np.array(L_VERTICES))
    centre, half = geoms.centre(shape), geoms.half_extents(shape)
    for slack in (vertices.min(axis=0) - (centre - half), centre + half - vertices.max(axis=0)):
        assert (slack >= 0).all() and (slack < 2 * voxels_of(shape).spacing).all()
    assert np.linalg.norm(vertices, axis=1).max() <= geoms.bounding_radius(shape)


def test_kept_voxels_are_used_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = mesh_model(L_VERTICES, L_FACES)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = geoms.shape_of(model, 0, cells=16)
    assert [f.suffix for f in (tmp_path / "mpm_env" / "sdf").iterdir()] == [".npz"]
    monkeypatch.setattr(voxels, "_mesh_distances", None)  # would raise if called
    second = geoms.shape_of(model, 0, cells=16)
    np.testing.assert_array_equal(voxels_of(first).values, voxels_of(second).values)


def test_other_meshes_and_other_cells_are_kept_apart(tmp_path: Path) -> None:
    longer = [(x, y, 2 * z) for x, y, z in L_VERTICES]
    geoms.shape_of(mesh_model(L_VERTICES, L_FACES), 0, cells=16, cache_dir=tmp_path)
    geoms.shape_of(mesh_model(L_VERTICES, L_FACES), 0, cells=20, cache_dir=tmp_path)
    geoms.shape_of(mesh_model(longer, L_FACES), 0, cells=16, cache_dir=tmp_path)
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: b"",
        lambda whole: b"not an archive",
        lambda whole: whole[: len(whole) // 2],
        lambda whole: whole[:500] + bytes([whole[500] ^ 1]) + whole[501:],
    ],
    ids=["empty", "foreign", "cut short", "one bit"],
)
def test_damaged_cache_is_rebuilt(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    model = mesh_model(L_VERTICES, L_FACES)
    first = geoms.shape_of(model, 0, cells=16, cache_dir=tmp_path)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    second = geoms.shape_of(model, 0, cells=16, cache_dir=tmp_path)
    np.testing.assert_array_equal(voxels_of(first).values, voxels_of(second).values)
    with np.load(file) as kept:
        np.testing.assert_array_equal(kept["values"], voxels_of(first).values)


def test_cache_that_cannot_be_written_warns_and_goes_on(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.warns(UserWarning, match="cannot be kept"):
        shape = geoms.shape_of(mesh_model(L_VERTICES, L_FACES), 0, cells=16, cache_dir=tmp_path / "file")
    assert shape.voxels is not None


def test_geom_without_a_distance_is_refused_by_name() -> None:
    ground = '<hfield name="h" nrow="2" ncol="2" size="1 1 1 1" elevation="0 0 0 1"/>'
    with pytest.raises(ValueError, match=r"tool is of type hfield.* plane, sphere, .*, box, mesh: replace"):
        geoms.shape_of(model_of('type="hfield" hfield="h"', ground), 0)


def test_unknown_geom_is_refused() -> None:
    with pytest.raises(ValueError, match=r"geom = 2 is not in this model: use an id in 0\.\.1"):
        geoms.shape_of(primitive(BOX), 2)


def test_mesh_without_faces_is_refused(tmp_path: Path) -> None:
    model = mesh_model(L_VERTICES, L_FACES)
    model.mesh_facenum[0] = 0
    with pytest.raises(ValueError, match="geom tool has a mesh without faces: give it faces"):
        geoms.shape_of(model, 0, cache_dir=tmp_path)


def test_a_sheet_is_refused(tmp_path: Path) -> None:
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0.1)]
    sheet = mesh_model(corners, [(0, 1, 2), (2, 1, 3)], inertia="shell")
    with pytest.raises(ValueError, match=r"mesh of geom tool has a hole, .* near \(.*\) m .*: mend it, or"):
        geoms.shape_of(sheet, 0, cells=16, cache_dir=tmp_path)


@pytest.mark.parametrize("cells", [7, 257])
def test_too_few_or_too_many_cells_are_refused(cells: int, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"cells = {cells} for the mesh of geom tool is outside 8\.\.256"):
        geoms.shape_of(mesh_model(L_VERTICES, L_FACES), 0, cells=cells, cache_dir=tmp_path)


@pytest.mark.slow
def test_the_nearest_of_many_geoms_is_found_as_if_each_were_alone(l_mesh: tuple[mujoco.MjModel, Shape]) -> None:
    rng = np.random.default_rng(3)
    sizes = rng.uniform(0.05, 0.2, (2 * len(GEOM_SDF), 3))
    # No plane: every point is under one of two that are tilted.
    kinds = [kind for kind in GEOM_SDF if GEOM_SDF[kind] is not geoms.plane]
    shapes = (l_mesh[1], *(Shape(kind, tuple(size)) for kind, size in zip(2 * kinds, sizes, strict=False)))
    pos, turn = rng.uniform(-0.6, 0.6, (len(shapes), 3)), Rotation.random(len(shapes), rng).as_matrix()
    x = rng.uniform(-0.8, 0.8, (500, 3))
    with jax.enable_x64(True):
        phi, n, geom = map(np.asarray, jax.jit(partial(nearest_geom, shapes))(x.T, pos, turn))
        local = [(x - p) @ R for p, R in zip(pos, turn, strict=True)]
        alone = np.asarray([distances(shape, at) for shape, at in zip(shapes, local, strict=True)])
        own = [normals(shape, at) @ R.T for shape, at, R in zip(shapes, local, turn, strict=True)]
    assert set(geom) == set(range(len(shapes)))
    np.testing.assert_allclose(phi, alone.min(axis=0), rtol=0, atol=SAME)
    np.testing.assert_array_equal(geom, alone.argmin(axis=0))
    np.testing.assert_allclose(n.T, np.asarray(own)[geom, np.arange(len(x))], rtol=0, atol=SAME)
