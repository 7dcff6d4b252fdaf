"""How long a user waits for the first step: import, make, reset, step, with an empty and with a filled compile cache.

python -m benchmarks.coldstart [--quick]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from statistics import median
from typing import Any

from benchmarks import machine, results
from benchmarks.clock import ROUNDS

STAGES = ("import", "make", "reset", "step 1", "step 2")


def start(fidelity: str | None) -> None:
    """Go through the stages in this process, and print what each took."""
    from benchmarks import job

    rows: dict[str, Any] = {}
    wall, cpu = time.perf_counter() - job.age(), 0.0  # from the start of the interpreter

    def mark(stage: str) -> None:
        nonlocal wall, cpu
        rows[stage] = {"wall": round(time.perf_counter() - wall, 3), "cpu": round(time.process_time() - cpu, 3)}
        wall, cpu = time.perf_counter(), time.process_time()

    import gymnasium

    import mpm_env  # noqa: F401  registers the environments

    mark("import")
    env = gymnasium.make("mpm_env/DigSand-v0", **({"fidelity": fidelity} if fidelity else {}))
    mark("make")
    env.reset(seed=0)
    mark("reset")
    still = env.action_space.sample() * 0
    for stage in ("step 1", "step 2"):
        env.step(still)
        mark(stage)
    print(json.dumps(rows | {"peak_mb": job.peak_mb()}))


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over processes; "to first step" is the sum up to it."""
    both = {
        stage: {kind: round(median(run[stage][kind] for run in runs), 2) for kind in ("wall", "cpu")}
        for stage in STAGES
    }
    first = {
        kind: round(median(sum(run[stage][kind] for stage in STAGES[:-1]) for run in runs), 2)
        for kind in ("wall", "cpu")
    }
    return both | {"to first step": first, "peak_mb": round(median(run["peak_mb"] for run in runs))}


def main() -> None:
    """Start processes with an empty, then with a filled cache; write results/coldstart.json."""
    parser = argparse.ArgumentParser(description="Time to the first step of the default environment.")
    parser.add_argument("--quick", action="store_true", help="one process each, and the draft fidelity")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    a = parser.parse_args()
    fidelity = "draft" if a.quick else None
    if a.inside:
        return start(fidelity)
    command = [sys.executable, "-m", "benchmarks.coldstart", "--inside", *(["--quick"] if a.quick else [])]
    runs: dict[str, list[dict[str, Any]]] = {"empty cache": [], "filled cache": []}
    for _ in range(1 if a.quick else ROUNDS):
        with tempfile.TemporaryDirectory() as cache:
            for kind in runs:
                env = os.environ | {"XDG_CACHE_HOME": cache}
                env.pop("JAX_COMPILATION_CACHE_DIR", None)
                done = subprocess.run(command, cwd=machine.ROOT, env=env, capture_output=True, text=True, check=True)
                runs[kind].append(json.loads(done.stdout.splitlines()[-1]))
    content = {kind: summary(some) for kind, some in runs.items()}
    results.write(
        "coldstart",
        {"quick": a.quick, "environment": "mpm_env/DigSand-v0", "fidelity": fidelity or "its own"} | content,
    )


if __name__ == "__main__":
    main()
