"""Rigid constraints while grains push: contacts of bodies with each other, joint limits, dry friction, equalities.

MuJoCo's constraints act on a whole rigid step, each by a law of the joint acceleration a over it: the force along a row
of their Jacobian is D (aref - J a), no less than `low` and no more than `high` (MuJoCo documentation, Computation,
"The general framework"; D and aref are MuJoCo's efc_D and efc_aref). Grains push at every substep. So a time t after
the start of a rigid step, joints move as if the step ended here, with all that the grains have given so far: the same
laws then hold for the mean acceleration since the start, and at the end of the step they are MJX's own. A row's impulse
since the start is then a law of the joint velocities q,

    p(q) = clip(D (aim - J T q), low, high),

with T = M^-1 M_hat where the integrator solves M_hat instead of M, as for damping: MuJoCo's constraints see the
acceleration before that.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

STEPS = (1.0, 0.5, 0.25, 0.0625)  # line search candidates: full Newton steps where they help, small ones at kinks
SOLVED = 4.0  # times rounding: an equation with no larger share left is not iterated any further
ITERATIONS = 12  # of Newton for the constraints alone: few rows change sides in a substep
HALVINGS = 16  # of a Newton step that goes too far, to find where it should have ended


class Laws(NamedTuple):
    """A rigid step's r constraint rows, as laws of the joint acceleration."""

    J: Array  # (r, nv) along which they push
    T: Array  # (nv, nv) by which joint velocities enter the law
    D: Array  # (r,) kg
    aref: Array  # (r,) m/s^2
    low: Array  # (r,) N
    high: Array  # (r,) N


class Rows(NamedTuple):
    """The rows some time after the step's start, as laws of the joint velocities; see the module's docstring."""

    J: Array  # (r, nv)
    T: Array  # (nv, nv)
    D: Array  # (r,) kg
    aim: Array  # (r,) m/s
    low: Array  # (r,) N s
    high: Array  # (r,) N s
    given: Array  # (r,) N s, what they had given a substep ago


def rows(laws: Laws, q_start: Array, t: Array, given: Array) -> Rows:
    """The laws at time t (s) of a step that joints began with q_start (nv,)."""
    aim = t * laws.aref + laws.J @ (laws.T @ q_start)
    return Rows(laws.J, laws.T, laws.D, aim, t * laws.low, t * laws.high, given)


def pushes(r: Rows, q: Array) -> Array:
    """Impulses (.., r) N s of the rows so far, when joints move with q (.., nv)."""
    return jnp.clip(r.D * (r.aim - q @ r.T.T @ r.J.T), r.low, r.high)


def slope(r: Rows, q: Array) -> Array:
    """Minus the derivative (nv, nv) kg of the rows' generalised impulse by q (nv,)."""
    return firm_mass(r, pushes(r, q)) @ r.T


def firm_mass(r: Rows, given: Array) -> Array:
    """What the rows that give this (r,) N s, and are at no bound, add to the mass matrix (nv, nv) kg; symmetric."""
    return r.J.T @ (jnp.where((given > r.low) & (given < r.high), r.D, 0)[:, None] * r.J)


class Settled(NamedTuple):
    """Joint velocities that the constraints agree with."""

    change: Array  # (nv,) from where they started
    given: Array  # (r,) N s, of the rows since the step's start
    left: Array  # () share of the equation left unsolved


def settled(M: Array, r: Rows, q: Array, load: Array, guess: Array, metric: Array | None = None) -> Settled:
    """The change c of joint velocities q (nv,) for which M c = load + J^T (p(q + c) - given), from a guess of it.

    load (nv,): generalised impulse besides the constraints'; M (nv, nv): what the integrator solves. In T c this is the
    minimum of a convex function, MuJoCo's. A Newton iteration, whose steps end where that function is least along them,
    if they would go beyond. What remains is measured in the metric, by default the inverse of M.
    """
    metric = jnp.linalg.inv(M) if metric is None else metric

    def size(R: Array) -> Array:
        return jnp.sqrt(jnp.maximum(R @ metric @ R, 0))

    def remains(c: Array) -> Array:
        return M @ c - load - (pushes(r, q + c) - r.given) @ r.J

    def share(c: Array, step: Array) -> Array:
        """How far to go along a step: where what remains has no part along it any more."""
        along = r.T @ step

        def beyond(a: Array) -> Array:
            return along @ remains(c + a * step) > 0

        def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = ends
            middle = (low + high) / 2
            past = beyond(middle)
            return jnp.where(past, low, middle), jnp.where(past, middle, high)

        one = jnp.ones((), q.dtype)
        return jax.lax.cond(
            beyond(one), lambda: jax.lax.fori_loop(0, HALVINGS, halve, (jnp.zeros_like(one), one))[1], lambda: one
        )

    enough = SOLVED * jnp.finfo(q.dtype).eps * (size(load) + size(M @ guess) + size(jnp.abs(r.given) @ jnp.abs(r.J)))

    def newton(c: Array) -> Array:
        step = -jnp.linalg.solve(M + slope(r, q + c), remains(c))
        return c + share(c, step) * step

    def one(_: int, c: Array) -> Array:
        return jax.lax.cond(size(remains(c)) > enough, newton, lambda c: c, c)

    c = jax.lax.fori_loop(0, ITERATIONS, one, guess)
    given = pushes(r, q + c)
    whole = size(load) + size((given - r.given) @ r.J)
    left = jnp.where(whole > enough, size(remains(c)) / jnp.where(whole > enough, whole, 1), 0)
    return Settled(c, given, left)
