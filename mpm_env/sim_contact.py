"""Grains against bodies over one rigid step: the boundary that the continuum meets in every substep."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from coupling import bodies as rigid
from coupling.bodies import Stance
from coupling.constraints import settled
from coupling.contact import distances
from coupling.geoms import bounding_radius, thickness
from coupling.meeting import Geoms, Meeting, Surfaces, counted, found, meet, near
from mpm_env.health import (
    MOST_ASTRAY,
    MOST_DEPTH,
    MOST_TRAVEL,
    MOST_UNPAID,
    ContactReport,
    Health,
    as_bits,
)
from mpm_env.mpm.substep import to_nodes
from mpm_env.mpm.types import Particles
from mpm_env.scene import Scene, lift
from mpm_env.scene_bodies import NODE_DEPTH

ROUNDS = 8  # in which plain XLA stops the grains inside bodies; up to an eighth of those near are inside, mostly
HALFWAY = 0.5  # of the way to a thin geom's middle, from where a grain is about to come out on the other side
MOST_RESIDUAL = 0.1  # share of the exchange's equation that may stay unsolved before it is called not converged


class Touch(NamedTuple):
    """What contact carries from substep to substep."""

    time: Array  # () s since the start of the rigid step
    q: Array  # (nv,) joint velocities as the grains see them
    given: Array  # (r,) N s, of the rigid constraints so far
    centre: Array  # (B, 3) m
    turn: Array  # (B, 3, 3) since the start of the rigid step
    impulse: Array  # (nv,) generalised impulse of the grains so far
    wrench: Array  # (G, 6) impulse wrench on each geom so far, N s and N m s
    depth: Array  # () m, deepest grain inside a body so far
    peak: Array  # () N s, largest impulse of a substep on the bodies so far
    unpaid: Array  # () N s, by which what grains got and what bodies got differ so far
    exchanged: Array  # () N s, sum of the sizes of all impulses so far
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
    full: Array  # (K,) kg, mass of each node with grains all around it
    shares: Array | None  # (M, K) of the materials in the nodes' mass; None where bodies treat all alike

    @classmethod
    def of(cls, scene: Scene, stance: Stance, p: Particles) -> Contact:
        """Look up the nodes and grains near the bodies."""
        b, dx = scene.bodies, scene.grid.cell_size
        assert b is not None
        g = _geoms(scene)
        pos, mat = rigid.poses(b, stance, stance.centre, _not_turned(stance))
        nodes = scene.world(jnp.asarray(scene.grid.node_positions().T, scene.dtype))
        band = jnp.full(nodes.shape[1:], (scene.fidelity.contact_band + MOST_TRAVEL) * dx, scene.dtype)
        watched, over = near(g, pos, mat, nodes, -NODE_DEPTH * dx, band, scene.sizes.nodes)
        if scene.sizes.grains and scene.slots:
            travel = MOST_TRAVEL * dx + scene.rigid_dt * jnp.sqrt(jnp.sum(p.v * p.v, axis=0))
            travel = jnp.where(p.m > 0, travel, -jnp.inf)
            grains = near(g, pos, mat, scene.world(p.x), -jnp.inf, travel, scene.sizes.grains)
        else:
            grains = (jnp.zeros((0,), jnp.int32), jnp.zeros((), bool))
        x = nodes.at[:, watched].get(mode="clip")
        return cls(scene, stance, watched, x, over, *grains, _full(scene, p, watched), _shares(scene, p, watched))

    def start(self, q: Array) -> Touch:
        """Nothing has happened yet; joints move with q (nv,)."""
        s = self.stance
        zero = jnp.zeros((), s.centre.dtype)
        wrench = jnp.zeros((s.lever.shape[0], 6), s.centre.dtype)
        given = jnp.zeros_like(s.laws.D)
        return Touch(zero, q, given, s.centre, _not_turned(s), jnp.zeros_like(q), wrench, *[zero] * 5)

    def nodes(self, touch: Touch, v: Array, m: Array) -> tuple[Touch, Array]:
        """Exchange momentum between bodies and the grid nodes within the band."""
        reach = self.scene.fidelity.contact_band * self.scene.grid.cell_size
        touch, free = self._freed(touch)
        if not self.scene.fidelity.two_way:
            touch, free = self._settled(touch, free)
        # A layer of nodes stands for a cell's width of surface each.
        area = self.scene.node_volume / self.scene.grid.cell_size
        surfaces = self._surfaces(self.shares, np.asarray(self.scene.adhesion) * area * self.scene.mpm_dt)
        surfaces = surfaces._replace(full=self.full)
        touch, met = self._meet(touch, surfaces, free, self.nodes_x, lift(v.T), m, reach)
        return touch, self._flatten(met.exchange.impulse / jnp.where(m > 0, m, 1)).T

    def grains(self, touch: Touch, p: Particles) -> tuple[Touch, Particles]:
        """Move the bodies, then stop grains that ended up inside them and put those back to the surface."""
        touch = self._moved(touch)
        if not self.grains_near.size:
            return touch, p
        # The native kernel passes over the grains outside by itself; a GPU would wait for each round.
        at_once = self.scene.kernels == "native" or jax.default_backend() != "cpu"
        touch, moves = self._stopped(touch, p, self.grains_near) if at_once else self._stopped_in_rounds(touch, p)
        index, dx, dv = moves
        return touch, replace(p, x=p.x.at[:, index].add(dx, mode="drop"), v=p.v.at[:, index].add(dv, mode="drop"))

    def _stopped_in_rounds(self, touch: Touch, p: Particles) -> tuple[Touch, Moves]:
        """Stop the grains inside bodies, some at a time.

        Most substeps find few of them: then all but the first rounds, or all, are rest. Where more are inside than a
        round takes, each round meets bodies as the one before left them, and not all at once.
        """
        candidates, room = self.grains_near, self.grains_near.size
        x = self.scene.world(p.x.at[:, candidates].get(mode="clip"))
        b = self.scene.bodies
        assert b is not None
        phi = distances(b.shapes, x, *rigid.poses(b, self.stance, touch.centre, touch.turn))
        count = counted((p.m.at[candidates].get(mode="fill", fill_value=0) > 0) & (phi < 0))
        few = -(-room // ROUNDS)

        def stop(touch: Touch, first: Array) -> tuple[Touch, Moves]:
            wanted = found(count, first + jnp.arange(few, dtype=count.dtype))
            return self._stopped(touch, p, candidates.at[wanted].get(mode="fill", fill_value=p.count))

        def rest(touch: Touch, first: Array) -> tuple[Touch, Moves]:
            none = jnp.zeros((self.scene.dimension, few), x.dtype)
            return touch, Moves(jnp.full((few,), p.count, candidates.dtype), none, none)

        firsts = few * jnp.arange(ROUNDS, dtype=count.dtype)
        touch, moves = lax.scan(lambda touch, k: lax.cond(k < count[-1], stop, rest, touch, k), touch, firsts)
        index, dx, dv = (jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1) for a in moves)
        return touch, Moves(index, dx, dv)

    def _stopped(self, touch: Touch, p: Particles, index: Array) -> tuple[Touch, Moves]:
        """Stop those inside bodies among the grains with these indices (K,), and put them on the surface.

        An index is the number of grains where a slot is free.
        """
        x, v = (a.at[:, index].get(mode="clip") for a in (p.x, p.v))
        m = p.m.at[index].get(mode="fill", fill_value=0)
        own = None
        if self.shares is not None:
            own = jnp.stack([((index >= a) & (index < b)).astype(x.dtype) for a, b in self.scene.spans])
        surfaces = self._surfaces(own, np.zeros(len(self.scene.spans)))  # what holds grains back, holds the nodes
        touch, met = self._meet(touch, surfaces, touch.q, self.scene.world(x), lift(v), m, 0.0)
        touch = touch._replace(depth=jnp.maximum(touch.depth, jnp.max(-met.phi)))
        change = met.exchange.impulse / jnp.where(m > 0, m, 1)
        return touch, Moves(index, self._flatten(-met.phi * met.n), self._flatten(change))

    def coast(self, touch: Touch) -> Touch:
        """A substep without any grain."""
        touch, q = self._settled(*self._freed(touch))
        return self._moved(touch._replace(q=q))

    def _settled(self, touch: Touch, q: Array) -> tuple[Touch, Array]:
        """What rigid constraints make of joint velocities q (nv,) where no grain pushes."""
        rows = rigid.twists(self.stance, touch.centre, touch.time, touch.given).rows
        if rows is None:
            return touch, q
        done = settled(self.stance.M, rows, q, jnp.zeros_like(q), jnp.zeros_like(q))
        return touch._replace(given=done.given), q + done.change

    def _freed(self, touch: Touch) -> tuple[Touch, Array]:
        """A substep on, and the joint velocities (nv,) then without grains and rigid constraints."""
        h = self.scene.mpm_dt
        return touch._replace(time=touch.time + h), touch.q + h * self.stance.acceleration

    def report(self, touch: Touch, q: Array) -> ContactReport:
        """How contact went, when MJX left the joint velocities q (nv,)."""
        exchanged = jnp.where(touch.exchanged > 0, touch.exchanged, 1)
        astray = self._speed(self.stance.J @ (q - touch.q)) * self.scene.rigid_dt
        peak = touch.peak / self.scene.mpm_dt
        return ContactReport(touch.depth, peak, touch.unpaid / exchanged, touch.residual, astray)

    def examined(self, touch: Touch, report: ContactReport) -> Array:
        """Health bits of this rigid step's contact."""
        b, dx = self.scene.bodies, self.scene.grid.cell_size
        assert b is not None
        # As MJX has it, which ends the step with its last speed, and as the grains saw a body that they stopped.
        travel = self._speed(self.stance.J @ touch.q + self.stance.drift) * self.scene.rigid_dt
        travel = jnp.maximum(travel, self._gone(touch))
        return as_bits(
            {
                Health.TOO_DEEP: report.depth > min(MOST_DEPTH * dx, *(HALFWAY * thickness(s) / 2 for s in b.shapes)),
                Health.NODES_OVERFLOW: self.nodes_over,
                Health.GRAINS_OVERFLOW: self.grains_over,
                Health.NOT_CONVERGED: report.unsolved > MOST_RESIDUAL,
                Health.BODY_TOO_FAST: travel > MOST_TRAVEL * dx,
                Health.BODY_ASTRAY: report.astray > MOST_ASTRAY * dx,
                Health.NOT_PAID: report.unpaid > MOST_UNPAID,
            }
        )

    def _speed(self, twist: Array) -> Array:
        """Speed () m/s of the fastest point of the coupled bodies, which move with these twists (B, 6)."""
        return self._farthest(jnp.linalg.norm(twist[:, :3], axis=-1), jnp.linalg.norm(twist[:, 3:], axis=-1))

    def _gone(self, touch: Touch) -> Array:
        """How far () m the farthest point of the coupled bodies is from where it was at the rigid step's start."""
        shift = jnp.linalg.norm(touch.centre - self.stance.centre, axis=-1)
        chord = jnp.linalg.norm(touch.turn - _not_turned(self.stance), axis=(-2, -1)) / np.sqrt(2)
        return self._farthest(shift, chord)

    def _farthest(self, shift: Array, turn: Array) -> Array:
        """The most () m that any point of the coupled bodies goes by these shifts (B,) m and turns (B,) rad."""
        b = self.scene.bodies
        assert b is not None
        reach = jnp.asarray([_reach(b, i) for i in range(len(b.bodies))], shift.dtype)
        return jnp.max(shift + reach * turn)

    def _surfaces(self, shares: Array | None, hold: np.ndarray) -> Surfaces:
        """How bodies are to points with these shares (M, K) of the materials, held back by up to hold (M,) N s."""
        b = self.scene.bodies
        assert b is not None
        count = slice(None) if shares is not None else slice(1)
        dtype = self.scene.dtype
        return Surfaces(jnp.asarray(b.friction, dtype)[:, count], jnp.asarray(hold[count], dtype), shares)

    def _meet(
        self, touch: Touch, surfaces: Surfaces, free: Array, x: Array, v: Array, m: Array, reach: float
    ) -> tuple[Touch, Meeting]:
        """Points against the bodies where they are now, whose joints move with free (nv,) without them."""
        b = self.scene.bodies
        assert b is not None
        t = rigid.twists(self.stance, touch.centre, touch.time, touch.given)
        solved = b.yields and self.scene.fidelity.two_way
        if not solved:  # every coupled body goes where it is told, or where its joints take it: nothing to solve
            t = t._replace(J=t.J[:, :, :0], M=t.M[:0, :0], rows=None, d=t.d + t.J @ free)
        pos, mat = rigid.poses(b, self.stance, touch.centre, touch.turn)
        met = meet(_geoms(self.scene), pos, mat, t, surfaces, free if solved else free[:0], x, v, m, reach)
        done = met.exchange
        onto = jnp.sum(done.wrench[:, :3], axis=0)
        return touch._replace(
            q=done.q if solved else free,
            given=done.given if solved else touch.given,
            impulse=touch.impulse + self._generalised(done.wrench) if self.scene.fidelity.two_way else touch.impulse,
            wrench=touch.wrench + done.wrench,
            peak=jnp.maximum(touch.peak, jnp.linalg.norm(onto)),
            unpaid=touch.unpaid + jnp.linalg.norm(onto + jnp.sum(done.impulse, axis=-1)),
            exchanged=touch.exchanged + jnp.sum(jnp.abs(done.impulse)),
            residual=jnp.maximum(touch.residual, done.residual),
        ), met

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


def _not_turned(stance: Stance) -> Array:
    """The bodies' turns (B, 3, 3) since the start of the rigid step, at its start."""
    return jnp.broadcast_to(jnp.eye(3, dtype=stance.centre.dtype), (stance.centre.shape[0], 3, 3))


def _reach(b: rigid.Bodies, body: int) -> float:
    """How far a body's coupled geoms reach from its centre of mass, m; planes count as nothing."""
    centre = b.model.body_ipos[b.bodies[body]]
    reaches = [
        float(np.linalg.norm(b.model.geom_pos[g] - centre)) + bounding_radius(shape)
        for g, shape, owner in zip(b.geoms, b.shapes, b.body_of, strict=True)
        if owner == body
    ]
    return max((r for r in reaches if np.isfinite(r)), default=0.0)


def _geoms(scene: Scene) -> Geoms:
    """The coupled geoms, and how contact with them is computed."""
    b, f = scene.bodies, scene.fidelity
    assert b is not None
    dx, flat = scene.grid.cell_size, scene.dimension == 2
    return Geoms(b.shapes, b.body_of, f.contact_iterations, dx, scene.mpm_dt, flat, scene.kernels)


def _full(scene: Scene, p: Particles, watched: Array) -> Array:
    """Masses (K,) kg of watched nodes with grains all around them, of the lightest at its density at rest.

    Near the box's walls, all around is on their inner side only.
    """
    density = jnp.min(jnp.where(p.m > 0, p.m / p.V0, jnp.inf), initial=jnp.inf)
    share = jnp.asarray(scene.grid.inner_shares().ravel(), p.m.dtype)
    full = density * scene.node_volume * share.at[watched].get(mode="fill", fill_value=1)
    return jnp.where(jnp.isfinite(full), full, 1)


def _shares(scene: Scene, p: Particles, watched: Array) -> Array | None:
    """Shares (M, K) of the materials in the mass of watched nodes, if bodies treat materials differently."""
    assert scene.bodies is not None
    if len(set(scene.adhesion)) <= 1 and all(len(set(mu)) <= 1 for mu in scene.bodies.friction):
        return None
    gravity = jnp.asarray(scene.gravity, scene.dtype)

    def mass(span: tuple[int, int]) -> Array:
        slots = jnp.arange(p.count)
        some = replace(p, m=jnp.where((slots >= span[0]) & (slots < span[1]), p.m, 0))
        nodes = to_nodes(scene.grid, some, scene.mpm_dt, gravity, watched, scene.kernels)
        return nodes.reshape(-1, nodes.shape[-1]).at[watched, -1].get(mode="fill", fill_value=0)

    m = jnp.stack([mass(span) for span in scene.spans])
    total = jnp.sum(m, axis=0)
    # Nodes that have no grains yet may get some within the rigid step: they take the middle of all.
    return jnp.where(total > 0, m / jnp.where(total > 0, total, 1), 1 / len(scene.spans))
