"""docs/coupling.md from the results: every measured number in it is read from a file in benchmarks/results.

python -m benchmarks.coupling.report
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from benchmarks import case, machine, results
from benchmarks.coupling.words import (
    COST,
    DROP,
    HEAD,
    LIGHT,
    LIMITS,
    MEASURES,
    PENETRATION,
    REFINED,
    SCENES,
    SCHEME,
    SCHEMES,
)
from benchmarks.marks import marked, span, table
from benchmarks.part import Band, Row, bands_of, misses

OUT = machine.ROOT / "docs" / "coupling.md"
FORMATS = {"weight": "{:.3f}", "rests_cells": "{:.2f}", "scatter_cells": "{:.2f}"}  # where two digits say too little
PLOTS = ("walls", "blades", "plates", "balls")


def brief(value: float | None) -> str:
    """A number as short as can be."""
    if value is None:
        return "not finite"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


def seen(result: Row, rows: Sequence[Row], measure: str) -> str:
    """A measure over some rows, marked where one of them lies outside its band."""
    outside = any(b.misses(row) for b in bands_of(result) if b.measure == measure for row in rows)
    how = FORMATS[measure].format if measure in FORMATS else brief
    return marked(span((row[measure] for row in rows), how), outside)


def troubled(rows: Iterable[Row]) -> str:
    """Health bits that were set in any of the rows."""
    return ", ".join(sorted({name for row in rows for name in row["trouble"]})) or "-"


def bounds(result: Row) -> str:
    """What was asked for."""
    alike: dict[tuple[str, float, float], list[Band]] = {}
    for band in bands_of(result):
        alike.setdefault((band.measure, band.low, band.high), []).append(band)
    texts = []
    for (measure, low, high), bands in alike.items():
        ratios = ", ".join(f"{band.where['ratio']:g}" for band in bands if "ratio" in band.where)
        thick = ", ".join(f"{band.where['thick_cells']:g}" for band in bands if "thick_cells" in band.where)
        told = " (told to move)" if bands[0].where.get("told") else ""
        limits = f"at most {high:g}" if low == 0 else f"{low:g} to {high:g}"
        where = f" (density ratio {ratios})" if ratios else f" ({thick} cells thick)" if thick else told
        texts.append(f"{MEASURES[measure]}: {limits}{where}")
    return f"Asked for: {'; '.join(texts)}.\n\n"


def missed(result: Row, of: Callable[[Row], str]) -> str:
    """A line for each measure that misses its band, with what is known about why; `of` names a row."""
    found: dict[tuple[str, str], list[Row]] = {}
    for band, rows in misses(result):
        found.setdefault((band.measure, band.note), []).extend(rows)
    lines = []
    for (measure, note), rows in found.items():
        names = list(dict.fromkeys(of(row) for row in rows))
        total = sum(measure in row for row in result["rows"])
        lines.append(
            f"- **Missed**: {MEASURES[measure]}, in {len(rows)} of {total} runs ({'; '.join(names)})."
            f" {note or 'Why is not known'}."
        )
    return "\n".join(lines) + "\n\n" if lines else "No band is missed.\n\n"


def tell_apart(r: Row) -> str:
    """Light bodies held by sand."""
    measures = ("fastest", "noise", "astray_cells", "unpaid")
    rows = []
    for row in r["rows"]:
        told = {m: seen(r, [row], m) for m in measures}
        if row["force_N"] == 0:
            told["noise"] = "no force left"
        rows.append([SCENES[row["name"]], SCHEMES[row["scheme"]], *told.values(), troubled([row])])
    head = ["scene", "exchange", *(MEASURES[m] for m in measures), "health"]
    return LIGHT + table(head, rows) + "\n" + bounds(r) + missed(r, lambda row: SCENES[row["name"]])


def drop(r: Row) -> str:
    """A dropped box."""
    by = {kind: [row for row in r["rows"] if row["name"] == kind] for kind in ("phase", "stiffness", "cell", "space")}
    scatter = {row["ratio"]: row for row in r["rows"] if row["name"] == "scatter"}
    base = by["phase"][0]
    measures = ("rebound", "rms_m_s", "weight", "rests_cells", "rise", "inside_cells")
    ratios = list(dict.fromkeys(row["ratio"] for row in by["phase"]))
    body = []
    for ratio in ratios:
        rows = [row for row in by["phase"] if row["ratio"] == ratio]
        cells = [f"{ratio:g}", *(seen(r, rows, m) for m in measures), seen(r, [scatter[ratio]], "scatter_cells")]
        body.append([*cells, troubled(rows)])
    head = ["density / sand's", *(MEASURES[m] for m in measures), MEASURES["scatter_cells"], "health"]
    phases = ", ".join(f"{p:g}" for p in dict.fromkeys(row["phase"] for row in by["phase"]))
    text = DROP + (
        f"Plane strain, cells of {1000 * base['cell_m']:g} mm, E = {base['E_Pa'] / 1e6:g} MPa; the bed's surface"
        f" {phases} of a cell above a plane of nodes.\n\n{table(head, body)}\n"
    )
    few, rows = ("rebound", "rms_m_s"), []
    for ratio in dict.fromkeys(row["ratio"] for row in by["stiffness"]):
        for some in (by["phase"], by["stiffness"]):
            same = [row for row in some if row["ratio"] == ratio]
            rows.append([f"{ratio:g}", f"{same[0]['E_Pa'] / 1e6:g}", *(seen(r, same, m) for m in few)])
    text += "Rebound against the sand's stiffness, at the same places:\n\n"
    text += table(["density / sand's", "E, MPa", *(MEASURES[m] for m in few)], rows)
    coarse = [row for row in by["phase"] if row["phase"] == base["phase"]]
    rows = [
        [f"{x['ratio']:g}", f"{1000 * x['cell_m']:g}", seen(r, [x], "rests_cells"), brief(_rest_mm(x))]
        for ratio in dict.fromkeys(row["ratio"] for row in by["cell"])
        for x in coarse + by["cell"]
        if x["ratio"] == ratio
    ]
    text += "\nWhere it rests against the size of cells:\n\n"
    head = ["density / sand's", "cell, mm", MEASURES["rests_cells"], "rests above the surface, mm"]
    text += table(head, rows)
    rows = [[f"{x['ratio']:g}", *(seen(r, [x], m) for m in measures), troubled([x])] for x in by["space"]]
    text += f"\nIn 3-D, cells of {1000 * by['space'][0]['cell_m']:g} mm:\n\n"
    text += table(["density / sand's", *(MEASURES[m] for m in measures), "health"], rows)
    return text + "\n" + bounds(r) + missed(r, _box)


def _rest_mm(row: Row) -> float | None:
    rest = row["rests_cells"]
    return None if rest is None else 1000 * row["cell_m"] * rest


def _box(row: Row) -> str:
    return f"density ratio {row['ratio']:g}"


def blade(r: Row) -> str:
    """A blade through a bed."""
    fine, flat, deep = ([row for row in r["rows"] if row["name"] == name] for name in ("reference", "slice", "3-D"))
    fine += [row for row in r["rows"] if row["name"] == "finer"]
    bands = [b for b in bands_of(r) if b.measure == "over_reference"]
    stretches = list(fine[0]["force_N_m"])
    rows = []
    for x in fine:
        name = f"{x['name']}: cells of {1000 * x['cell_m']:.3g} mm, {1000 * x['thick_m']:g} mm thick"
        forces = [f"{x['force_N_m'][s]:.0f}" for s in stretches]
        rows.append([name, *forces, "", seen(r, [x], "leaked"), troubled([x])])
    for name in dict.fromkeys(map(_thick, flat)):
        some = [x for x in flat if _thick(x) == name]
        cells = [_force(some, s, bands) for s in stretches]
        over = span((x["over_reference"][s] for x in some for s in stretches), lambda v: f"{v:.2f}")
        rows.append([name, *cells, over, seen(r, some, "leaked"), troubled(some)])
    offsets = ", ".join(f"{o:g}" for o in dict.fromkeys(x["offset"] for x in flat))
    text = (
        "10 cm deep, 0.3 m/s. The force in N per metre of width, averaged over stretches of the way, with its spread"
        f" over the blade's place in its cell ({offsets}); plane strain, cells of {1000 * flat[0]['cell_m']:g} mm but"
        " for the references, whose mean the others are held against; the finer one tells how far those have converged."
        " `Passed` is the sand that went from the blade's front to its back.\n\n"
    )
    text += table(["", *stretches, MEASURES["over_reference"], MEASURES["leaked"], "health"], rows)
    rows = []
    for x in deep:
        forces = [f"{force:.0f}" for force in x["force_N_m"].values()]
        rows.append([f"{x['yaw_deg']:g}", f"{x['offset']:g}", *forces, seen(r, [x], "leaked"), troubled([x])])
    (stretch,) = deep[0]["force_N_m"]
    text += (
        f"\nIn 3-D the blade is half as wide as the bed, {deep[0]['thick_cells']:g} cells thick, and sand flows round"
        f" it; cells of {1000 * deep[0]['cell_m']:g} mm.\n\n"
    )
    head = ["yaw, degrees", "offset, cells", f"force along the way, N/m, {stretch}", MEASURES["leaked"], "health"]
    text += table(head, rows)
    return text + "\n" + bounds(r) + missed(r, _thick)


def _thick(row: Row) -> str:
    alone = "" if row.get("push_out", True) else ", by the grid alone"
    return f"{row['thick_cells']:g} cell{'s' * (row['thick_cells'] != 1)} thick{alone}"


def _force(rows: Sequence[Row], stretch: str, bands: Sequence[Band]) -> str:
    """Mean and standard deviation of the force over a stretch, marked where one run lies outside its band."""
    forces = [row["force_N_m"][stretch] for row in rows]
    mean = sum(forces) / len(forces)
    spread = (sum((f - mean) ** 2 for f in forces) / len(forces)) ** 0.5
    return marked(f"{mean:.0f} ± {spread:.0f}", any(band.misses(row, stretch) for band in bands for row in rows))


def penetration(r: Row) -> str:
    """Bodies that go into sand."""
    text = PENETRATION + case.table_of(r["cases"]) + "\n" + case.missed(r["cases"])
    plots = [f"![{name}](coupling/penetration_{name}.png)" for name in PLOTS]
    return text + "\n" + table(plots[:2], [plots[2:]]) + "\n"


def refined(r: Row) -> str:
    """How little the cut of time matters."""
    told = {"16": "16", "4": "4", "1": "1", "half": "16, half as long"}
    rows = [
        [
            row["name"],
            told[row["how"]],
            f"{row['impulse_N_s']:.4g}",
            seen(r, [row], "impulse_off"),
            seen(r, [row], "way_off"),
            troubled([row]),
        ]
        for row in r["rows"]
    ]
    head = ["scene", "substeps a rigid step", "impulse of the sand, N s", "impulse, off by", "way, off by", "health"]
    return REFINED + table(head, rows) + "\n" + bounds(r) + missed(r, lambda row: str(row["name"])) + "\n"


def cost(r: Row) -> str:
    """What bodies cost on top of grains."""
    ways = {"alone": "alone", "map": f"{r['envs']}, mapped", "vmap": f"{r['envs']}, vmapped"}
    rows = [
        [
            fidelity,
            row["grains"],
            told,
            "{median:.2f} [{min:.2f}, {max:.2f}]".format(**row[way]["share"]),
            brief(row[way]["ms_per_rigid_step"]),
        ]
        for fidelity, row in r["dig"].items()
        for way, told in ways.items()
    ]
    head = ["fidelity", "slots for grains", "environments", "bodies on top of grains", "ms per rigid step, at least"]
    return COST + table(head, rows) + "\n"


SECTIONS: dict[str, tuple[str, Callable[[Row], str], tuple[str, ...]]] = {  # part -> title, text, pictures
    "tell_apart": ("Light bodies that sand holds", tell_apart, ("buried", "buried_speed")),
    "drop": ("A dropped box", drop, ("drop",)),
    "blade": ("A blade through a bed", blade, ("blade", "blade_turned")),
    "penetration": ("Into sand, against experiments", penetration, ()),
    "refined": ("However time is cut", refined, ()),
    "cost": ("What it costs", cost, ()),
    "pictures": ("A mesh digs", lambda r: "", ("bucket",)),
}


def where(r: Row) -> str:
    """On what a part was measured."""
    about = r["about"]
    quick = " A quick run, coarser than the full one." if r.get("quick") else ""
    on = f"{about['cpu']}, {about['cores']} cores; {about['versions']}"
    return f"*Commit {about['commit']}, {about['date']}; {on}.*{quick}"


def render(parts: Mapping[str, Row | None]) -> str:
    """The page, from the results of the parts; a part that has none is said to be missing."""
    text = HEAD + SCHEME
    captions = (parts.get("pictures") or {}).get("pictures", {})
    for name, (title, section, pictures) in SECTIONS.items():
        text += f"## {title}\n\n"
        if (r := parts.get(name)) is None:
            text += f"Not measured yet: `python -m benchmarks.coupling {name}`.\n\n"
            continue
        shown = [f"![{captions[p]}](coupling/{p}.png)\n\n{captions[p]}\n\n" for p in pictures if p in captions]
        text += section(r) + "".join(shown) + where(r) + "\n\n"
    return text + LIMITS


def main() -> None:
    """Write docs/coupling.md from whatever results there are."""
    OUT.write_text(render({name: results.read(f"coupling_{name}") for name in SECTIONS}))
    print(f"wrote {OUT.relative_to(machine.ROOT)}")


if __name__ == "__main__":
    main()
