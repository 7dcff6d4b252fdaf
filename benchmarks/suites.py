"""Benchmarks that belong together, one after the other in processes of their own."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Mapping, Sequence

from benchmarks import machine


def run(package: str, suites: Mapping[str, Sequence[str]]) -> None:
    """Run a package's suites (name -> options), then its report; one that fails stops only the exit status."""
    failed = []
    for name, options in suites.items():
        began = time.perf_counter()
        done = subprocess.run([sys.executable, "-m", f"{package}.{name}", *options], cwd=machine.ROOT, check=False)
        print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)
        if done.returncode:
            failed.append(name)
    subprocess.run([sys.executable, "-m", f"{package}.report"], cwd=machine.ROOT, check=True)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")
