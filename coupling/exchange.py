"""Momentum exchange between many points and a few bodies, solved in joint space.

Each point is a lumped mass, so its post-contact velocity is known once the bodies' is: what remains is one equation in
the nv joint velocities q,

    M (q - q*) - J_c^T (p(q) - p_0) + sum_b J_b^T sum_i A_i^T lambda_i(v_i - A_i u_b) = 0,      u_b = J_b q + d_b,

M the mass matrix that the integrator will use, q* the velocity without contact and constraints, p(q) the impulses of
the rigid constraints along J_c and p_0 what they had given before (see constraints.py), A_i = [1, -[r_i]x] the point's
lever, lambda_i the contact law, d_b the prescribed twist of a kinematic body. It is an inelastic collision: momentum is
exchanged exactly and energy cannot rise, whatever the mass ratio. Solved by a semi-smooth Newton iteration that starts
where every point sticks, with a line search on the residual; where it has not converged, impulses are scaled down until
they dissipate.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from coupling.constraints import SOLVED, STEPS, Rows, firm_mass, pushes, settled
from coupling.contact import Points, Surface, cross, impulses, stiffness
from coupling.geoms import dot, once

NOISE = 1e-6  # share of the points' kinetic energy below which work is rounding, and not scaled


class Twists(NamedTuple):
    """How coupled bodies may move: body b has the twist J q + d about its centre, linear part first."""

    centre: Array  # (B, 3) m
    J: Array  # (B, 6, nv)
    d: Array  # (B, 6) m/s and rad/s
    M: Array  # (nv, nv) kg, kg m^2
    rows: Rows | None = None  # of the rigid constraints; None where there are none


class Exchange(NamedTuple):
    """What contact did."""

    q: Array  # (nv,) joint velocities after contact
    impulse: Array  # (3, K) N s on the points
    wrench: Array  # (G, 6) impulse wrench on each geom about its body's centre: N s and N m s
    residual: Array  # () share of the equation left unsolved, 0 when converged
    scale: Array  # () factor that kept the impulses dissipative, 1 when converged
    given: Array  # (r,) N s, of the rigid constraints since the rigid step's start; (0,) where there are none


def exchange(
    p: Points, t: Twists, q_free: Array, surface: Surface, body_of: tuple[int, ...], iterations: int
) -> Exchange:
    """Impulses between points p and bodies t from the velocity q_free (nv,) without them and without constraints.

    body_of is the body of each geom. No iterations are made when no coupled body can yield (nv == 0): then the law is
    explicit.
    """
    body = jnp.asarray(body_of, jnp.int32)[p.geom]
    r = p.x - t.centre.T[:, body]
    w = p.v - _at(t.d.T[:, body], r)
    nv = t.M.shape[0]
    if nv == 0:
        f = impulses(p, w, surface)
        zero = jnp.zeros((), p.v.dtype)
        return Exchange(q_free, f, _per_geom(f, p, r, len(body_of)), zero, zero + 1, jnp.zeros((0,), zero.dtype))
    # How the body's points under the grid points move with q: (3, nv, K).
    lever = _at(jnp.moveaxis(t.J, 0, -1)[..., body], r[:, None])

    def moved(q: Array) -> Array:
        """Velocities (3, K) of the bodies' points with joint velocities q (nv,)."""
        return dot(q, [lever[:, j] for j in range(nv)])

    def pull(f: Array) -> Array:
        """Generalised impulses (n, nv) of n times impulses f (3, n, K) on the bodies."""
        return jnp.sum(jnp.einsum("cik,cjk->cij", f, lever), axis=0)

    zero, rows = jnp.zeros_like(q_free), t.rows
    points_mass = pull(p.m * lever)
    q_held, stuck_mass = q_free, t.M + points_mass
    if rows:  # what they do without the points
        held = settled(t.M, rows, q_free, zero, zero)
        q_held = q_free + held.change
        stuck_mass += firm_mass(rows, held.given)
    # The unknown is the change of q, not q: a heavy body's would drown in the rounding of q.
    w_free = w - moved(q_held)
    metric = jnp.linalg.inv(stuck_mass)

    def best(changes: Array, w: Array) -> Newton:
        """The best of n changes (n, nv), with which points move with w (3, n, K) relative to their body."""
        R = changes @ t.M.T + pull(impulses(p, w, surface))
        if rows:
            R -= (pushes(rows, q_held + changes) - held.given) @ rows.J
        size = jnp.sqrt(jnp.maximum(jnp.sum((R @ metric) * R, axis=-1), 0))
        i = jnp.argmin(size)
        return Newton(changes[i], w[:, i], R[i], size[i], jnp.ones((), bool))

    none = best(zero[None], w_free[:, None])
    enough = SOLVED * jnp.finfo(none.size.dtype).eps * none.size

    def nearer(old: Newton, step: Array, shares: Array) -> Newton:
        """After the best of some shares (n,) of a step (nv,), if it helps at all."""
        w = old.w[:, None] - shares[:, None] * once(moved(step))[:, None]
        return better(old, best(old.change + shares[:, None] * step, w))

    def better(old: Newton, new: Newton) -> Newton:
        helps = new.size < old.size
        new = jax.tree.map(lambda a, b: jnp.where(helps, a, b), new, old)
        return new._replace(going=helps & (new.size > enough))

    def newton(_: int, at: Newton) -> Newton:
        D = stiffness(p, at.w, surface)
        K = pull(jnp.stack([dot(row[:, None], lever) for row in D])).T
        if not rows:
            return nearer(at, -jnp.linalg.solve(t.M + K, at.R), jnp.asarray(STEPS, at.R.dtype))
        pulled = pull(impulses(p, at.w, surface)[:, None])[0]
        return better(at, among([held_step(at.change, K, pulled, share) for share in STEPS]))

    def held_step(x: Array, K: Array, pulled: Array, share: float) -> Array:
        """The change (nv,) of q by a Newton step from x for the points, that the constraints take to the full.

        Their kinks would stop a line search; so shorter steps are not shares of it, but steps of heavier points.
        """
        assert rows is not None
        A = K + (1 / share - 1) * stuck_mass
        return settled(t.M + A, rows._replace(given=held.given), q_held, A @ x - pulled, x, metric).change

    def among(changes: list[Array]) -> Newton:
        some = jnp.stack(changes)
        return best(some, w_free[:, None] - dot(some.T[..., None], [lever[:, None, j] for j in range(nv)]))

    all_stick = pull((p.m * w_free)[:, None])[0]
    if rows:
        at = better(none, among([held_step(zero, points_mass, -all_stick, 1.0)]))
    else:
        at = nearer(none, metric @ all_stick, jnp.ones((1,), all_stick.dtype))
    at = at._replace(going=at.size > enough)
    at = jax.lax.fori_loop(0, iterations, lambda i, at: jax.lax.cond(at.going, newton, lambda _, at: at, i, at), at)
    f = impulses(p, at.w, surface)
    pulled = pull(f[:, None])[0]
    if rows:
        push = held.change - settled(t.M, rows, q_free, -pulled, held.change + at.change).change
    else:
        push = jnp.linalg.solve(t.M, pulled)  # what the bodies give: q = q_held - push
    work = jnp.sum(f * w_free)
    doubled = jnp.sum(dot(f, f) / jnp.where(p.m > 0, p.m, 1)) + pulled @ push
    noise = NOISE * jnp.sum(p.m * dot(p.v, p.v))
    noticeable = jnp.abs(work) > noise
    left = jnp.where(none.size**2 > noise, at.size / jnp.maximum(none.size, jnp.finfo(w.dtype).tiny), 0)
    scale = jnp.where(noticeable & (doubled > 0), jnp.clip(-work / jnp.where(doubled > 0, doubled, 1), 0, 1), 1)
    f = scale * f
    wrench = _per_geom(f, p, r, len(body_of))
    if not rows:
        return Exchange(q_free - scale * push, f, wrench, left, scale, jnp.zeros((0,), f.dtype))
    done = settled(t.M, rows, q_free, -scale * pulled, held.change - scale * push)
    left = jnp.maximum(left, jnp.maximum(held.left, done.left))
    return Exchange(q_free + done.change, f, wrench, left, scale, done.given)


class Newton(NamedTuple):
    """Where the iteration stands."""

    change: Array  # (nv,) of q by contact
    w: Array  # (3, K) m/s, how points then move relative to their bodies
    R: Array  # (nv,) what is left of the equation there
    size: Array  # () of R
    going: Array  # () bool, whether another step can help


def _at(twist: Array, r: Array) -> Array:
    """Velocities (3, ..) at r (3, ..) m of bodies with twists (6, ..)."""
    return twist[:3] + cross(twist[3:], r)


def _per_geom(f: Array, p: Points, r: Array, count: int) -> Array:
    """Impulse wrench (G, 6) on each geom: the reaction of the impulses f (3, K) on its points."""
    onto = (p.geom == jnp.arange(count)[:, None]).astype(f.dtype)
    return -onto @ jnp.concatenate([f, cross(r, f)]).T
