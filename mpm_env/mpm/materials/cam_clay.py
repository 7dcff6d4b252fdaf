"""Snow or soil that compacts, crumbles and breaks."""

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

ROOT = math.sqrt(3 / 2)  # q = ROOT |s|: the equivalent stress of triaxial compression
MOST_STRENGTH = 10.0  # of the bulk modulus: more no elastic strain ever meets; it only keeps sinh finite
MOST_COMPACTION = 3.0  # of the hardening variable, either way: e^3 in volume, where the strength is at its bound or nil


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["E", "nu", "rho", "M", "beta", "xi", "compaction"],
    meta_fields=[],
)
@dataclass(frozen=True)
class CamClay:
    """Modified Cam-Clay with cohesion, whose flow keeps the volume (G18 methods; "NACC").

    Yield surface (1 + 2 beta) q^2 + M^2 (p + beta p0) (p - p0) = 0: an ellipse from the tension beta p0 to the
    compression p0 = K sinh(xi max(compaction - lnJp, 0)). Beyond its tips the return is along p, elsewhere it scales q
    at the same p. lnJp hardens by the volume of that step: beyond a tip the plastic one, else the one between the trial
    and the point where the line from it to the ellipse's middle enters, so that sand-like shear on the side of large p
    compacts and on the other side loosens, until p lies at the middle: the critical state. Rate independent, hardening
    and softening, not associated. Remembers lnJp, from 0.

    Changed: Hencky elasticity (p = -K tr eps) in the place of G18's, equal to first order in the elastic strain, since
    with it the return keeps the volume exactly; the compaction at the start is a parameter, not a first lnJp. As in
    G18, p0 is that of before the step: strength lags one step behind.

    E Pa, nu, rho kg/m^3, M slope of the critical state (6 sin(phi) / (3 - sin(phi)) in triaxial compression), beta
    cohesion over p0, xi hardening, compaction: -lnJp that the material has behind it at the start.
    """

    E: Array
    nu: Array
    rho: Array
    M: Array
    beta: Array
    xi: Array
    compaction: Array
    history_start: ClassVar[tuple[float, ...]] = (0.0,)

    def strength(self, history: Array) -> Array:
        """Even compression p0 (n,) Pa at which it yields, which cohesion makes bear beta p0 in tension."""
        lam, mu = lame(self.E, self.nu)
        packed = self.xi * jnp.maximum(self.compaction - history[0], 0)
        return (lam + 2 * mu / 3) * jnp.sinh(jnp.minimum(packed, math.asinh(MOST_STRENGTH)))

    def update(self, e: Array, history: Array, dt: float | Array) -> tuple[Array, Array, Array]:
        """To a tip beyond it, else down to the ellipse; then harden or soften (G18 methods)."""
        lam, mu = lame(self.E, self.nu)
        bulk = lam + 2 * mu / 3
        eps, axes = hencky_strain(e)
        tr = jnp.sum(eps, axis=0)
        deviator = eps - tr / 3
        q = 2 * mu * ROOT * jnp.sqrt(jnp.sum(deviator * deviator, axis=0) + TINY)
        p, p0 = -bulk * tr, self.strength(history)
        middle, half = (1 - self.beta) / 2 * p0, (1 + self.beta) / 2 * p0
        p_new = jnp.clip(p, middle - half, middle + half)
        at_tip = p_new != p
        # The ellipse is (1 + 2 beta) q^2 + M^2 (p - middle)^2 = M^2 half^2.
        room = jnp.maximum(half**2 - (p - middle) ** 2, 0)
        most_q = self.M * jnp.sqrt(room / (1 + 2 * self.beta) + TINY)
        yields = ~at_tip & (q > most_q)
        keep = jnp.where(at_tip, 0, jnp.where(yields, most_q / q, 1))
        reach = jnp.sqrt((1 + 2 * self.beta) * q * q + (self.M * (p - middle)) ** 2 + TINY)
        entry = middle + self.M * half / jnp.where(yields, reach, 1) * (p - middle)
        flow = jnp.where(at_tip, p_new - p, jnp.where(yields, entry - p, 0)) / bulk
        lnJp = jnp.clip(history[0] + flow, -MOST_COMPACTION, MOST_COMPACTION)
        e, tau = hencky_answer(-p_new / (3 * bulk) + keep * deviator, axes, lam, mu)
        return e, lnJp[None], tau

    def energy(self, e: Array, history: Array) -> Array:
        """Elastic energy density, (n,) J/m^3."""
        return hencky_energy(e, *lame(self.E, self.nu))

    def wave_speed(self) -> Array:
        """Compression wave speed, m/s: hardening raises the strength, not the moduli."""
        return p_wave_speed(self.E, self.nu, self.rho)
