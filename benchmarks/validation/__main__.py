"""The grains held against references, part by part in processes of their own, and then docs/validation.md.

python -m benchmarks.validation [--quick] [PART ...]
"""

from __future__ import annotations

import argparse

from benchmarks import suites
from benchmarks.validation.report import SECTIONS


def main() -> None:
    """Run the parts asked for; a part that fails does not stop the others, but the exit status."""
    parser = argparse.ArgumentParser(description="Validate the grains; write docs/validation.md.")
    a = suites.asked(parser, tuple(SECTIONS))
    suites.run("benchmarks.validation", {name: ["--quick"] * a.quick for name in a.parts})


if __name__ == "__main__":
    main()
