"""A substep with the forces of its end: its length is bounded by how far grains go, not by the speed of sound.

Backward Euler on the grid, by Newton and a Krylov method without matrices (Sulsky & Kaul, Implicit dynamics in the
material-point method, CMAME 193, 2004; S13 and J16 solve once, linearly): the nodes' velocities u have M (u - v) =
dt f(u), where v are those that grains and gravity bring and f are the forces once grains were strained by dt grad u and
their materials answered, return mapping included: with elastic forces alone sand would hold together for the length of
a step. BiCGSTAB, since plastic flow has unsymmetric slopes; a step of Newton's that does not help is halved. Waves that
a substep does not resolve are damped.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.sparse.linalg import bicgstab

from mpm_env.mpm.linalg3 import matrix_rows
from mpm_env.mpm.substep import LEAST_MASS, Bed, chunk_of, move, node_velocities, stretch, take_out, walls
from mpm_env.mpm.transfer import g2p, p2g
from mpm_env.mpm.types import Grid, Particles

WALLS = ("slip", "stick", "open")  # what rubs or lets go changes with the forces, which the solve does not follow
CLOSE = 1e-2  # share of the forces that may be left over; a collapse ends the same with 1e-3
TRIES = 30  # at most, of Newton's steps and parts of them; 2 to 5 are usual
INNER = 0.1  # of the residual that each of Newton's steps leaves; more digits are lost on the next one
ITERATIONS = 30  # at most, of BiCGSTAB
LEAST_PART = 1 / 32  # of Newton's step: when not even this part helps, a kink of the material is in the way
TINY = 1e-30  # kg^1/2 m/s, where nothing is to be solved


class _Search(NamedTuple):
    """Newton on its way."""

    u: Array  # (*shape, d) m/s, the best so far
    left: Array  # () what it leaves over
    step: Array  # (*shape, d) m/s, Newton's from there
    part: Array  # () of the step to be tried next
    tries: Array  # () int32


def substep(
    grid: Grid, beds: tuple[Bed, ...], p: Particles, dt: float | Array, gravity: Array, worst: Array
) -> tuple[Particles, Array]:
    """Advance the grains by dt; gravity (d,) m/s^2. Returns the grains, and the larger of `worst` and what is unsolved.

    Momentum is conserved whatever is left unsolved: what the search adds has no sum, as internal forces have none.
    """
    unstressed = replace(p, tau=jnp.zeros_like(p.tau))
    nodes = p2g(grid, unstressed, dt, chunk_of(p))
    pushes = p2g(grid, p, dt, chunk_of(p)) - nodes
    v, m = node_velocities(nodes, dt, gravity)
    u, unsolved = solved(grid, beds, p, v, m, dt, pushes[..., :-1])
    nodes = jnp.concatenate([u, m[..., None]], axis=-1)
    for bed in beds:
        p = move(grid, bed, p, nodes, dt, "xla")
    return take_out(grid, p), jnp.maximum(worst, unsolved)


def solved(
    grid: Grid, beds: tuple[Bed, ...], p: Particles, v: Array, m: Array, dt: float | Array, pushes: Array
) -> tuple[Array, Array]:
    """Velocities (*shape, d) m/s at the end of nodes that have v before forces and walls, and masses m (*shape,) kg.

    And the share () that is left unsolved, of the impulses `pushes` (*shape, d) kg m/s of today's forces and of what
    motion adds to them, both as root of sum r^2 / m.
    """
    mass = jnp.where(m > LEAST_MASS, m, 1)[..., None]
    free = walls(grid, jnp.ones_like(v)) * (m > LEAST_MASS)[..., None]

    def off(u: Array) -> tuple[Array, Array]:
        r = mass * (u - free * v) - free * dt * forces(grid, beds, p, u, dt)
        return r, r

    def size(r: Array) -> Array:
        return jnp.sqrt(jnp.sum(r * r / mass))

    def newton(s: _Search) -> _Search:
        u = s.u + s.part * s.step
        _, slope, r = jax.linearize(off, u, has_aux=True)
        left = size(r)

        def onward() -> _Search:
            step, _ = bicgstab(slope, -r, tol=INNER, maxiter=ITERATIONS, M=lambda r: r / mass)
            return _Search(u, left, jnp.where(jnp.isfinite(step), step, 0), jnp.ones_like(left), s.tries + 1)

        def back() -> _Search:
            return s._replace(part=s.part / 2, tries=s.tries + 1)

        return lax.cond(left < s.left, onward, back)

    start = _Search(free * v, jnp.asarray(jnp.inf, v.dtype), jnp.zeros_like(v), jnp.ones((), v.dtype), jnp.int32(0))
    s = newton(start)
    whole = size(free * pushes) + s.left + TINY
    s = lax.while_loop(lambda s: (s.left > CLOSE * whole) & (s.part >= LEAST_PART) & (s.tries < TRIES), newton, s)
    return s.u, s.left / whole


def forces(grid: Grid, beds: tuple[Bed, ...], p: Particles, u: Array, dt: float | Array) -> Array:
    """Internal forces (*shape, d) N at the end of a step in which the nodes move with u (*shape, d) m/s.

    -V0 tau (I + dt grad u)^-T w (x_i - x_p) / D: the gradient of the elastic energy over the nodes' end positions, so
    that without plastic flow the slope is symmetric.
    """
    d = grid.dimension
    _, C = g2p(grid, u, p.x)
    G = dt * C
    answers = [mat.update(stretch(p.e[:, a:b], G[:, :, a:b]), p.history[:, a:b], dt) for mat, a, b in beds]
    tau = matrix_rows(jnp.concatenate([tau for _, _, tau in answers], axis=-1))
    back = _inverse_transposed(jnp.eye(d, dtype=u.dtype)[..., None] + G)
    scale = jnp.where(p.m > 0, -4 / grid.cell_size**2 * p.V0 / jnp.where(p.m > 0, p.m, 1), 0)
    S = jnp.stack(
        [jnp.stack([scale * sum(tau[i][k] * back[k, j] for k in range(d)) for j in range(d)]) for i in range(d)]
    )
    # As an affine velocity per mass, these stresses take the way of every momentum to the nodes.
    pushed = replace(p, v=jnp.zeros_like(p.v), C=S, tau=jnp.zeros_like(p.tau))
    return p2g(grid, pushed, dt, chunk_of(p))[..., :d]


def _inverse_transposed(F: Array) -> Array:
    """F^-T (d, d, n) of deformations F (d, d, n), by their cofactors."""
    if F.shape[0] == 2:
        cofactors = jnp.stack([jnp.stack([F[1, 1], -F[1, 0]]), jnp.stack([-F[0, 1], F[0, 0]])])
    else:
        cofactors = jnp.stack(
            [jnp.cross(F[1], F[2], axis=0), jnp.cross(F[2], F[0], axis=0), jnp.cross(F[0], F[1], axis=0)]
        )
    return cofactors / jnp.sum(F[0] * cofactors[0], axis=0)
