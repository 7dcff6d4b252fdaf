"""What was set out to be reached, what was, and why where it was not."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from benchmarks import results
from benchmarks.marks import table

KERNELS = ("native", "xla")
COMPARE: dict[str, Callable[[Any, Any], bool]] = {"<": operator.lt, "<=": operator.le, ">": operator.gt}
COMPARE[">="] = operator.ge
HEAD = "Each section below says at which commit it was measured; the goals take their numbers from those sections.\n\n"


def met(wanted: str, value: Any) -> str:
    """Whether a value is as wanted ("< 5", or a word): yes, MISSED, or a dash where there is none."""
    if value is None:
        return "-"
    sign, _, bound = wanted.rpartition(" ")
    return "yes" if (COMPARE[sign](value, float(bound)) if sign else value == wanted) else "MISSED"


@dataclass
class Goals:
    """Rows of the table, and a note for each that was missed and has one."""

    suites: dict[str, dict[str, Any]]
    rows: list[list[Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def rate(self, sweep: str, name: str, kernels: str) -> float | None:
        """M/s of a variant of the throughput's sweeps."""
        row = self.suites["throughput"].get("sweeps", {}).get(sweep, {}).get(kernels, {}).get(name)
        return row and row["Mpss_cpu"]["median"]

    def add(self, what: str, wanted: str, value: Any, why: str = "") -> None:
        """A goal, with a note on why it is missed, should it be."""
        verdict = met(wanted, value)
        shown = "-" if value is None else f"{value:.3g}" if isinstance(value, float) else value
        self.rows.append([what, wanted, shown, verdict])
        if verdict == "MISSED" and why:
            self.notes.append(f"- {what}: {why}")


def over(a: float | None, b: float | None) -> float | None:
    """A ratio, or None where a part of it is missing."""
    return a / b if a and b else None


def section() -> str:
    """The goals with their verdicts, from whatever results there are, and notes on the missed ones."""
    suites = ("throughput", "compare", "stages", "coupled", "coldstart")
    goals = Goals({name: results.read(name) or {} for name in suites})
    for kernels, least in zip(KERNELS, (10, 3), strict=True):
        of_kernels(goals, kernels, least)
    of_all(goals)
    against_peers(goals)
    notes = "\n".join(["Why some were missed:", "", *goals.notes]) + "\n\n" if goals.notes else ""
    return HEAD + table(["goal", "wanted", "measured", "met"], goals.rows) + "\n" + notes


def of_kernels(goals: Goals, kernels: str, least: int) -> None:
    """How fast grains go in these kernels, in each variant, and what bodies cost on top."""

    def rate(sweep: str, name: str) -> float | None:
        return goals.rate(sweep, name, kernels)

    for grains in (8000, 64000, 262144):
        goals.add(f"{kernels} kernels, {grains} grains, M/s", f">= {least}", rate("size", f"{grains} grains"))
    sand, whole = rate("material", "sand"), rate("batch", "one scene of 140608")
    goals.add(f"{kernels}: snow over sand", ">= 0.7", over(rate("material", "snow"), sand))
    goals.add(f"{kernels}: 2-D over 3-D", ">= 2", over(rate("dimension", "2-D"), rate("dimension", "3-D")))
    double, single = rate("precision", "f64"), rate("precision", "f32")
    goals.add(f"{kernels}: f64 over f32", ">= 0.4", over(double, single), in_f64(kernels, double, single))
    batch = rate("batch", "64 x 1728")
    why = in_a_batch(rate("batch", "1 x 1728"), whole, batch)
    goals.add(f"{kernels}: 64 x 1728 over one scene", ">= 0.8", over(batch, whole), why)
    steps = {
        k: goals.suites["stages"].get("kernels", {}).get(k, {}).get("dig, rigid step", {}).get("standard", {})
        for k in KERNELS
    }
    share = steps[kernels].get("share on top of grains")
    goals.add(f"{kernels}: bodies in the dig scene, on top of grains", "<= 0.3", share, of_bodies(kernels, steps))
    drop = goals.suites["coupled"].get("kernels", {}).get(kernels, {}).get("drop", {})
    goals.add(f"{kernels}: box drop, CPU s per simulated s", "< 66", drop.get("mean_cpu_per_sim_s"))
    goals.add(f"{kernels}: the box settles", "yes", {True: "yes", False: "no"}.get(drop.get("settled")))
    exponent = goals.suites["throughput"].get("fit", {}).get(kernels, {}).get("exponent")
    goals.add(f"{kernels}: exponent of time against grains (1 is linear)", "<= 1.05", exponent)


def in_f64(kernels: str, double: float | None, single: float | None) -> str:
    """Why f64 is slower than was wanted."""
    if kernels != "native" or not (double and single):
        return ""
    return (
        "a pack of 16 lanes is one register in f32 and two in f64 (of AVX-512), and series take more terms to more"
        f" digits; f32 also became faster than the goal foresaw, with {single:.3g} M/s. f64 itself runs at"
        f" {double:.3g} M/s."
    )


def in_a_batch(alone: float | None, whole: float | None, batch: float | None) -> str:
    """Why a batch of small columns is slower than one large one."""
    if not (alone and whole and batch):
        return ""
    small, large = ((n + 2) ** 3 / (8 * n**3) for n in (6, 26))
    return (
        "small columns have more surface, so more nodes per grain"
        f" ({small:.2g} against {large:.2g}): a single one of 1728 grains runs at {alone:.3g} M/s alone,"
        f" {alone / whole:.2g} of the one scene. The batch comes to {batch / alone:.2g} of that."
    )


def of_bodies(kernels: str, steps: dict[str, dict[str, float]]) -> str:
    """Why bodies cost more, next to grains, than was wanted."""
    if kernels != "native" or not all(steps.values()):
        return ""
    grains = steps["xla"]["grains"] / steps["native"]["grains"]
    own = {k: step["whole"] - step["grains"] for k, step in steps.items()}
    return (
        f"grains became {grains:.2g} times as fast as on plain XLA, bodies {own['xla'] / own['native']:.2g} times:"
        f" their share grew, though they cost {own['native']:.0f} us per rigid step instead of {own['xla']:.0f}."
    )


def of_all(goals: Goals) -> None:
    """What does not depend on kernels."""
    cold = goals.suites["coldstart"]
    heaps = goals.suites["throughput"].get("same_job", {}).values()
    goals.add("farthest heap from the C++ code's", "< 0.005", max(heaps, default=None))
    for cache, least_s in (("empty cache", 15), ("filled cache", 5)):
        first = cold.get(cache, {}).get("to first step", {}).get("wall")
        goals.add(f"first step, {cache}, wall s", f"< {least_s}", first)
    peak = cold.get("empty cache", {}).get("peak_mb")
    goals.add("peak memory to the first step, MB", "< 1000", peak)


def against_peers(goals: Goals) -> None:
    """Against the other codes that take the same steps, and those that take fewer and longer ones."""
    rows = goals.suites["compare"].get("rows", {})
    for n in (10, 20, 32):
        peers = [row for row in rows.values() if row["n"] == n]
        ours = rows.get(f"mpm-env native n={n}", {})
        explicit = [r["Mpss_cpu"]["median"] for r in peers if re.match("taichi|warp|genesis", r["code"])]
        implicit = [r["cpu_per_sim_s"]["median"] for r in peers if r["code"].startswith("newton")]
        rate, cost = (ours.get(key, {}).get("median") for key in ("Mpss_cpu", "cpu_per_sim_s"))
        ratio = over(rate, max(explicit, default=None))
        goals.add(f"native over the quickest explicit Python peer, n = {n}", "> 1", ratio)
        goals.add(f"CPU time over Newton's quickest, n = {n}", "< 1", over(cost, min(implicit, default=None)))
