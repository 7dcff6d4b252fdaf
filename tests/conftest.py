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


MOST_MAPS = 40_000  # memory maps of a process, of which Linux allows 65 530


@pytest.fixture(autouse=True, scope="module")
def programs_leave_room() -> Iterator[None]:
    """Compiled programs take hundreds of memory maps each, and past what the system allows XLA aborts: let them go."""
    yield
    maps, jax = Path("/proc/self/maps"), sys.modules.get("jax")
    if jax is not None and maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()
