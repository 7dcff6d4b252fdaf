"""What every test runs under. Set here, before anything imports JAX, which reads its environment once."""

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

# Tests compare with float64 oracles and to the bit across runs: the CPU, unless someone asks for a GPU.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

# One thread per process, as mpm_env itself asks for when it is imported before JAX.
os.environ.setdefault("NPROC", "1")

# A coupled step takes many seconds to compile: keep every program for the next run and the other processes.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parent.parent / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

# The first example of a shape compiles, so a deadline measures nothing; the same examples on every machine.
hypothesis.settings.register_profile("house", deadline=None, derandomize=True)
hypothesis.settings.load_profile("house")


@pytest.fixture(autouse=True, scope="module")
def programs_go_with_their_file() -> Iterator[None]:
    """Compiled programs take hundreds of memory maps each, of which a process has 65 530: past that XLA aborts."""
    yield
    jax = sys.modules.get("jax")
    if jax is not None:
        jax.clear_caches()
        gc.collect()
