"""Level beds of dry sand and the states they start from: at rest under their own weight, denser, with room for tools.

Sand that is denser and stiffer by one factor is the same sand under bodies that are lighter by that factor: so one
compiled scene serves all density ratios, see `lighter`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mpm_env import Scene, State, initial
from mpm_env.mpm.materials.protocol import lame

G = 9.81  # m/s^2
RHO = 1500.0  # kg/m^3, of the sand as poured


def sand(friction_deg: float, E: float, fit: str = "plane_strain") -> dict[str, Any]:
    """Dry sand with its angle from this test; E (Pa) is as stiff as the time at hand allows."""
    return {"model": "sand", "E": E, "nu": 0.3, "rho": RHO, "friction_deg": friction_deg, "friction_fit": fit}


SAND = sand(35.0, 1e6, "triaxial")


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


def lighter(state: State, ratio: float) -> State:
    """The state with sand over `ratio` times as dense and stiff: bodies of sand's density are as light as that."""
    return with_sand(state, denser=1 / ratio)


def without(state: State, gone: jax.Array) -> State:
    """The state without the grains (n,) that are in the way."""
    return replace(state, grains=replace(state.grains, m=jnp.where(gone, 0, state.grains.m)))
