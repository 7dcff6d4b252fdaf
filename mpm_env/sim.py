"""The coupled step: the only place where grains and bodies meet.

A rigid step opens (forward dynamics without grains), lets the grains run their substeps against the moving bodies, pays
the bodies the summed impulse, moves them, and asks how everyone feels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from coupling import bodies as rigid
from coupling.bodies import Stance
from coupling.contact import Points, distances, nearest_geom
from coupling.exchange import Exchange, exchange
from coupling.geoms import Shape, bounding_radius, dot, half_extents
from mpm_env.health import MOST_DEPTH, MOST_TRAVEL, Health
from mpm_env.mpm.budgets import mass_that_left
from mpm_env.mpm.sorting import in_order
from mpm_env.mpm.stability import MOST_CELLS_PER_SUBSTEP
from mpm_env.mpm.substep import substep
from mpm_env.mpm.types import Particles
from mpm_env.scene import NODE_DEPTH, Scene, State, inside_grid, lift

ROUNDS = 8  # in which the grains near bodies can be stopped; up to an eighth of them is inside in most substeps
HALFWAY = 0.5  # of the way to a thin geom's middle, from where a grain is about to come out on the other side
MOST_RESIDUAL = 0.1  # share of the exchange's equation that may stay unsolved before it is called not converged


class Drive(NamedTuple):
    """What moves the bodies in one rigid step: controls, and where mocap bodies are at its end."""

    control: Array  # (nu,)
    position: Array  # (nmocap, 3) m
    quaternion: Array  # (nmocap, 4) w x y z


def scripted(scene: Scene, first: int, count: int) -> Drive:
    """The scene's own motion for `count` rigid steps from step `first`: arrays with a leading axis of steps."""
    controls, positions, turns = [], [], []
    for k in range(first, first + count):
        controls.append(scene.motion.control(k * scene.rigid_dt))
        position, turn = scene.motion.mocap((k + 1) * scene.rigid_dt)
        positions.append(position)
        turns.append(turn)
    dtype = jax.dtypes.canonicalize_dtype(np.float64)
    return Drive(*(jnp.asarray(np.asarray(rows), dtype) for rows in (controls, positions, turns)))


def advance(scene: Scene, state: State, drives: Drive) -> tuple[State, Array]:
    """As many rigid steps as the drives have rows. Returns the state and each step's reaction (k, G, 6) N, N m."""

    def one(state: State, drive: Drive) -> tuple[State, Array]:
        state = rigid_step(scene, state, drive)
        return state, state.reaction

    return lax.scan(one, state, drives)


def rigid_step(scene: Scene, state: State, drive: Drive) -> State:
    """One rigid step with its substeps."""
    if state.order is not None:
        grains, order = in_order(scene.grid, state.grains, scene.spans, state.order)
        state = replace(state, grains=grains, order=order)
    if scene.bodies is None:
        grains = _run_grains(scene, state)
        return _examined(scene, state, replace(state, grains=grains, steps=state.steps + 1), Health.WELL)
    b = scene.bodies
    d = state.rigid.replace(ctrl=drive.control)
    twist = rigid.drift(b, d, drive.position, drive.quaternion)
    d, stance = rigid.open_step(b, d, twist)
    contact = Contact.of(scene, jax.tree.map(lambda a: a.astype(scene.dtype), stance), state.grains)
    touch = contact.start(d.qvel.astype(scene.dtype))
    grains, touch = _run_grains(scene, state, contact, touch)
    d = rigid.close_step(b, d, touch.impulse.astype(d.qvel.dtype))
    d = rigid.refresh(b, rigid.place(d, drive.position, drive.quaternion))
    after = replace(
        state,
        rigid=d,
        grains=grains,
        steps=state.steps + 1,
        reaction=touch.wrench / jnp.asarray(scene.rigid_dt, scene.dtype),
    )
    return _examined(scene, state, after, contact.examined(touch))


def _run_grains(scene: Scene, state: State, contact: Contact | None = None, touch: Any = None) -> Any:
    """The substeps of one rigid step: the grains, and with a contact also what it noted."""
    beds = scene.beds(state.materials)
    gravity = jnp.asarray(scene.gravity, scene.dtype)
    if not scene.slots:
        if contact is None:
            return state.grains
        return state.grains, lax.fori_loop(0, scene.mpm_per_rigid, lambda _, t: contact.coast(t), touch)

    def one(_: int, both: tuple[Particles, Any]) -> tuple[Particles, Any]:
        return substep(scene.grid, beds, both[0], scene.mpm_dt, gravity, contact, both[1], scene.kernels)

    grains, touch = lax.fori_loop(0, scene.mpm_per_rigid, one, (state.grains, touch))
    return grains if contact is None else (grains, touch)


class Touch(NamedTuple):
    """What contact carries from substep to substep."""

    q: Array  # (nv,) joint velocities as the grains see them
    centre: Array  # (B, 3) m
    turn: Array  # (B, 3, 3) since the start of the rigid step
    impulse: Array  # (nv,) generalised impulse of the grains so far
    wrench: Array  # (G, 6) impulse wrench on each geom so far, N s and N m s
    depth: Array  # () m, deepest grain inside a body so far
    residual: Array  # () worst share of an exchange left unsolved


class Moves(NamedTuple):
    """How contact moves some grains."""

    grains: Array  # (K,) indices, their number where a slot is free
    dx: Array  # (d, K) m
    dv: Array  # (d, K) m/s


class Contact(NamedTuple):
    """Grains against bodies over one rigid step: a Boundary of the continuum.

    The points that can come near a body are looked up once per rigid step, in buffers of fixed size; each substep only
    visits those.
    """

    scene: Scene
    stance: Stance
    watched: Array  # (K,) indices into the flattened grid, its size where a slot is free
    nodes_x: Array  # (3, K) m
    nodes_over: Array  # () bool, more than fit
    grains_near: Array  # (P,) indices of grains, their number where a slot is free
    grains_over: Array  # () bool

    @classmethod
    def of(cls, scene: Scene, stance: Stance, p: Particles) -> Contact:
        """Look up the nodes and grains near the bodies."""
        b, dx = scene.bodies, scene.grid.cell_size
        assert b is not None
        pos, mat = rigid.poses(b, stance, stance.centre, jnp.broadcast_to(jnp.eye(3), (len(b.bodies), 3, 3)))
        nodes = scene.world(jnp.asarray(scene.grid.node_positions().T, scene.dtype))
        phi = distances(b.shapes, nodes, pos, mat)
        band = (scene.fidelity.contact_band + MOST_TRAVEL) * dx
        near, over = _pick((phi < band) & (phi > -NODE_DEPTH * dx), scene.sizes.nodes)
        if scene.sizes.grains and scene.slots:
            phi = distances(b.shapes, scene.world(p.x), pos, mat)
            travel = scene.rigid_dt * jnp.sqrt(jnp.sum(p.v * p.v, axis=0))
            grains = _pick((phi < MOST_TRAVEL * dx + travel) & (p.m > 0), scene.sizes.grains)
        else:
            grains = (jnp.zeros((0,), jnp.int32), jnp.zeros((), bool))
        return cls(scene, stance, near, nodes.at[:, near].get(mode="clip"), over, *grains)

    def start(self, q: Array) -> Touch:
        """Nothing has happened yet; joints move with q (nv,)."""
        B, G = self.stance.centre.shape[0], self.stance.lever.shape[0]
        dtype = self.stance.centre.dtype
        zero = jnp.zeros((), dtype)
        eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (B, 3, 3))
        return Touch(q, self.stance.centre, eye, jnp.zeros_like(q), jnp.zeros((G, 6), dtype), zero, zero)

    def nodes(self, touch: Touch, v: Array, m: Array) -> tuple[Touch, Array]:
        """Exchange momentum between bodies and the grid nodes within the band."""
        at = self._nearest(touch, self.nodes_x)
        near = at[0] < self.scene.fidelity.contact_band * self.scene.grid.cell_size
        points = Points(self.nodes_x, lift(v.T), jnp.where(near, m, 0), *at)
        free = touch.q + self.scene.mpm_dt * self.stance.acceleration
        touch, done = self._exchange(touch, points, free)
        return touch, self._flatten(done.impulse / jnp.where(points.m > 0, points.m, 1)).T

    def grains(self, touch: Touch, p: Particles) -> tuple[Touch, Particles]:
        """Move the bodies, then stop grains that ended up inside them and put those back to the surface."""
        touch = self._moved(touch)
        if not self.grains_near.size:
            return touch, p
        near, room = self.grains_near, self.grains_near.size
        x = self.scene.world(p.x.at[:, near].get(mode="clip"))
        inside = (p.m.at[near].get(mode="fill", fill_value=0) > 0) & (self._distances(touch, x) < 0)

        count = _count(inside)
        few = -(-room // ROUNDS)

        def stop(touch: Touch, first: Array) -> tuple[Touch, Moves]:
            wanted = _find(count, first + jnp.arange(few, dtype=count.dtype))
            return self._stopped(touch, p, near.at[wanted].get(mode="fill", fill_value=p.count))

        def rest(touch: Touch, first: Array) -> tuple[Touch, Moves]:
            none = jnp.zeros((self.scene.dimension, few), x.dtype)
            return touch, Moves(jnp.full((few,), p.count, near.dtype), none, none)

        # Most substeps find few grains inside a body: then all but the first rounds, or all, are rest.
        firsts = few * jnp.arange(ROUNDS, dtype=count.dtype)
        touch, moves = lax.scan(lambda touch, k: lax.cond(k < count[-1], stop, rest, touch, k), touch, firsts)
        index, dx, dv = (jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1) for a in moves)
        return touch, replace(p, x=p.x.at[:, index].add(dx, mode="drop"), v=p.v.at[:, index].add(dv, mode="drop"))

    def _stopped(self, touch: Touch, p: Particles, index: Array) -> tuple[Touch, Moves]:
        """Stop the grains with these indices (K,), their number where a slot is free, and put them on the surface."""
        x, v = (a.at[:, index].get(mode="clip") for a in (p.x, p.v))
        m = p.m.at[index].get(mode="fill", fill_value=0)
        x = self.scene.world(x)
        points = Points(x, lift(v), m, *self._nearest(touch, x))
        touch, done = self._exchange(touch, points, touch.q)
        depth = jnp.where(m > 0, -points.phi, 0)
        touch = touch._replace(depth=jnp.maximum(touch.depth, jnp.max(depth)))
        change = done.impulse / jnp.where(m > 0, m, 1)
        return touch, Moves(index, self._flatten(depth * points.n), self._flatten(change))

    def coast(self, touch: Touch) -> Touch:
        """A substep without any grain."""
        return self._moved(touch._replace(q=touch.q + self.scene.mpm_dt * self.stance.acceleration))

    def examined(self, touch: Touch) -> Array:
        """Health bits of this rigid step's contact."""
        b, dx = self.scene.bodies, self.scene.grid.cell_size
        assert b is not None
        twist = self.stance.J @ touch.q + self.stance.drift
        reach = jnp.asarray([_reach(b, i) for i in range(len(b.bodies))], touch.centre.dtype)
        speed = jnp.linalg.norm(twist[:, :3], axis=-1) + reach * jnp.linalg.norm(twist[:, 3:], axis=-1)
        return _bits(
            {
                Health.TOO_DEEP: touch.depth > min(MOST_DEPTH * dx, *(HALFWAY * _half_thickness(s) for s in b.shapes)),
                Health.NODES_OVERFLOW: self.nodes_over,
                Health.GRAINS_OVERFLOW: self.grains_over,
                Health.NOT_CONVERGED: touch.residual > MOST_RESIDUAL,
                Health.BODY_TOO_FAST: jnp.max(speed) * self.scene.rigid_dt > MOST_TRAVEL * dx,
            }
        )

    def _distances(self, touch: Touch, x: Array) -> Array:
        """Signed distances (K,) m of points x (3, K) m from the bodies where they are now."""
        b = self.scene.bodies
        assert b is not None
        return distances(b.shapes, x, *rigid.poses(b, self.stance, touch.centre, touch.turn))

    def _nearest(self, touch: Touch, x: Array) -> tuple[Array, Array, Array]:
        """The same with normals (3, K) in the grid's dimension and the geoms (K,) that are nearest."""
        b = self.scene.bodies
        assert b is not None
        phi, n, geom = nearest_geom(b.shapes, x, *rigid.poses(b, self.stance, touch.centre, touch.turn))
        if self.scene.dimension == 2:
            n = n.at[1].set(0)
            n = n / jnp.maximum(jnp.sqrt(dot(n, n)), 1e-6)
        return phi, n, geom

    def _exchange(self, touch: Touch, points: Points, free: Array) -> tuple[Touch, Exchange]:
        b, f = self.scene.bodies, self.scene.fidelity
        assert b is not None
        t = rigid.twists(self.stance, touch.centre)
        if not b.yields:  # every coupled body goes where it is told: nothing to solve
            t = t._replace(J=t.J[:, :, :0], M=t.M[:0, :0])
        mu = jnp.asarray(b.friction, touch.centre.dtype)
        done = exchange(points, t, free if b.yields else free[:0], mu, b.body_of, f.contact_iterations)
        q = done.q if b.yields else free
        given = self._generalised(done.wrench)
        return touch._replace(
            q=q,
            impulse=touch.impulse + given,
            wrench=touch.wrench + done.wrench,
            residual=jnp.maximum(touch.residual, done.residual),
        ), done

    def _generalised(self, wrench: Array) -> Array:
        """Generalised impulse (nv,) of the impulse wrenches (G, 6) on the geoms."""
        assert self.scene.bodies is not None
        return jnp.einsum("gkn,gk->n", self.stance.J[np.asarray(self.scene.bodies.body_of)], wrench)

    def _moved(self, touch: Touch) -> Touch:
        twist = self.stance.J @ touch.q + self.stance.drift
        h = self.scene.mpm_dt
        return touch._replace(centre=touch.centre + h * twist[:, :3], turn=rigid.turned(touch.turn, twist[:, 3:], h))

    def _flatten(self, a: Array) -> Array:
        """Rows (3, K) of space as rows (d, K) of the grid."""
        return a if self.scene.dimension == 3 else a[::2]


def _half_thickness(shape: Shape) -> float:
    """Half the smallest side of a geom, m: how deep a grain can be before it is nearer to the other side."""
    return float(np.min(half_extents(shape)))


def _reach(b: rigid.Bodies, body: int) -> float:
    """How far a body's coupled geoms reach from its centre of mass, m; planes count as nothing."""
    centre = b.model.body_ipos[b.bodies[body]]
    reaches = [
        float(np.linalg.norm(b.model.geom_pos[g] - centre)) + bounding_radius(shape)
        for g, shape, owner in zip(b.geoms, b.shapes, b.body_of, strict=True)
        if owner == body
    ]
    return max((r for r in reaches if np.isfinite(r)), default=0.0)


def _pick(mask: Array, size: int) -> tuple[Array, Array]:
    """Indices (size,) where the mask (n,) holds, n where there are fewer, and whether there were more."""
    count = _count(mask)
    return _find(count, jnp.arange(size, dtype=count.dtype)), count[-1] > size


def _count(mask: Array) -> Array:
    """How many of the mask (n,) hold up to here, (n,)."""
    return jnp.cumsum(mask.astype(jnp.int32))


def _find(count: Array, k: Array) -> Array:
    """Indices (size,) of the k-th that hold, from 0, by their count (n,); n where there are fewer.

    A search takes less time than jnp.nonzero, which scatters the whole mask.
    """
    return jnp.searchsorted(count, k + 1).astype(jnp.int32)


def _bits(faults: dict[Health, Array]) -> Array:
    """Faults as one integer of health bits."""
    return sum((jnp.where(at, int(bit), 0) for bit, at in faults.items()), start=jnp.zeros((), jnp.int32)).astype(
        jnp.int32
    )


def _examined(scene: Scene, before: State, after: State, contact: Array | int) -> State:
    """The state after a rigid step, with what is wrong with it and what left through open walls."""
    p, dx = after.grains, scene.grid.cell_size
    finite = jnp.ones((), bool)
    if after.rigid is not None:
        finite = jnp.all(jnp.isfinite(after.rigid.qpos)) & jnp.all(jnp.isfinite(after.rigid.qvel))
    if not scene.slots:
        return replace(after, health=after.health | contact | _bits({Health.NOT_FINITE: ~finite}))
    finite &= jnp.isfinite(jnp.sum(p.x) + jnp.sum(p.v) + jnp.sum(p.e))
    here = p.m > 0
    speed2 = jnp.where(here, jnp.sum(p.v * p.v, axis=0), 0)
    turning2 = jnp.where(here, jnp.sum(p.C * p.C, axis=(0, 1)), 0)
    bits = _bits(
        {
            Health.NOT_FINITE: ~finite,
            Health.LEFT_GRID: jnp.any(here & ~inside_grid(scene.grid, p.x)),
            Health.TOO_FAST: jnp.max(speed2) > (MOST_CELLS_PER_SUBSTEP * dx / scene.mpm_dt) ** 2,
            Health.INVERTED: jnp.max(turning2) * scene.mpm_dt**2 >= 1,
        }
    )
    left = before.left + mass_that_left(before.grains, p)
    return replace(after, health=after.health | contact | bits, left=left)
