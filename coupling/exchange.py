"""Momentum exchange between many points and a few bodies, solved in joint space.

Each point is a lumped mass, so its post-contact velocity is known once the bodies' is: what remains is one equation in
the nv joint velocities q,

    M (q - q*) + sum_b J_b^T sum_i A_i^T lambda_i(v_i - A_i u_b) = 0,      u_b = J_b q + d_b,

M the mass matrix that the integrator will use, q* the velocity without contact, A_i = [1, -[r_i]x] the point's lever,
lambda_i the contact law, d_b the prescribed twist of a kinematic body. It is an inelastic collision: momentum is
exchanged exactly and energy cannot rise, whatever the mass ratio. Solved by a semi-smooth Newton iteration that starts
where every point sticks, with a line search on the residual; where it has not converged, impulses are scaled down until
they dissipate.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from coupling.contact import Points, impulses, stiffness

STEPS = (1.0, 0.5, 0.25, 0.0625)  # line search candidates: full Newton steps where they help, small ones at kinks
NOISE = 1e-6  # share of the points' kinetic energy below which work is rounding, and not scaled


class Twists(NamedTuple):
    """How coupled bodies may move: body b has the twist J q + d about its centre, linear part first."""

    centre: Array  # (B, 3) m
    J: Array  # (B, 6, nv)
    d: Array  # (B, 6) m/s and rad/s
    M: Array  # (nv, nv) kg, kg m^2


class Exchange(NamedTuple):
    """What contact did."""

    q: Array  # (nv,) joint velocities after contact
    impulse: Array  # (K, 3) N s on the points
    wrench: Array  # (G, 6) impulse wrench on each geom about its body's centre: N s and N m s
    residual: Array  # () share of the equation left unsolved, 0 when converged
    scale: Array  # () factor that kept the impulses dissipative, 1 when converged


def exchange(p: Points, t: Twists, q_free: Array, mu: Array, body_of: tuple[int, ...], iterations: int) -> Exchange:
    """Impulses between points p and bodies t from the velocity q_free (nv,) that the bodies would have without them.

    mu (G,) is the friction coefficient of each geom, body_of the body of each geom. No iterations are made when no
    coupled body can yield (nv == 0): then the law is explicit.
    """
    geom_body = jnp.asarray(body_of, jnp.int32)
    body = geom_body[p.geom]
    friction = mu[p.geom]
    r = p.x - t.centre[body]
    count = t.centre.shape[0]
    member = (body[:, None] == jnp.arange(count)).astype(p.v.dtype)  # (K, B)

    def relative(q: Array) -> Array:
        u = (t.J @ q + t.d)[body]
        return p.v - u[:, :3] - jnp.cross(u[:, 3:], r)

    def wrenches(f: Array, onto: Array) -> Array:
        """Sum of forces f (K, 3) with their moments per column of onto (K, B or G): (columns, 6)."""
        return onto.T @ jnp.concatenate([f, jnp.cross(r, f)], axis=-1)

    def pull(f: Array) -> Array:
        """Generalised impulse (nv,) of impulses f (K, 3) on the bodies."""
        return jnp.einsum("bkn,bk->n", t.J, wrenches(f, member))

    if t.M.shape[0] == 0:
        f = impulses(p, relative(q_free), friction)
        zero = jnp.zeros((), p.v.dtype)
        return Exchange(q_free, f, _per_geom(f, p, r, len(body_of)), zero, zero + 1)

    lever = jnp.concatenate([jnp.broadcast_to(jnp.eye(3, dtype=r.dtype), (r.shape[0], 3, 3)), -_cross(r)], axis=-1)

    def added_mass(D: Array) -> Array:
        """sum_b J_b^T (sum_i A_i^T D_i A_i) J_b, (nv, nv): the one large reduction."""
        DA = D @ lever  # (K, 3, 6)
        per_body = jnp.einsum("kia,kib,kB->Bab", lever, DA, member)
        return jnp.einsum("Bam,Bab,Bbn->mn", t.J, per_body, t.J)

    everyone = p.m[:, None, None] * jnp.eye(3, dtype=r.dtype)
    metric = jnp.linalg.inv(t.M + added_mass(everyone))

    def residual(q: Array) -> Array:
        return t.M @ (q - q_free) + pull(impulses(p, relative(q), friction))

    def size(R: Array) -> Array:
        return jnp.sqrt(jnp.maximum(R @ metric @ R, 0))

    stuck = metric @ (t.M @ q_free + pull(p.m[:, None] * (relative(0 * q_free))))
    start = size(residual(q_free))
    q = jnp.where(size(residual(stuck)) < start, stuck, q_free)
    steps = jnp.asarray(STEPS, q.dtype)

    def newton(_: int, q: Array) -> Array:
        H = t.M + added_mass(stiffness(p, relative(q), friction))
        step = -jnp.linalg.solve(H, residual(q))
        tries = q + steps[:, None] * step
        sizes = jax.vmap(lambda trial: size(residual(trial)))(tries)
        best = jnp.argmin(sizes)
        return jnp.where(sizes[best] < size(residual(q)), tries[best], q)

    q = jax.lax.fori_loop(0, iterations, newton, q)
    f = impulses(p, relative(q), friction)
    push = jnp.linalg.solve(t.M, pull(f))  # what the bodies give: q = q_free - push
    work = jnp.sum(f * relative(q_free))
    doubled = jnp.sum(jnp.sum(f * f, axis=-1) / jnp.where(p.m > 0, p.m, 1)) + pull(f) @ push
    noise = NOISE * jnp.sum(p.m * jnp.sum(p.v * p.v, axis=-1))
    noticeable = jnp.abs(work) > noise
    left = jnp.where(start * start > noise, size(residual(q)) / jnp.maximum(start, jnp.finfo(q.dtype).tiny), 0)
    scale = jnp.where(noticeable & (doubled > 0), jnp.clip(-work / jnp.where(doubled > 0, doubled, 1), 0, 1), 1)
    f = scale * f
    return Exchange(q_free - scale * push, f, _per_geom(f, p, r, len(body_of)), left, scale)


def _per_geom(f: Array, p: Points, r: Array, count: int) -> Array:
    """Impulse wrench (G, 6) on each geom: the reaction of the impulses f (K, 3) on its points."""
    onto = (p.geom[:, None] == jnp.arange(count)).astype(f.dtype)
    return -onto.T @ jnp.concatenate([f, jnp.cross(r, f)], axis=-1)


def _cross(r: Array) -> Array:
    """Matrices (K, 3, 3) with [r]x w = r x w."""
    x, y, z = r[:, 0], r[:, 1], r[:, 2]
    o = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([o, -z, y], -1), jnp.stack([z, o, -x], -1), jnp.stack([-y, x, o], -1)], axis=-2)
