"""The friction of sand from how far a column of it runs out, by short simulations in plane strain."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mpm_env.config import parse
from mpm_env.fidelity import load_fidelity
from mpm_env.scene import build, initial
from mpm_env.scene_config import MaterialConfig, SceneConfig
from mpm_env.sim import advance, scripted

ACROSS = (16, 24)  # cells over the height: to search with, and to see what the resolution changes
LEAST, MOST = 12.0, 50.0  # degrees searched
CLOSE = 0.2  # degrees; seeds scatter more
SEEDS = 4  # columns of other grains at the angle found
REACH = 6.0  # heights that the box leaves beyond the column: more than sand of LEAST runs
LASTS = 4.0  # in sqrt(height / gravity); a column stands still after 3.3 (Lube et al., Phys. Rev. E 72, 2005)
FRONT = 0.99  # share of the grains behind what counts as the front: a few roll on alone
DIFFERENCE = 2.0  # degrees, for the slope of the runout over the angle


class Column(NamedTuple):
    """A column that stood against a wall on a rough floor, and how far from the wall it came to lie."""

    width: float  # m
    height: float  # m
    runout: float  # m from the wall to the front


class Found(NamedTuple):
    """The angle, and what moves it."""

    friction_deg: float
    scatter_deg: float  # standard deviation over seeds
    resolution_deg: float  # by how much finer cells would change it
    runs: int


def fit_column(config: MaterialConfig, column: Column) -> Found:
    """The friction angle with which a column runs as far as measured, on the material's own friction fit.

    Raises ValueError for a material without a friction angle, senseless lengths, or a runout that no angle gives.
    """
    from scipy.optimize import brentq

    if config.model != "sand":
        raise ValueError(f"The runout of a column tells the friction_deg of sand, and {config.model} has none.")
    if not all(math.isfinite(a) and a > 0 for a in column) or column.runout <= column.width:
        raise ValueError(
            f"A column needs positive lengths and a runout beyond its width, got {column.width} m wide,"
            f" {column.height} m high, runout {column.runout} m."
        )
    done: dict[tuple[float, int, int], float] = {}
    runs = {n: Runs(config, column, n) for n in ACROSS}

    def off(angle: float, seed: int = 0, n: int = ACROSS[0]) -> float:
        if (angle, seed, n) not in done:
            done[angle, seed, n] = runs[n].front(angle, seed) - column.runout
        return done[angle, seed, n]

    farthest, nearest = off(LEAST), off(MOST)
    if farthest * nearest > 0:
        raise ValueError(
            f"No friction from {LEAST:g} to {MOST:g} degrees lets this column run to {column.runout:g} m: it comes to"
            f" {column.runout + farthest:.3g} m at the least and {column.runout + nearest:.3g} m at the most of them."
        )
    angle = float(brentq(off, LEAST, MOST, xtol=CLOSE))
    slope = (off(angle + DIFFERENCE) - off(angle - DIFFERENCE)) / (2 * DIFFERENCE)  # m per degree, negative
    seeds = [off(angle, seed) for seed in range(1, SEEDS + 1)]
    finer = off(angle, 0, ACROSS[1]) - off(angle)
    return Found(angle, float(np.std(seeds, ddof=1)) / abs(slope), -finer / slope, len(done))


class Runs:
    """Columns of one resolution: one program, whatever the angle and the seed."""

    def __init__(self, config: MaterialConfig, column: Column, across: int) -> None:
        cell = column.height / across
        long = math.ceil((column.width + REACH * column.height) / cell) * cell
        fidelity = load_fidelity("draft", ["cells=4"])
        lasts = LASTS * math.sqrt(column.height / 9.81)
        self.steps = math.ceil(lasts / fidelity.rigid_dt)
        block = {"shape": "box", "lower": [0, 0, 0], "upper": [column.width, cell, column.height]}
        scene = {
            "name": "column",
            "plane_strain": True,
            "box": {"lower": [0, 0, 0], "upper": [long, cell, (across + 2) * cell]},
            "feature": 4 * cell,
            "duration": self.steps * fidelity.rigid_dt,
            "walls": {"z_lower": {"kind": "stick"}},
            "grains": [{"material": config.model_dump(), "fill": [block]}],
        }
        self.scene = build(parse(SceneConfig, scene, "column"), fidelity)
        drives = scripted(self.scene, 0, self.steps)
        self.run = jax.jit(lambda state: advance(self.scene, state, drives)[0])

    def front(self, angle: float, seed: int) -> float:
        """How far from the wall, m, the front of a column of this friction angle (degrees) comes to lie."""
        state = initial(self.scene, jax.random.key(seed))
        (material,) = state.materials
        friction = jnp.asarray(math.radians(angle), self.scene.dtype)
        slippery = replace(material, friction=friction)  # type: ignore[type-var]
        state = self.run(replace(state, materials=(slippery,)))
        here = np.asarray(state.grains.m) > 0
        x = np.asarray(state.grains.x[0])[here] + self.scene.grid.origin[0]
        return float(np.quantile(x, FRONT))
