"""Compiled programs kept on disk, so that a scene which ran before starts at once.

A coupled step takes many seconds to compile and a fraction of one to load. JAX can keep its programs in a folder but
does so only when told; building a scene tells it, unless you have.
"""

from __future__ import annotations

import os
from typing import Any

import jax

from coupling.voxels import user_cache

LEAST_COMPILE_TIME = 0.05  # s: what takes less is compiled as fast as it is found in the folder


def keep_programs() -> None:
    """Have JAX keep this process's programs in `mpm_env/programs` in `$XDG_CACHE_HOME` or `~/.cache`.

    Does nothing where a folder is chosen (JAX_COMPILATION_CACHE_DIR or jax.config), where JAX_ENABLE_COMPILATION_CACHE
    is 0, or where the folder cannot be written. JAX never empties it: delete it whenever you like.
    """
    settings: Any = jax.config  # whose settings mypy does not see in every version of JAX
    if settings.jax_compilation_cache_dir is not None or not settings.jax_enable_compilation_cache:
        return
    try:
        place = user_cache("programs")
        place.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return
    if not os.access(place, os.W_OK | os.X_OK):
        return
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_COMPILE_TIME)
