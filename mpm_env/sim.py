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
from mpm_env.health import MOST_UNSOLVED, Health, as_bits
from mpm_env.mpm import implicit
from mpm_env.mpm.budgets import mass_that_left
from mpm_env.mpm.sorting import in_order
from mpm_env.mpm.stability import MOST_CELLS_PER_SUBSTEP
from mpm_env.mpm.substep import substep
from mpm_env.mpm.types import Particles
from mpm_env.scene import Scene, State, inside_grid
from mpm_env.sim_contact import Contact


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
        grains, unsolved = _run_grains(scene, state)
        bits = as_bits({Health.NOT_SOLVED: ~(unsolved <= MOST_UNSOLVED)}) if unsolved is not None else Health.WELL
        return _examined(scene, state, replace(state, grains=grains, steps=state.steps + 1), bits)
    b = scene.bodies
    d = state.rigid.replace(ctrl=drive.control)
    twist = rigid.drift(b, d, drive.position, drive.quaternion)
    d, stance = rigid.open_step(b, d, twist)
    contact = Contact.of(scene, jax.tree.map(lambda a: a.astype(scene.dtype), stance), state.grains)
    touch = contact.start(d.qvel.astype(scene.dtype))
    grains, touch = _run_grains(scene, state, contact, touch)
    dtype = d.qvel.dtype
    foreseen = rigid.foreseen(b, stance, touch.q.astype(dtype)) if b.steps else None
    d = rigid.close_step(b, d, touch.impulse.astype(dtype), foreseen)
    d = rigid.refresh(b, rigid.place(d, drive.position, drive.quaternion))
    # Under 64-bit JAX, MJX's contacts come back with wider integers than they went in.
    d = jax.tree.map(lambda new, old: new.astype(old.dtype), d, state.rigid)
    report = contact.report(touch, d.qvel.astype(scene.dtype))
    after = replace(
        state,
        rigid=d,
        grains=grains,
        steps=state.steps + 1,
        reaction=touch.wrench / jnp.asarray(scene.rigid_dt, scene.dtype),
        contact=report,
    )
    return _examined(scene, state, after, contact.examined(touch, report))


def _run_grains(scene: Scene, state: State, contact: Contact | None = None, touch: Any = None) -> tuple[Particles, Any]:
    """The substeps of one rigid step: the grains, with what a contact noted, or the largest share left unsolved."""
    beds = scene.beds(state.materials)
    gravity = jnp.asarray(scene.gravity, scene.dtype)
    if not scene.slots:
        if contact is not None:
            touch = lax.fori_loop(0, scene.mpm_per_rigid, lambda _, t: contact.coast(t), touch)
        return state.grains, touch

    def one(_: int, both: tuple[Particles, Any]) -> tuple[Particles, Any]:
        if scene.fidelity.solver == "semi_implicit":
            return implicit.substep(scene.grid, beds, both[0], scene.mpm_dt, gravity, both[1])
        return substep(scene.grid, beds, both[0], scene.mpm_dt, gravity, contact, both[1], scene.kernels)

    if scene.fidelity.solver == "semi_implicit":
        touch = jnp.zeros((), scene.dtype)
    return lax.fori_loop(0, scene.mpm_per_rigid, one, (state.grains, touch))


def _examined(scene: Scene, before: State, after: State, contact: Array | int) -> State:
    """The state after a rigid step, with what is wrong with it and what left through open walls."""
    p, dx = after.grains, scene.grid.cell_size
    finite = jnp.ones((), bool)
    if after.rigid is not None:
        d = after.rigid  # a mocap body told to go nowhere touches no grain, which then seem well
        told = (d.qpos, d.qvel, d.mocap_pos, d.mocap_quat)
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(a)) for a in told]))
    if not scene.slots:
        return replace(after, health=after.health | contact | as_bits({Health.NOT_FINITE: ~finite}))
    finite &= jnp.isfinite(jnp.sum(p.x) + jnp.sum(p.v) + jnp.sum(p.e))
    here = p.m > 0
    speed2 = jnp.where(here, jnp.sum(p.v * p.v, axis=0), 0)
    turning2 = jnp.where(here, jnp.sum(p.C * p.C, axis=(0, 1)), 0)
    bits = as_bits(
        {
            Health.NOT_FINITE: ~finite,
            Health.LEFT_GRID: jnp.any(here & ~inside_grid(scene.grid, p.x)),
            Health.TOO_FAST: jnp.max(speed2) > (MOST_CELLS_PER_SUBSTEP * dx / scene.mpm_dt) ** 2,
            Health.INVERTED: jnp.max(turning2) * scene.mpm_dt**2 >= 1,
        }
    )
    left = before.left + mass_that_left(before.grains, p)
    return replace(after, health=after.health | contact | bits, left=left)
