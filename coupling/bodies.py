"""The rigid side of a scene: which geoms meet grains, where they are, and one rigid step around the grains' substeps.

All use of MJX lives here. A rigid step is MuJoCo's own step cut in two: `open_step` computes everything that does not
depend on the grains, `close_step` adds their summed impulse and integrates. Between the two the grains run, meeting
bodies that move with the joint velocities of the exchange.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    from mujoco import mjx  # prints that it lacks a package which nothing here uses
from mujoco.mjx._src.types import IntegratorType

from coupling.constraints import Laws, rows
from coupling.exchange import Twists
from coupling.geoms import Shape, once, shape_of

INTEGRATORS = {mujoco.mjtIntegrator.mjINT_EULER: "Euler", mujoco.mjtIntegrator.mjINT_IMPLICITFAST: "implicitfast"}


@dataclass(frozen=True, eq=False)
class Bodies:
    """A MuJoCo model as grains see it: the coupled geoms, and the bodies that carry them. Static."""

    model: mujoco.MjModel
    mjx_model: Any  # mjx.Model
    geoms: tuple[int, ...]  # (G) ids of coupled geoms
    shapes: tuple[Shape, ...]  # (G)
    friction: tuple[tuple[float, ...], ...]  # (G, M) to each material
    bodies: tuple[int, ...]  # (B) ids of the bodies that carry coupled geoms
    body_of: tuple[int, ...]  # (G) index into bodies
    mocap: tuple[int, ...]  # (B) mocap id of the body it hangs on, or -1

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coupled geoms."""
        return tuple(self.model.geom(g).name or f"geom{g}" for g in self.geoms)

    @property
    def yields(self) -> bool:
        """Whether any coupled body can give way to the grains; if none can, no exchange is solved."""
        return any(_jointed(self.model, b) for b in self.bodies)

    @property
    def steps(self) -> bool:
        """Whether there is any joint for MJX to step."""
        return self.model.nv > 0


class Stance(NamedTuple):
    """The coupled bodies over one rigid step: geometry and inertia are those of its start."""

    centre: Array  # (B, 3) m, centres of mass
    lever: Array  # (G, 3) m, geom frame's origin from its body's centre
    mat: Array  # (G, 3, 3) geom axes
    J: Array  # (B, 6, nv)
    drift: Array  # (B, 6) prescribed twist of mocap bodies, m/s and rad/s
    M: Array  # (nv, nv) what the integrator solves
    acceleration: Array  # (nv,) of the joints without grains and rigid constraints
    q: Array  # (nv,) joint velocities at the start
    laws: Laws  # of the rigid constraints


def couple(model: mujoco.MjModel, geoms: dict[int, tuple[float, ...]]) -> Bodies:
    """The rigid side for a model and its coupled geoms with their friction coefficients to each material.

    Raises ValueError where MJX cannot run the model, or a geom has no signed distance.
    """
    if model.nv and model.opt.integrator not in INTEGRATORS:
        raise ValueError(
            f"The model's integrator is {mujoco.mjtIntegrator(model.opt.integrator).name}, which cannot be solved"
            f" together with grains: choose {' or '.join(INTEGRATORS.values())}."
        )
    if model.nv and model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and _collides(model):
        raise ValueError(
            "The model's friction cones are elliptic, which cannot be solved together with grains:"
            ' choose <option cone="pyramidal"/>.'
        )
    try:
        mjx_model = mjx.put_model(model)
    except NotImplementedError as error:
        raise ValueError(f"MJX cannot run this model: {error}. Remove that feature or those contacts.") from None
    ids = tuple(geoms)
    carriers = [int(model.geom_bodyid[g]) for g in ids]
    bodies = tuple(dict.fromkeys(carriers))
    mocap = [int(model.body_mocapid[model.body_rootid[b]]) for b in bodies]
    for body, on in zip(bodies, mocap, strict=True):
        if on >= 0 and _jointed(model, body):
            raise ValueError(
                f"The coupled body {model.body(body).name!r} hangs by a joint on a mocap body, which moves it without"
                " a velocity: give it a free joint and a weld to the mocap body, or no joint."
            )
    return Bodies(
        model,
        mjx_model,
        ids,
        tuple(shape_of(model, g) for g in ids),
        tuple(geoms.values()),
        bodies,
        tuple(bodies.index(b) for b in carriers),
        tuple(mocap),
    )


def _collides(model: mujoco.MjModel) -> bool:
    """Whether any two geoms may touch each other."""
    return bool(model.geom_contype.any() and model.geom_conaffinity.any()) or model.npair > 0


def _jointed(model: mujoco.MjModel, body: int) -> bool:
    """Whether any joint can move this body."""
    return bool(model.body_treeid[body] >= 0)


def posed(
    b: Bodies, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray, mocap: tuple[np.ndarray, np.ndarray]
) -> mujoco.MjData:
    """MuJoCo's data at qpos (nq,) with joint velocities qvel (nv,), controls ctrl (nu,) and mocap poses set; fresh."""
    d = mujoco.MjData(b.model)
    d.qpos[:], d.qvel[:], d.ctrl[:] = qpos, qvel, ctrl
    d.mocap_pos[:], d.mocap_quat[:] = mocap
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
        stage(b.model, d)
    return d


def start(b: Bodies, d: mujoco.MjData) -> Any:
    """MJX data from MuJoCo's, see `posed`: a program in which bodies start has nothing of placing them to compile."""
    return mjx.put_data(b.model, d)


def place(d: Any, position: Array, quaternion: Array) -> Any:
    """Data with its mocap bodies at these positions (nmocap, 3) m and quaternions (nmocap, 4) w x y z."""
    return d.replace(
        mocap_pos=jnp.asarray(position, d.mocap_pos.dtype), mocap_quat=jnp.asarray(quaternion, d.mocap_quat.dtype)
    )


def drift(b: Bodies, d: Any, position: Array, quaternion: Array) -> Array:
    """Twists (B, 6) that bring the mocap bodies to the given poses in one rigid step; zero for all other bodies."""
    dt = b.model.opt.timestep
    out = []
    for body, mocap in zip(b.bodies, b.mocap, strict=True):
        if mocap < 0:
            out.append(jnp.zeros((6,), d.qpos.dtype))
            continue
        spin = _quaternion_difference(d.mocap_quat[mocap], quaternion[mocap]) / dt
        arm = d.xipos[body] - d.mocap_pos[mocap]
        new = position[mocap] + _rotate(quaternion[mocap], _rotate(d.mocap_quat[mocap] * _CONJUGATE, arm))
        out.append(jnp.concatenate([(new - d.xipos[body]) / dt, spin]))
    return jnp.stack(out)


_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0], np.float32)


def _rotate(q: Array, v: Array) -> Array:
    """v (3,) turned by the unit quaternion q (4,) w x y z."""
    return v + 2 * jnp.cross(q[1:], jnp.cross(q[1:], v) + q[0] * v)


def _quaternion_difference(a: Array, b: Array) -> Array:
    """Rotation vector (3,) rad in world axes that takes orientation a to orientation b."""
    turn = _product(b, a * _CONJUGATE)
    w, v = turn[0], turn[1:]
    v = jnp.where(w < 0, -v, v)
    norm = jnp.sqrt(jnp.sum(v * v) + 1e-30)
    return 2 * jnp.arctan2(norm, jnp.abs(w)) / norm * v


def _product(a: Array, b: Array) -> Array:
    """The quaternion a b (4,) w x y z: turn by b, then by a."""
    return jnp.concatenate(
        [(a[0] * b[0] - jnp.dot(a[1:], b[1:]))[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])]
    )


def refresh(b: Bodies, d: Any) -> Any:
    """Fresh data: poses, centres of mass and body velocities belong to its qpos, qvel and mocap poses.

    MJX leaves those of the step's start behind. `open_step` goes on from them, so whoever changes qpos or a mocap pose
    by hand calls this.
    """
    if not b.steps:
        return _carried(b, d)
    # Kept apart, they take a third less to compile: XLA would work the same poses out again for each of their uses.
    for stage in (mjx.kinematics, mjx.com_pos, mjx.com_vel):
        d = once(stage(b.mjx_model, d))
    return d


def _carried(b: Bodies, d: Any) -> Any:
    """Data of a model without joints, which MJX refuses: all that hangs on a mocap body moves along with it."""
    model, rest = b.model, mujoco.MjData(b.model)
    mujoco.mj_kinematics(model, rest)
    # One row per mocap body, and a last one for the world, to which mocap id -1 belongs.
    hangs_on = model.body_mocapid[model.body_rootid]
    dtype = d.mocap_pos.dtype
    origin, upright = np.zeros((1, 3), dtype), np.asarray([[1, 0, 0, 0]], dtype)
    p, q = jnp.concatenate([d.mocap_pos, origin]), jnp.concatenate([d.mocap_quat, upright])
    p0, q0 = np.concatenate([rest.mocap_pos, origin]), np.concatenate([rest.mocap_quat, upright])
    q0 /= np.linalg.norm(q0, axis=-1, keepdims=True)
    q = q / jnp.linalg.norm(q, axis=-1, keepdims=True)
    turn = jax.vmap(_product)(q, jnp.asarray(q0 * _CONJUGATE, dtype))
    of_geom, of_site = hangs_on[model.geom_bodyid], hangs_on[model.site_bodyid]

    def at(x: np.ndarray, on: np.ndarray) -> Array:
        return p[on] + jax.vmap(_rotate)(turn[on], jnp.asarray(x - p0[on], dtype))

    def axes(mat: np.ndarray, on: np.ndarray) -> Array:
        columns = jnp.asarray(mat.reshape(-1, 3, 3), dtype)
        return jax.vmap(jax.vmap(_rotate, in_axes=(None, 1), out_axes=1))(turn[on], columns)

    return d.replace(
        xpos=at(rest.xpos, hangs_on),
        xquat=jax.vmap(_product)(turn[hangs_on], jnp.asarray(rest.xquat, dtype)),
        xmat=axes(rest.xmat, hangs_on),
        xipos=at(rest.xipos, hangs_on),
        ximat=axes(rest.ximat, hangs_on),
        geom_xpos=at(rest.geom_xpos, of_geom),
        geom_xmat=axes(rest.geom_xmat, of_geom),
        site_xpos=at(rest.site_xpos, of_site),
        site_xmat=axes(rest.site_xmat, of_site),
    )


def open_step(b: Bodies, d: Any, prescribed: Array) -> tuple[Any, Stance]:
    """Forward dynamics of fresh data d, but for grains and constraints, and the stance that the grains will meet.

    prescribed (B, 6): twists of the coupled bodies that hang on mocap bodies, zero for others (see drift).
    """
    model, nv = b.mjx_model, b.model.nv
    if b.steps:
        d = d.replace(qfrc_applied=jnp.zeros_like(d.qfrc_applied))  # the last step's load
        for stage in AFTER_PLACING:
            d = stage(model, d)
        M = _integrated_mass(b, d)
        acceleration, laws = jnp.linalg.solve(M, d.qfrc_smooth), _laws(b, d, M)
    else:
        M, acceleration = jnp.zeros((0, 0), d.qpos.dtype), jnp.zeros((0,), d.qpos.dtype)
        none = jnp.zeros((0,), d.qpos.dtype)
        laws = Laws(M, M, none, none, none, none)
    bodies, geoms = np.asarray(b.bodies), np.asarray(b.geoms)
    centre_of_mass = d.xipos[bodies]
    lever = d.geom_xpos[geoms] - centre_of_mass[np.asarray(b.body_of)]
    if nv:
        pairs = [mjx.jac(model, d, centre_of_mass[i], body) for i, body in enumerate(b.bodies)]
        J = jnp.stack([jnp.concatenate([jacp.T, jacr.T]) for jacp, jacr in pairs])
    else:
        J = jnp.zeros((len(bodies), 6, 0), d.qpos.dtype)
    return d, Stance(centre_of_mass, lever, d.geom_xmat[geoms], J, prescribed, M, acceleration, d.qvel, laws)


# What mjx.forward does between com_pos and the constraint solver, in its order: what comes before, `refresh` has done,
# which is half of the compile time, and what comes after, `close_step` does.
AFTER_PLACING = (
    mjx.camlight,
    mjx.tendon,
    mjx.crb,
    mjx.tendon_armature,
    mjx.factor_m,
    mjx.collision,
    mjx.make_constraint,
    mjx.transmission,
    mjx.sensor_pos,
    mjx.fwd_velocity,
    mjx.sensor_vel,
    mjx.fwd_actuation,
    mjx.fwd_acceleration,
)


def _laws(b: Bodies, d: Any, M: Array) -> Laws:
    """The rigid constraints as laws of the joint acceleration, in MuJoCo's order of rows."""
    J, D, aref, most = d._impl.efc_J, d._impl.efc_D, d._impl.efc_aref, d._impl.efc_frictionloss
    # Equalities pull both ways without bound, dry friction up to its loss; limits and contacts only push.
    row = jnp.arange(J.shape[0])
    equality, rubs = row < d._impl.ne, row < d._impl.ne + d._impl.nf
    high = jnp.where(equality | ~rubs, jnp.inf, most).astype(J.dtype)
    low = jnp.where(rubs, -high, 0).astype(J.dtype)
    T = jnp.linalg.solve(mjx.full_m(b.mjx_model, d), M) if _damped(b) else jnp.eye(b.model.nv, dtype=M.dtype)
    return Laws(J, T, D, aref, low, high)


def _constrained(model: Any, d: Any) -> Any:
    """Data with the acceleration under rigid constraints, if there are any."""
    if d._impl.efc_J.size == 0:
        return d.replace(qacc=d.qacc_smooth)
    return mjx.solve(model, d)


def _damped(b: Bodies) -> bool:
    """Whether the integrator solves more than the mass matrix: damping, or all that depends on velocity."""
    if b.model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        return True
    return not b.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP and bool(b.model.dof_damping.any())


def _integrated_mass(b: Bodies, d: Any) -> Array:
    """The matrix (nv, nv) that MJX's integrator solves, so that it lands on the velocity of the exchange."""
    model = b.mjx_model
    M = mjx.full_m(model, d)
    dt = b.model.opt.timestep
    if not _damped(b):
        return M
    if model.opt.integrator == IntegratorType.IMPLICITFAST:
        slope = mjx.deriv_smooth_vel(model, d)
        return M if slope is None else M - dt * slope
    return M + dt * jnp.diag(model.dof_damping)


def close_step(b: Bodies, d: Any, impulse: Array, foreseen: Array | None = None) -> Any:
    """Integrate one rigid step with the grains' summed generalised impulse (nv,) N s, N m s.

    With the same matrix and constraints as in the exchange, the joint velocities come out as the exchange left them.
    MJX's constraint solver starts from the acceleration `foreseen` (nv,), see there, and then has little left to do:
    stiff constraints of light bodies under much sand are more than it can do in f32 by itself.
    """
    if not b.steps:
        return d.replace(time=d.time + b.model.opt.timestep)
    model = b.mjx_model
    if foreseen is not None:
        d = d.replace(qacc_warmstart=foreseen)
    d = mjx.fwd_acceleration(model, d.replace(qfrc_applied=impulse / b.model.opt.timestep))
    d = mjx.sensor_acc(model, _constrained(model, d))
    step = mjx.implicit if model.opt.integrator == IntegratorType.IMPLICITFAST else mjx.euler
    return step(model, d)


def foreseen(b: Bodies, s: Stance, q: Array) -> Array:
    """The joint acceleration (nv,) over a rigid step that ends with q (nv,), as the constraints see it."""
    return s.laws.T @ (q - s.q) / b.model.opt.timestep


def twists(s: Stance, centre_now: Array, time: Array, given: Array) -> Twists:
    """How the bodies may move, at the given centres (B, 3) m.

    That is `time` (s) after the rigid step's start; the rigid constraints had given (r,) N s a substep ago.
    """
    return Twists(centre_now, s.J, s.drift, s.M, rows(s.laws, s.q, time, given) if given.size else None)


def poses(b: Bodies, s: Stance, centre_now: Array, turn: Array) -> tuple[Array, Array]:
    """Geom positions (G, 3) m and axes (G, 3, 3) when centres (B, 3) have moved and bodies turned by turn (B, 3, 3)."""
    body = np.asarray(b.body_of)
    R = turn[body]
    return centre_now[body] + jnp.einsum("gij,gj->gi", R, s.lever), R @ s.mat


def turned(turn: Array, w: Array, dt: float) -> Array:
    """Rotations (B, 3, 3) after angular velocity w (B, 3) rad/s acted for dt (Rodrigues' formula)."""
    angle2 = jnp.sum(w * w, axis=-1) * dt * dt
    angle = jnp.sqrt(angle2 + 1e-20)
    x, y, z = (w * dt).T
    o = jnp.zeros_like(x)
    K = jnp.stack([jnp.stack([o, -z, y], -1), jnp.stack([z, o, -x], -1), jnp.stack([-y, x, o], -1)], axis=-2)
    a = (jnp.sin(angle) / angle)[:, None, None]
    c = ((1 - jnp.cos(angle)) / angle**2)[:, None, None]
    return turn + (a * K + c * (K @ K)) @ turn
