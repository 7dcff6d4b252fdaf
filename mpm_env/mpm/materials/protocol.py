"""What every constitutive model offers, and the elastic constants they share."""

from __future__ import annotations

from typing import ClassVar, Protocol

import jax.numpy as jnp
from jax import Array

LEAST_B = 1e-6  # smallest eigenvalue of b that a logarithm sees: stretch 1e-3, where f32 has lost the digits anyway


class Material(Protocol):
    """A constitutive model: parameters as fields, one verb, and what it costs in time step.

    `update` takes the trial elastic strain and returns the strain after the return mapping with the stress that
    belongs to it, for grains side by side; it is pure and differentiable.
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

    def update(self, e: Array, history: Array) -> tuple[Array, Array, Array]:
        """Return mapping and stress: trial e (s, n), history (k, n) -> e, history, tau (s, n) Pa."""

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


def hencky_energy(eps: Array, lam: Array, mu: Array) -> Array:
    """Energy density (n,) J/m^3 of principal Hencky strains eps (3, n) (K16 eq. 14)."""
    return mu * jnp.sum(eps * eps, axis=0) + 0.5 * lam * jnp.sum(eps, axis=0) ** 2
