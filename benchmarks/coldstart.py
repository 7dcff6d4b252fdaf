"""How long a user waits: for the first step, for the run command, and for one environment of a batch to start anew.

python -m benchmarks.coldstart [--quick]

The first two with an empty and with a filled cache of compiled programs, in processes of their own. The run command
simulates one frame of a scene, so that it is all start: packages, compiler, recording, picture.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks import machine, results
from benchmarks.clock import ROUNDS, cpu_seconds, significant

SCENE, DURATION = "blade_push", 0.04  # s: one frame
BATCH = 8
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


def run_command(fidelity: str | None, env: dict[str, str]) -> dict[str, dict[str, float]]:
    """Wall and CPU seconds of `mpm-env run`, from the start of its process to its end, and its parts by its summary."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "mpm_env.cli", "run", SCENE, "--set", f"duration={DURATION}", "--out", out]
        command += ["--fidelity", fidelity] if fidelity else []
        wall, cpu = time.perf_counter(), children_cpu()
        subprocess.run(command, cwd=machine.ROOT, env=env, capture_output=True, check=True)
        both = {"wall": round(time.perf_counter() - wall, 3), "cpu": round(children_cpu() - cpu, 3)}
        parts = json.loads((Path(out) / "summary.json").read_text())["wall_s"]
    return {"all": both} | {part: {"wall": round(parts[part], 3)} for part in ("build", "compile", "log", "picture")}


def children_cpu() -> float:
    """CPU seconds of the processes that this one has started and seen end."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def partial_reset(fidelity: str | None) -> None:
    """Print CPU ms of a step of a batch, and of one in which an environment starts anew."""
    import gymnasium

    import mpm_env  # noqa: F401  registers the environments

    env = gymnasium.make_vec("mpm_env/DigSand-v0", num_envs=BATCH, **({"fidelity": fidelity} if fidelity else {}))
    env.reset(seed=0)
    still, inner, times = env.action_space.sample() * 0, env.unwrapped, {"all step": [], "one starts anew": []}
    for _ in range(ROUNDS + 1):
        for name, taken in times.items():
            if name == "one starts anew":
                ended = inner.episodes.truncated.at[0].set(True)
                inner.episodes = replace(inner.episodes, truncated=ended)
            taken.append(cpu_seconds(lambda: env.step(still)))
    print(json.dumps({name: significant(1e3 * median(taken[1:]), 3) for name, taken in times.items()}))


def of_runs(runs: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Medians over processes of the run command."""
    return {
        part: {kind: round(median(run[part][kind] for run in runs), 2) for kind in runs[0][part]} for part in runs[0]
    }


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
    parser = argparse.ArgumentParser(description="Time to the first step, of the run command, and of a partial reset.")
    parser.add_argument("--quick", action="store_true", help="one process each, and the draft fidelity")
    parser.add_argument("--inside", choices=("start", "batch"), help=argparse.SUPPRESS)
    a = parser.parse_args()
    fidelity = "draft" if a.quick else None
    if a.inside:
        return {"start": start, "batch": partial_reset}[a.inside](fidelity)

    def inside(what: str, env: dict[str, str]) -> dict[str, Any]:
        command = [sys.executable, "-m", "benchmarks.coldstart", "--inside", what, *(["--quick"] if a.quick else [])]
        done = subprocess.run(command, cwd=machine.ROOT, env=env, capture_output=True, text=True, check=True)
        return dict(json.loads(done.stdout.splitlines()[-1]))

    firsts: dict[str, list[Any]] = {"empty cache": [], "filled cache": []}
    commands: dict[str, list[Any]] = {"empty cache": [], "filled cache": []}
    for _ in range(1 if a.quick else ROUNDS):
        with tempfile.TemporaryDirectory() as cache:
            env = os.environ | {"XDG_CACHE_HOME": cache}
            env.pop("JAX_COMPILATION_CACHE_DIR", None)
            for kind in firsts:
                firsts[kind].append(inside("start", env))
        with tempfile.TemporaryDirectory() as cache:  # another: the run is not to find what the environment compiled
            for kind in commands:
                commands[kind].append(run_command(fidelity, env | {"XDG_CACHE_HOME": cache}))
    content = {
        "quick": a.quick,
        "environment": "mpm_env/DigSand-v0",
        "fidelity": fidelity or "its own",
        "run": {"scene": SCENE, "duration": DURATION, **{kind: of_runs(some) for kind, some in commands.items()}},
        "batch": {"envs": BATCH, "cpu_ms": inside("batch", dict(os.environ))},
    }
    results.write("coldstart", content | {kind: summary(some) for kind, some in firsts.items()})


if __name__ == "__main__":
    main()
