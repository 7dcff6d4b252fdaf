"""Benchmarks that belong together, one after the other in processes of their own."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence

from benchmarks import machine


def asked(parser: argparse.ArgumentParser, parts: Sequence[str]) -> argparse.Namespace:
    """The command line's options, with the `parts` to run, all of them if none is named, and whether `quick`."""
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(parts)}; default: all")
    parser.add_argument("--quick", action="store_true", help="fewer and coarser runs")
    a = parser.parse_args()
    if unknown := set(a.parts) - set(parts):
        parser.error(f"there is no part {', '.join(sorted(unknown))}: use {', '.join(parts)}")
    a.parts = a.parts or list(parts)
    return a


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
