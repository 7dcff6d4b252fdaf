"""What every constitutive model offers, and the elastic constants they share."""

from __future__ import annotations

from typing import ClassVar, Protocol

import jax.numpy as jnp
from jax import Array

from mpm_env.mpm.linalg3 import compose, eigen

LEAST_B = 1e-6  # smallest eigenvalue of b that a logarithm sees: stretch 1e-3, where f32 has lost the digits anyway


class Material(Protocol):
    """A constitutive model: parameters as fields, one verb, and what it costs in time step.

    `update` takes the trial elastic strain and returns the strain after the return mapping with the stress that
    belongs to it, for grains side by side; it is pure and differentiable. Only materials whose stress depends on the
    rate look at dt.
    """

    history_start: ClassVar[tuple[float, ...]]  # what a virgin grain remembers, one number per row of history

    @property
    def rho(self) -> Array:
        """Density at rest, kg/m^3."""

    @property
    def E(self) -> Array:
        """Young's modulus, Pa."""

    @property
    def nu(self) -> Array:
        """Poisson ratio."""

    def update(self, e: Array, history: Array, dt: float | Array) -> tuple[Array, Array, Array]:
        """Return mapping and stress: trial e (s, n), history (k, n), over dt s -> e, history, tau (s, n) Pa."""

    def energy(self, e: Array, history: Array) -> Array:
        """Elastic energy per rest volume, (n,) J/m^3."""

    def wave_speed(self) -> Array:
        """Fastest elastic wave this material can reach, hardening included, m/s."""


def lame(E: Array, nu: Array) -> tuple[Array, Array]:
    """Lame parameters (lam, mu) in Pa of Young's modulus and Poisson ratio."""
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def p_wave_speed(E: Array, nu: Array, rho: Array) -> Array:
    """Speed of compression waves, m/s: sqrt((lam + 2 mu) / rho)."""
    lam, mu = lame(E, nu)
    return jnp.sqrt((lam + 2 * mu) / rho)


def hencky_strain(e: Array) -> tuple[Array, Array]:
    """Principal Hencky strains (3, n), logarithms of the principal stretches, and principal axes of e (s, n)."""
    values, axes = eigen(e)
    return 0.5 * jnp.log1p(jnp.maximum(values, LEAST_B - 1)), axes


def hencky_answer(eps: Array, axes: Array, lam: Array, mu: Array) -> tuple[Array, Array]:
    """Strain e (s, n) of principal Hencky strains (3, n), and its stress tau = 2 mu eps + lam tr(eps) I (s, n) Pa."""
    return compose(axes, jnp.expm1(2 * eps)), compose(axes, 2 * mu * eps + lam * jnp.sum(eps, axis=0))


def hencky_energy(e: Array, lam: Array, mu: Array) -> Array:
    """Energy density (n,) J/m^3 of strains e (s, n): mu eps:eps + lam tr(eps)^2 / 2 (K16 eq. 14)."""
    eps, _ = hencky_strain(e)
    return mu * jnp.sum(eps * eps, axis=0) + 0.5 * lam * jnp.sum(eps, axis=0) ** 2
