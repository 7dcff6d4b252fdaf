"""What contact is worth, part by part in processes of their own, and then docs/coupling.md.

python -m benchmarks.coupling [--quick] [--out coupling_out] [PART ...]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

from benchmarks import machine

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
    failed = []
    for name in a.parts or PARTS:
        options = ["--quick"] * a.quick + (["--out", str(Path(a.out).resolve())] if name == "pictures" else [])
        began = time.perf_counter()
        command = [sys.executable, "-m", f"benchmarks.coupling.{name}", *options]
        done = subprocess.run(command, cwd=machine.ROOT, check=False)
        print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)
        if done.returncode:
            failed.append(name)
    subprocess.run([sys.executable, "-m", "benchmarks.coupling.report"], cwd=machine.ROOT, check=True)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
