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
    parser.add_argument("--out", default="coupling_out", metavar="FOLDER", help="where the pictures' recordings go")
    a = suites.asked(parser, PARTS)
    out = ["--out", str(Path(a.out).resolve())]
    options = {name: ["--quick"] * a.quick + out * (name == "pictures") for name in a.parts}
    suites.run("benchmarks.coupling", options)


if __name__ == "__main__":
    main()
