"""Metal-like solid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from mpm_env.mpm.linalg3 import TINY
from mpm_env.mpm.materials.protocol import hencky_answer, hencky_energy, hencky_strain, lame, p_wave_speed

ROOT = math.sqrt(2 / 3)  # |s| = ROOT q: the norm of a deviator over its uniaxial stress


@partial(jax.tree_util.register_dataclass, data_fields=["E", "nu", "rho", "yield_stress", "hardening"], meta_fields=[])
@dataclass(frozen=True)
class VonMises:
    """J2 plasticity with linear isotropic hardening on Hencky elasticity.

    Radial return (Simo & Hughes, Computational Inelasticity, 1998, box 3.1), exact in logarithmic strains (Simo, CMAME
    99, 1992, section 3). Rate independent, hardening, associated, which for a cylinder means that flow keeps the
    volume. Remembers the equivalent plastic strain.

    E Pa, nu, rho kg/m^3, yield_stress Pa (uniaxial, of the Kirchhoff stress), hardening Pa: slope of the yield stress
    over the equivalent plastic strain.
    """

    E: Array
    nu: Array
    rho: Array
    yield_stress: Array
    hardening: Array
    history_start: ClassVar[tuple[float, ...]] = (0.0,)

    def update(self, e: Array, history: Array, dt: float | Array) -> tuple[Array, Array, Array]:
        """Shrink the deviator to the yield surface, which the flow moves outwards."""
        lam, mu = lame(self.E, self.nu)
        eps, axes = hencky_strain(e)
        mean = jnp.mean(eps, axis=0)
        deviator = eps - mean
        norm = jnp.sqrt(jnp.sum(deviator * deviator, axis=0) + TINY)
        over = jnp.maximum(2 * mu * norm - ROOT * (self.yield_stress + self.hardening * history[0]), 0)
        flow = over / (2 * mu + 2 / 3 * self.hardening)  # norm of the plastic strain of this step
        e, tau = hencky_answer(mean + deviator * (1 - flow / norm), axes, lam, mu)
        return e, (history[0] + ROOT * flow)[None], tau

    def energy(self, e: Array, history: Array) -> Array:
        """Elastic energy density, (n,) J/m^3."""
        return hencky_energy(e, *lame(self.E, self.nu))

    def wave_speed(self) -> Array:
        """Compression wave speed, m/s."""
        return p_wave_speed(self.E, self.nu, self.rho)
