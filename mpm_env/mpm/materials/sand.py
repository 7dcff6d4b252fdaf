"""Dry or cohesive sand."""

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

LEAST_FRICTION = 1e-6  # rad: clay is the limit of no friction, a cone whose tip lies at a huge but finite tension
# Slope of the cone over sin(friction), by the test that the angle comes from.
FRICTION_FITS = {
    "triaxial": lambda sin: math.sqrt(2 / 3) * 2 * sin / (3 - sin),  # K16 eq. 24
    "plane_strain": lambda sin: math.sqrt(2) / 3 * sin,
    "mc2d": lambda sin: sin / math.sqrt(2),  # of the deviator and the trace in the plane
}
IN_PLANE = "mc2d"  # the fit whose return mapping leaves the direction out of the plane alone
VOLUME_CORRECTION_CAP = 0.1  # largest remembered dilation: beyond 10 % loose sand is spray, not a volume to restore


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["E", "nu", "rho", "friction", "cohesion"],
    meta_fields=["friction_fit", "volume_correction"],
)
@dataclass(frozen=True)
class Sand:
    """Drucker-Prager sand on Hencky elasticity (K16 sections 5 and 6, volume correction after T17).

    Rate independent, perfectly plastic, not associated (flow on the cone keeps the volume). Remembers the volume gained
    by separation, which later compression must close before it meets stress.

    E Pa, nu, rho kg/m^3, friction rad (angle of internal friction), cohesion Pa. friction_fit says which test the angle
    comes from, that is where the smooth cone touches Mohr-Coulomb: "triaxial" compression (K16), or "plane_strain",
    with which sin(phi) = (s1 - s3) / (s1 + s3) in the plane once the stress out of it lies midway, as it does where
    sand keeps flowing. Plane strain with either of them is the same sand as 3-D. "mc2d" is what two-dimensional codes
    do, and only for plane strain: Mohr-Coulomb of the stresses in the plane alone, whatever acts across; it reaches the
    same angle at once that "plane_strain" reaches after some flow.
    """

    E: Array
    nu: Array
    rho: Array
    friction: Array
    cohesion: Array
    friction_fit: str = "triaxial"
    volume_correction: bool = True
    history_start: ClassVar[tuple[float, ...]] = (0.0,)

    @property
    def alpha(self) -> Array:
        """Slope of the cone: |s| <= -alpha (tr(tau) - k c cot(phi)) for the Kirchhoff deviator s of k directions."""
        return FRICTION_FITS[self.friction_fit](jnp.sin(jnp.maximum(self.friction, LEAST_FRICTION)))

    @property
    def directions(self) -> int:
        """How many principal directions flow: 3, or the 2 in the plane."""
        return 2 if self.friction_fit == IN_PLANE else 3

    @property
    def tip(self) -> Array:
        """Volumetric strain at the tip of the cone, which cohesion shifts to the tension c cot(phi)."""
        lam, mu = lame(self.E, self.nu)
        k = self.directions
        return k * self.cohesion / ((k * lam + 2 * mu) * jnp.tan(jnp.maximum(self.friction, LEAST_FRICTION)))

    def update(self, e: Array, history: Array, dt: float | Array) -> tuple[Array, Array, Array]:
        """Project the trial strain onto the cone: elastic inside, tip in tension, cone otherwise (K16 section 6.3).

        Raises ValueError for the fit "mc2d" in 3-D.
        """
        k = self.directions
        if k == 2 and e.shape[0] != 4:
            raise ValueError(f"friction_fit = {IN_PLANE!r} knows plane strain only: use 'plane_strain' in 3-D.")
        lam, mu = lame(self.E, self.nu)
        eps_all, axes = hencky_strain(e)
        eps_trial, across = eps_all[:k], eps_all[k:]
        eps = eps_trial + history[0] / k if self.volume_correction else eps_trial
        tip = self.tip - (k * lam / (k * lam + 2 * mu) * across[0] if k == 2 else 0)
        tr = jnp.sum(eps, axis=0)
        deviator = eps - tr / k
        norm = jnp.sqrt(jnp.sum(deviator * deviator, axis=0) + TINY)
        over = norm + (k * lam + 2 * mu) / (2 * mu) * self.alpha * (tr - tip)  # dgamma of K16 eq. 27
        in_tension = tr >= tip
        on_cone = ~in_tension & (over > 0)
        eps_cone = eps - jnp.maximum(over, 0) / norm * deviator
        eps_new = jnp.where(in_tension, tip / k, jnp.where(on_cone, eps_cone, eps))
        if self.volume_correction:
            gained = history[0] + jnp.sum(eps_trial, axis=0) - jnp.sum(eps_new, axis=0)
            history = jnp.clip(gained, -VOLUME_CORRECTION_CAP, VOLUME_CORRECTION_CAP)[None]
        e, tau = hencky_answer(jnp.concatenate([eps_new, across]), axes, lam, mu)
        return e, history, tau

    def energy(self, e: Array, history: Array) -> Array:
        """Elastic energy density, (n,) J/m^3."""
        return hencky_energy(e, *lame(self.E, self.nu))

    def wave_speed(self) -> Array:
        """Compression wave speed at rest, m/s."""
        return p_wave_speed(self.E, self.nu, self.rho)
