"""Elastic solid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from mpm_env.mpm.linalg3 import compose
from mpm_env.mpm.materials.protocol import hencky_energy, hencky_strain, lame, p_wave_speed


@partial(jax.tree_util.register_dataclass, data_fields=["E", "nu", "rho"], meta_fields=[])
@dataclass(frozen=True)
class Elastic:
    """Isotropic elastic solid with Hencky strain: tau = 2 mu eps + lam tr(eps) I (K16 eq. 14).

    Rate independent, no plastic flow, nothing remembered. E Pa, nu, rho kg/m^3.
    """

    E: Array
    nu: Array
    rho: Array
    history_start: ClassVar[tuple[float, ...]] = ()

    def update(self, e: Array, history: Array, dt: float | Array) -> tuple[Array, Array, Array]:
        """Stress of the strain e; the strain itself is kept."""
        eps, axes = hencky_strain(e)
        lam, mu = lame(self.E, self.nu)
        return e, history, compose(axes, 2 * mu * eps + lam * jnp.sum(eps, axis=0))

    def energy(self, e: Array, history: Array) -> Array:
        """Elastic energy density, (n,) J/m^3."""
        return hencky_energy(e, *lame(self.E, self.nu))

    def wave_speed(self) -> Array:
        """Compression wave speed at rest, m/s."""
        return p_wave_speed(self.E, self.nu, self.rho)
