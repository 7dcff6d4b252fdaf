"""Snow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from mpm_env.mpm.linalg3 import compose, eigen
from mpm_env.mpm.materials.protocol import LEAST_B, lame, p_wave_speed

MOST_LN_JP = 3.0  # e^3: twentyfold expansion; hardening is zero long before, this only keeps the exponent finite


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["E", "nu", "rho", "theta_c", "theta_s", "xi", "Jp_min"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Snow:
    """Snow after S13: fixed-corotated elasticity, principal stretches clamped to [1 - theta_c, 1 + theta_s].

    Rate independent, hardening in compression and softening in tension, not associated. Remembers ln J_P, the log of
    the plastic volume ratio; Lame parameters are scaled by h = exp(xi (1 - J_P)) (S13 eq. 2).

    E Pa, nu, rho kg/m^3, theta_c and theta_s critical compression and stretch, xi hardening. Jp_min bounds it (in
    S13 nothing does): h stays at its value for J_P = Jp_min however far the snow is packed, so that one time step is
    right for the whole run.
    """

    E: Array
    nu: Array
    rho: Array
    theta_c: Array
    theta_s: Array
    xi: Array
    Jp_min: Array
    history_start: ClassVar[tuple[float, ...]] = (0.0,)

    def hardening(self, history: Array) -> Array:
        """Factor (n,) on the Lame parameters."""
        Jp = jnp.maximum(jnp.exp(history[0]), self.Jp_min)
        return jnp.exp(self.xi * (1 - Jp))

    def update(self, e: Array, history: Array, dt: float | Array) -> tuple[Array, Array, Array]:
        """Clamp the principal stretches, move the rest into ln J_P, answer with the hardened stress (S13 section 5)."""
        values, axes = eigen(e)
        values = jnp.maximum(values, LEAST_B - 1)
        # Stretch minus one, without losing the digits of small strains: sqrt(1 + B) - 1 = B / (1 + sqrt(1 + B)).
        stretch = values / (1 + jnp.sqrt(1 + values))
        clamped = jnp.clip(stretch, -self.theta_c, self.theta_s)
        flow = jnp.sum(jnp.log1p(stretch) - jnp.log1p(clamped), axis=0)
        history = jnp.minimum(history[0] + flow, MOST_LN_JP)[None]
        e = compose(axes, clamped * (2 + clamped))
        return e, history, compose(axes, self._principal_stress(clamped, history))

    def _principal_stress(self, s1: Array, history: Array) -> Array:
        """Principal Kirchhoff stress (3, n) of stretches minus one: 2 mu (s - 1) s + lam (J - 1) J (S13 eq. 6)."""
        lam, mu = lame(self.E, self.nu)
        Jm1 = jnp.expm1(jnp.sum(jnp.log1p(s1), axis=0))
        return self.hardening(history) * (2 * mu * s1 * (1 + s1) + lam * Jm1 * (1 + Jm1))

    def energy(self, e: Array, history: Array) -> Array:
        """Elastic energy density, (n,) J/m^3 (S13 eq. 1)."""
        lam, mu = lame(self.E, self.nu)
        values = jnp.maximum(eigen(e)[0], LEAST_B - 1)
        s1 = values / (1 + jnp.sqrt(1 + values))
        Jm1 = jnp.expm1(jnp.sum(jnp.log1p(s1), axis=0))
        return self.hardening(history) * (mu * jnp.sum(s1 * s1, axis=0) + 0.5 * lam * Jm1 * Jm1)

    def wave_speed(self) -> Array:
        """Compression wave speed at the hardening bound, m/s."""
        h = jnp.exp(self.xi * (1 - self.Jp_min))
        return p_wave_speed(self.E * h, self.nu, self.rho)
