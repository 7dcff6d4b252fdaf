"""Runs watched step by step: what is finite, how fast it gets, whether mass is kept, and what the scene says of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.coupling.beds import G
from benchmarks.coupling.scenes import ROWS
from coupling.bodies import refresh
from mpm_env import Scene, State, scripted
from mpm_env.health import MOST_TRAVEL, Health, names
from mpm_env.mpm.budgets import budgets
from mpm_env.sim import Drive, rigid_step

FEW = 3.0  # times the speed of a tool that hits sand: a wave doubles at a free surface, and jets are faster still
LEDGER = 1e-6  # of the mass at the start: what left is summed in float32


class Watch(NamedTuple):
    """Numbers after each of k rigid steps."""

    finite: np.ndarray  # (k,) bool, all that is known of grains and bodies
    grain: np.ndarray  # (k,) m/s, of the fastest grain
    joint: np.ndarray  # (k,) m/s or rad/s, of the fastest joint
    kept: np.ndarray  # (k,) bool, each grain has the mass that it had, or has left
    gone: np.ndarray  # (k,) kg, of grains that are not there any more
    left: np.ndarray  # (k,) kg, as the state says
    rise: np.ndarray  # (k,) J, energy of the grains above that at the start
    reaction: np.ndarray  # (k, G, 6) N and N m, mean over the step
    qpos: np.ndarray  # (k, nq)
    qvel: np.ndarray  # (k, nv)
    depth: np.ndarray  # (k,) m, deepest grain inside a body
    health: np.ndarray  # (k,) sticky bits

    def wrong(self, most: float, most_joint: float = np.inf) -> np.ndarray:
        """Which steps (k,) are garbage: not finite, or a grain or joint faster than these."""
        return ~self.finite | ~(self.grain <= most) | ~(self.joint <= most_joint)

    @property
    def trouble(self) -> list[str]:
        """Health bits that were set."""
        return names(int(self.health[-1]))


def fall(height: float, gravity: float = G) -> float:
    """Speed (m/s) after a fall through this height (m)."""
    return float(np.sqrt(2 * abs(gravity) * height))


def too_fast(scene: Scene, speed: float) -> bool:
    """Whether a body of this speed (m/s) goes farther in a rigid step than points near it are looked up for."""
    return speed * scene.rigid_dt > MOST_TRAVEL * scene.grid.cell_size


def under(scene: Scene, gravity: Any, heavier: Any) -> Scene:
    """The scene in this gravity (m/s^2, down), its bodies so many times heavier; both may be traced."""
    b, down = scene.bodies, jnp.asarray([0, 0, -1.0]) * gravity
    assert b is not None
    model = b.mjx_model
    changed = {"opt.gravity": down.astype(model.opt.gravity.dtype)}
    changed |= {name: getattr(model, name) * heavier for name in ("body_mass", "body_subtreemass", "body_inertia")}
    changed |= {name: getattr(model, name) / heavier for name in ("body_invweight0", "dof_invweight0")}
    flat = down if scene.dimension == 3 else down[::2]
    return replace(scene, gravity=flat, bodies=replace(b, mjx_model=model.tree_replace(changed)))


@cache
def _program(scene: Scene) -> Any:
    def energy(there: Scene, state: State) -> jax.Array:
        b = budgets(there.grid, there.beds(state.materials), state.grains, jnp.asarray(there.gravity, there.dtype))
        return b.kinetic + b.elastic + b.potential

    def one(there: Scene, first: jax.Array, state: State, drive: Drive) -> tuple[State, Watch]:
        state = rigid_step(there, state, drive)
        g, d = state.grains, state.rigid
        here = g.m > 0
        known = (g.x, g.v, g.C, g.e, g.tau, g.m, d.qpos, d.qvel, d.mocap_pos, d.mocap_quat, state.reaction)
        return state, Watch(
            finite=jnp.all(jnp.asarray([jnp.all(jnp.isfinite(a)) for a in known])),
            grain=jnp.sqrt(jnp.max(jnp.where(here, jnp.sum(g.v**2, axis=0), 0))),
            joint=jnp.max(jnp.abs(d.qvel), initial=0),
            kept=jnp.all(jnp.where(here, g.m == first, g.m == 0)),
            gone=jnp.sum(jnp.where(here, 0, first)),
            left=state.left,
            rise=energy(there, state),
            reaction=state.reaction,
            qpos=d.qpos,
            qvel=d.qvel,
            depth=state.contact.depth,
            health=state.health,
        )

    def some(state: State, drives: Drive, first: jax.Array, gravity: jax.Array, heavier: jax.Array) -> Any:
        there = under(scene, gravity, heavier)
        state = replace(state, rigid=refresh(there.bodies, state.rigid))  # data of bodies so heavy
        return energy(there, state), *jax.lax.scan(partial(one, there, first), state, drives)

    return jax.jit(some)


def watched(
    scene: Scene, state: State, count: int, drives: Drive | None = None, *, gravity: float = G, heavier: float = 1.0
) -> tuple[State, Watch]:
    """So many rigid steps, up to ROWS more, by the scene's own motion, or by these drives (count, ..).

    Gravity (m/s^2, down) and how much heavier the bodies are than the scene's belong to the run: a scene compiles once.
    """
    first, before, parts = state.grains.m, None, []
    how = jnp.asarray(gravity, scene.dtype), jnp.asarray(heavier, scene.dtype)
    for k in range(0, count, ROWS):  # in equal calls, for the same reason
        some = (
            scripted(scene, int(state.steps), ROWS)
            if drives is None
            else jax.tree.map(lambda a, k=k: a[k : k + ROWS], drives)
        )
        energy, state, rows = _program(scene)(state, some, first, *how)
        before = float(energy) if before is None else before
        rows = jax.tree.map(np.asarray, rows)
        parts.append(rows._replace(rise=rows.rise.astype(np.float64) - before))
    return state, jax.tree.map(lambda *a: np.concatenate(a), *parts)


def straight(scene: Scene, start: np.ndarray, velocity: np.ndarray, count: int, end: float = np.inf) -> Drive:
    """Drives of mocap bodies from positions (nmocap, 3) m with velocities (nmocap, 3) m/s, that stop at `end` s."""
    assert scene.bodies is not None
    t = np.minimum((np.arange(count) + 1) * scene.rigid_dt, end)
    position = start + t[:, None, None] * velocity
    turn = np.tile(np.asarray([1, 0, 0, 0], np.float32), (count, len(start), 1))
    return Drive(jnp.zeros((count, scene.bodies.model.nu)), jnp.asarray(position, jnp.float32), jnp.asarray(turn))


def velocities(scene: Scene, start: np.ndarray, drives: Drive) -> np.ndarray:
    """Velocities (k, nmocap, 3) m/s that these drives give to mocap bodies from their start (nmocap, 3) m."""
    return np.diff(np.concatenate([start[None], np.asarray(drives.position)]), axis=0) / scene.rigid_dt


def work(scene: Scene, w: Watch, velocity: np.ndarray) -> np.ndarray:
    """Work (k,) J so far of bodies that move with these velocities (k, G, 3) m/s, one for each coupled geom."""
    power = -np.sum(w.reaction[..., :3].astype(np.float64) * velocity, axis=(-2, -1))
    return np.cumsum(power) * scene.rigid_dt


def assert_told(w: Watch, most: float, most_joint: float = np.inf) -> None:
    """Garbage is never silent: where a step is the first that is wrong, a health bit is set by then."""
    wrong = w.wrong(most, most_joint)
    k = int(np.argmax(wrong))
    assert not wrong.any() or w.health[k] != Health.WELL, (
        f"step {k}: finite {w.finite[k]}, a grain of {w.grain[k]:.3g} m/s, a joint of {w.joint[k]:.3g}, but well"
    )


def assert_kept(w: Watch, mass: float) -> None:
    """No grain's mass (kg in all, at the start) changed, but for those that left, and what left is what is missing."""
    assert w.kept.all(), f"a mass changed in step {int(np.argmin(w.kept))}"
    np.testing.assert_allclose(w.left, w.gone, rtol=0, atol=LEDGER * mass)


def assert_sound(w: Watch, mass: float, most: float, most_joint: float = np.inf) -> None:
    """Finite, bounded, mass kept: whatever the health bits say."""
    wrong = w.wrong(most, most_joint)
    k = int(np.argmax(wrong))
    assert not wrong.any(), (
        f"step {k} of {len(wrong)}: finite {w.finite[k]}, a grain of {w.grain[k]:.3g} m/s (at most {most:.3g}),"
        f" a joint of {w.joint[k]:.3g} (at most {most_joint:.3g}), trouble {w.trouble}"
    )
    assert_kept(w, mass)


def mass_of(state: State) -> float:
    """Mass of the grains, kg."""
    return float(np.sum(np.asarray(state.grains.m), dtype=np.float64))
