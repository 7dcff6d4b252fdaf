"""A bed that starts at rest: grains held where they are until they bear what lies above them.

Seeded grains are unstrained. Left alone they sink under their own weight and ring between nothing and twice its
stress, since nothing but the transfers damps a bed. Held in place, grains get the stress that walls, shapes and
materials give them in a run: whatever way gravity points, with materials on top of each other, and at free sides no
more than the material bears. What nothing holds, a steep side of dry sand or a block in the air, falls as ever.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mpm_env.mpm.linalg3 import volume_ratio
from mpm_env.mpm.materials import Material
from mpm_env.mpm.materials.protocol import p_wave_speed
from mpm_env.mpm.stability import largest_dt
from mpm_env.mpm.substep import Bed, substep
from mpm_env.mpm.types import Grid, Particles

# Of the bed's slowest wave, which critical damping leaves exp(-6 pi) of. With 2 elastic beds rest as well, but what
# yields under its own weight is slower: snow that its weight packs by 7 % still moved at 6e-3 sqrt(g H), now at 8e-4.
PERIODS = 3.0
MOST_LOAD = 0.5  # of the modulus: squeezed to 0.7, waves are 1.2 times as fast, which the time step's safety bears
ALONG = 1e-3  # share of gravity along an axis from which it counts as loading the bed along that axis


class Settling(NamedTuple):
    """How long a bed takes to come to rest, static."""

    period: float  # s, of the slowest compression wave that gravity excites
    dt: float  # s, of an explicit substep


def settling_of(materials: tuple[Material, ...], extent: np.ndarray, gravity: np.ndarray, cell_size: float) -> Settling:
    """For grains that fill this extent (d,) m, in gravity (d,) m/s^2.

    A quarter of the slowest wave fits a bed, which is held at one end: its period is 4 H / c. Of several materials the
    softest may lie under the densest; none has hardened yet. Raises ValueError for beds too soft for their weight.
    """
    loaded = np.abs(gravity) > ALONG * np.linalg.norm(gravity)
    length = float(np.max(extent, where=loaded, initial=0.0))
    densest = max(float(m.rho) for m in materials)
    speed = min(float(p_wave_speed(m.E, m.nu, jnp.asarray(densest))) for m in materials)
    weight, modulus = densest * float(np.linalg.norm(gravity)) * length, densest * speed**2
    if weight > MOST_LOAD * modulus:
        raise ValueError(
            f"Grains that start at rest weigh up to {weight:.4g} Pa, {weight / modulus:.2g} of the modulus"
            f" {modulus:.4g} Pa: beyond {MOST_LOAD} they are squeezed until the time step is too long. Use a stiffer"
            " material, less depth or start = unstrained."
        )
    return Settling(4 * length / speed, largest_dt(materials, cell_size, len(extent), 0.0).dt)


def at_rest(
    grid: Grid,
    beds: tuple[Bed, ...],
    p: Particles,
    gravity: Array,
    settling: Settling,
    kernels: str = "auto",
) -> Particles:
    """The grains with the strains that bear gravity (d,) m/s^2; positions, velocities and masses stay.

    Dynamic relaxation: substeps that move no grain, with critical damping of the slowest wave. The
    volume that a grain comes with is that in the bed, so that a bed stays where it was filled in and its density is
    the material's rho there; V0 becomes the volume that it would spring back to.
    Grains that move at the start are left as they are, and weigh on nothing.
    """
    period, dt = settling
    keep = math.exp(-4 * math.pi * dt / period)
    moves = jnp.any(p.v != 0, axis=0)

    def one(_: int, q: Particles) -> Particles:
        q = replace(q, V0=p.V0 / volume_ratio(q.e))
        new, _carry = substep(grid, beds, q, dt, gravity, kernels=kernels)
        return replace(new, x=p.x, v=keep * new.v, C=keep * new.C, m=q.m)

    q = replace(p, v=jnp.zeros_like(p.v), m=jnp.where(moves, 0, p.m))
    q = lax.fori_loop(0, math.ceil(PERIODS * period / dt), one, q)
    return replace(p, e=q.e, tau=q.tau, history=q.history, V0=p.V0 / volume_ratio(q.e))
