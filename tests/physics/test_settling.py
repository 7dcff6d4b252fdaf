"""Beds that start at rest: what grains bear, how still they are, and what is left alone."""

from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from benchmarks.validation.blocks import GRAVITY, alive, block, box, example, go, lattice, longest_step
from mpm_env import build, initial
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.mpm.linalg3 import volume_ratio
from mpm_env.mpm.materials import MATERIALS, Material, MuI, Sand
from mpm_env.mpm.materials.protocol import lame
from mpm_env.mpm.settling import Settling, at_rest, settling_of
from mpm_env.mpm.substep import Bed
from mpm_env.mpm.types import MARGIN, Grid, Particles, Wall
from mpm_env.scene_config import SceneConfig, resolve
from mpm_env.sim import advance, scripted

HEIGHT = 0.2  # m
ACROSS = {2: 6, 3: 4}  # cells of the bed along each level axis
JITTER = 0.25  # of the spacing, as scenes have it
STILL = 1e-3  # of sqrt(g H); 2e-4 of mu_i, 5e-5 of the others observed
CARRIED = 0.02  # of rho g H; 0.007 observed
LATERAL = 0.03  # of K0; 0.007 observed
SAME = 2e-6  # f32
PROBES = 4  # looks at the bed while sqrt(H / g) goes by


def down(d: int) -> tuple[float, ...]:
    return (0.0,) * (d - 1) + (-GRAVITY,)


def bed(name: str, cells: int, d: int, **changes: float | str) -> tuple[Grid, Material, Particles]:
    """A bed of unstrained grains, so many cells high, between slippery walls on a rough floor."""
    dx, across = HEIGHT / cells, ACROSS[d]
    grid = box((across,) * (d - 1) + (cells + 2,), dx, lower=Wall("separate", 0.5), other=Wall("slip"))
    sites = lattice((0.0,) * d, (2 * across,) * (d - 1) + (2 * cells,), dx / 2)
    jitter = np.random.default_rng(0).uniform(-JITTER, JITTER, sites.shape) * dx / 2
    material = example(name, **changes)
    return grid, material, block(grid, material, sites + jitter, volume=(dx / 2) ** d)


def rested(grid: Grid, material: Material, p: Particles, gravity: tuple[float, ...] | None = None) -> Particles:
    d = grid.dimension
    gravity = gravity or down(d)
    settling = settling_of((material,), np.full(d, HEIGHT), np.asarray(gravity), grid.cell_size)
    return settle(grid, settling, material, p, jnp.asarray(gravity, p.x.dtype))


@partial(jax.jit, static_argnums=(0, 1))
def settle(grid: Grid, settling: Settling, material: Material, p: Particles, gravity: Array) -> Particles:
    return at_rest(grid, (Bed(material, 0, p.count),), p, gravity, settling)


def speeds(grid: Grid, material: Material, p: Particles, gravity: tuple[float, ...] | None = None) -> list[float]:
    """Root mean square speeds over sqrt(g H) while sqrt(H / g) goes by."""
    dt, found = longest_step(grid, material), []
    steps = int(np.ceil(np.sqrt(HEIGHT / GRAVITY) / dt / PROBES))
    for _ in range(PROBES):
        p = go(grid, material, p, dt=dt, steps=steps, gravity=gravity or down(grid.dimension))
        v2 = np.sum(np.asarray(p.v, float)[:, alive(p)] ** 2, axis=0)
        found.append(float(np.sqrt(v2.mean() / (GRAVITY * HEIGHT))))
    return found


def carried(grid: Grid, material: Material, p: Particles, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Compression over rho g H at levels a cell apart, the outermost left out; and what weighs on those levels.

    Averaged as nodes do, with a hat a cell to both sides, over the volume of the window and not of its grains: where
    jitter left few of them, each bears more.
    """
    d, dx = grid.dimension, grid.cell_size
    z = np.asarray(p.x, float)[-1] - MARGIN * dx
    levels = np.arange(1.5, HEIGHT / dx - 1) * dx
    hats = np.maximum(1 - np.abs(z - levels[:, None]) / dx, 0)
    forces = -np.asarray(p.tau, float)[row] * np.asarray(p.V0) * alive(p)
    window = (ACROSS[d] * dx) ** (d - 1) * dx
    return hats @ forces / window / (float(material.rho) * GRAVITY * HEIGHT), 1 - levels / HEIGHT


def at_rest_pressure(material: Material) -> float:
    """K0 of what is loaded from nothing: elastic, or what friction holds where it gives way before."""
    held = 0.0
    if isinstance(material, Sand):
        held = (1 - np.sin(material.friction)) / (1 + np.sin(material.friction))
    elif isinstance(material, MuI):  # (1 - K) / sqrt(3) = mu_s (1 + 2 K) / 3
        held = (np.sqrt(3) - material.mu_s) / (np.sqrt(3) + 2 * material.mu_s)
    return max(float(material.nu / (1 - material.nu)), float(held))


LOOSE = {"friction": np.deg2rad(15)}  # gives way before it bears its elastic lateral stress
CASES = [
    *((name, cells, 2, {}) for name in MATERIALS for cells in (8, 16, 32)),
    *((name, 6, 3, {}) for name in MATERIALS),
    *(("sand", cells, 3, {}) for cells in (4, 8)),
    *(("sand", 8, d, LOOSE) for d in (2, 3)),
]


@pytest.mark.parametrize(("name", "cells", "d", "changes"), CASES)
def test_bed_bears_its_weight_and_stays_still(name: str, cells: int, d: int, changes: dict[str, float]) -> None:
    grid, material, p = bed(name, cells, d, **changes)
    start = rested(grid, material, p)
    stress, weight = carried(grid, material, start, d - 1)
    np.testing.assert_allclose(stress, weight, rtol=0, atol=CARRIED)
    sideways, _ = carried(grid, material, start, 0)
    np.testing.assert_allclose(sideways.sum() / stress.sum(), at_rest_pressure(material), rtol=LATERAL)
    assert max(speeds(grid, material, start)) < STILL
    np.testing.assert_array_equal(start.x, p.x)
    np.testing.assert_array_equal(start.m, p.m)
    np.testing.assert_allclose(start.V0 * volume_ratio(start.e), p.V0, rtol=SAME)


def test_unstrained_bed_does_not_stay_still() -> None:
    """The negative control."""
    grid, material, p = bed("sand", 8, 2)
    assert min(speeds(grid, material, p)) > 5 * STILL


@pytest.mark.parametrize("tilt_deg", [20.0, 90.0, 180.0])
def test_gravity_may_point_anywhere_that_something_holds_the_bed(tilt_deg: float) -> None:
    """At 20 degrees the top is a slope that sand of 30 bears; at 90 and 180 rubber hangs on the walls that hold it."""
    name = "sand" if tilt_deg < 30 else "elastic"
    grid, material, p = bed(name, 8, 2)
    if name == "elastic":
        grid = replace(grid, walls=((Wall("stick"), Wall("stick")),) * 2)
    gravity = (GRAVITY * np.sin(np.deg2rad(tilt_deg)), -GRAVITY * np.cos(np.deg2rad(tilt_deg)))
    assert max(speeds(grid, material, rested(grid, material, p, gravity), gravity)) < STILL
    wrong = rested(grid, material, p)  # the negative control: at rest in gravity straight down
    assert max(speeds(grid, material, wrong, gravity)) > 1.5 * STILL


def under(load: float, name: str) -> tuple[Grid, Material, Particles]:
    """A bed so soft that its weight rho g H is this share of its modulus."""
    grid, material, p = bed(name, 8, 2)
    lam, mu = lame(material.E, material.nu)
    E = material.E * material.rho * GRAVITY * HEIGHT / (lam + 2 * mu) / load
    return grid, replace(material, E=E), p  # type: ignore[type-var]


@pytest.mark.parametrize("load", [0.02, 0.1, 0.49])
@pytest.mark.parametrize("name", ["sand", "snow"])
def test_beds_that_are_soft_for_their_weight_rest_as_well(name: str, load: float) -> None:
    """Up to half the modulus, which squeezes sand to two thirds of its volume and packs snow."""
    grid, material, p = under(load, name)
    start = rested(grid, material, p)
    assert max(speeds(grid, material, start)) < STILL
    stress, weight = carried(grid, material, start, 1)
    np.testing.assert_allclose(stress, weight, rtol=0, atol=CARRIED)


def test_bed_too_soft_for_its_weight_is_refused() -> None:
    with pytest.raises(ValueError, match=r"weigh up to 4316 Pa, 0\.51 of the modulus .* start = unstrained"):
        rested(*under(0.51, "sand"))


LAYERS = {
    "name": "layers",
    "plane_strain": True,
    "box": {"lower": [0, 0, 0], "upper": [0.4, 0.1, 0.6]},
    "feature": 0.1,
    "duration": 1.0,
    "walls": {"z_lower": {"kind": "separate", "friction": 0.5}},
    "grains": [
        {"material": "snow_packed", "fill": [{"shape": "box", "lower": [0, 0, 0], "upper": [0.4, 0.1, 0.1]}]},
        {
            "material": "dry_sand",
            "fill": [
                {"shape": "box", "lower": [0, 0, 0.1], "upper": [0.4, 0.1, 0.2]},
                {"shape": "sphere", "centre": [0.2, 0.05, 0.5], "radius": 0.05, "velocity": [0, 0, 0.5]},
            ],
        },
    ],
}


def started(start: str, **changes: object) -> tuple[Any, Any]:
    """The scene of layers and its start."""
    data = {**deepcopy(LAYERS), "start": start, **changes}
    resolve(data, Path())
    scene = build(parse(SceneConfig, data, "layers"), Fidelity(cells=4, stiffness=0.25))
    return scene, jax.jit(partial(initial, scene))(jax.random.key(0))


def test_sand_on_snow_rests_and_what_is_thrown_flies_on() -> None:
    scene, state = started("geostatic")
    _, plain = started("unstrained")
    p, thrown = state.grains, np.asarray(plain.grains.v)[1] > 0
    assert thrown.any() and not np.asarray(p.e)[:, thrown].any()
    for field in ("x", "v", "m"):
        np.testing.assert_array_equal(getattr(p, field), getattr(plain.grains, field))
    np.testing.assert_array_equal(np.asarray(p.V0)[thrown], np.asarray(plain.grains.V0)[thrown])
    go_on = jax.jit(partial(advance, scene))
    residual = []
    for s in (state, plain):
        s, _ = go_on(s, scripted(scene, 0, 10))
        bed = ~thrown & (np.asarray(s.grains.m) > 0)
        residual.append(np.sqrt(np.mean(np.sum(np.asarray(s.grains.v)[:, bed] ** 2, axis=0)) / (GRAVITY * HEIGHT)))
    assert residual[0] < STILL < 5 * STILL < residual[1]


def test_without_gravity_there_is_nothing_to_bear() -> None:
    scene, state = started("geostatic", gravity=[0.0, 0.0, 0.0])
    assert scene.settling is None
    assert not np.asarray(state.grains.tau).any()
