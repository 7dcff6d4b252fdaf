"""What contact is worth, part by part in processes of their own, and then docs/coupling.md.

python -m benchmarks.coupling [--quick] [--out coupling_out] [PART ...]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks import suites

PARTS = ("tell_apart", "drop", "blade", "penetration", "refined", "cost", "pictures")


def main() -> None:
    """Run the parts asked for; a part that fails does not stop the others, but the exit status."""
    parser = argparse.ArgumentParser(description="Measure contact between grains and bodies; write docs/coupling.md.")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)}; default: all")
    parser.add_argument("--quick", action="store_true", help="fewer and coarser runs")
    parser.add_argument("--out", default="coupling_out", metavar="FOLDER", help="where the pictures' recordings go")
    a = parser.parse_args()
    if unknown := set(a.parts) - set(PARTS):
        parser.error(f"there is no part {', '.join(sorted(unknown))}: use {', '.join(PARTS)}")
    out = ["--out", str(Path(a.out).resolve())]
    options = {name: ["--quick"] * a.quick + out * (name == "pictures") for name in a.parts or PARTS}
    suites.run("benchmarks.coupling", options)


if __name__ == "__main__":
    main()
