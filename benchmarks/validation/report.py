"""docs/validation.md from the results: every measured number in it is read from a file in benchmarks/results.

python -m benchmarks.validation.report
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from benchmarks import case, machine, results
from benchmarks.case import Case
from benchmarks.coupling.report import where
from benchmarks.part import Row, bands_of

OUT = machine.ROOT / "docs" / "validation.md"

HEAD = """# Validation

What the grains are worth: numbers held against exact cases, experiments, and laws that every right answer obeys. Made \
by `make validation` from `benchmarks/results/validation_*.json`; not written by hand. Scenes are in \
`benchmarks/validation`; tests in `tests/physics` run them small, each with a control that fails. Bands were stated \
before measuring and say how far a correct code of this kind may be off; one outside its band is marked, with what is \
known about why. CPU seconds are of one core, for all runs behind a number; of long ones without compiling.

"""


class Section(NamedTuple):
    """What the page says of a part."""

    title: str
    words: str  # what is done, in a few sentences
    plots: Mapping[str, str] = {}  # file in docs/validation -> caption


SECTIONS: dict[str, Section] = {  # part -> what is said of it; the parts run in this order
    "laws": Section(
        "What one grain answers",
        "The solver's own material in the laboratory's tests (`mpm_env.element`), and trial strains with known answers."
        " Under the triaxial fit, 30 degrees are 43.9 in plane strain.",
    ),
    "motion": Section(
        "What motion keeps",
        "An elastic block turns about its centre, far from any wall; sand falls, and flies out of an open box.",
    ),
    "symmetry": Section(
        "Which way, how fast, how far",
        "A column of sand collapses as it does mirrored, moved by whole cells, or with its axes swapped; a block turns"
        " as it does in a frame that moves, to rounding in each step, and to what the grid's places change over many; a"
        " scene 1000 m away is the same to the bit.",
    ),
    "bars": Section(
        "Bars that ring",
        "A standing wave in a bar that is round on itself, and the first mode of one held by a sticking wall at one end"
        " and free at the other. Strains of 1e-4.",
        {"bars.png": "Pitch over cells; lines of second and first order"},
    ),
    "discs": Section(
        "Discs",
        "Two elastic discs fly into each other and part again (E = 1 kPa, 1 t/m^3, each at 0.14 m/s; sound runs at"
        " 1.16 m/s). Grains meet through nodes that both reach, so before their edges do. A disc that spins grows by"
        " what centrifugal stress does to it, and by no more however long it spins: `(1 + dt C) F` would, by"
        " `omega^2 dt` a second, if no stress opposed it.",
        {"discs.png": "Kinetic and all energy of two discs over time"},
    ),
    "vortex": Section(
        "A ring twisted as told",
        "The generalised vortex: a ring whose points turn about its centre by an angle that depends on their radius, to"
        " and fro, driven by the body force that makes this motion exact. The force is derived from the solver's own"
        " material by JAX. Errors are of positions, the largest over time of the root mean square over grains.",
        {"vortex.png": "Error of positions over cells; lines of second order"},
    ),
    "rest": Section(
        "Sand at rest",
        "A column between smooth walls, started under its own weight or loaded from nothing by gravity that comes up"
        " slowly: of sand that its walls hold elastically, and of sand that yields meanwhile. Half a heap of 20 degrees"
        " of 30 degree sand, left alone. And a collapse in f32 beside the same in f64, grain by grain.",
        {"column.png": "Stress over depth in a column at rest"},
    ),
    "columns": Section(
        "Columns and banks",
        "Columns on a floor that grains stick to, in plane strain against discs by contact dynamics, and quarters of"
        " cylinders against experiments. Sand of one friction has tan(phi) = 0.36 in plane strain, chosen to run as the"
        " discs do, or 30 degrees as triaxial tests have it; mu(I) has the numbers that the discs' authors gave it."
        " Heights are mass over density. A bank is what stays where one side of a bed is opened, and what falls is"
        " gone; its band around Davis's angle was set with the first banks known.",
        {
            "columns_0.5.png": "A wide column at rest, and discs",
            "columns_6.26.png": "A tall one",
            "columns_scaling.png": "Runout over the aspect ratio",
        },
    ),
    "footing": Section(
        "A strip footing",
        "A rough footing pressed slowly into clay without weight (von Mises without hardening, whose shear strength in"
        " plane strain is the yield stress over sqrt(3)) and into sand. The load is the mean over the second cell of"
        " travel: under a face that passes planes of nodes it has their period. Limit loads of sand are for associated"
        " flow; without dilation they are lower.",
        {"footing.png": "Pressure over travel"},
    ),
    "silo": Section(
        "A silo",
        "Grains out of a slot in plane strain, of mu(I) with the numbers of the reference and of one friction.",
        {"silo.png": "Flow over the width of the slot"},
    ),
    "stir": Section(
        "A bed that is stirred",
        "A paddle goes into a level bed, sweeps to and fro and comes out. The volume is read off the mean heights of"
        " columns, so a level or an uneven bed counts the same.",
        {"stir.png": "Volume over the cycles of the paddle"},
    ),
    "snow": Section(
        "Snow",
        "Snow confined between smooth walls under gravity that grows to 38 g, against the closed form of confined"
        " compression. Balls of 8 cm, in plane strain, are thrown on a floor: at 20 cells they stick and keep their"
        " shape at 1 m/s, break at 3 m/s, and are crushed where the blow, rho v^2, exceeds what packed snow bears."
        " Size, speeds and bands of the balls were chosen with the first of them known, to show both ends; a ball of 20"
        " cm and 40 cells crumbles when dropped.",
        {"snow.png": "Weight of the snow above a layer over the layer's volume"},
    ),
}
CONTACT = Section(
    "Contact with bodies",
    "Measured by `make coupling`, where scenes and plots are told: [coupling.md](coupling.md).",
)


# Measures of coupling that are cited: part, measure, name of the case, source, and what the source says.
CITED = (
    ("drop", "weight", "dropped box at rest: force on it / weight", "statics", 1.0),
    ("drop", "rise", "dropped box: largest rise of all energy / impact's", "dissipation", 0.0),
    ("tell_apart", "unpaid", "light bodies: momentum that did not close / exchanged", "momentum", 0.0),
    ("refined", "impulse_off", "rigid steps of 1, 4 substeps, or halved ones: impulse, off", "convergence", 0.0),
)


def contact(parts: Mapping[str, Row | None]) -> Iterator[dict[str, Any]]:
    """Cases from the results of coupling: those of penetration as they are, and the measures CITED."""
    yield from (parts.get("penetration") or {}).get("cases", [])
    for name, measure, told, source, reference in CITED:
        if r := parts.get(name):
            for band in bands_of(r):
                for row in r["rows"]:
                    if band.measure == measure and band.asks(row):
                        value = math.nan if row[measure] is None else row[measure]
                        about = (told, source, reference, (band.low, band.high), value, "as told there", math.nan)
                        yield Case(*about, note=band.note).told()


def section(told: Section, cases: list[dict[str, Any]]) -> str:
    """A part's text."""
    plots = "".join(f"![{caption}](validation/{name})\n\n{caption}\n\n" for name, caption in told.plots.items())
    return f"{told.words}\n\n{case.table_of(cases)}\n{case.missed(cases).rstrip()}\n\n{plots}"


def render(parts: Mapping[str, Row | None], coupling: Mapping[str, Row | None]) -> str:
    """The page, from the results of the parts and of coupling's; a part that has none is said to be missing."""
    text = HEAD
    for name, told in SECTIONS.items():
        text += f"## {told.title}\n\n"
        if (r := parts.get(name)) is None:
            text += f"Not measured yet: `python -m benchmarks.validation {name}`.\n\n"
            continue
        text += section(told, r["cases"]) + where(r) + "\n\n"
    cited = list(contact(coupling))
    return text + (f"## {CONTACT.title}\n\n{section(CONTACT, cited)}" if cited else "")


def kept() -> tuple[dict[str, Row | None], dict[str, Row | None]]:
    """The results of the parts, and of those of coupling that the page cites."""
    parts = {name: results.read(f"validation_{name}") for name in SECTIONS}
    cited = dict.fromkeys(["penetration", *(name for name, *_ in CITED)])
    return parts, {name: results.read(f"coupling_{name}") for name in cited}


def main() -> None:
    """Write docs/validation.md from whatever results there are."""
    OUT.write_text(render(*kept()))
    print(f"wrote {OUT.relative_to(machine.ROOT)}")


if __name__ == "__main__":
    main()
