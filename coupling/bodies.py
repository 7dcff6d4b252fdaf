"""The rigid side of a scene: which geoms meet grains, where they are, and one rigid step around the grains' substeps.

All use of MJX lives here. A rigid step is MuJoCo's own step cut in two: `open_step` computes everything that does not
depend on the grains, `close_step` adds their summed impulse and integrates. Between the two the grains run, meeting
bodies that move with the joint velocities of the exchange.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjx
from mujoco.mjx._src.types import IntegratorType

from coupling.exchange import Twists
from coupling.geoms import Shape, bounding_radius, centre, distance, half_extents, shape_of

INTEGRATORS = {mujoco.mjtIntegrator.mjINT_EULER: "Euler", mujoco.mjtIntegrator.mjINT_IMPLICITFAST: "implicitfast"}


@dataclass(frozen=True, eq=False)
class Bodies:
    """A MuJoCo model as grains see it: the coupled geoms, and the bodies that carry them. Static."""

    model: mujoco.MjModel
    mjx_model: Any  # mjx.Model
    geoms: tuple[int, ...]  # (G) ids of coupled geoms
    shapes: tuple[Shape, ...]  # (G)
    friction: tuple[float, ...]  # (G)
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
        return any(self.model.body_weldid[b] != 0 for b in self.bodies)

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
    acceleration: Array  # (nv,) of the joints without grains


def couple(model: mujoco.MjModel, geoms: dict[int, float]) -> Bodies:
    """The rigid side for a model and its coupled geoms with their friction coefficients.

    Raises ValueError where MJX cannot run the model, or a geom has no signed distance.
    """
    if model.nv and model.opt.integrator not in INTEGRATORS:
        raise ValueError(
            f"The model's integrator is {mujoco.mjtIntegrator(model.opt.integrator).name}, which cannot be solved"
            f" together with grains: choose {' or '.join(INTEGRATORS.values())}."
        )
    try:
        mjx_model = mjx.put_model(model)
    except NotImplementedError as error:
        raise ValueError(f"MJX cannot run this model: {error}. Remove that feature or those contacts.") from None
    ids = tuple(geoms)
    carriers = [int(model.geom_bodyid[g]) for g in ids]
    bodies = tuple(dict.fromkeys(carriers))
    return Bodies(
        model,
        mjx_model,
        ids,
        tuple(shape_of(model, g) for g in ids),
        tuple(geoms.values()),
        bodies,
        tuple(bodies.index(b) for b in carriers),
        tuple(int(model.body_mocapid[model.body_rootid[b]]) if model.body_weldid[b] == 0 else -1 for b in bodies),
    )


def start(b: Bodies, qpos: Array | None, ctrl: Array, mocap: tuple[Array, Array]) -> Any:
    """MJX data at rest at qpos (nq,), or at the model's own pose, with controls and mocap poses set."""
    d = mjx.make_data(b.mjx_model)
    if qpos is not None:
        d = d.replace(qpos=jnp.asarray(qpos, d.qpos.dtype))
    d = d.replace(ctrl=jnp.asarray(ctrl, d.ctrl.dtype))
    return refresh(b, place(d, *mocap))


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
    c = a * _CONJUGATE
    w = b[0] * c[0] - jnp.dot(b[1:], c[1:])
    v = b[0] * c[1:] + c[0] * b[1:] + jnp.cross(b[1:], c[1:])
    v = jnp.where(w < 0, -v, v)
    norm = jnp.sqrt(jnp.sum(v * v) + 1e-30)
    return 2 * jnp.arctan2(norm, jnp.abs(w)) / norm * v


def refresh(b: Bodies, d: Any) -> Any:
    """Data whose poses, centres of mass and body velocities belong to its qpos and qvel.

    MJX leaves those of the step's start behind.
    """
    d = mjx.com_pos(b.mjx_model, mjx.kinematics(b.mjx_model, d))
    return mjx.com_vel(b.mjx_model, d) if b.steps else d


def open_step(b: Bodies, d: Any, prescribed: Array) -> tuple[Any, Stance]:
    """Forward dynamics without grains, and the stance that the grains will meet.

    prescribed (B, 6): twists of the coupled bodies that hang on mocap bodies, zero for others (see drift).
    """
    model, nv = b.mjx_model, b.model.nv
    if b.steps:
        # The load of the last step stays in, so that rigid constraints answer it; then it is taken out of the predictor
        # again, since the exchange will find this step's load itself.
        load = d.qfrc_applied
        d = mjx.forward(model, d)
        M = _integrated_mass(b, d)
        acceleration = jnp.linalg.solve(M, d.qfrc_smooth + d.qfrc_constraint - load)
    else:
        d = refresh(b, d)
        M, acceleration = jnp.zeros((0, 0), d.qpos.dtype), jnp.zeros((0,), d.qpos.dtype)
    bodies, geoms = np.asarray(b.bodies), np.asarray(b.geoms)
    centre_of_mass = d.xipos[bodies]
    lever = d.geom_xpos[geoms] - centre_of_mass[np.asarray(b.body_of)]
    if nv:
        pairs = [mjx.jac(model, d, centre_of_mass[i], body) for i, body in enumerate(b.bodies)]
        J = jnp.stack([jnp.concatenate([jacp.T, jacr.T]) for jacp, jacr in pairs])
    else:
        J = jnp.zeros((len(bodies), 6, 0), d.qpos.dtype)
    return d, Stance(centre_of_mass, lever, d.geom_xmat[geoms], J, prescribed, M, acceleration)


def _integrated_mass(b: Bodies, d: Any) -> Array:
    """The matrix (nv, nv) that MJX's integrator solves: with it the exchange and the integrator land on one velocity."""
    model = b.mjx_model
    M = mjx.full_m(model, d)
    dt = b.model.opt.timestep
    if model.opt.integrator == IntegratorType.IMPLICITFAST:
        slope = mjx.deriv_smooth_vel(model, d)
        return M if slope is None else M - dt * slope
    if b.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
        return M
    return M + dt * jnp.diag(model.dof_damping)


def close_step(b: Bodies, d: Any, impulse: Array) -> Any:
    """Integrate one rigid step with the grains' summed generalised impulse (nv,) N s, N m s.

    With the same matrix as in the exchange, the joint velocities come out as the exchange left them, unless a rigid
    constraint changes its mind about the load.
    """
    if not b.steps:
        return d.replace(time=d.time + b.model.opt.timestep)
    model = b.mjx_model
    d = mjx.fwd_acceleration(model, d.replace(qfrc_applied=impulse / b.model.opt.timestep))
    if d._impl.efc_J.size == 0:
        d = d.replace(qacc=d.qacc_smooth)
    else:
        d = mjx.solve(model, d)
    step = mjx.implicit if model.opt.integrator == IntegratorType.IMPLICITFAST else mjx.euler
    return step(model, d)


def twists(s: Stance, centre_now: Array) -> Twists:
    """How the bodies may move, at the given centres (B, 3) m."""
    return Twists(centre_now, s.J, s.drift, s.M)


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


def points_near(b: Bodies, low: float, high: float, spacing: float, *, middle: float | None = None) -> int:
    """About how many points of a lattice of this spacing (m) lie between the distances low and high (m) of the geoms.

    Sizes node and grain buffers on the host. With `middle`, a plane y = middle is counted at the initial pose (plane
    strain), else space. A geom without bound counts as nothing here: the caller takes the whole grid.
    """
    total = 0
    d = mujoco.MjData(b.model)
    mujoco.mj_forward(b.model, d)
    for g, shape in zip(b.geoms, b.shapes, strict=True):
        if not np.isfinite(bounding_radius(shape)):
            continue
        pos, mat = d.geom_xpos[g], d.geom_xmat[g].reshape(3, 3)
        step = spacing / 2
        if middle is None:
            half = half_extents(shape) + high
            axes = [np.arange(-h, h + step, step) + c for h, c in zip(half, centre(shape), strict=True)]
            local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            per_point = 8.0
        else:
            r = bounding_radius(shape) + high
            side = np.arange(-r, r + step, step)
            x, z = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))
            local = (np.stack([x, np.full_like(x, middle - pos[1]), z], axis=-1)) @ mat
            per_point = 4.0
        phi = np.asarray(jax.vmap(distance, in_axes=(None, 0))(shape, jnp.asarray(local, jnp.float32)))
        total += int(np.ceil(np.count_nonzero((phi > low) & (phi < high)) / per_point)) + 1
    return total
