"""All benchmarks, or some, one after the other in processes of their own, and then the report.

python -m benchmarks [--quick] [--keep] [--peers VENVS] [SUITE ...]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

from benchmarks import machine

SUITES = {  # suite -> options of a full and of a quick run
    "throughput": ([], ["--quick"]),
    "stages": ([], ["--quick"]),
    "coupled": ([], ["--quick"]),
    "coldstart": ([], ["--quick"]),
    "guard": ([], []),
    "compare": ([], ["--sizes", "10", "--rounds", "1"]),
}


def main() -> None:
    """Run the suites asked for; a suite that fails does not stop the others, but the exit status."""
    parser = argparse.ArgumentParser(description="Run the benchmarks and write docs/performance.md.")
    parser.add_argument("suites", nargs="*", metavar="SUITE", help=f"{', '.join(SUITES)}; default: all")
    parser.add_argument("--quick", action="store_true", help="a few minutes: smaller, fewer rounds")
    parser.add_argument("--keep", action="store_true", help="the guard keeps this run's ratios, and compares nothing")
    parser.add_argument("--peers", metavar="VENVS", help="folder of the other codes' environments; see compare.py")
    a = parser.parse_args()
    if unknown := set(a.suites) - set(SUITES):
        parser.error(f"there is no suite {', '.join(sorted(unknown))}: use {', '.join(SUITES)}")
    failed = []
    for suite in a.suites or SUITES:
        options = list(SUITES[suite][a.quick])
        if suite in ("compare", "coupled") and a.peers:
            options += ["--peers", a.peers]
        if suite == "guard" and a.keep:
            options.append("--keep")
        began = time.perf_counter()
        done = subprocess.run([sys.executable, "-m", f"benchmarks.{suite}", *options], cwd=machine.ROOT, check=False)
        print(f"{suite}: {time.perf_counter() - began:.0f} s", flush=True)
        if done.returncode:
            failed.append(suite)
    subprocess.run([sys.executable, "-m", "benchmarks.report"], cwd=machine.ROOT, check=True)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
