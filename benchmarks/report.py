"""docs/performance.md from the results: every number in it is read from a file in benchmarks/results.

python -m benchmarks.report
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from benchmarks import machine, results

OUT = machine.ROOT / "docs" / "performance.md"
HEAD = """# Performance

Made by `make bench` from `benchmarks/results`; not written by hand. `M/s` is million grain-substeps per CPU second of \
one core. Tables give medians, with the least and the most in brackets; variants took turns within one run, so ratios \
hold better than numbers. The job, unless said: a 0.2 m cube of sand, n cells a side, eight grains per cell, collapses \
on a rough floor; 3-D, f32, dt = 0.01 s/m times the cell size (`benchmarks/job.py`).

"""


def table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A table in Markdown."""
    lines = [tuple(head), *([str(cell) for cell in row] for row in rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def brief(value: dict[str, float] | float | None) -> str:
    """A spread as median [least, most]; a dash for nothing."""
    if value is None:
        return "-"
    if isinstance(value, dict):
        return f"{value['median']:.3g} [{value['min']:.3g}, {value['max']:.3g}]"
    return f"{value:.3g}"


def throughput(r: dict[str, Any]) -> str:
    """Rates over every sweep, the fit against size, and the check that it is the same job."""
    text = ""
    for sweep, by_kernels in r["sweeps"].items():
        kinds = list(by_kernels)
        names = list(dict.fromkeys(name for rows in by_kernels.values() for name in rows))
        key, unit = ("Mpss", "M/s of wall time") if sweep == "cores" else ("Mpss_cpu", "M/s")
        body = [[n, *(brief(by_kernels[k].get(n, {}).get(key)) for k in kinds)] for n in names]
        text += table([sweep, *(f"{k}, {unit}" for k in kinds)], body) + "\n"
    rows = [
        [k, f["ns_per_grain"], f["fixed_us"], f["exponent"], f["bytes_per_grain"], f["base_mb"]]
        for k, f in r["fit"].items()
    ]
    head = ["kernels", "ns per grain and substep", "fixed us per substep", "exponent", "bytes per grain", "MB besides"]
    text += "Straight lines through time and peak memory against grains; an exponent of 1 is linear.\n\n"
    text += table(head, rows)
    again = "".join(f"Sweep taken again at {commit}: {sweep}.\n" for sweep, commit in r.get("retaken", {}).items())
    same = ", ".join(f"{name}: {100 * value:.2g} %" for name, value in r["same_job"].items())
    return (
        again
        + ("\n" if again else "")
        + text
        + f"\nLargest difference of r99, z99 and zcom at t = 0.1 s from the C++ code's: {same}.\n"
    )


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
    return f"Rounds: {r['rounds']}.\n\n" + table([*head, "r99, z99, zcom there"], rows)


def stages(r: dict[str, Any]) -> str:
    """Stage by stage, and the roofline."""
    text = "The least of the rounds: small stages are differences, in which medians of a busy machine say little.\n\n"
    for kernels, scenes in r["kernels"].items():
        names = list(dict.fromkeys(name for key in ("column", "dig") for name in scenes[key] if name != "grains"))
        head = [
            f"{kernels} kernels, ns per grain and substep",
            *(f"{k}, {scenes[k]['grains']} slots" for k in ("column", "dig")),
        ]
        text += table(head, [[n, *(brief(scenes[k].get(n)) for k in ("column", "dig"))] for n in names]) + "\n"
        text += rigid_step(kernels, scenes["dig, rigid step"]) + "\n"
    return text + roofline(r)


def rigid_step(kernels: str, by_fidelity: dict[str, Any]) -> str:
    """The dig's rigid step, stage by stage, at each fidelity."""

    def cell(value: float) -> str:
        return f"{value:.0f}" if value >= 10 else f"{value:.3g}"

    rows = [[name, *(cell(step[name]) for step in by_fidelity.values())] for name in next(iter(by_fidelity.values()))]
    return table([f"{kernels} kernels, us per rigid step of the dig", *by_fidelity], rows)


def roofline(r: dict[str, Any]) -> str:
    """What one core could do, and how far from it the substep is."""
    limit = r["limits"]
    by_flops = limit["gflop_per_s"] * 1e3 / limit["flops_per_grain"]
    by_bytes = limit["gb_per_s"] * 1e3 / (2 * limit["state_bytes_per_grain"])
    text = (
        f"**Roofline.** One core was seen to do {limit['gflop_per_s']:.0f} GFLOP/s (f32 matrix product) and"
        f" {limit['gb_per_s']:.0f} GB/s (sum of long arrays). A substep needs {limit['flops_per_grain']:.0f} operations"
        f" per grain as XLA counts them, and {limit['state_bytes_per_grain']:.0f} bytes of state read and written once:"
        f" arithmetic would allow {by_flops:.0f} M/s, memory {by_bytes:.0f} M/s."
    )
    for kernels, scenes in r["kernels"].items():
        rate = 1e3 / scenes["column"]["whole substep"]
        share = 100 * rate / min(by_flops, by_bytes)
        text += f" The {kernels} kernels reach {rate:.3g} M/s, {share:.0f} % of the lesser."
    return text + " The stages above say where the rest goes.\n"


def coldstart(r: dict[str, Any]) -> str:
    """The wait for the first step."""
    caches = ("empty cache", "filled cache")
    names = [name for name in r[caches[0]] if name != "peak_mb"]
    rows = [[n, *(f"{r[c][n]['wall']} ({r[c][n]['cpu']})" for c in caches)] for n in names]
    rows.append(["peak memory, MB", *(r[c]["peak_mb"] for c in caches)])
    return f"`{r['environment']}`, fidelity: {r['fidelity']}. Wall seconds, CPU seconds in brackets.\n\n" + table(
        ["", *(f"{c} of compiled programs" for c in caches)], rows
    )


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
                f"The box lands at {drop['impact_m_s']} m/s, moves up at {drop['fastest_up_m_s']} m/s at most after"
                f" that, and at {drop['rms_at_the_end_m_s']} m/s (root mean square) at the end, where the bed carries"
                f" {drop['reaction_over_weight']} of its weight: it {word}.\n\n"
            )
    for row in r.get("newton", {}).values():
        text += f"The drop in {row['code']}: {brief(row['cpu_per_sim_s'])} CPU s per simulated s"
        if "settled" in row:
            text += f", up at {row['fastest_up_m_s']} m/s at most, {row['rms_at_the_end_m_s']} m/s at the end"
        text += ".\n\n"
    return text


def guard(r: dict[str, Any]) -> str:
    """The ratios kept."""
    kept = ", ".join(f"{kernels} {value}" for kernels, value in r["ratios"].items())
    return f"A rigid step of the column takes so many times a plain numpy kernel: {kept}. 25 % more fails the guard.\n"


def gpu(r: dict[str, Any]) -> str:
    """Rates on a GPU."""
    rows = [[name, brief(row["Mpss"]), row["launches"], row["peak_mb_so_far"]] for name, row in r["rows"].items()]
    return f"{r['device']}.\n\n" + table(["job", "M/s of wall time", "launches (counted)", "peak MB so far"], rows)


def goals() -> str:
    """What was set out to be reached, and what was."""
    t, c, st, co, cold = (
        results.read(name) or {} for name in ("throughput", "compare", "stages", "coupled", "coldstart")
    )
    sweeps, rows = t.get("sweeps", {}), []

    def rate(sweep: str, name: str, kernels: str) -> float | None:
        row = sweeps.get(sweep, {}).get(kernels, {}).get(name)
        return row and row["Mpss_cpu"]["median"]

    def add(what: str, least: str, value: Any) -> None:
        rows.append([what, least, "-" if value is None else f"{value:.3g}" if isinstance(value, float) else value])

    def over(a: float | None, b: float | None) -> float | None:
        return a / b if a and b else None

    for kernels, least in (("native", 10), ("xla", 3)):
        for grains in (8000, 64000, 262144):
            add(f"{kernels} kernels, {grains} grains, M/s", f">= {least}", rate("size", f"{grains} grains", kernels))
        for what, least_ratio, a, b in (
            ("snow over sand", 0.7, ("material", "snow"), ("material", "sand")),
            ("2-D over 3-D", 2, ("dimension", "2-D"), ("dimension", "3-D")),
            ("f64 over f32", 0.4, ("precision", "f64"), ("precision", "f32")),
            ("64 x 1728 over one scene", 0.8, ("batch", "64 x 1728"), ("batch", "one scene of 140608")),
        ):
            add(f"{kernels}: {what}", f">= {least_ratio}", over(rate(*a, kernels), rate(*b, kernels)))
        step = st.get("kernels", {}).get(kernels, {}).get("dig, rigid step", {}).get("standard", {})
        add(f"{kernels}: bodies in the dig scene, on top of grains", "<= 0.3", step.get("share on top of grains"))
        drop = co.get("kernels", {}).get(kernels, {}).get("drop", {})
        add(f"{kernels}: box drop, CPU s per simulated s", "< 66", drop.get("mean_cpu_per_sim_s"))
        add(f"{kernels}: the box settles", "yes", {True: "yes", False: "no"}.get(drop.get("settled")))
        add(f"{kernels}: exponent of time against grains", "1", t.get("fit", {}).get(kernels, {}).get("exponent"))
    add("farthest heap from the C++ code's", "< 0.005", max(t.get("same_job", {}).values(), default=None))
    for cache, least_s in (("empty cache", 15), ("filled cache", 5)):
        add(f"first step, {cache}, wall s", f"< {least_s}", cold.get(cache, {}).get("to first step", {}).get("wall"))
    add("peak memory to the first step, MB", "< 1000", float(cold["empty cache"]["peak_mb"]) if cold else None)
    for n in (10, 20, 32):
        peers = [
            row["Mpss_cpu"]["median"]
            for row in c.get("rows", {}).values()
            if row["n"] == n and row["code"].startswith(("taichi", "warp", "genesis"))
        ]
        ours = c.get("rows", {}).get(f"mpm-env native n={n}", {}).get("Mpss_cpu", {}).get("median")
        add(f"native over the quickest explicit Python peer, n = {n}", "> 1", over(ours, max(peers, default=None)))
        implicit = [
            row["cpu_per_sim_s"]["median"]
            for row in c.get("rows", {}).values()
            if row["n"] == n and row["code"].startswith("newton")
        ]
        cost = c.get("rows", {}).get(f"mpm-env native n={n}", {}).get("cpu_per_sim_s", {}).get("median")
        add(f"CPU time over Newton's quickest, n = {n}", "< 1", over(cost, min(implicit, default=None)))
    return table(["goal", "wanted", "measured"], rows) + "\n"


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
    text = HEAD + "## Goals\n\n" + goals()
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
