"""Grains as a scene describes them: materials with numbers, and shapes as lattices that fit the box."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from mpm_env.fidelity import Fidelity
from mpm_env.mpm.materials import MATERIALS, Material
from mpm_env.mpm.materials.sand import IN_PLANE
from mpm_env.mpm.seeding import Fill, Relief, fill_ball, fill_box, fill_cylinder
from mpm_env.mpm.types import Grid
from mpm_env.scene_config import BoxFill, CylinderFill, MaterialConfig, SceneConfig, SphereFill

WHOLE = 1e-6  # how far from a whole number a ratio of two lengths or times may be, for rounding in the inputs


def whole(ratio: float) -> int | None:
    """The whole number from 1 up that a ratio is, rounding in the inputs aside; None where it is none."""
    n = round(ratio)
    return n if n >= 1 and abs(ratio - n) < WHOLE * n else None


def axes_of(d: int) -> list[int]:
    """The world axes that a grid of d dimensions has: x and z in plane strain."""
    return [0, 2] if d == 2 else [0, 1, 2]


def material_of(config: MaterialConfig, dtype: Any, *, dimension: int, stiffness: float = 1.0) -> Material:
    """A material of the solver, softened by a factor. Raises ValueError where 3-D does not know its friction fit."""
    values = config.model_dump(exclude={"model", "about"})
    if config.model in ("sand", "mu_i"):  # strength is friction; snow yields at critical strains, so E is its strength
        values["E"] *= stiffness
    if dimension == 3 and values.get("friction_fit") == IN_PLANE:
        raise ValueError(
            f"friction_fit = {IN_PLANE!r} knows plane strain only: use 'plane_strain' in 3-D, or plane_strain: true."
        )
    if "friction_deg" in values:
        values["friction"] = math.radians(values.pop("friction_deg"))
    leaves = {k: v if isinstance(v, str | bool) else jnp.asarray(v, dtype) for k, v in values.items()}
    material: Material = MATERIALS[config.model](**leaves)
    return material


def fill_of(fill: BoxFill | SphereFill | CylinderFill, config: SceneConfig, grid: Grid, fidelity: Fidelity) -> Fill:
    """A filled shape. Raises ValueError where it leaves the box or holds no grain."""
    axes = axes_of(grid.dimension)
    target = grid.cell_size / fidelity.particles_per_axis
    thickness = config.box.upper[1] - config.box.lower[1] if grid.dimension == 2 else 1.0
    velocity = tuple(fill.velocity[a] for a in axes)
    if isinstance(fill, BoxFill):
        low, high = np.asarray(fill.lower), np.asarray(fill.upper)
        if not (low < high).all():
            raise ValueError(f"A box of grains needs lower < upper on every axis, got {fill.lower} and {fill.upper}.")
        if grid.dimension == 2:  # a bed narrower than the box has as much less mass in the slice
            thickness = fill.upper[1] - fill.lower[1]
        relief = Relief(fill.relief.height, fill.relief.wavelength) if fill.relief else None
        made = fill_box(low[axes], high[axes], relief=relief, target=target, thickness=thickness, velocity=velocity)
        reach = (low, high + np.asarray([0, 0, 3 * relief.height if relief else 0]))
    elif isinstance(fill, SphereFill):
        centre = np.asarray(fill.centre)
        made = fill_ball(centre[axes], fill.radius, target=target, thickness=thickness, velocity=velocity)
        reach = (centre - fill.radius, centre + fill.radius)
    else:
        base, side = np.asarray(fill.base), np.asarray([fill.radius, fill.radius, 0])
        made = fill_cylinder(
            base[axes], fill.radius, fill.height, target=target, thickness=thickness, velocity=velocity
        )
        reach = (base - side, base + side + np.asarray([0, 0, fill.height]))
    _refuse_outside(fill.shape, *reach, config, axes)
    if not len(made.sites):
        raise ValueError(
            f"A {fill.shape} of grains is smaller than the distance {target:.3g} m of two grains and would stay empty:"
            " enlarge it or raise the fidelity's cells."
        )
    return made


def _refuse_outside(shape: str, low: np.ndarray, high: np.ndarray, config: SceneConfig, axes: list[int]) -> None:
    for a in axes:
        lower, upper = config.box.lower[a], config.box.upper[a]
        if low[a] < lower - WHOLE or high[a] > upper + WHOLE:
            raise ValueError(
                f"A {shape} of grains reaches from {low[a]:.6g} to {high[a]:.6g} m along {'xyz'[a]}, outside the"
                f" simulated box from {lower:.6g} to {upper:.6g} m: move it or enlarge the box."
            )
