"""The friction of sand from what a slice of it does on a rough floor: short simulations, the same program for all."""

from __future__ import annotations

import math
from collections.abc import Callable
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
CLOSE = 0.2  # degrees; seeds scatter more
SEEDS = 4  # runs of other grains at the angle found
DIFFERENCE = 2.0  # degrees, for the slope of what is measured over the angle


class Found(NamedTuple):
    """The angle, and what moves it."""

    friction_deg: float
    scatter_deg: float  # standard deviation over seeds
    resolution_deg: float  # by how much finer cells would change it
    runs: int


class Slice:
    """A bed of sand in plane strain that begins at x = 0, so many cells high: one program, whatever angle and seed.

    wide, high m of the bed; long m of the box, rounded up to whole cells; lasts sqrt(high / gravity). The floor sticks,
    and the end of the box may be open.
    """

    def __init__(
        self,
        config: MaterialConfig,
        across: int,
        *,
        wide: float,
        high: float,
        long: float,
        lasts: float,
        opens: bool = False,
    ) -> None:
        cell = self.cell = high / across
        fidelity = load_fidelity("draft", ["cells=4"])
        self.steps = math.ceil(lasts * math.sqrt(high / 9.81) / fidelity.rigid_dt)
        walls = {"z_lower": {"kind": "stick"}} | ({"x_upper": {"kind": "open"}} if opens else {})
        scene = {
            "name": "slice",
            "plane_strain": True,
            "box": {"lower": [0, 0, 0], "upper": [math.ceil(long / cell - 1e-9) * cell, cell, (across + 2) * cell]},
            "feature": 4 * cell,
            "duration": self.steps * fidelity.rigid_dt,
            "walls": walls,
            "grains": [
                {
                    "material": config.model_dump(),
                    "fill": [{"shape": "box", "lower": [0, 0, 0], "upper": [wide, cell, high]}],
                }
            ],
        }
        self.scene = build(parse(SceneConfig, scene, "slice"), fidelity)
        drives = scripted(self.scene, 0, self.steps)
        self.run = jax.jit(lambda state: advance(self.scene, state, drives)[0])

    def rests(self, angle: float, seed: int) -> np.ndarray:
        """Where the grains of this friction angle (degrees) that are left come to rest, (2, n) m."""
        state = initial(self.scene, jax.random.key(seed))
        (material,) = state.materials
        friction = jnp.asarray(math.radians(angle), self.scene.dtype)
        slippery = replace(material, friction=friction)  # type: ignore[type-var]
        state = self.run(replace(state, materials=(slippery,)))
        here = np.asarray(state.grains.m) > 0
        return np.asarray(state.grains.x, np.float64)[:, here] + self.scene.grid.origin[:, None]


def refuse_without_friction(config: MaterialConfig, what: str) -> None:
    """Raise ValueError for a material without a friction angle."""
    if config.model != "sand":
        raise ValueError(f"{what} tells the friction_deg of sand, and {config.model} has none.")


def find(
    measure: Callable[[float, int, int], float],
    target: float,
    between: tuple[float, float],
    refusal: Callable[[float, float], str],
) -> Found:
    """The friction angle, of those between two, at which measure(angle, seed, across) comes to the target.

    Raises ValueError with refusal(at the lower angle, at the higher one) where no angle between them does.
    """
    from scipy.optimize import brentq

    done: dict[tuple[float, int, int], float] = {}

    def off(angle: float, seed: int = 0, across: int = ACROSS[0]) -> float:
        if (angle, seed, across) not in done:
            done[angle, seed, across] = measure(angle, seed, across) - target
        return done[angle, seed, across]

    ends = [off(angle) for angle in between]
    if ends[0] * ends[1] > 0:
        raise ValueError(refusal(target + ends[0], target + ends[1]))
    angle = float(brentq(off, *between, xtol=CLOSE))
    slope = (off(angle + DIFFERENCE) - off(angle - DIFFERENCE)) / (2 * DIFFERENCE)  # of what is measured, per degree
    seeds = [off(angle, seed) for seed in range(1, SEEDS + 1)]
    finer = off(angle, 0, ACROSS[1]) - off(angle)
    return Found(angle, float(np.std(seeds, ddof=1)) / abs(slope), -finer / slope, len(done))
