"""The substep's two halves by the native kernels.

Twins of what `transfer`, `substep` and the materials say in JAX, which stay the reference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mpm_env import native
from mpm_env.mpm.materials import Elastic, Material, Sand, Snow
from mpm_env.mpm.materials.protocol import LEAST_B, lame
from mpm_env.mpm.materials.sand import VOLUME_CORRECTION_CAP
from mpm_env.mpm.materials.snow import MOST_LN_JP
from mpm_env.mpm.types import MARGIN, WALL_KINDS, Grid, Particles


def to_nodes(
    grid: Grid,
    p: Particles,
    dt: float | Array,
    gravity: Array,
    watched: Array,
    least_mass: float,
    reference: Callable[[Particles, Array, Array], Array],
) -> Array:
    """Nodes (*shape, 4): velocity m/s after forces, gravity and walls, padded to three numbers, and mass kg.

    Nodes that no grain reaches are undefined, but for the watched (K,). `reference` gives the same in JAX, all of it,
    from the grains, dt and gravity.
    """

    def kernel(p: Particles, dt: Array, gravity: Array, watched: Array) -> Array:
        shape = jax.ShapeDtypeStruct((*grid.shape, 4), p.x.dtype)
        call = jax.ffi.ffi_call("mpm_env_to_nodes", shape, vmap_method="broadcast_all")
        step = jnp.concatenate([dt[None], gravity]).astype(p.x.dtype)
        arrays = (p.x, p.v, p.C, p.tau, p.m, p.V0, step, watched)
        return call(*arrays, **_attributes(grid), least_mass=np.float64(least_mass))

    either = native.differentiable(kernel, lambda p, dt, gravity, watched: _padded(reference(p, dt, gravity)))
    return either(p, jnp.asarray(dt, p.x.dtype), gravity, watched)


def to_grains(
    grid: Grid,
    material: Material | None,
    span: tuple[int, int],
    p: Particles,
    nodes: Array,
    dt: float | Array,
    reference: Callable[[Particles, Array, Array, Material | None], Particles],
) -> Particles:
    """The grains of a span of slots after nodes (*shape, 4) moved them; with a material also strained and answered.

    Without one, e, tau and history stay as they are. `reference` gives the same in JAX.
    """

    def kernel(p: Particles, nodes: Array, dt: Array, material: Material | None) -> Particles:
        law, parameters = (0, ()) if material is None else LAWS[type(material)](material)
        moved = (p.x, p.v, p.C, p.e, p.tau, p.history)
        call = jax.ffi.ffi_call(
            "mpm_env_to_grains",
            [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in moved],
            vmap_method="broadcast_all",
            input_output_aliases={3 + i: i for i in range(len(moved))},
        )
        row = jnp.stack([jnp.asarray(a, p.x.dtype) for a in (dt, *parameters)])
        job = {"law": np.int64(law), "start": np.int64(span[0]), "stop": np.int64(span[1])}
        x, v, C, e, tau, history = call(nodes, p.m, row, *moved, **_attributes(grid), **job)
        return replace(p, x=x, v=v, C=C, e=e, tau=tau, history=history)

    return native.differentiable(kernel, reference)(p, nodes, jnp.asarray(dt, p.x.dtype), material)


def _elastic(m: Elastic) -> tuple[int, tuple[Any, ...]]:
    return 1, (*lame(m.E, m.nu), LEAST_B)


def _sand(m: Sand) -> tuple[int, tuple[Any, ...]]:
    lam, mu = lame(m.E, m.nu)
    cap = VOLUME_CORRECTION_CAP if m.volume_correction else -1.0
    return 2, (lam, mu, 1.5 * (lam + 2 * mu / 3) / mu * m.alpha, m.tip, cap, LEAST_B)


def _snow(m: Snow) -> tuple[int, tuple[Any, ...]]:
    return 3, (*lame(m.E, m.nu), m.theta_c, m.theta_s, m.xi, m.Jp_min, MOST_LN_JP, LEAST_B)


# Laws that the kernels know, by number, with their parameters in the order of laws.h; other materials are evaluated in
# JAX after the transfer.
LAWS: dict[type, Callable[[Any], tuple[int, tuple[Any, ...]]]] = {Elastic: _elastic, Sand: _sand, Snow: _snow}


def knows(material: Material) -> bool:
    """Whether the kernels have this material's law; sand that flows in the plane only is not theirs."""
    return type(material) in LAWS and not (isinstance(material, Sand) and material.directions == 2)


def _padded(nodes: Array) -> Array:
    """Nodes (*shape, d + 1) as the kernels lay them out."""
    if nodes.shape[-1] == 4:
        return nodes
    return jnp.concatenate([nodes[..., :2], jnp.zeros_like(nodes[..., :1]), nodes[..., 2:]], axis=-1)


def _attributes(grid: Grid) -> dict[str, Any]:
    """What both kernels are told of the grid."""
    sides = [wall for pair in grid.walls for wall in pair]
    return {
        "shape": np.asarray(grid.shape, np.int64),
        "kinds": np.asarray([WALL_KINDS.index(w.kind) for w in sides], np.int64),
        "friction": np.asarray([w.friction for w in sides], np.float64),
        "cell_size": np.float64(grid.cell_size),
        "margin": np.int64(MARGIN),
    }
