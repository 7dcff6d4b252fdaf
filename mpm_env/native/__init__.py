"""C++ kernels for the CPU, called by XLA through `jax.ffi`: whether they are there, and how they are differentiated.

Faster twins of what the continuum (`mpm_env.mpm.kernels`) and contact (`coupling.meeting`) say in JAX, which stays the
reference: same equations, sums in another order. Those of the grains use all cores the process may run on
(MPM_ENV_THREADS sets another number), those of contact a core per environment; a batch under `vmap` is one call. Where
they were not built or do not fit, `why_not` says why; whoever calls them asks that, or `chosen`, first.
"""

from __future__ import annotations

import ctypes
import os
import re
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero

from mpm_env.native.sources import source_hash

LIBRARY = Path(__file__).parent / "kernels.so"
LANES = 16  # grains that a kernel takes at a time: slots come in multiples of it
TARGETS = ("to_nodes", "to_grains", "near", "meet")


@cache
def why_not() -> str | None:
    """Why the kernels cannot be used in this process, or None where they can; loads and registers them."""
    if jax.default_backend() != "cpu":
        return f"they are for the CPU, and JAX runs on {jax.default_backend()}"
    if not LIBRARY.exists():
        reason = LIBRARY.with_suffix(".txt")  # build.py leaves it
        if reason.exists():
            return f"they were not built ({reason.read_text().strip()}): mend that, then install the package again"
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
    for name in TARGETS:
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


def differentiable(kernel: Callable[..., Any], reference: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel, which runs forward only, with the derivatives of its reference; both take the same arguments."""
    both = jax.custom_jvp(kernel)
    both.defjvp(partial(_derivative, reference), symbolic_zeros=True)
    return both


def _derivative(reference: Callable[..., Any], primals: Any, tangents: Any) -> Any:
    """Value and derivative of the reference along the tangents that are not zero for sure."""
    values, shape = jax.tree.flatten(primals)
    slopes = jax.tree.leaves(tangents)
    live = [i for i, t in enumerate(slopes) if not isinstance(t, SymbolicZero)]

    def along(*some: jax.Array) -> Any:
        given = dict(zip(live, some, strict=True))
        return reference(*jax.tree.unflatten(shape, [given.get(i, value) for i, value in enumerate(values)]))

    return jax.jvp(along, [values[i] for i in live], [slopes[i] for i in live])


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
