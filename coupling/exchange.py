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
    body = jnp.asarray(body_of, jnp.int32)[p.geom]
    friction = mu[p.geom]
    r = p.x - t.centre[body]
    prescribed = t.d[body]
    drift = prescribed[:, :3] + jnp.cross(prescribed[:, 3:], r)
    if t.M.shape[0] == 0:
        f = impulses(p, p.v - drift, friction)
        zero = jnp.zeros((), p.v.dtype)
        return Exchange(q_free, f, _per_geom(f, p, r, len(body_of)), zero, zero + 1)
    # How the body's points under the grid points move with q: (K, 3, nv), and flat as (3K, nv).
    J = t.J[body]
    lever = (J[:, :3] + jnp.cross(J[:, 3:], r[:, :, None], axis=1)).reshape(-1, t.M.shape[0])

    w_free = p.v - drift - (lever @ q_free).reshape(-1, 3)

    # The unknown is the change of q, not q: a heavy body's would drown in the rounding of q.
    def relative(change: Array) -> Array:
        return w_free - (lever @ change).reshape(-1, 3)

    def pull(f: Array) -> Array:
        """Generalised impulse (nv,) of impulses f (K, 3) on the bodies."""
        return f.reshape(-1) @ lever

    def added_mass(D: Array) -> Array:
        """What points that answer with D (K, 3, 3) kg add to the bodies' inertia, (nv, nv)."""
        return lever.T @ (D @ lever.reshape(-1, 3, t.M.shape[0])).reshape(lever.shape)

    metric = jnp.linalg.inv(t.M + lever.T @ (jnp.repeat(p.m, 3)[:, None] * lever))

    def residual(change: Array) -> Array:
        return t.M @ change + pull(impulses(p, relative(change), friction))

    def size(R: Array) -> Array:
        return jnp.sqrt(jnp.maximum(R @ metric @ R, 0))

    none, stuck = jnp.zeros_like(q_free), metric @ pull(p.m[:, None] * w_free)
    start = size(residual(none))
    change = jnp.where(size(residual(stuck)) < start, stuck, none)
    steps = jnp.asarray(STEPS, q_free.dtype)

    def newton(_: int, change: Array) -> Array:
        H = t.M + added_mass(stiffness(p, relative(change), friction))
        step = -jnp.linalg.solve(H, residual(change))
        tries = change + steps[:, None] * step
        sizes = jax.vmap(lambda trial: size(residual(trial)))(tries)
        best = jnp.argmin(sizes)
        return jnp.where(sizes[best] < size(residual(change)), tries[best], change)

    change = jax.lax.fori_loop(0, iterations, newton, change)
    f = impulses(p, relative(change), friction)
    push = jnp.linalg.solve(t.M, pull(f))  # what the bodies give: q = q_free - push
    work = jnp.sum(f * w_free)
    doubled = jnp.sum(jnp.sum(f * f, axis=-1) / jnp.where(p.m > 0, p.m, 1)) + pull(f) @ push
    noise = NOISE * jnp.sum(p.m * jnp.sum(p.v * p.v, axis=-1))
    noticeable = jnp.abs(work) > noise
    left = jnp.where(start * start > noise, size(residual(change)) / jnp.maximum(start, jnp.finfo(start.dtype).tiny), 0)
    scale = jnp.where(noticeable & (doubled > 0), jnp.clip(-work / jnp.where(doubled > 0, doubled, 1), 0, 1), 1)
    f = scale * f
    return Exchange(q_free - scale * push, f, _per_geom(f, p, r, len(body_of)), left, scale)


def _per_geom(f: Array, p: Points, r: Array, count: int) -> Array:
    """Impulse wrench (G, 6) on each geom: the reaction of the impulses f (K, 3) on its points."""
    onto = (p.geom[:, None] == jnp.arange(count)).astype(f.dtype)
    return -onto.T @ jnp.concatenate([f, jnp.cross(r, f)], axis=-1)
