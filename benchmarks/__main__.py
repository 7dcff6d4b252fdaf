"""All benchmarks, or some, one after the other in processes of their own, and then the report.

python -m benchmarks [--quick] [--keep] [--peers VENVS] [SUITE ...]
"""

from __future__ import annotations

import argparse

from benchmarks import suites

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
    options = {suite: list(SUITES[suite][a.quick]) for suite in a.suites or SUITES}
    for suite in options.keys() & {"compare", "coupled"}:
        options[suite] += ["--peers", a.peers] if a.peers else []
    if "guard" in options and a.keep:
        options["guard"].append("--keep")
    suites.run("benchmarks", options)


if __name__ == "__main__":
    main()
