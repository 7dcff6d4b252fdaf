"""Mud, paste, foam: flows above a stress, the faster the more."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from mpm_env.mpm.linalg3 import TINY
from mpm_env.mpm.materials.protocol import hencky_answer, hencky_energy, hencky_strain, lame, p_wave_speed

ITERATIONS = 12  # of Newton for flow indices other than 1; from its start 4 to 8 reach round-off for n from 0.1 to 10
MOST_DRAG = 1e18  # of the drag over the overstress, and of its inverse: beyond, all or nothing relaxes to f64's digits


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["E", "nu", "rho", "yield_stress", "consistency", "flow_index"],
    meta_fields=[],
)
@dataclass(frozen=True)
class HerschelBulkley:
    """Viscoplastic solid: in shear, stress = yield_stress + consistency (shear rate)^flow_index once it flows.

    Flow rule and backward Euler in time of Y15 sections 4 and 5 (theirs scales b, ours the deviator of the Hencky
    strain, so that flow keeps the volume exactly); Bingham for flow_index 1, Newtonian (Maxwell, with the relaxation
    time consistency / mu) if there is no yield_stress. Viscoplastic, perfectly plastic in the limit of slow flow,
    associated, nothing remembered. Unconditionally stable in the viscous part: the time step is the elastic one.

    E Pa, nu, rho kg/m^3, yield_stress Pa and consistency Pa s^flow_index, both in shear: of the equivalent shear stress
    |s| / sqrt(2) and the shear rate sqrt(2) |D|, which in simple shear are the stress and the rate themselves.
    """

    E: Array
    nu: Array
    rho: Array
    yield_stress: Array
    consistency: Array
    flow_index: Array
    history_start: ClassVar[tuple[float, ...]] = ()

    def update(self, e: Array, history: Array, dt: float | Array) -> tuple[Array, Array, Array]:
        """Relax the stress above the yield stress for dt."""
        lam, mu = lame(self.E, self.nu)
        eps, axes = hencky_strain(e)
        mean = jnp.mean(eps, axis=0)
        deviator = eps - mean
        stress = math.sqrt(2) * mu * jnp.sqrt(jnp.sum(deviator * deviator, axis=0) + TINY)
        over = jnp.maximum(stress - self.yield_stress, 0)
        e, tau = hencky_answer(mean + deviator * (1 - over * self._relaxed(over, dt) / stress), axes, lam, mu)
        return e, history, tau

    def _relaxed(self, over: Array, dt: float | Array) -> Array:
        """Share u (n,) of the trial's overstress Pa that relaxes in dt s.

        Backward Euler, stress = trial - mu dt rate and stress = yield_stress + consistency rate^n, is u + c u^n = 1
        with c = consistency (over / (mu dt))^n / over. For n < 1 it is solved for u^n, for n > 1 for u: convex either
        way, a z^p + b z = 1 with p > 1, and Newton from the right never leaves the right.
        """
        _, mu = lame(self.E, self.nu)
        n = self.flow_index
        start = jnp.maximum(over, TINY)
        log_c = jnp.log(self.consistency + TINY) + n * (jnp.log(start) - jnp.log(mu * dt + TINY)) - jnp.log(start)
        c = jnp.exp(jnp.clip(log_c, -math.log(MOST_DRAG), math.log(MOST_DRAG)))
        thins = n < 1
        p = jnp.where(thins, 1 / n, n)
        a, b = jnp.where(thins, 1, c), jnp.where(thins, c, 1)

        def newton(_: int, z: Array) -> Array:
            power = z ** (p - 1)
            return z - (a * power * z + b * z - 1) / (a * p * power + b)

        z = lax.fori_loop(0, ITERATIONS, newton, jnp.minimum(1 / b, a ** (-1 / p)))
        return jnp.where(thins, z**p, z)

    def energy(self, e: Array, history: Array) -> Array:
        """Elastic energy density, (n,) J/m^3."""
        return hencky_energy(e, *lame(self.E, self.nu))

    def wave_speed(self) -> Array:
        """Compression wave speed, m/s."""
        return p_wave_speed(self.E, self.nu, self.rho)
