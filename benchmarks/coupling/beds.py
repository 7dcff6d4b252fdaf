"""Level beds of dry sand for tools to go into: at rest under their own weight, with tools placed in them and driven."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from coupling import bodies as rigid
from mpm_env import Drive, Scene, State, advance, initial
from mpm_env.mpm.materials.protocol import lame

G = 9.81  # m/s^2
RHO = 1500.0  # kg/m^3, of the sand as poured
ROWS = 25  # rigid steps in one call: one program serves runs of any length


def sand(friction_deg: float, E: float) -> dict[str, Any]:
    """Dry sand with its angle from a plane-strain test; E (Pa) is as stiff as the time at hand allows."""
    return {
        "model": "sand",
        "E": E,
        "nu": 0.3,
        "rho": RHO,
        "friction_deg": friction_deg,
        "friction_fit": "plane_strain",
    }


def block(lower: tuple[float, float, float], upper: tuple[float, float, float]) -> dict[str, Any]:
    """A box full of grains."""
    return {"shape": "box", "lower": lower, "upper": upper}


@cache
def program(scene: Scene) -> Any:
    """The scene's compiled step of ROWS rigid steps, or of as many as it is given."""
    return jax.jit(partial(advance, scene))


@cache
def started(scene: Scene) -> State:
    """The scene's start, on its device: what is not committed to one would have the first step compiled twice."""
    return jax.device_put(jax.jit(partial(initial, scene))(jax.random.key(0)), jax.devices()[0])


def at_rest(scene: Scene, state: State, surface: float, gravity: float = G) -> State:
    """The state with each grain compressed by the sand above it, up to a level surface (m), in gravity (m/s^2).

    Confined elastic sand: the weight above strains it along z only. Gravity that sets in at once would make the bed
    ring between nothing and twice its weight.
    """
    (material,) = state.materials
    lam, mu = lame(material.E, material.nu)
    g = state.grains
    above = jnp.maximum(surface - scene.world(g.x)[2], 0)
    strain = -material.rho * gravity * above / (lam + 2 * mu)
    upright = 1 if scene.dimension == 2 else 2
    e = jnp.zeros_like(g.e).at[upright].set(jnp.expm1(2 * strain))
    tau = jnp.zeros_like(g.tau).at[:3].set(lam * strain).at[upright].set((lam + 2 * mu) * strain)
    return replace(state, grains=replace(g, e=e, tau=tau))


def with_sand(state: State, *, denser: float = 1.0, friction_deg: float | None = None) -> State:
    """The state with sand as many times denser and stiffer, which to a body is one so much lighter; with this friction.

    To be brought to rest afterwards.
    """
    (material,) = state.materials
    material = replace(material, rho=material.rho * denser, E=material.E * denser)
    if friction_deg is not None:
        material = replace(material, friction=jnp.full_like(material.friction, np.radians(friction_deg)))
    return replace(state, materials=(material,), grains=replace(state.grains, m=state.grains.m * denser))


def without(state: State, gone: jax.Array) -> State:
    """The state without the grains (n,) that are in the way."""
    return replace(state, grains=replace(state.grains, m=jnp.where(gone, 0, state.grains.m)))


def planted(scene: Scene, state: State, position: np.ndarray, turn: np.ndarray) -> State:
    """The state with the mocap bodies at these positions (nmocap, 3) m and quaternions (nmocap, 4)."""
    assert scene.bodies is not None
    placed = rigid.place(state.rigid, jnp.asarray(position), jnp.asarray(turn))
    return replace(state, rigid=rigid.refresh(scene.bodies, placed))


def about_y(angle_deg: float) -> np.ndarray:
    """The quaternion (4,) w x y z of a turn about y."""
    half = np.radians(angle_deg) / 2
    return np.array([np.cos(half), 0, np.sin(half), 0])


def soft_travel(t: np.ndarray, speed: float, ramp: float) -> np.ndarray:
    """How far (m) a tool has gone that comes up to speed (m/s) within `ramp` s, without a jerk."""
    early = np.minimum(t, ramp)
    eased = speed / 2 * (early - ramp / np.pi * np.sin(np.pi * early / ramp))
    return eased + speed * np.maximum(t - ramp, 0)


class Ride(NamedTuple):
    """A tool on its way through sand; rows are rigid steps."""

    travel: np.ndarray  # (k,) m
    force: np.ndarray  # (k, 3) N on the tool
    last: State
    cpu_s: float  # without compiling


def ride(
    scene: Scene, state: State, travel: np.ndarray, pose: Callable[[float], tuple[np.ndarray, np.ndarray]], geom: int
) -> Ride:
    """Drive mocap bodies along pose(travel), which gives positions (nmocap, 3) and quaternions (nmocap, 4).

    Travel (k,) m is told at the end of each rigid step; steps beyond a whole number of calls are left out. The force
    is that on one coupled geom.
    """
    calls = len(travel) // ROWS
    drives = []
    for k in range(calls):
        poses = [pose(s) for s in travel[k * ROWS : (k + 1) * ROWS]]
        position, turn = (jnp.asarray(np.asarray(rows), jnp.float32) for rows in zip(*poses, strict=True))
        drives.append(Drive(jnp.zeros((ROWS, 0)), position, turn))
    run = program(scene)
    jax.block_until_ready(run(state, drives[0]))  # compiles
    began, forces = time.process_time(), []
    for drive in drives:
        state, reaction = run(state, drive)
        forces.append(np.asarray(reaction[:, geom, :3], np.float64))
    return Ride(travel[: calls * ROWS], np.concatenate(forces), state, time.process_time() - began)


def smooth(travel: np.ndarray, values: np.ndarray, length: float) -> np.ndarray:
    """Values (k,) averaged over a stretch of travel (m) around each: a tool feels the planes of nodes it passes."""
    return np.array([values[np.abs(travel - s) <= length / 2].mean() for s in travel])


class Line(NamedTuple):
    """A straight line through points."""

    slope: float
    start: float
    r2: float  # share of the variance that it explains


def line(x: np.ndarray, y: np.ndarray) -> Line:
    """The line of least squares."""
    slope, start = np.polyfit(x, y, 1)
    rest = y - slope * x - start
    return Line(float(slope), float(start), float(1 - rest.var() / y.var()))


def exponent(x: np.ndarray, y: np.ndarray) -> float:
    """The power n of y ~ x^n that fits best."""
    return line(np.log(x), np.log(y)).slope
