"""What goes into sand, held against what is known: dropped balls and cones, plates told where to go, walls and blades.

    python -m benchmarks.coupling.penetration [--quick]

Writes results/coupling_penetration.json, a case for each reference, and plots into docs/coupling. A case whose value
lies outside the reference's band is told as a miss, with what is known about why.
"""

from __future__ import annotations

import argparse
import itertools
from functools import partial
from typing import Any

import numpy as np

from benchmarks import job, machine, results
from benchmarks.case import Band, Case, say, within
from benchmarks.coupling import cutting, impact, intrusion
from benchmarks.coupling.fits import line
from benchmarks.coupling.intrusion import ALONG_FLAT, ALONG_UPRIGHT, DOWN, UP, UP_DEEPER
from mpm_env.plot import Series, plot

PLOTS = machine.ROOT / "docs" / "coupling"
FRICTIONS = (20.0, 25.0, 30.0, 35.0, 40.0)  # degrees
UEHARA, BRZINSKI, RFT = "Uehara et al. 2003", "Brzinski et al. 2013", "Li, Zhang & Goldman 2013"
COARSE = (
    "Transfers make sand viscous, in proportion to cells, which takes more from a shallow dent than from a deep one and"
    " so raises the powers; see the limit"
)
VISCOUS = (
    "Transfers to the grid and back smooth velocities over a cell, so sand that shears within few cells is viscous, by"
    " about a cell squared over the substep: more with more substeps, less with smaller cells. It is not contact, for a"
    " ball made of grains meets it too"
)
EDGE = (
    "A node inside a box and nearer to its side than to the face that presses, or on it, has the side's normal: sand"
    " slips past it into the box, unless a plane of nodes lies within the contact band ahead of the face. A piston"
    " without edges holds its load at any place"
)
SHALLOW = (
    "What lifts a shallow plate is the weight of the block above it, which grows with depth squared and more; what it"
    " bears grows with depth. In a continuum with friction the ratio falls with depth and is no constant"
)


def balls(cells: tuple[int, ...]) -> list[Case]:
    """Balls dropped at these resolutions, and what those tend to."""
    runs = {n: impact.sweep(n) for n in cells}
    told = {f"{n} cells to the diameter": run for n, run in runs.items()}
    if len(cells) > 1:
        told[f"limit of {', '.join(map(str, cells))} cells"] = impact.limit(runs)
    out, series = [], []
    for resolution, run in told.items():
        worst = max(run.over_uehara.values(), key=lambda share: abs(np.log(share)))
        for name, reference, allowed, value in (
            ("power of the fall", 1 / 3, (1 / 3 - 0.08, 1 / 3 + 0.08), run.power_of_height),
            ("power of the density", 0.5, (0.4, 0.6), run.power_of_density),
            ("depth over Uehara's, the worst", 1.0, (1 / 1.35, 1.35), worst),
        ):
            kept = (resolution, run.cpu_s, run.health, COARSE)
            out.append(Case(f"ball: {name}", UEHARA, reference, allowed, value, *kept))
        depth = [run.depths[h, impact.RATIOS[1]] for h in impact.HEIGHTS]
        series.append(Series(resolution, np.add(impact.HEIGHTS, depth), depth))
    fall = np.geomspace(0.08, 1.0, 20)
    law = 0.14 / impact.REPOSE * np.sqrt(impact.RATIOS[1]) * impact.SIZE ** (2 / 3) * fall ** (1 / 3)
    plot(
        PLOTS / "penetration_balls.png",
        f"A ball {impact.RATIOS[1]:g} times as dense as sand, {impact.SIZE:g} m across",
        "whole fall, m",
        "depth, m",
        [Series(UEHARA, fall, law, joined=True), *series],
        log=True,
        names="below",
    )
    return out


def one_ball(cells: int) -> list[Case]:
    """Whether a quarter of a ball does what a free one does; what more substeps change; what friction holds up."""
    key, cell, bottom = (impact.HEIGHTS[1], impact.RATIOS[1]), impact.SIZE / cells, impact.DEPTH * impact.SIZE
    ball = impact.drop("ball", cells, *key)
    whole = impact.drop("ball", cells, *key, whole=True)
    often = impact.drop("ball", cells, *key, courant=0.125)
    slippery = impact.drop("ball", cells, *key, friction_deg=0.0)

    def case(name: str, source: str, reference: float, band: Band, value: float, run: impact.Drop) -> Case:
        resolution = f"{cells} cells to the diameter"
        return Case(f"ball: {name}", source, reference, band, value, resolution, run.cpu_s, run.health, VISCOUS)

    even = within(1, 0.25 * cell / ball.depth)  # a quarter of a cell: what the place of the nodes changes
    sunk = 1 - cell / bottom
    return [
        case("free and whole over guided quarter", "symmetry", 1, even, whole.depth / ball.depth, whole),
        case(
            "a quarter of the substep over its own", "convergence", 1, within(1, 0.1), often.depth / ball.depth, often
        ),
        case("depth in a fluid over the bed's", "it sinks", sunk, (0.85, 1), slippery.depth / bottom, slippery),
    ]


def cones(cells: tuple[int, ...]) -> list[Case]:
    """Dropped cones."""
    runs = {n: impact.cones(n) for n in cells}
    told = {f"{n} cells to {impact.SIZE:g} m": run for n, run in runs.items()}
    if len(cells) > 1:
        told[f"limit of {', '.join(map(str, cells))} cells"] = impact.limit(runs)
    name, source = "cone: power of the load", "force as depth and area"
    return [
        Case(name, source, 0.25, (0.2, 0.3), run.power_of_load, resolution, run.cpu_s, run.health, COARSE)
        for resolution, run in told.items()
    ]


def plates(cells: int) -> list[Case]:
    """A square plate pushed down, dragged and pulled up."""
    down, upright, flat = (intrusion.push(cells, m) for m in (DOWN, ALONG_UPRIGHT, ALONG_FLAT))
    slow = intrusion.push(cells, DOWN, speed=intrusion.SPEED / 2)
    under = down.depth > intrusion.BURIED
    fit = line(down.depth[under], down.force[under, 1])
    bears = down.at(1.0)[1]
    per_depth = 35 * np.tan(np.radians(intrusion.FRICTION_DEG))
    steady, resolution = "sand has no rate", f"{cells} cells to the side"

    def case(name: str, source: str, reference: float, band: Band, value: float, *runs: intrusion.Push) -> Case:
        cpu, health = sum(r.cpu_s for r in runs), int(np.bitwise_or.reduce([r.health for r in runs]))
        note = SHALLOW if "over up" in name else VISCOUS
        return Case(f"plate {name}", source, reference, band, float(value), resolution, cpu, health, note)

    out = [
        case("down: R2 of force against depth", RFT, 1, (0.98, 1), fit.r2, down),
        case("down: force at half the speed over force", steady, 1, within(1, 0.1), slow.at(1.0)[1] / bears, slow),
        case("down: pressure per rho g depth", BRZINSKI, per_depth, (per_depth / 2, 2 * per_depth), fit.slope, down),
        case("upright along over flat down", RFT, 0.37, (0.25, 0.49), -upright.holding[0] / bears, upright, down),
        case("flat along over flat down", RFT, 0.136, (0.068, 0.272), -flat.holding[0] / bears, flat, down),
    ]
    for motion in (UP, UP_DEEPER):
        p = intrusion.push(cells, motion)
        top, pull = motion.depth - intrusion.THICK / 2, -p.force[:, 1].min()
        at, bound = f"{motion.depth:g} of its side deep", intrusion.breakout(top)
        pressed = fit.start + fit.slope * motion.depth
        out += [
            case(f"up, {at}: over the sand on it", "Murray & Geddes 1987", bound, within(bound, 0.3), pull / top, p),
            case(f"down over up, {at}", RFT, 4, (3, 5), pressed / pull, p, down),
        ]
    plot(
        PLOTS / "penetration_plates.png",
        "A square plate pushed down, and dragged at a depth of its side",
        "depth of the first, travel of the others, over the side",
        "force / rho g side^3",
        [
            Series("flat, down", down.depth, down.force[:, 1], joined=True),
            Series("upright, along", upright.travel, -upright.force[:, 0], joined=True),
            Series("flat, along", flat.travel, -flat.force[:, 0], joined=True),
        ],
    )
    return out


def walls(cells: int) -> list[Case]:
    """A smooth wall against passive earth pressure, at another speed too, and in sand without friction."""
    done = {phi: cutting.cut(cells, phi) for phi in FRICTIONS}
    slow, fluid = (cutting.cut(cells, phi, speed=cutting.SPEED / 5) for phi in (30.0, 0.0))

    def case(name: str, source: str, reference: float, share: float, value: float, run: cutting.Cut) -> Case:
        resolution, band = f"{cells} cells to the depth", within(reference, share)
        return Case(f"wall, phi {name}", source, reference, band, value, resolution, run.cpu_s, run.health)

    lines = [Series("", [0, 0.1], [cutting.passive(phi)] * 2, True, k) for k, phi in enumerate(done)]
    plot(
        PLOTS / "penetration_walls.png",
        f"A smooth wall pushed into sand {cells} cells deep; straight lines: Rankine",
        "travel / depth",
        "K",
        [
            *(Series(f"phi {phi:.0f}", c.travel, 2 * c.draft, True, k) for k, (phi, c) in enumerate(done.items())),
            *lines,
        ],
        names="below",
    )
    same = slow.pressure / done[30.0].pressure
    return [
        *(case(f"{phi:.0f}: K", "Rankine", cutting.passive(phi), 0.15, c.pressure, c) for phi, c in done.items()),
        case("30: K at a fifth of the speed over K", "sand has no rate", 1, 0.05, same, slow),
        case("0: K", "hydrostatics", 1, 0.15, fluid.pressure, fluid),
    ]


def blades(cells: int) -> list[Case]:
    """Inclined blades, smooth and rough, against the earth-moving equation."""
    out, series, resolution = [], [], f"{cells} cells to the depth"
    for k, (blade, rake) in enumerate(itertools.product(cutting.BLADES, (45.0, 60.0))):
        laws = [cutting.earth_moving(phi, rake, cutting.BLADES[blade]) for phi in FRICTIONS]
        done = [cutting.cut(cells, phi, rake, blade) for phi in FRICTIONS]
        for phi, N, c in zip(FRICTIONS, laws, done, strict=True):
            name = f"{blade} blade, rake {rake:.0f}, phi {phi:.0f}: N"
            out.append(Case(name, "Reece, McKyes", N, within(N, 0.3), c.resistance, resolution, c.cpu_s, c.health))
        series.append(Series(f"{blade}, rake {rake:.0f}", FRICTIONS, [c.resistance for c in done], colour=k))
        series.append(Series("", FRICTIONS, laws, joined=True, colour=k))
    plot(
        PLOTS / "penetration_blades.png",
        f"Blades through sand {cells} cells deep; lines: the earth-moving equation",
        "friction angle, degrees",
        "N",
        series,
    )
    return out


def footings() -> list[Case]:
    """What a footing holds where its face lies badly in the grid, over where well: with edges on nodes and between."""
    out = []
    for half, edges in ((4.0, "on"), (4.5, "between")):
        badly, well = intrusion.footing(half, 1.4), intrusion.footing(half, 1.9)
        name, resolution = f"footing, edges {edges} nodes: badly over well placed", f"{2 * half:g} cells across"
        cost, health, even = badly.cpu_s + well.cpu_s, badly.health | well.health, badly.held / well.held
        out.append(Case(name, "the grid is no part of it", 1, within(1, 0.1), even, resolution, cost, health, EDGE))
    return out


def dropped(quick: bool) -> list[Case]:
    """Balls and cones."""
    cells = (6,) if quick else (6, 8, 12)
    return balls(cells) + one_ball(6) + cones(cells)


def main() -> None:
    """Measure all and write results/coupling_penetration.json."""
    parser = argparse.ArgumentParser(description="Bodies that go into sand, against experiments and limit theorems.")
    parser.add_argument("--quick", action="store_true", help="coarser: a few minutes")
    quick = parser.parse_args().quick
    job.pin(1)
    PLOTS.mkdir(parents=True, exist_ok=True)
    cells = 8 if quick else 32
    told: list[dict[str, Any]] = []
    for cases in (
        partial(walls, cells),
        partial(blades, cells),
        partial(plates, 4 if quick else 8),
        footings,
        partial(dropped, quick),
    ):
        told += say(cases())
    results.write("coupling_penetration", {"quick": quick, "cases": told})


if __name__ == "__main__":
    main()
