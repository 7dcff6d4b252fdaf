"""docs/performance.md from the results: every number in it is read from a file in benchmarks/results.

python -m benchmarks.report
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks import goals, machine, results
from benchmarks.marks import brief, table

SLOTS = (
    "Slots are places for grains in the arrays, some of them empty; standard and draft are fidelities, 6 and 3 cells \
to a scene's smallest feature (`configs/fidelities`).\n\n"
)
OUT = machine.ROOT / "docs" / "performance.md"
HEAD = """# Performance

Made by `make bench` from `benchmarks/results`; not written by hand. `M/s` is million grain-substeps per CPU second of \
one core. Tables give medians, with the least and the most in brackets; variants took turns within one run, so ratios \
hold better than numbers. The job, unless said: a 0.2 m cube of sand, n cells a side, eight grains per cell, collapses \
on a rough floor; 3-D, f32, dt = 0.01 s/m times the cell size (`benchmarks/job.py`).

"""


def throughput(r: dict[str, Any]) -> str:
    """Rates over every sweep, the fit against size, and the check that it is the same job."""
    text = ""
    for sweep, by_kernels in r["sweeps"].items():
        kinds = list(by_kernels)
        names = list(dict.fromkeys(name for rows in by_kernels.values() for name in rows))
        key, unit = ("Mpss", "M/s of wall time") if sweep == "cores" else ("Mpss_cpu", "M/s")
        body = [[n, *(brief(by_kernels[k].get(n, {}).get(key)) for k in kinds)] for n in names]
        text += table([sweep, *(f"{k}, {unit}" for k in kinds)], body) + "\n"
        if sweep == "room":
            text += room(by_kernels)
    rows = [
        [k, f["ns_per_grain"], f["fixed_us"], f["exponent"], f["bytes_per_grain"], f["base_mb"]]
        for k, f in r["fit"].items()
    ]
    head = ["kernels", "ns per grain and substep", "fixed us per substep", "exponent", "bytes per grain", "MB besides"]
    text += "Straight lines through time and peak memory against grains; an exponent of 1 is linear. "
    text += (
        "Memory is the most that the process held: here the state of a grain, 120 bytes in f32, stands in it three"
        " times, as the start that repetitions go back to, as the state at hand and as the next one, since this program"
        " donates nothing; a step works with some 95 bytes more.\n\n"
    )
    text += table(head, rows)
    again = "".join(f"Sweep taken again at {commit}: {sweep}.\n" for sweep, commit in r.get("retaken", {}).items())
    same = ", ".join(f"{name}: {100 * value:.2g} %" for name, value in r["same_job"].items())
    return (
        again
        + ("\n" if again else "")
        + text
        + f"\nLargest difference of r99, z99 and zcom at t = 0.1 s from the C++ code's: {same}.\n"
    )


def room(by_kernels: dict[str, Any]) -> str:
    """What an empty box costs."""
    text = "The same grains in a larger box: plain XLA works on all nodes, the native kernels on those near grains.\n\n"
    for kernels, rows in by_kernels.items():
        if len(rows) > 1:
            first, *_, last = rows.values()
            cost, more = first["Mpss_cpu"]["median"] / last["Mpss_cpu"]["median"], last["nodes"] / first["nodes"]
            text += f"- {kernels}: with {more:.2g} times as many nodes {cost:.2g} times the cost\n"
    return text + "\n"


def compare(r: dict[str, Any]) -> str:
    """All codes on the same job."""
    rows = [
        [
            row["code"],
            row["grains"],
            brief(row["Mpss_cpu"]),
            brief(row["cpu_per_sim_s"]),
            brief(row["t_first_cpu"]),
            f"{row['rss_mb']['median']:.0f}",
            row["t_sim"],
            f"{row['r99']}, {row['z99']}, {row['zcom']}",
        ]
        for row in sorted(r["rows"].values(), key=lambda row: (row["grains"], row["cpu_per_sim_s"]["median"]))
    ]
    head = ["code", "grains", "M/s", "CPU s per simulated s", "first step, CPU s", "peak MB", "simulated s"]
    about = (
        "r99 and z99 are the 99th percentiles of the grains' radius and height, zcom is their mean height, all in m and"
        " at the end of the simulated time: by them one sees that codes did the same job. `c++` is vectorised by hand"
        " for this job alone (`peers/sand_column.cpp`). Stress is taken from strain by `series`, a power series of the"
        " logarithm; `eigen`, principal values; `svd`, singular values of F, as those codes' own examples do.\n\n"
    )
    return f"Rounds: {r['rounds']}. {about}" + table([*head, "r99, z99, zcom there"], rows)


def stages(r: dict[str, Any]) -> str:
    """Stage by stage, and the roofline."""
    text = "The least of the rounds: small stages are differences, in which medians of a busy machine say little. "
    text += SLOTS
    for kernels, scenes in r["kernels"].items():
        names = list(dict.fromkeys(name for key in ("column", "dig") for name in scenes[key] if name != "grains"))
        head = [
            f"{kernels} kernels, ns per grain and substep",
            *(f"{k}, {scenes[k]['grains']} slots" for k in ("column", "dig")),
        ]
        text += table(head, [[n, *(brief(scenes[k].get(n)) for k in ("column", "dig"))] for n in names]) + "\n"
        if "most_disorder" in r:
            text += " ".join(sort_pays(scenes[k], k, r["most_disorder"]) for k in ("column", "dig"))
            text += " The sort is the same JAX code for all kernels.\n\n"
        text += rigid_step(kernels, scenes["dig, rigid step"]) + "\n"
    return text + roofline(r)


def sort_pays(times: dict[str, float], scene: str, share: float) -> str:
    """After how many substeps a sort of grains that are nearly in order has paid for itself."""
    more = times["whole substep, nearly sorted"] - times["whole substep, sorted"]
    sort = times["sort, if it were done"]
    verdict = f"has paid for itself after {sort / more:.0f} substeps" if more > 0 else "does not pay for itself"
    return f"In the {scene}, a sort of grains of which {100 * share:g} % are out of order {verdict}."


def rigid_step(kernels: str, by_fidelity: dict[str, Any]) -> str:
    """The dig's rigid step, stage by stage, at each fidelity."""

    def cell(value: float) -> str:
        return f"{value:.0f}" if value >= 10 else f"{value:.3g}"

    rows = [[name, *(cell(step[name]) for step in by_fidelity.values())] for name in next(iter(by_fidelity.values()))]
    return table([f"{kernels} kernels, us per rigid step of the dig", *by_fidelity], rows)


def roofline(r: dict[str, Any]) -> str:
    """What one core could do, and how far from it the substep is."""
    limit = r["limits"]
    rates = {kernels: 1e3 / scenes["column"]["whole substep"] for kernels, scenes in r["kernels"].items()}
    by_bytes = limit["gb_per_s"] * 1e3 / (2 * limit["state_bytes_per_grain"])
    text = (
        f"**Ceilings.** At its best one core was seen to do {limit['gflop_per_s']:.0f} GFLOP/s (f32 matrix product) and"
        f" {limit['gb_per_s']:.0f} GB/s (sum of long arrays). Memory would allow {by_bytes:.0f} M/s, were the"
        f" {limit['state_bytes_per_grain']:.0f} bytes of a grain's state only read and written once:"
    )
    text += ",".join(
        f" the {k} kernels reach {rate:.3g} M/s or {100 * rate / by_bytes:.0f} %" for k, rate in rates.items()
    )
    text += "."
    if "operations_per_grain" in limit and "xla" in rates:
        needs = limit["operations_per_grain"]
        by_flops = limit["gflop_per_s"] * 1e3 / needs
        text += (
            f" Plain XLA's program has {needs:.0f} operations per grain and substep, those in loops counted as often as"
            f" they run: arithmetic would allow {by_flops:.0f} M/s, of which it reaches"
            f" {100 * rates['xla'] / by_flops:.0f} %. The native kernels do other arithmetic, series instead of"
            " eigenvalues where all of a pack's strains are small, which nobody has counted."
        )
    return text + " The stages above say where the rest goes.\n"


def coldstart(r: dict[str, Any]) -> str:
    """The wait for the first step."""
    caches = ("empty cache", "filled cache")
    names = [name for name in r[caches[0]] if name != "peak_mb"]
    rows = [[n, *(both(r[c][n]) for c in caches)] for n in names]
    rows.append(["peak memory, MB", *(r[c]["peak_mb"] for c in caches)])
    heads = [f"{c} of compiled programs" for c in caches]
    text = f"`{r['environment']}`, fidelity: {r['fidelity']}. Wall seconds, CPU seconds in brackets.\n\n"
    text += table(["", *heads], rows)
    if run := r.get("run"):
        text += f"\n`mpm-env run {run['scene']}`, of which {run['duration']} s are simulated, one frame:\n\n"
        cells = [[part, *(both(run[c][part]) for c in caches)] for part in run[caches[0]]]
        text += table(["", *heads], cells)
    if batch := r.get("batch"):
        ms = batch["cpu_ms"]
        text += (
            f"\nA step of {batch['envs']} such environments takes {ms['all step']} ms of CPU time, and"
            f" {ms['one starts anew']} ms if one of them starts anew.\n"
        )
    return text


def both(times: dict[str, float]) -> str:
    """Wall seconds, and CPU seconds in brackets where they are known."""
    return f"{times['wall']} ({times['cpu']})" if "cpu" in times else str(times["wall"])


def coupled(r: dict[str, Any]) -> str:
    """Scenes with bodies."""
    text = ""
    for kernels, jobs in r["kernels"].items():
        head = [f"{kernels} kernels", "grains", "substeps per rigid step", "CPU s per simulated s", "simulated s"]
        rows = [
            [name, row["grains"], row["substeps"], brief(row["cpu_per_sim_s"]), row["t_sim"]]
            for name, row in jobs.items()
        ]
        text += table(head, rows) + "\n"
        drop = jobs["drop"]
        if "settled" in drop:
            word = "settled" if drop["settled"] else "DID NOT SETTLE"
            text += (
                f"The box lands at {drop['impact_m_s']} m/s, {upwards(drop['fastest_up_m_s'])} after"
                f" that, and moves at {drop['rms_at_the_end_m_s']} m/s (root mean square) at the end, where the bed"
                f" carries {drop['reaction_over_weight']} of its weight: it {word}.\n\n"
            )
    for row in r.get("newton", {}).values():
        text += f"The drop in {row['code']}: {brief(row['cpu_per_sim_s'])} CPU s per simulated s"
        if "settled" in row:
            text += f"; the box {upwards(row['fastest_up_m_s'])} after it landed,"
            text += f" and moves at {row['rms_at_the_end_m_s']} m/s at the end"
        text += ".\n\n"
    return text


def upwards(fastest: float) -> str:
    """How a box moves whose upward speed is so much (m/s) at most; one that only sinks has none."""
    return f"moves up at {fastest} m/s at most" if fastest > 0 else "never moves up"


def guard(r: dict[str, Any]) -> str:
    """The ratios kept."""
    kept = ", ".join(f"{kernels} {value}" for kernels, value in r["ratios"].items())
    return f"A rigid step of the column takes so many times a plain numpy kernel: {kept}. 25 % more fails the guard.\n"


def gpu(r: dict[str, Any]) -> str:
    """Rates on a GPU."""
    rows = [[name, brief(row["Mpss"]), row["launches"], row["peak_mb_so_far"]] for name, row in r["rows"].items()]
    return f"{r['device']}.\n\n" + table(["job", "M/s of wall time", "launches (counted)", "peak MB so far"], rows)


SECTIONS: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {
    "compare": ("With other codes, in one run", compare),
    "throughput": ("Throughput", throughput),
    "stages": ("Where the time goes", stages),
    "coupled": ("With bodies", coupled),
    "coldstart": ("The first step", coldstart),
    "guard": ("Guard", guard),
    "gpu": ("GPU", gpu),
}


def main() -> None:
    """Write docs/performance.md from whatever results there are."""
    text = HEAD + "## Goals\n\n" + goals.section()
    for suite, (title, section) in SECTIONS.items():
        if (r := results.read(suite)) is None:
            continue
        about = r["about"]
        where = f"{about['cpu']} ({about['vectors']}), {about['cores']} cores, {about['ram_gb']:.0f} GB; Python"
        text += f"## {title}\n\n{where} {about['python']}, {about['versions']}; commit {about['commit']},"
        quick = " A quick run, smaller than the full one." if r.get("quick") else ""
        text += f" {about['date']}.{quick}\n\n{section(r)}\n"
        if left_out := r.get("left_out"):
            text += "Left out: " + " ".join(left_out) + "\n\n"
    OUT.write_text(text.rstrip() + "\n")
    print(f"wrote {OUT.relative_to(machine.ROOT)}")


if __name__ == "__main__":
    main()
