"""Dry grains whose friction grows with the speed of flow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from mpm_env.mpm.linalg3 import TINY
from mpm_env.mpm.materials.protocol import hencky_answer, hencky_energy, hencky_strain, lame, p_wave_speed
from mpm_env.mpm.materials.sand import VOLUME_CORRECTION_CAP

MOST_DRAG = 1e14  # beyond it a step ends with the friction at rest to f64's digits; its square still is an f32
LEAST_PRESSURE = 1e-9  # of the bulk modulus: grains pressed less than f32 can tell from not at all are loose


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["E", "nu", "rho", "mu_s", "mu_2", "I_0", "grain_size", "grain_density"],
    meta_fields=["volume_correction"],
)
@dataclass(frozen=True)
class MuI:
    """Granular flow with the friction mu(I) = mu_s + (mu_2 - mu_s) / (1 + I_0 / I) (JK eq. 2, in 3-D by JK eq. 3).

    The inertial number is I = rate grain_size sqrt(grain_density / p), with the equivalent shear rate sqrt(2) |D| and
    shear stress |s| / sqrt(2) = mu p. Elasticity (Hencky here), backward Euler in time and its closed solution after
    D15 section 3. Viscoplastic, perfectly plastic with friction mu_s in the limit of slow flow, not associated (flow
    keeps the volume), no cohesion. Remembers the volume gained by separation as Sand does (T17, in the place of D15's
    test of the density). The pressure is that of the Kirchhoff stress.

    E Pa, nu, rho kg/m^3 (of the bed), mu_s and mu_2 > mu_s friction at rest and in fast flow, I_0, grain_size m,
    grain_density kg/m^3 (of a grain). mu_s = sin(phi) of plane strain, since there the stress across lies midway.
    """

    E: Array
    nu: Array
    rho: Array
    mu_s: Array
    mu_2: Array
    I_0: Array
    grain_size: Array
    grain_density: Array
    volume_correction: bool = True
    history_start: ClassVar[tuple[float, ...]] = (0.0,)

    def update(self, e: Array, history: Array, dt: float | Array) -> tuple[Array, Array, Array]:
        """Stress-free where grains separate; else let the shear stress above mu_s p relax for dt."""
        lam, mu = lame(self.E, self.nu)
        bulk = lam + 2 * mu / 3
        eps_trial, axes = hencky_strain(e)
        eps = eps_trial + history[0] / 3 if self.volume_correction else eps_trial
        tr = jnp.sum(eps, axis=0)
        deviator = eps - tr / 3
        ratio = mu * jnp.sqrt(2 * jnp.sum(deviator * deviator, axis=0) + TINY)  # of the trial's shear stress to p
        p = bulk * jnp.maximum(-tr, LEAST_PRESSURE)
        ratio = ratio / p
        keep = jnp.where(ratio > self.mu_s, self._friction(ratio, p, dt) / ratio, 1)
        eps_new = jnp.where(tr >= 0, 0, tr / 3 + keep * deviator)
        if self.volume_correction:
            gained = history[0] + jnp.sum(eps_trial, axis=0) - jnp.sum(eps_new, axis=0)
            history = jnp.clip(gained, -VOLUME_CORRECTION_CAP, VOLUME_CORRECTION_CAP)[None]
        e, tau = hencky_answer(eps_new, axes, lam, mu)
        return e, history, tau

    def _friction(self, ratio: Array, p: Array, dt: float | Array) -> Array:
        """Friction (n,) after dt s, of a trial's ratio of shear stress to the pressure p (n,) Pa.

        With f the friction, backward Euler is (ratio - f) p = mu dt rate, and the law solved for the rate is
        rate = I_0 sqrt(p / grain_density) / grain_size (f - mu_s) / (mu_2 - f): a quadratic whose smaller root lies
        between mu_s and the smaller of mu_2 and the trial (D15 eq. 33, without its cancellation).
        """
        _, mu = lame(self.E, self.nu)
        slow = self.grain_size * jnp.sqrt(self.grain_density * p) / self.I_0
        drag = mu * jnp.minimum(dt / slow, MOST_DRAG / mu)
        half = (self.mu_2 + ratio + drag) / 2
        root = jnp.sqrt(((ratio - self.mu_2 + drag) / 2) ** 2 + drag * (self.mu_2 - self.mu_s) + TINY)
        return (self.mu_2 * ratio + self.mu_s * drag) / (half + root)

    def energy(self, e: Array, history: Array) -> Array:
        """Elastic energy density, (n,) J/m^3."""
        return hencky_energy(e, *lame(self.E, self.nu))

    def wave_speed(self) -> Array:
        """Compression wave speed at rest, m/s."""
        return p_wave_speed(self.E, self.nu, self.rho)
