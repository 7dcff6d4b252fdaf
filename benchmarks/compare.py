"""The sand column in several codes, taking turns on one core: who is how fast, at the same job, in one run.

    python -m benchmarks.compare --peers VENVS --sizes 10 20 32 --rounds 5

VENVS is a folder of virtual environments: `taichi` (taichi==1.7.4 numpy), `newton` (newton==1.8.0 warp-lang numpy),
`genesis` (genesis-world==1.4.5 torch). The C++ code needs g++ and AVX-512 only. What is missing is left out, in words.
Own commands that print the JSON lines of benchmarks/job.py join with --also "NAME=COMMAND", {n} standing for the size.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import machine, results
from benchmarks.clock import ROUNDS, spread

HERE = Path(__file__).resolve().parent
CPP_FLAGS = ("-O3", "-march=native", "-ffast-math", "-fno-finite-math-only", "-fopenmp", "-std=c++17")
COLD = {"JAX_ENABLE_COMPILATION_CACHE": "false"}  # so that the first step of each process includes the compiler
LONGEST = 600  # s that one run of one code may take
# s simulated, by n: a second or so of work for each code, more for the quick ones
QUICK_TEND = {10: 0.1, 20: 0.02, 32: 0.005}
SLOW_TEND = {10: 0.02, 20: 0.002, 32: 0.00125}
IMPLICIT_TEND = {10: 0.1, 20: 0.1, 32: 0.05}


class Code(NamedTuple):
    """A way to run the column: the words before its options, and how long it simulates."""

    command: list[str]
    tend: dict[int, float]

    def options(self, n: int) -> list[str]:
        """Size and duration; sizes without a tried duration get one of as much work as the nearest that has."""
        near = min(self.tend, key=lambda known: abs(known - n))
        t = self.tend[near] * (1.0 if self.tend is IMPLICIT_TEND else min((near / n) ** 4, 1.0))
        return ["--n", str(n), "--tend", f"{t:.6g}", "--reps", "1"]


def codes(venvs: Path | None, folder: Path) -> tuple[dict[str, Code], list[str]]:
    """The codes that can run here, and a sentence for each that cannot."""
    found: dict[str, Code] = {}
    missing: list[str] = []
    own = [sys.executable, "-m", "benchmarks.column", "--kernels"]
    for kernels in ("native", "xla"):
        found[f"mpm-env {kernels}"] = Code([*own, kernels], QUICK_TEND)
    binary = folder / "sand_column"
    built = _quiet(["g++", *CPP_FLAGS, str(HERE / "peers" / "sand_column.cpp"), "-o", str(binary)])
    if built and _quiet([str(binary), "--n", "2", "--tend", "0.001"]):
        for stress in ("series", "eigen"):
            found[f"c++ {stress}"] = Code([str(binary), "--stress", stress], QUICK_TEND)
    else:
        missing.append("c++: needs g++ and a processor with AVX-512.")
    for venv, module, name, more, tend in (
        ("taichi", "taichi_column", "taichi series", ["--stress", "series"], QUICK_TEND),
        ("taichi", "taichi_column", "taichi svd", ["--stress", "svd"], SLOW_TEND),
        ("newton", "warp_column", "warp svd", [], SLOW_TEND),
        ("genesis", "genesis_column", "genesis", [], SLOW_TEND),
        ("newton", "newton_column", "newton implicit, dt 1/60", ["--dt", "0.016666667"], IMPLICIT_TEND),
        ("newton", "newton_column", "newton implicit, dt 1/240", ["--dt", "0.004166667"], IMPLICIT_TEND),
    ):
        python = (venvs or Path()) / venv / "bin" / "python"
        if venvs is not None and python.exists():
            found[name] = Code([str(python.absolute()), "-m", f"benchmarks.peers.{module}", *more], tend)
        else:
            missing.append(f"{name}: needs an environment called {venv} in the folder of --peers.")
    return found, missing


def _quiet(command: list[str]) -> bool:
    try:
        return subprocess.run(command, cwd=machine.ROOT, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def lines_of(command: list[str], setting: dict[str, str]) -> tuple[list[dict[str, Any]], str]:
    """The JSON lines that a command prints, or none and the last thing it said about why."""
    words = {"cwd": machine.ROOT, "env": os.environ | setting, "capture_output": True, "text": True}
    try:
        done = subprocess.run(command, **words, check=False, timeout=LONGEST)
    except subprocess.TimeoutExpired:
        return [], f"took more than {LONGEST} s"
    records = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
    last = re.sub(r"(?<!\w)/\S*/", "", last)  # results are kept: no paths of this machine
    return ([], last) if done.returncode or not records else (records, "")


def in_rounds(
    jobs: dict[str, list[str]], rounds: int, setting: dict[str, str]
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Each job's summary after so many rounds in which the jobs take turns, and a word on each that failed.

    `setting` is added to the jobs' environment.
    """
    records: dict[str, list[dict[str, Any]]] = defaultdict(list)
    failed: dict[str, str] = {}
    for round_number in range(rounds):
        for name, command in jobs.items():
            if name in failed:
                continue
            got, why = lines_of(command, setting)
            if why:
                failed[name] = f"{name}: {why}"
                print(f"left out, {failed[name]}", file=sys.stderr, flush=True)
            records[name] += got
            print(f"round {round_number + 1} of {rounds}: {name}", file=sys.stderr, flush=True)
    return {name: summary(records[name]) for name in jobs if name not in failed}, list(failed.values())


def summary(records: list[dict[str, Any]]) -> dict[str, Any]:
    """The last record, with median, least and most of what was timed."""
    timed = ("Mpss_cpu", "Mpss", "cpu_per_sim_s", "t_first_cpu", "rss_mb")
    return records[-1] | {key: spread([r[key] for r in records]) for key in timed if key in records[-1]}


def main() -> None:
    """Run all codes and write results/compare.json."""
    parser = argparse.ArgumentParser(description="The sand column in several codes, in one run.")
    parser.add_argument("--peers", type=Path, help="folder of virtual environments")
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 20, 32], help="cells along the cube's side")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--only", nargs="+", default=[], help="run only codes whose name starts with one of these")
    parser.add_argument("--also", action="append", default=[], metavar="NAME=COMMAND")
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found, missing = codes(a.peers, Path(folder))
        if a.only:
            found = {name: code for name, code in found.items() if name.startswith(tuple(a.only))}
        jobs = {f"{name} n={n}": [*code.command, *code.options(n)] for n in a.sizes for name, code in found.items()}
        for entry in a.also:
            name, _, command = entry.partition("=")
            jobs |= {f"{name} n={n}": shlex.split(command.replace("{n}", str(n))) for n in a.sizes}
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # the jobs inherit the one core
        rows, failed = in_rounds(jobs, a.rounds, COLD)
    results.write("compare", {"rounds": a.rounds, "rows": rows, "left_out": [*missing, *failed]})


if __name__ == "__main__":
    main()
