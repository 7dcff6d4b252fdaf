"""Points that meet bodies: the native kernels against the same in JAX, and against what must hold of any exchange.

The reference is asked in float64 only, about numbers as the kernels get them, and with as many joints as the largest
case has, since joints that move no body change nothing: few programs are compiled, and float32 meets a better judge.
"""

import itertools
import shutil
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coupling.exchange import Twists
from coupling.geoms import Shape, Voxels
from coupling.meeting import Geoms, Meeting, meet
from mpm_env import native

FAR = 10.0  # m, a reach that all points are within
REACH = 0.05  # m
each_precision = pytest.mark.parametrize("dtype", ["float32", "float64"])


@pytest.fixture(autouse=True)
def _needs_kernels() -> None:
    """A machine with a compiler has them: only one without may skip."""
    if native.why_not() and shutil.which("g++") is None:
        pytest.skip(f"no native kernels: {native.why_not()}")
    assert native.why_not() is None


class Case(NamedTuple):
    """What `meet` is given, in its order; numpy in float64."""

    pos: Any  # (G, 3) m
    mat: Any  # (G, 3, 3)
    t: Twists
    mu: Any  # (G,)
    q_free: Any  # (nv,) m/s
    x: Any  # (3, K) m
    v: Any  # (3, K) m/s
    m: Any  # (K,) kg


@cache
def program(g: Geoms, reach: float, batch: bool) -> Any:
    def one(case: Case) -> Meeting:
        return meet(g, *case, reach)

    return jax.jit(jax.vmap(one) if batch else one)


def met(g: Geoms, case: Case, reach: float, dtype: str, batch: bool = False) -> Meeting:
    """How the points met the bodies in this precision, back as float64."""
    with jax.enable_x64(dtype == "float64"):
        cast = jax.tree.map(lambda a: jnp.asarray(a, dtype), case)
        return jax.tree.map(lambda a: np.asarray(a, np.float64), program(g, reach, batch)(cast))


def in_precision(a: Any, dtype: str) -> Any:
    """Numbers as that precision stores them, so that inputs are not counted as errors."""
    return jax.tree.map(lambda n: n.astype(dtype).astype(np.float64), a)


def close(a: np.ndarray, b: np.ndarray, tolerance: Any) -> None:
    np.testing.assert_array_less(np.abs(a - b), np.broadcast_to(tolerance, b.shape) + 1e-300)


# ---- Distances and normals: all kinds of geoms at once.

SIZE = (0.3, 0.15, 0.1)  # m; each primitive reads from it what it needs
KINDS = ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH", "MESH")
EACH = 125  # points around each geom: a number that is no multiple of 16, nor is eight times it one of 128
LAYOUTS = ("apart", "axes", "crowd")
PITCH = 1.5  # m between the geoms that stand apart
DIGIT = 1e-6  # m, about the rounding of positions in float32; what normals change over it is not known any better
RIDGE = 1e-3  # change of the normal over a digit, from where it is not compared
DEFINED = 0.85  # of the points, at least, that are away from ridges
DISTANCE_TOLERANCE = {"float32": 1e-6, "float64": 1e-12}  # m;
NORMAL_TOLERANCE = {"float32": 2e-6, "float64": 1e-9}


def balls(nodes: tuple[int, int, int], spacing: float) -> Voxels:
    """Voxels of two balls that overlap: a mesh, concave, and off the middle of its grid."""
    origin = -0.55 * spacing * np.array(nodes)
    at = origin + spacing * np.stack(np.meshgrid(*map(np.arange, nodes), indexing="ij"), axis=-1)
    values = [np.linalg.norm(at - c, axis=-1) - r for c, r in (((-0.05, 0, 0), 0.09), ((0.05, 0.02, 0), 0.07))]
    return Voxels(np.minimum(*values).astype(np.float32), origin, spacing)


@cache
def geoms(kernels: str, plane_strain: bool = False) -> Geoms:
    """One of every kind, and a second mesh."""
    return Geoms(shapes(), tuple(0 for _ in KINDS), 0, plane_strain, kernels)


@cache
def shapes() -> tuple[Shape, ...]:
    voxels = iter((balls((18, 14, 12), 0.02), balls((13, 17, 18), 0.025)))
    numbers = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in KINDS]
    return tuple(
        Shape(n, SIZE, next(voxels) if kind == "MESH" else None) for n, kind in zip(numbers, KINDS, strict=True)
    )


@cache
def around(layout: str) -> Case:
    """Points outside, inside and far from geoms that stand apart and turned; that stand along the axes, and points where
    careless distances divide by zero; or in a crowd. In this order of geoms, `EACH` points are meant for each."""
    rng = np.random.default_rng(0)
    G = len(KINDS)
    pos = PITCH * np.array([(0, 0, -1), *itertools.product((-1, 0, 1), (-1, 0, 1), (0,))], float)[:G]
    mat = Rotation.random(G, rng).as_matrix()
    mat[0] = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix()
    local = rng.uniform(-0.6, 0.6, (G, EACH, 3)) * np.resize([1.0, 0.3, 0.1, 0.03], EACH)[:, None]
    if layout == "axes":
        mat[:] = np.eye(3)
        local[:] = list(itertools.product(*([0, s / 2, s, -s, 2 * s] for s in SIZE)))
    if layout == "crowd":
        pos[1:] = rng.uniform(-0.4, 0.4, (G - 1, 3))
        pos[0, 2] = -0.5
        local = rng.uniform(-0.7, 0.7, (G, EACH, 3)) - pos[:, None]
        local = local @ mat
    x = np.concatenate([p + a @ R.T for p, a, R in zip(pos, local, mat, strict=True)]).T
    t = Twists(np.zeros((1, 3)), np.zeros((1, 6, 0)), np.zeros((1, 6)), np.zeros((0, 0)))
    return Case(pos, mat, t, np.ones(G), np.zeros(0), x, np.zeros_like(x), np.ones(x.shape[1]))


class Faced(NamedTuple):
    """What points face, by the reference in float64."""

    phi: np.ndarray  # (K,) m
    n: np.ndarray  # (3, K)
    change: np.ndarray  # (K,) of n over a digit of the position


@cache
def faced(layout: str, dtype: str) -> Faced:
    case = in_precision(around(layout), dtype)
    steps = DIGIT * np.concatenate([np.zeros((3, 1)), np.eye(3), -np.eye(3)], axis=1)
    x = (case.x[:, None] + steps[:, :, None]).reshape(3, -1)
    case = case._replace(x=x, v=np.zeros_like(x), m=np.ones(x.shape[1]))
    done = met(geoms("xla"), case, FAR, "float64")
    phi, n = done.phi.reshape(7, -1), done.n.reshape(3, 7, -1)
    return Faced(phi[0], n[:, 0], np.abs(n - n[:, :1]).max(axis=(0, 1)))


@cache
def found(layout: str, dtype: str) -> Meeting:
    return met(geoms("native"), around(layout), FAR, dtype)


@each_precision
@pytest.mark.parametrize("layout", LAYOUTS)
def test_distances_are_those_of_the_reference(layout: str, dtype: str) -> None:
    truth = faced(layout, dtype)
    assert truth.phi.min() < -0.05 and truth.phi.max() > 0.3
    err = np.abs(found(layout, dtype).phi - truth.phi).reshape(8, -1).max(axis=1)
    print(layout, dtype, err)


@each_precision
@pytest.mark.parametrize("layout", LAYOUTS)
def test_normals_are_those_of_the_reference(layout: str, dtype: str) -> None:
    truth = faced(layout, dtype)
    n = found(layout, dtype).n
    clear = truth.change < RIDGE
    err = np.where(clear, np.abs(n - truth.n).max(axis=0) - (truth.change if dtype == "float32" else 0), 0)
    print(layout, dtype, err.reshape(8, -1).max(axis=1), clear.reshape(8, -1).mean(axis=1))
    print(np.abs(np.linalg.norm(n, axis=0) - 1).max())
