"""The substep's two halves as C++ kernels for the CPU, called by XLA through `jax.ffi`.

A faster twin of what `transfer`, `substep` and the materials say in JAX, which stay the reference: same equations, sums
in another order. The kernels run forward only; a derivative is taken of the reference. They use all cores the process
may run on (MPM_ENV_THREADS sets another number), and a batch under `vmap` is one call. Where they were not built or do
not fit, `why_not` says why.
"""

from __future__ import annotations

import ctypes
import os
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from mpm_env.mpm.materials import Elastic, Material, Sand, Snow
from mpm_env.mpm.materials.protocol import LEAST_B, lame
from mpm_env.mpm.materials.sand import VOLUME_CORRECTION_CAP
from mpm_env.mpm.materials.snow import MOST_LN_JP
from mpm_env.mpm.native.sources import source_hash
from mpm_env.mpm.types import MARGIN, WALL_KINDS, Grid, Particles

LIBRARY = Path(__file__).parent / "kernels.so"
LANES = 16  # grains that a kernel takes at a time: slots come in multiples of it


@cache
def why_not() -> str | None:
    """Why the kernels cannot be used in this process, or None where they can; loads and registers them."""
    if jax.default_backend() != "cpu":
        return f"they are for the CPU, and JAX runs on {jax.default_backend()}"
    if not LIBRARY.exists():
        return "they were not built: install a C++ compiler, then the package again"
    try:
        library = ctypes.CDLL(str(LIBRARY))
    except OSError as error:
        return f"the library does not load: {error}"
    # JAX would stop working altogether with a library that was built for a newer one.
    if library.mpm_env_api() > _own_api():
        return "they were built for a newer jaxlib: install the package again"
    library.mpm_env_source.restype = ctypes.c_char_p
    if library.mpm_env_source().decode() != source_hash():
        return "they are older than their sources: install the package again"
    if not library.mpm_env_runs_here():
        return "this processor lacks AVX2"
    for name in ("to_nodes", "to_grains"):
        handler = jax.ffi.pycapsule(getattr(library, f"mpm_env_{name}"))
        jax.ffi.register_ffi_target(f"mpm_env_{name}", handler, platform="cpu")
    return None


def width() -> str:
    """The instructions that the kernels use here, such as "AVX-512"."""
    library = ctypes.CDLL(str(LIBRARY))
    library.mpm_env_width.restype = ctypes.c_char_p
    return library.mpm_env_width().decode()


def _own_api() -> int:
    """The version of the interface that this jaxlib offers, major times 1000 plus minor."""
    text = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text()
    major, minor = (int(re.search(rf"#define XLA_FFI_API_{n} (\d+)", text)[1]) for n in ("MAJOR", "MINOR"))  # type: ignore[index]
    return major * 1000 + minor


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

    @jax.custom_jvp
    def kernel(p: Particles, dt: Array, gravity: Array, watched: Array) -> Array:
        shape = jax.ShapeDtypeStruct((*grid.shape, 4), p.x.dtype)
        call = jax.ffi.ffi_call("mpm_env_to_nodes", shape, vmap_method="broadcast_all")
        step = jnp.concatenate([dt[None], gravity]).astype(p.x.dtype)
        arrays = (p.x, p.v, p.C, p.tau, p.m, p.V0, step, watched)
        return call(*arrays, **_attributes(grid), least_mass=np.float64(least_mass))

    def rule(primals: Any, tangents: Any) -> Any:
        return _derivative(lambda p, dt, gravity, watched: _padded(reference(p, dt, gravity)), primals, tangents)

    kernel.defjvp(rule, symbolic_zeros=True)

    return kernel(p, jnp.asarray(dt, p.x.dtype), gravity, watched)


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

    @jax.custom_jvp
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

    kernel.defjvp(partial(_derivative, reference), symbolic_zeros=True)

    return kernel(p, nodes, jnp.asarray(dt, p.x.dtype), material)


def _derivative(reference: Callable[..., Any], primals: Any, tangents: Any) -> Any:
    """Value and derivative of the reference along the tangents that are not zero for sure."""
    values, shape = jax.tree.flatten(primals)
    slopes = jax.tree.leaves(tangents)
    live = [i for i, t in enumerate(slopes) if not isinstance(t, SymbolicZero)]

    def along(*some: Array) -> Any:
        given = dict(zip(live, some, strict=True))
        return reference(*jax.tree.unflatten(shape, [given.get(i, value) for i, value in enumerate(values)]))

    return jax.jvp(along, [values[i] for i in live], [slopes[i] for i in live])


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


def chosen(wish: str) -> str:
    """The kernels for a wish "auto", "native" or "xla": "native" or "xla".

    MPM_ENV_KERNELS says what "auto" means, for tests and measurements. Raises ValueError where native ones are wished
    for and cannot be had.
    """
    if wish == "auto":
        wish = os.environ.get("MPM_ENV_KERNELS", "auto")
        if wish not in ("auto", "native", "xla"):
            raise ValueError(f"MPM_ENV_KERNELS is auto, native or xla, got {wish!r}.")
    if wish == "native" and why_not():
        raise ValueError(f"kernels = native is not possible here: {why_not()}. Use auto or xla.")
    return "xla" if wish == "xla" or why_not() else "native"


def spoken(kernels: str) -> str:
    """Kernels as a summary names them: with the width of their registers, or why native ones are not there."""
    if kernels == "native":
        return f"native ({width()})"
    return f"xla (no native ones: {why_not()})" if why_not() else "xla"


__all__ = ["LANES", "LAWS", "chosen", "spoken", "to_grains", "to_nodes", "why_not", "width"]
