"""Columns of sand that collapse: against discs, over aspect ratios, down a slope; and the slope that stays.

python -m benchmarks.validation.columns [--quick]
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import case, job, part
from benchmarks.case import Case, at_most, within
from benchmarks.validation import PLOTS, flows
from benchmarks.validation.flows import STICK, Clock, G, block, flow, sand
from mpm_env.calibrate_repose import face
from mpm_env.plot import Series, plot

HIGH = 0.2  # m; nothing here depends on it, since all is told in heights
EDGE = 0.02  # of the height: a heap ends where it is lower
SLIPPERY = sand(float(np.degrees(np.arctan(0.36))), HIGH)  # of one friction, with which a continuum runs as discs do
TRIAXIAL = sand(30.0, HIGH, friction_fit="triaxial")  # as laboratories measure it
SHORT, TALL = (0.5, 0.7, 1.0, 1.5), (3.0, 4.0, 5.0, 6.0)  # aspect ratios of the two regimes
LAGREE, MATTER, DAVIS = "Lagree et al. 2011, contact dynamics", "the code matter", "Davis 1968"
LUBE = "Lube et al. 2004"


class Discs(NamedTuple):
    """Half a column of discs, in heights, at times 1, 2, .. in sqrt(height / gravity); x = 0 is its middle.

    Contact dynamics of Lagree, Staron & Popinet, J. Fluid Mech. 686, 2011, read off the profiles published with it.
    """

    width: float
    grain: float  # diameter
    fronts: tuple[float, ...]
    x: tuple[float, ...]
    h: tuple[float, ...]  # over x, at rest


DISCS = {  # by aspect ratio
    0.5: Discs(
        2.0,
        0.0336,
        (2.27, 2.89, 3.27, 3.73, 3.88, 3.90),
        (0, 1, 1.5, 2, 2.5, 3, 3.5, 3.9),
        (0.96, 0.767, 0.607, 0.471, 0.337, 0.228, 0.092, 0),
    ),
    6.26: Discs(
        0.16,
        0.0075,
        (0.51, 1.23, 1.70, 1.92, 1.91),
        (0, 0.1, 0.2, 0.3, 0.5, 0.75, 1, 1.25, 1.5, 1.91),
        (0.199, 0.180, 0.160, 0.145, 0.117, 0.092, 0.070, 0.058, 0.037, 0),
    ),
}


class Heap(NamedTuple):
    """What a column became, in heights."""

    width: float  # of the column
    x: np.ndarray  # (k,) middles of columns an eighth of a height wide
    h: np.ndarray  # (k,)
    fronts: list[float]  # at times 1, 2, .. sqrt(height / gravity)
    health: int
    cpu_s: float

    @property
    def runout(self) -> float:
        """How far the front went, over the width."""
        return self.fronts[-1] / self.width - 1

    def off(self, discs: Discs) -> float:
        """The area between this heap and the discs', over the discs' area."""
        inside = self.x[:, None] + np.linspace(-1 / 16, 1 / 16, 9)
        there = np.interp(inside, discs.x, discs.h, right=0).mean(axis=1)
        return float(np.abs(self.h - there).sum() / there.sum())


def mu_i(grain: float) -> dict[str, Any]:
    """Grains so many heights in diameter, with the numbers that the discs' authors gave a continuum: mu(I)."""
    law = {"mu_s": 0.32, "mu_2": 0.60, "I_0": 0.4, "grain_size": grain * HIGH, "grain_density": 2500.0}
    return {"model": "mu_i"} | {k: SLIPPERY[k] for k in ("E", "nu", "rho")} | law


def collapse(width: float, across: int, material: dict[str, Any], *, times: int = 7, pic: bool = False) -> Heap:
    """A column so many heights wide and cells high, let go beside its mirror on a floor that grains stick to."""
    cell = HIGH / across
    wide = max(round(width * across), 1) * cell
    room = max(2.6, 2.6 * (HIGH / wide) ** 0.7) * wide + 2 * HIGH  # more than sand of 20 degrees runs
    scene = flow(
        material,
        (flows.whole_cells(wide + room, cell), HIGH + 2 * cell),
        cell,
        [block((0, 0), (wide, HIGH))],
        STICK,
        pic=pic,
    )
    state, fronts, clock = flows.start(scene), [], Clock()
    for _ in range(times):
        state = flows.go(scene, state, np.sqrt(HIGH / G), pic=pic)
        x, h = (a / HIGH for a in flows.heights(scene, state, HIGH / 16))
        fronts.append(flows.front(x, h, EDGE))
    x, h = (a / HIGH for a in flows.heights(scene, state, HIGH / 8))
    return Heap(wide / HIGH, x, h, fronts, int(state.health), clock.cpu_s)


class Scaling(NamedTuple):
    """Powers of the runout over the aspect ratio."""

    runouts: dict[float, float]  # by aspect ratio
    short: float
    tall: float
    breaks: float  # aspect ratio where the two laws meet
    health: int
    cpu_s: float


def scaling(
    friction_deg: float, *, across: int = 24, short: tuple[float, ...] = SHORT, tall: tuple[float, ...] = TALL
) -> Scaling:
    """Columns of these aspect ratios, at least so many cells high and eight wide, and a power law for each regime."""
    heaps = [collapse(1 / a, max(round(8 * a), across), sand(friction_deg, HIGH)) for a in (*short, *tall)]
    aspect, far = np.array([1 / heap.width for heap in heaps]), np.array([heap.runout for heap in heaps])
    cut = len(short)
    (n1, c1), (n2, c2) = (np.polyfit(np.log(aspect[s]), np.log(far[s]), 1) for s in (slice(cut), slice(cut, None)))
    breaks = float(np.exp((c2 - c1) / (n1 - n2)))
    health = int(np.bitwise_or.reduce([heap.health for heap in heaps]))
    runouts = dict(zip(aspect.tolist(), far.tolist(), strict=True))
    return Scaling(runouts, float(n1), float(n2), breaks, health, sum(heap.cpu_s for heap in heaps))


class Cone(NamedTuple):
    """What an upright cylinder became."""

    runout: float  # over its radius
    health: int
    cpu_s: float


def cylinder(aspect: float, across: int, material: dict[str, Any]) -> Cone:
    """A quarter of a cylinder so many cells in radius, between two mirrors, let go on a floor that grains stick to."""
    radius = HIGH / aspect
    cell = radius / across
    high = flows.whole_cells(HIGH, cell)
    wide = flows.whole_cells((2 + 2 * min(aspect, np.sqrt(aspect))) * radius, cell)
    fill = block((0, 0, 0), (radius, radius, high))
    scene = flow(material, (wide, wide, high + 2 * cell), cell, [fill], STICK)
    state, clock = flows.start(scene), Clock()
    lower = np.asarray(scene.grid.origin)[:2, None]
    outside = np.hypot(*(np.asarray(state.grains.x[:2]) + lower)) > radius
    state = replace(state, grains=replace(state.grains, m=jnp.where(jnp.asarray(outside), 0, state.grains.m)))
    state = flows.go(scene, state, 5 * np.sqrt(HIGH / G))
    (x, y, _), m = flows.places(scene, state)
    edges = np.arange(0, wide, cell)
    rings = np.pi / 4 * np.diff(edges**2)
    h = np.histogram(np.hypot(x, y), edges, weights=m)[0] / (flows.RHO * rings)
    far = flows.front((edges[1:] + edges[:-1]) / 2, h, EDGE * HIGH)
    return Cone(far / radius - 1, int(state.health), clock.cpu_s)


def lube(aspect: float) -> float:
    """Runout over the radius of cylinders of many sands, salt and sugar (J. Fluid Mech. 508, 2004)."""
    return 1.24 * aspect if aspect < 1.7 else 1.6 * float(np.sqrt(aspect))


class Slope(NamedTuple):
    """A column let go on a slope."""

    farthest: float  # m from the wall along the slope, of any grain
    most: float  # m, behind which 99 % of the grains lie
    health: int
    cpu_s: float


def slope(across: int, *, friction_fit: str = "mc2d", pic: bool = False, courant: float = 0.5) -> Slope:
    """Sand 0.2 m wide and 0.15 m (so many cells) high, 1.4 s on 10 degrees; shear strength tan(30) of pressure.

    The code matter expects 0.56 m +- 0.011 m for the farthest grain; an independent two-dimensional code came to
    0.5578 m at 40 cells and to 0.486 m at 20.
    """
    high, down = 0.15, np.radians(10)
    cell = high / across
    phi = float(np.degrees(np.arcsin(np.tan(np.radians(30)))))
    given = {"E": 1e6, "rho": 1000.0, "volume_correction": False}
    scene = flow(
        sand(phi, high, friction_fit=friction_fit) | given,
        (flows.whole_cells(0.9, cell), high + 2 * cell),
        cell,
        [block((0, 0), (0.2, high))],
        STICK,
        gravity=(G * np.sin(down), -G * np.cos(down)),
        pic=pic,
        courant=courant,
    )
    state, clock = flows.start(scene), Clock()
    state = flows.go(scene, state, 1.4, pic=pic)
    (x, _), _ = flows.places(scene, state)
    return Slope(float(x.max()), float(np.quantile(x, 0.99)), int(state.health), clock.cpu_s)


class Bank(NamedTuple):
    """A slope that stayed."""

    angle_deg: float
    missing: float  # share of the mass that is neither there nor counted as gone
    health: int
    cpu_s: float


def bank(across: int, friction_deg: float, **changes: Any) -> Bank:
    """Sand so many cells high on a rough floor, one side open: what does not stand leaves, and no heap builds up."""
    cell, long = HIGH / across, 4 * HIGH  # more than a slope of 20 degrees needs
    scene = flow(
        sand(friction_deg, HIGH, **changes),
        (long, HIGH + 2 * cell),
        cell,
        [block((0, 0), (long, HIGH))],
        STICK | {"x_upper": {"kind": "open"}},
    )
    state, clock = flows.start(scene), Clock()
    begin = flows.mass(state)
    state = flows.go(scene, state, 12 * np.sqrt(HIGH / G))
    x, h = flows.heights(scene, state, 2 * cell)
    missing = abs(1 - (flows.mass(state) + float(state.left)) / begin)
    return Bank(face(x, h, HIGH), missing, int(state.health), clock.cpu_s)


def davis(friction_deg: float) -> float:
    """The slope, degrees, of sand that flows without dilation: tan = sin(phi), the shear it bears where it slides.

    Davis, in Soil Mechanics: Selected Topics, 1968: along lines of no extension the shear over the normal stress is
    sin(phi) cos(psi) / (1 - sin(phi) sin(psi)), with psi = 0 here.
    """
    return float(np.degrees(np.arctan(np.sin(np.radians(friction_deg)))))


TOE = (
    "What runs ahead is one grain thick, and how far depends on the number of transfers, each of which takes energy: at"
    " half the substep the farthest grain comes to the reference; the place behind which 99 % lie moves by 4 %"
)
ONE = (
    "Of one friction; it moves by no more than 0.02 with cells and seeds, and grains whose friction grows with the rate"
    " of shear, mu(I), come closer"
)
MOVING = "Where the toe ends depends on the friction chosen and on the cells: it thins as they get finer"
STEEP = "See Davis: sand that flows without dilation slides at tan = sin(phi), which falls behind phi as it grows"


def discs(quick: bool) -> list[Case]:
    """Two columns against discs, of one friction and of mu(I), with a plot of all."""
    out = []
    for aspect, across in {0.5: 16 if quick else 32, 6.26: 50}.items():
        there, told = DISCS[aspect], f"{across} cells high"
        series = [Series(LAGREE, there.x, there.h)]
        for law, material in {"tan(phi) 0.36": SLIPPERY, "mu(I)": mu_i(there.grain)}.items():
            heap = collapse(there.width, across, material, times=8)
            series.append(Series(f"here, {law}", heap.x, heap.h, joined=True))
            for what, reference, band, value in (
                ("profile at rest, off by", 0.0, at_most(0.12), heap.off(there)),
                ("front at rest", there.fronts[-1], within(there.fronts[-1], 0.18), heap.fronts[-1]),
                ("front at time 2", there.fronts[1], within(there.fronts[1], 0.18), heap.fronts[1]),
                ("height at rest", there.h[0], within(there.h[0], 0.12), float(heap.h[0])),
            ):
                name, note = f"column of aspect {aspect:g}, {law}: {what}", ONE if material is SLIPPERY else ""
                out.append(Case(name, LAGREE, reference, band, value, told, heap.cpu_s, heap.health, note))
        title = f"A column of aspect ratio {aspect:g}, at rest, {told}"
        axes = ("x over height", "height over that of the column")
        plot(PLOTS / f"columns_{aspect:g}.png", title, *axes, series, names="middle")
    return out


def laws(quick: bool) -> list[Case]:
    """How the runout grows with the aspect ratio, in plane strain and of cylinders."""
    r = scaling(22.2, across=16 if quick else 24)
    far, told, source = r.runouts, "8 cells wide or more", "discs, Kumar 2014"
    tall = np.geomspace(2.0, 7.0, 9)
    plot(
        PLOTS / "columns_scaling.png",
        "Runout of columns in plane strain",
        "aspect ratio",
        "runout over width",
        [
            Series("discs, 22.2 degrees: 1.67 a, 2.7 a^(2/3)", [0.4, 2.7], [0.668, 4.509], joined=True),
            Series("", tall, 2.7 * tall ** (2 / 3), joined=True, colour=0),
            Series("here, 22.2 degrees", list(far), list(far.values())),
        ],
        log=True,
        names="below",
    )
    out = [
        Case("runout: power of small aspect", source, 1.0, (0.88, 1.12), r.short, told, r.cpu_s, r.health),
        Case("runout: power of large aspect", source, 2 / 3, (0.547, 0.787), r.tall, told, r.cpu_s, r.health),
        Case("runout: aspect where the laws meet", source, 2.5, (1.5, 3.5), r.breaks, told, r.cpu_s, r.health),
    ]
    runs = [(1.0, 8), (3.0, 8)] if quick else [(1.0, 12), (1.0, 20), (3.0, 12), (5.0, 12)]
    for friction, material in {"tan(phi) 0.36": SLIPPERY, "30 degrees triaxial": TRIAXIAL}.items():
        for aspect, across in runs:
            cone, law = cylinder(aspect, across, material), lube(aspect)
            name, told = f"cylinder of aspect {aspect:g}, {friction}: runout", f"{across} cells in radius"
            out.append(Case(name, LUBE, law, within(law, 0.25), cone.runout, told, cone.cpu_s, cone.health, MOVING))
    return out


def slopes(quick: bool) -> list[Case]:
    """A column on a slope."""
    out = []
    for across, courant, reference in ((20, 0.5, 0.486), (40, 0.5, 0.56), (40, 0.25, 0.56)):
        if quick and across > 20:
            continue
        s = slope(across, courant=courant)
        name, told = f"column on a slope, Courant {courant:g}: farthest grain, m", f"{across} cells high"
        band = (reference - 0.02, reference + 0.02)
        out.append(Case(name, MATTER, reference, band, s.farthest, told, s.cpu_s, s.health, TOE))
    return out


def banks(quick: bool) -> list[Case]:
    """Slopes that stay, over the angle of friction."""
    across = 24
    done = {phi: bank(across, phi) for phi in ((20.0, 30.0, 40.0) if quick else (20.0, 25.0, 30.0, 35.0, 40.0))}
    told, angles = f"{across} cells high", [b.angle_deg for b in done.values()]
    out = []
    for phi, b in done.items():
        kept, law = (told, b.cpu_s, b.health), davis(phi)
        name, band = f"bank, phi {phi:g}: angle that stays", (law - 2, law + 2)
        out.append(Case(name, DAVIS, law, band, b.angle_deg, *kept))
        name, band = f"bank, phi {phi:g}: angle, within 8 degrees of phi", (phi - 8, phi)
        out.append(Case(name, "angle of friction", phi, band, b.angle_deg, *kept, note=STEEP))
        out.append(Case(f"bank, phi {phi:g}: mass missing", "it is counted", 0, at_most(1e-5), b.missing, *kept))
    cpu_s, health = sum(b.cpu_s for b in done.values()), int(np.bitwise_or.reduce([b.health for b in done.values()]))
    least = float(np.diff(angles).min())
    name = "bank: least gain from one phi to the next"
    out.append(Case(name, "steeper with friction", 2.0, case.at_least(0.5), least, told, cpu_s, health))
    return out


def measure(quick: bool) -> dict[str, Any]:
    """All cases."""
    job.pin(1)
    return {"cases": case.say([*discs(quick), *laws(quick), *slopes(quick), *banks(quick)])}


if __name__ == "__main__":
    part.main("validation_columns", measure, __doc__)
