"""How fast the column runs, over size, dimension, material, precision, kernels, room, batch and cores.

    python -m benchmarks.throughput [--quick] [--only SWEEP ...]

Million grain-substeps per CPU second on one core, unless said. Each variant is a process of its own, so that its memory
is known. The variants of a sweep take turns, one sweep after the other, so that those that are compared run within a
minute or two of each other; each turn has three repetitions.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from typing import Any

import numpy as np

from benchmarks import job, machine, results
from benchmarks.clock import significant
from benchmarks.column import kernels_here
from benchmarks.compare import in_rounds

REPS, ROUNDS = 3, 3
WORK = 2e6  # grain-substeps of a repetition, if 20 substeps are not more
SIZES = (6, 10, 20, 32, 50)  # cells a side: 2k, 8k, 64k, 262k and 1M grains
# The heap at t = 0.1 s by peers/sand_column.cpp: by this one sees that it is the same job.
HEAPS = {
    10: {"r99": 0.1435, "z99": 0.1643, "zcom": 0.08301},
    20: {"r99": 0.1446, "z99": 0.1628, "zcom": 0.08055},
    32: {"r99": 0.1440, "z99": 0.1621, "zcom": 0.07937},
}


def variant(n: int, **options: Any) -> list[str]:
    """Options of benchmarks.column for one variant, at most 0.1 s long."""
    dt = job.DT_PER_CELL * job.SIDE / n
    grains = 4 * n**2 if options.get("dimension") == 2 else 8 * n**3 * options.get("envs", 1)
    substeps = max(20, 20 * round(min(WORK / grains, 0.1 / dt) / 20))
    words = [word for key, value in options.items() for word in (f"--{key}", str(value))]
    return ["--n", str(n), "--tend", f"{substeps * dt:.6g}", "--reps", str(REPS), *words]


def sweeps(quick: bool) -> dict[str, dict[str, list[str]]]:
    """Sweep -> variant -> options, kernels aside."""
    sizes = SIZES[:3] if quick else SIZES
    middle, flat = (10, 64) if quick else (20, 128)
    one = variant(middle)
    found = {
        "size": {f"{8 * n**3} grains": variant(n) for n in sizes},
        "dimension": {"3-D": one, "2-D": variant(flat, dimension=2)},
        "material": {"sand": one, **{m: variant(middle, material=m) for m in ("snow", "elastic")}},
        "precision": {"f32": one, "f64": variant(middle, precision="f64")},
    }
    found["room"] = {f"box {k} x as long a side": variant(10, **({"room": k} if k > 1 else {})) for k in (1, 2, 4)}
    if quick:
        found["batch"] = {f"{b} x 1728": variant(6, envs=b) if b > 1 else variant(6) for b in (1, 16)}
    else:
        found["batch"] = {
            **{f"{b} x 1728": variant(6, envs=b) if b > 1 else variant(6) for b in (1, 4, 16, 64, 256)},
            **{f"{b} x 4096": variant(8, envs=b) if b > 1 else variant(8) for b in (1, 16, 64)},
            "64 x 1728, vmap": variant(6, envs=64, batching="vmap"),
            "one scene of 140608": variant(26),
        }
        found["cores"] = {"1": one, "2": variant(middle, cores=2), "2, 64 x 1728": variant(6, envs=64, cores=2)}
    return found


def fit(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Straight lines through CPU time of a substep, and through memory, against the number of grains.

    `exponent` is the slope in logarithms: 1 is linear. Needs two sizes.
    """
    n = np.array([row["grains"] for row in rows], float)
    seconds = n / np.array([row["Mpss_cpu"]["median"] for row in rows]) / 1e6
    memory = np.array([row["rss_mb"]["median"] for row in rows])
    (per_grain, fixed), (bytes_per_grain, base) = np.polyfit(n, seconds, 1, w=1 / seconds), np.polyfit(n, memory, 1)
    return {
        "ns_per_grain": significant(per_grain * 1e9, 3),
        "fixed_us": significant(fixed * 1e6, 3),
        "exponent": significant(np.polyfit(np.log(n), np.log(seconds), 1)[0], 3),
        "bytes_per_grain": significant(bytes_per_grain * 2**20, 3),
        "base_mb": significant(base, 3),
    }


def same_job(row: dict[str, Any]) -> float:
    """The largest relative difference of the heap at 0.1 s from the C++ code's."""
    return max(abs(row[key] / value - 1) for key, value in HEAPS[row["n"]].items())


def merged(kept: dict[str, Any], rows: dict[str, Any], commit: str) -> dict[str, Any]:
    """Kept results with some sweeps (name -> kernels -> variant) taken again at this commit."""
    retaken = kept.get("retaken", {}) | dict.fromkeys(rows, commit)
    return kept | {"sweeps": kept["sweeps"] | rows, "retaken": retaken}


def main() -> None:
    """Run every variant and write results/throughput.json."""
    parser = argparse.ArgumentParser(description="Throughput of the column over its variants.")
    parser.add_argument("--quick", action="store_true", help="fewer variants, one round")
    parser.add_argument("--only", nargs="+", metavar="SWEEP", help="take these again and keep the others' results")
    a = parser.parse_args()
    own = [sys.executable, "-m", "benchmarks.column"]
    wanted = sweeps(a.quick)
    kept = results.read("throughput")
    if unknown := set(a.only or ()) - set(wanted):
        parser.error(f"there is no sweep {', '.join(sorted(unknown))}: use {', '.join(wanted)}")
    if a.only and (kept is None or kept["quick"] != a.quick):
        parser.error("there are no results to keep of a run as long as this: run all sweeps")
    heaps = {f"--n {n}": ["--n", str(n), "--tend", "0.1"] for n in (HEAPS if not a.quick else (10,))}
    kinds, missing = kernels_here()
    rows: dict[str, Any] = {}
    left_out = list(missing)

    def run(variants: dict[str, list[str]], rounds: int) -> dict[str, dict[str, Any]]:
        """Kernels -> variant -> its summary."""
        jobs = {f"{k} {name}": [*own, "--kernels", k, *words] for k in kinds for name, words in variants.items()}
        got, failed = in_rounds(jobs, rounds, setting)
        left_out.extend(failed)
        return {k: {name: got[f"{k} {name}"] for name in variants if f"{k} {name}" in got} for k in kinds}

    with tempfile.TemporaryDirectory() as cache:  # so that a variant is compiled once, not in each round
        setting = {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        for sweep in a.only or wanted:
            rows[sweep] = run(wanted[sweep], 1 if a.quick else ROUNDS)
        heaped = {} if a.only else run(heaps, 1)
    if a.only and kept:
        return results.write("throughput", merged(kept, rows, machine.commit()))
    content = {
        "quick": a.quick,
        "sweeps": rows,
        "fit": {k: fit(list(rows["size"][k].values())) for k in kinds if len(rows["size"][k]) > 1},
        "same_job": {f"{k} {name}": round(same_job(row), 5) for k in kinds for name, row in heaped[k].items()},
        "left_out": left_out,
    }
    results.write("throughput", content)


if __name__ == "__main__":
    main()
