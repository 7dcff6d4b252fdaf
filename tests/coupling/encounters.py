"""Points and bodies to meet each other: around geoms of every kind, and before bodies of many masses and joints."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from coupling.constraints import Rows
from coupling.exchange import Twists
from coupling.geoms import Shape, Voxels
from coupling.meeting import Geoms, Meeting, Surfaces, meet, near
from mpm_env import native


class Case(NamedTuple):
    """What `meet` is given; numpy in float64."""

    pos: Any  # (G, 3) m
    mat: Any  # (G, 3, 3)
    t: Twists
    mu: Any  # (G,) or, with more than one material, (G, M)
    q_free: Any  # (nv,) m/s
    x: Any  # (3, K) m
    v: Any  # (3, K) m/s
    m: Any  # (K,) kg
    hold: Any = np.zeros(())  # () or (M,) N s
    shares: Any = None  # (M, K)
    full: Any = None  # (K,) kg


def encounter(g: Geoms, case: Case, reach: float) -> Meeting:
    """The points of a case meet its bodies."""
    mu, hold = case.mu.reshape(len(g.shapes), -1), jnp.atleast_1d(jnp.asarray(case.hold, case.x.dtype))
    surfaces = Surfaces(mu, hold, case.shares, case.full)
    return meet(g, case.pos, case.mat, case.t, surfaces, case.q_free, case.x, case.v, case.m, reach)


def in_precision(numbers: Any, dtype: str) -> Any:
    """Numbers as that precision stores them, so that inputs are not counted as errors."""
    return jax.tree.map(lambda a: np.asarray(a).astype(dtype).astype(np.float64), numbers)


@cache
def program(g: Geoms, reach: float, how: str) -> Any:
    def one(case: Case) -> Meeting:
        return encounter(g, case, reach)

    return jax.jit({"one": one, "batch": jax.vmap(one), "map": lambda cases: jax.lax.map(one, cases)}[how])


def met(g: Geoms, case: Case, reach: float, dtype: str, how: str = "one") -> Meeting:
    """How points meet bodies in this precision, back as float64; a batch of cases at once, or one by one in a map."""
    if g.kernels == "native":
        assert native.why_not() is None  # and so they are loaded
    with jax.enable_x64(dtype == "float64"):
        cast = jax.tree.map(lambda a: jnp.asarray(a, dtype), case)
        return jax.tree.map(lambda a: np.asarray(a, np.float64), program(g, reach, how)(cast))


# Points around one geom of every kind, and a second mesh.

SIZE = (0.3, 0.15, 0.1)  # m; each primitive reads from it what it needs
KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "mesh")
TIPS = {
    "sphere": (0, SIZE[0], 0),
    "capsule": (0, 0, SIZE[0] + SIZE[1]),
    "ellipsoid": (SIZE[0], 0, 0),
    "cylinder": (SIZE[0], 0, SIZE[1]),
    "box": SIZE,
    "mesh": (-0.14, 0, 0),
}  # m, where geoms that end reach farthest from their middle
LAYER = 0.05  # m, that adhesion is shared in
DT = 0.01  # s, in which gaps may close
EACH = 125  # points around each geom: no multiple of 16, nor is eight times it
PITCH = 1.5  # m between geoms that stand apart
FAR = 10.0  # m, a reach that all points are within
DIGIT = 1e-6  # m, a few roundings of a position in float32; what a normal changes over it is not known any better
LOW = -0.02  # m, a lower limit for those near
BORDER = 1e-5  # m, that no point is from its upper limit


def balls(nodes: tuple[int, int, int], spacing: float) -> Voxels:
    """Voxels of two balls that overlap: a mesh that is concave, and off the middle of its grid."""
    origin = -0.55 * spacing * np.array(nodes)
    at = origin + spacing * np.stack(np.meshgrid(*map(np.arange, nodes), indexing="ij"), axis=-1)
    values = [np.linalg.norm(at - c, axis=-1) - r for c, r in (((-0.05, 0, 0), 0.09), ((0.05, 0.02, 0), 0.07))]
    return Voxels(np.minimum(*values).astype(np.float32), origin, spacing)


@cache
def shapes() -> tuple[Shape, ...]:
    voxels = iter((balls((18, 14, 12), 0.02), balls((13, 17, 18), 0.025)))
    numbers = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")) for kind in KINDS]
    return tuple(
        Shape(number, SIZE, next(voxels) if kind == "mesh" else None)
        for number, kind in zip(numbers, KINDS, strict=True)
    )


@cache
def geoms(kernels: str, plane_strain: bool = False) -> Geoms:
    """All of them on one body without joints."""
    return Geoms(shapes(), tuple(0 for _ in KINDS), 0, LAYER, DT, plane_strain, kernels)


@cache
def around(layout: str) -> Case:
    """Points inside, beside and far from geoms, as many meant for each.

    Geoms stand "apart", turned; along the "axes", apart too, with points where careless distances divide by zero; or in
    a "crowd", turned and through each other.
    """
    rng = np.random.default_rng(0)
    G = len(KINDS)
    pos = PITCH * np.array([(0, 0, -1), *itertools.product((-1, 0, 1), (-1, 0, 1), (0,))], float)[:G]
    mat = Rotation.random(G, rng).as_matrix()
    mat[0] = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix()  # the plane stays under the others
    local = rng.uniform(-0.6, 0.6, (G, EACH, 3)) * np.resize([1.0, 0.3, 0.1, 0.03], EACH)[:, None]
    if layout == "axes":
        mat[:] = np.eye(3)
        local[:] = list(itertools.product(*([0, s / 2, s, -s, 2 * s] for s in SIZE)))
    if layout == "crowd":
        pos[1:] = rng.uniform(-0.4, 0.4, (G - 1, 3))
        pos[0, 2] = -0.5
        local = (rng.uniform(-0.7, 0.7, (G, EACH, 3)) - pos[:, None]) @ mat
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
    """What the points of a layout face, as this precision stores them and their geoms."""
    case = in_precision(around(layout), dtype)
    steps = DIGIT * np.concatenate([np.zeros((3, 1)), np.eye(3), -np.eye(3)], axis=1)
    x = (case.x[:, None] + steps[:, :, None]).reshape(3, -1)
    case = case._replace(x=x, v=np.zeros_like(x), m=np.ones(x.shape[1]))
    done = met(geoms("xla"), case, FAR, "float64")
    phi, n = done.phi.reshape(7, -1), done.n.reshape(3, 7, -1)
    return Faced(phi[0], n[:, 0], np.abs(n - n[:, :1]).max(axis=(0, 1)))


@cache
def found(layout: str, dtype: str) -> Meeting:
    """What the kernel says that they face."""
    return met(geoms("native"), around(layout), FAR, dtype)


def alone(geom: int, x: np.ndarray, turn: np.ndarray | None = None) -> tuple[Geoms, Case]:
    """One of the geoms in the middle, turned or not, among points x (3, N) m, for `near`."""
    mat = (np.eye(3) if turn is None else turn)[None]
    case = around("apart")._replace(pos=np.zeros((1, 3)), mat=mat, x=x)
    return Geoms((shapes()[geom],), (0,), 0, LAYER, DT, False, "native"), case


def listed(phi: np.ndarray, low: float, high: np.ndarray, room: int) -> np.ndarray:
    """Indices (room,) that `near` must find where distances are phi."""
    return np.append(np.flatnonzero((phi > low) & (phi < high)), np.full(room, len(phi)))[:room]


@cache
def _looking(g: Geoms, low: float, room: int) -> Any:
    return jax.jit(lambda pos, mat, x, high: near(g, pos, mat, x, low, high, room))


def looked_up(g: Geoms, case: Case, low: float, high: np.ndarray, room: int, dtype: str) -> tuple[np.ndarray, bool]:
    """What `near` finds in this precision."""
    if g.kernels == "native":
        assert native.why_not() is None  # and so they are loaded
    with jax.enable_x64(dtype == "float64"):
        cast = (jnp.asarray(a, dtype) for a in (case.pos, case.mat, case.x, high))
        index, over = _looking(g, low, room)(*cast)
        assert index.dtype == np.int32
        return np.asarray(index), bool(over)


@cache
def limits(dtype: str) -> np.ndarray:
    """An upper limit for each point of the crowd, some of them none at all."""
    rng = np.random.default_rng(2)
    phi = faced("crowd", dtype).phi
    high = np.where(rng.random(phi.shape) < 0.2, -np.inf, rng.uniform(-0.1, 0.3, phi.shape))
    high = np.where(np.abs(high - phi) < BORDER, high + 2 * BORDER, high)
    assert np.abs(phi - LOW).min() > DIGIT, "a point is on the border"
    return in_precision(high, dtype)


# Points before the faces of boxes and spheres on bodies that can yield.

REACH = 0.05  # m
BODY_OF = (0, 1, 1, 2, 0, 2)  # of each geom
BALLS, BOXES = (0, 2, 5), (1, 3, 4)  # which of the geoms
RADIUS, HALF = 0.1, np.array([0.1, 0.06, 0.08])  # m
PER_GEOM = 10  # points before each geom; one more is far from all, which makes a number that is no multiple of 16
FACED = np.append(np.repeat(np.arange(len(BODY_OF)), PER_GEOM), -1)  # (K,) the geom before each point
JOINTS = (0, 1, 3, 6, 9)
RATIOS = (1e-3, 0.03, 1.0, 30.0, 1e3)  # of the bodies' mass to that of the points
FRICTIONS = (0.0, 0.5, 2.0)
TOLD = (0.0, 1.0)  # m/s and rad/s that bodies are also told to move with
CROWDS = (1, 7, 16, 17, 33)  # as many as there are JOINTS
COPIES = len(RATIOS) * len(FRICTIONS) * len(TOLD)


class Encounters(NamedTuple):
    """Cases, each with a leading axis of instances, and what their points face by construction."""

    case: Case
    phi: np.ndarray  # (instances, K) m
    n: np.ndarray  # (instances, 3, K)


@cache
def crowd(kernels: str, iterations: int = 6) -> Geoms:
    """Three balls and three boxes on three bodies."""
    ball, box = Shape(2, (RADIUS, 0, 0)), Shape(6, tuple(HALF))
    return Geoms(
        tuple(ball if g in BALLS else box for g in range(len(BODY_OF))), BODY_OF, iterations, LAYER, DT, False, kernels
    )


@cache
def encounters(nv: int) -> Encounters:
    """One for every mass ratio, friction, and whether bodies are also told to move, with nv joint velocities."""
    rng = np.random.default_rng(nv)
    rows = []
    for ratio, friction, told in itertools.product(RATIOS, FRICTIONS, TOLD):
        G, K = len(BODY_OF), len(FACED)
        places = list(itertools.product((-0.6, 0, 0.6), repeat=3))  # so far apart that none is in another's way
        pos, mat = rng.permutation(places)[:G], Rotation.random(G, rng).as_matrix()
        phi = rng.uniform(-0.02, 0.045, (G, PER_GEOM)) + 0.07 * (rng.random((G, PER_GEOM)) < 0.15)
        n = rng.normal(size=(G, PER_GEOM, 3))
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        local = n * (RADIUS + phi)[..., None]
        for g in BOXES:
            face, side, k = rng.integers(0, 3, PER_GEOM), rng.choice([-1.0, 1.0], PER_GEOM), np.arange(PER_GEOM)
            local[g], n[g] = rng.uniform(-0.6, 0.6, (PER_GEOM, 3)) * HALF, 0  # away from edges
            local[g, k, face], n[g, k, face] = side * (HALF[face] + phi[g]), side
        n = np.einsum("gij,gkj->igk", mat, n).reshape(3, -1)
        x = np.einsum("gij,gkj->igk", mat, local).reshape(3, -1) + np.repeat(pos, PER_GEOM, axis=0).T
        m = 10 ** rng.uniform(-3, 0, K) * (rng.random(K) < 0.9)
        case = Case(
            pos,
            mat,
            _twists(nv, ratio * m.sum(), told, rng),
            friction * rng.uniform(0.5, 1, G),
            rng.normal(size=nv),
            np.column_stack([x, [3, 3, 3]]),
            rng.normal(size=(3, K)),
            m,
        )
        rows.append(Encounters(case, np.append(phi, 9), np.column_stack([n, np.zeros(3)])))
    return jax.tree.map(lambda *a: np.stack(a), *rows)


def _twists(nv: int, mass: float, told: float, rng: np.random.Generator) -> Twists:
    """Six joints are those of one free body beside two fixed ones; any other number, some mechanism of all."""
    if nv == 6:
        J, M = np.zeros((3, 6, 6)), np.diag([1, 1, 1, 0.01, 0.02, 0.015])
        J[0] = np.eye(6)
    else:
        J, A = rng.normal(size=(3, 6, nv)), rng.normal(size=(nv, nv))
        M = A @ A.T / max(nv, 1) + 0.1 * np.eye(nv)
    return Twists(rng.uniform(-0.6, 0.6, (3, 3)), J, told * rng.normal(size=(3, 6)), mass * M)


@cache
def constrained(dtype: str) -> Case:
    """The mechanism of nine joints, some of which rigid constraints hold: an equality, dry friction, limits."""
    case, rng = encounters(9).case, np.random.default_rng(11)
    count, nv, r = *case.q_free.shape, 6
    J = rng.normal(size=(count, r, nv))
    undamped = case.t.M - 0.1 * np.linalg.eigvalsh(case.t.M)[:, :1, None] * np.eye(nv)
    T = np.linalg.solve(undamped, case.t.M)
    heavy = np.trace(case.t.M, axis1=1, axis2=2)[:, None] / nv  # kg, as bodies are
    free, one = heavy * np.inf, np.ones((count, 1))
    low = np.concatenate([-free, -0.3 * heavy, *[0 * heavy] * 4], axis=1)
    high = np.concatenate([free, 0.3 * heavy, *[free] * 4], axis=1)
    D = heavy * 10 ** rng.uniform(-1, 2, (count, r))
    aim = np.concatenate([rng.normal(size=(count, r - 1)), -50 * one], axis=1)  # the last limit is far away
    given = np.clip(0.1 * heavy * rng.normal(size=(count, r)), low, high)
    rows = Rows(J, T, D, aim, low, high, given)
    return in_precision(case._replace(t=case.t._replace(rows=rows)), dtype)


def padded(case: Case) -> Case:
    """The cases with as many joints as the largest have: those that come to it move no body."""
    (count, nv), most = case.q_free.shape, max(JOINTS)
    J, M, q = np.zeros((count, 3, 6, most)), np.tile(np.eye(most), (count, 1, 1)), np.zeros((count, most))
    J[..., :nv], M[:, :nv, :nv], q[:, :nv] = case.t.J, case.t.M, case.q_free
    return case._replace(q_free=q, t=case.t._replace(J=J, M=M))


def solved(cases: list[Case]) -> list[Meeting]:
    """The reference's answers, in float64, to as many batches of COPIES cases as there are JOINTS: one program."""
    together = jax.tree.map(lambda *a: np.concatenate(a), *map(padded, cases))
    done = met(crowd("xla"), together, REACH, "float64", "batch")
    return [jax.tree.map(lambda a, k=k: a[k * COPIES : (k + 1) * COPIES], done) for k in range(len(cases))]


@cache
def answers(dtype: str) -> list[Meeting]:
    """The reference's, by number of joints."""
    return solved([in_precision(encounters(nv).case, dtype) for nv in JOINTS])


@cache
def native_answer(nv: int, dtype: str, iterations: int = 6) -> Meeting:
    """The kernel's."""
    return met(crowd("native", iterations), encounters(nv).case, REACH, dtype, "batch")


@cache
def few(dtype: str) -> tuple[list[Case], list[Meeting]]:
    """The free body with the first points only: the cases for each number of them, and the reference's answers."""
    case = in_precision(encounters(6).case, dtype)
    cases = [case._replace(m=case.m * (np.arange(case.m.shape[1]) < count)) for count in CROWDS]
    return cases, solved(cases)


@cache
def sticky(dtype: str) -> Case:
    """The free body before points of two materials, one of which it holds on to; one for every mass ratio and so on."""
    case, rng = encounters(6).case, np.random.default_rng(8)
    share = rng.random((len(case.q_free), 1, len(FACED)))
    mu = case.mu[..., None] * np.array([1.0, 0.3])
    hold = np.tile([0.05, 0.0], (len(mu), 1))
    return in_precision(case._replace(mu=mu, hold=hold, shares=np.concatenate([share, 1 - share], axis=1)), dtype)


@cache
def gapped(dtype: str) -> Case:
    """The free body before nodes of which some have little of the material that could be around them."""
    case, rng = encounters(6).case, np.random.default_rng(9)
    fill = np.where(
        rng.random(case.m.shape) < 0.5, rng.uniform(0, 1.2, case.m.shape), rng.uniform(0, 0.2, case.m.shape)
    )
    return in_precision(case._replace(full=np.where(case.m > 0, case.m / np.maximum(fill, 1e-3), 1)), dtype)


def sliding(nv: int) -> tuple[Geoms, Case]:
    """Points that all slide over a ball, none near a kink of the law."""
    rng = np.random.default_rng(5)
    n = rng.normal(size=(9, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    v = 2 * np.cross(n, rng.normal(size=(9, 3))) - n
    t = Twists(np.zeros((1, 3)), 0.3 * rng.normal(size=(1, 6, nv)), 0.1 * rng.normal(size=(1, 6)), 3 * np.eye(nv))
    q = rng.normal(scale=0.2, size=nv)
    case = Case(np.zeros((1, 3)), np.eye(3)[None], t, np.full(1, 0.3), q, 0.11 * n.T, v.T, rng.uniform(0.1, 1, 9))
    return Geoms((Shape(2, (RADIUS, 0, 0)),), (0,), 3, LAYER, DT, False, "native"), case


@cache
def digest() -> dict[str, np.ndarray]:
    """What the kernels make of some of these cases; names end in the precision."""
    out: dict[str, Any] = {f"distances float{bits}": found("crowd", f"float{bits}") for bits in (32, 64)}
    out |= {f"exchange float{bits}": native_answer(9, f"float{bits}") for bits in (32, 64)}
    out["near float32"] = looked_up(geoms("native"), around("crowd"), LOW, limits("float32"), 200, "float32")[0]
    return {f"{i} {name}": leaf for name, a in out.items() for i, leaf in enumerate(jax.tree.leaves(a))}
