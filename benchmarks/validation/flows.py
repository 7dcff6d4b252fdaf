"""Grains in a box with walls and no bodies: built from few words, walked by one program, and what their surface is."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.coupling import beds
from benchmarks.coupling.beds import RHO, G
from mpm_env import Fidelity, Scene, SceneConfig, State, build, initial
from mpm_env.config import parse
from mpm_env.sim import rigid_step

STICK = {"z_lower": {"kind": "stick"}}
SOFT = 0.015  # rho g H / E: the weight of a bed strains it by a per cent, and a column runs as if it were rigid


def sand(friction_deg: float, high: float, **changes: Any) -> dict[str, Any]:
    """Dry sand with its angle from plane strain; `high` (m) is the bed that SOFT is for."""
    return beds.sand(friction_deg, RHO * G * high / SOFT) | changes


def block(lower: Sequence[float], upper: Sequence[float]) -> dict[str, Any]:
    """A box of grains between corners (x, z) m of a slice, or (x, y, z)."""
    return {"shape": "box", "lower": _space(lower), "upper": _space(upper, 1.0)}


def flow(
    material: dict[str, Any],
    size: Sequence[float],
    cell: float,
    fills: Sequence[dict[str, Any]],
    walls: dict[str, Any],
    *,
    gravity: Sequence[float] = (0.0, -G),
    pic: bool = False,
    **fidelity: Any,
) -> Scene:
    """A box of this size (x, z) m, a slice 1 m thick, or (x, y, z); sides not named slip.

    pic: transfers that forget the affine velocity, which dissipate: the negative control.
    """
    scene = {
        "name": "flow",
        "plane_strain": len(size) == 2,
        "box": {"lower": (0, 0, 0), "upper": _space(size, 1.0)},
        "feature": 4 * cell,
        "gravity": _space(gravity),
        "duration": 1.0,
        "walls": walls,
        "grains": [{"material": material, "fill": list(fills)}],
    }
    config, how = parse(SceneConfig, scene, "flow"), {"cells": 4, **fidelity}
    built = build(config, Fidelity(**how))
    return build(config, Fidelity(**(how | {"rigid_dt": built.mpm_dt}))) if pic else built


def _space(point: Sequence[float], y: float = 0.0) -> list[float]:
    """A point of a slice in space."""
    return [point[0], y, point[1]] if len(point) == 2 else list(point)


def whole_cells(length: float, cell: float) -> float:
    """At least this length, m, in whole cells."""
    return float(np.ceil(length / cell - 1e-9) * cell)


@partial(jax.jit, static_argnums=0)
def _walk(scene: Scene, state: State, steps: Array, weight: Array, affine: Array) -> State:
    gravity = jnp.asarray(scene.gravity, scene.dtype)

    def one(k: Array, state: State) -> State:
        share = weight[0] + (weight[1] - weight[0]) * k / steps
        heavy = replace(scene, gravity=share * gravity)
        state = rigid_step(heavy, state, None)  # no bodies, nothing to drive
        return replace(state, grains=replace(state.grains, C=state.grains.C * affine))

    return jax.lax.fori_loop(0, steps, one, state)


def go(
    scene: Scene, state: State, seconds: float, *, weight: tuple[float, float] = (1.0, 1.0), pic: bool = False
) -> State:
    """The state so many seconds later, gravity going evenly from one share of the scene's to another.

    `pic` asks for a scene that was built for it.
    """
    steps = jnp.int32(round(seconds / scene.rigid_dt))
    shares, affine = (jnp.asarray(a, scene.dtype) for a in (weight, 1.0 - pic))
    return jax.block_until_ready(_walk(scene, state, steps, shares, affine))


def start(scene: Scene, seed: int = 0) -> State:
    """Grains as seeded; what walks them is compiled."""
    return go(scene, jax.jit(partial(initial, scene))(jax.random.key(seed)), 0.0)


class Clock:
    """CPU seconds of this process since it was made."""

    def __init__(self) -> None:
        self.begin = time.process_time()

    @property
    def cpu_s(self) -> float:
        """So far."""
        return time.process_time() - self.begin


def places(scene: Scene, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Where the grains in the box are, (d, n) m from its lower corner, and their masses (n,) kg."""
    m = np.asarray(state.grains.m, np.float64)
    here = m > 0
    corner = np.asarray(scene.grid.origin) - np.asarray(scene.grid.lower)
    return np.asarray(state.grains.x, np.float64)[:, here] + corner[:, None], m[here]


def mass(state: State) -> float:
    """Of the grains in the box, kg."""
    return float(np.asarray(state.grains.m, np.float64).sum())


def heights(scene: Scene, state: State, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Middles (k,) m of columns so wide and how high, m, their mass stands at the density it started with."""
    (x, *_), m = places(scene, state)
    edges = np.arange(0, scene.grid.cells[0] * scene.grid.cell_size + width, width)
    rho = float(state.materials[0].rho)
    return (edges[1:] + edges[:-1]) / 2, np.histogram(x, edges, weights=m)[0] / (rho * width)


def front(x: np.ndarray, h: np.ndarray, least: float) -> float:
    """Where a heap that begins at x = 0 first is lower than `least`, between the middles x (k,) of its columns, m.

    Infinite where it is so nowhere: the box was too short.
    """
    low = np.flatnonzero(h < least)
    if not len(low) or low[0] == 0:
        return float(x[0]) if len(low) else np.inf
    k = low[0]
    return float(np.interp(least, [h[k], h[k - 1]], [x[k], x[k - 1]]))
