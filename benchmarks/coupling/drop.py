"""A box dropped on sand, light or heavy: does it bounce, settle, weigh what it weighs, and where does it rest?

The box of 20 x 20 x 10 cm falls 5 cm on a bed 20 cm deep, as in Newton's example. Below it all stands a rigid floor,
which boxes a hundred times as dense as sand may sink down to.

    python -m benchmarks.coupling.drop [--quick]
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from benchmarks import part
from benchmarks.coupling.beds import RHO, G, lighter
from benchmarks.coupling.scenes import Bed, body_energy, run, settled, shifted, trouble
from benchmarks.part import Band, kept
from mpm_env import State

RATIOS = (0.01, 0.1, 1.0, 10.0, 100.0)  # density of the box over that of sand
HALF = (0.1, 0.1, 0.05)  # m
DEPTH, GAP = 0.2, 0.05  # m
WIDTH = {2: (0.8, 0.2), 3: (0.6, 0.6)}  # m, of the bed along x and y
ABOVE = 2.0  # m, where the box waits while the bed settles
LAST = 0.25  # s at the end, over which rest is measured

DX, E, SECONDS = 0.025, 3e6, 1.25  # m, Pa, s
PHASES = (0.0, 0.25, 0.5, 0.75)  # cells
STIFF = 1e7  # Pa, for STIFF_RATIOS
STIFF_RATIOS = (1.0, 10.0)
FINER = (0.02, 0.0125)  # m, for REST_RATIOS
REST_RATIOS = (0.1, 1.0)
SPACE_RATIOS = (0.1, 1.0, 10.0)  # in 3-D

STORED = (
    "Sand without damping gives back what it stored, so boxes bounce and ring on it; the contact only dissipates, as"
    " the energy shows. Stiffer sand stores less, which helps boxes as dense as sand; heavier ones it hardly helps"
)
HEAVY = "The mean over a quarter of a second of a box that still moves"
DEEP = "It sinks by cells, and still moves at the end; how much of the scatter is that is not known"
BANDS = (
    Band("rise", 0.0, 0.01),
    Band("rebound", 0.0, 0.05, STORED),
    Band("rms_m_s", 0.0, 0.002, STORED),
    Band("weight", 0.99, 1.01, HEAVY),
    Band("inside_cells", 0.0, 0.25),
    *(Band("rests_cells", -0.5, 0.5, where={"ratio": ratio}) for ratio in RATIOS if ratio <= 1),
    Band("scatter_cells", 0.0, 0.2, DEEP),
)


@cache
def drop(dimension: int, dx: float, E: float = E, phase: float = 0.0, gap: float = GAP) -> Bed:
    """The box above its bed, whose surface lies `phase` cells above a plane of nodes."""
    width, across = WIDTH[dimension]
    top = DEPTH + phase * dx
    high = np.ceil((top + gap + 2 * HALF[2] + 0.1) / dx) * dx
    mjcf = f"""<worldbody><geom name="floor" type="plane" size="1 1 1" pos="{width / 2} {across / 2} 0"/>
      <body pos="{width / 2} {across / 2} {top + gap + HALF[2]}"><freejoint/>
      <geom name="box" type="box" size="{HALF[0]} {HALF[1]} {HALF[2]}" density="{RHO}"/></body></worldbody>"""
    return Bed(
        mjcf,
        ("box",),
        (width, across, float(high)),
        (((0, 0, 0), (width, across, top)),),
        dx,
        dimension,
        rigid_dt=0.004 if dx > 0.016 else 0.002,  # s: it falls at 1 m/s, by less than a quarter of a cell each
        material={"E": E},
        fidelity={"contact_iterations": 8},  # for boxes as light as foam
    )


@cache
def settled_below(bed: Bed, ratio: float) -> State:
    """The bed at rest and the box above it."""
    scene, state = bed.scene(), lighter(bed.start(), ratio)
    q = np.array(state.rigid.qpos)
    away = q + np.eye(7)[2] * ABOVE
    state = settled(scene, shifted(scene, state, away, np.zeros(6)))
    return shifted(scene, state, q, np.zeros(6))


class Drop(NamedTuple):
    """What became of a drop."""

    impact: float  # m/s
    up: float  # m/s, fastest upward after the first touch
    rms: float  # m/s, of the vertical speed over the last quarter of a second
    weight: float  # mean force of sand and floor over the box's weight, at the end
    from_sand: float  # mean force of the sand alone over the weight
    rise: float  # largest rise of all energy in a rigid step, over that of the impact
    rises: float  # sum of all rises in energy over that of the impact
    depth: float  # cells, deepest grain inside the box
    gap: float  # cells, from the bed's surface beside it at the start, to the box's underside at the end
    trouble: list[str]


def dropped(bed: Bed, ratio: float, seconds: float) -> tuple[Drop, np.ndarray]:
    """Drop it; also its height (k,) m over the rigid steps."""
    scene = bed.scene()
    count = round(seconds / bed.rigid_dt)
    _, steps = run(scene, settled_below(bed, ratio), count, energy=True)
    mass = scene.bodies.model.body_mass[1]
    gap = scene.bodies.model.qpos0[2] - HALF[2] - bed.fills[0][1][2]
    impact = np.sqrt(2 * G * gap)
    speed, force, few = steps.qvel[:, 2], steps.reaction[:, 0, 2], round(LAST / bed.rigid_dt)
    touched = int(np.argmax(force > 0.01 * mass * G))
    energy = steps.grains + body_energy(scene, steps)
    rises = np.diff(energy)
    kick = 0.5 * mass * impact**2
    total = mass * (np.diff(speed) / bed.rigid_dt + G)  # force on the box, whoever gave it
    return Drop(
        impact=float(impact),
        up=float(speed[touched:].max()),
        rms=float(np.sqrt(np.mean(speed[-few:] ** 2))),
        weight=float(total[-few:].mean() / (mass * G)),
        from_sand=float(force[-few:].mean() / (mass * G)),
        rise=float(rises.max() / kick),
        rises=float(np.maximum(rises, 0).sum() / kick),
        depth=float(steps.contact.depth.max() / bed.dx),
        gap=float((steps.qpos[-1, 2] - HALF[2] - bed.fills[0][1][2]) / bed.dx),
        trouble=trouble(steps),
    ), steps.qpos[:, 2]


def case(name: str, dimension: int, dx: float, ratio: float, E: float = E, phase: float = 0.0) -> dict[str, Any]:
    """A drop as it is kept."""
    done, _ = dropped(drop(dimension, dx, E, phase), ratio, SECONDS)
    return {
        "name": name,
        "dimension": dimension,
        "cell_m": dx,
        "E_Pa": E,
        "phase": phase,
        "ratio": ratio,
        "rebound": kept(max(done.up, 0.0) / done.impact),
        "rms_m_s": kept(done.rms),
        "weight": kept(done.weight),
        "from_sand": kept(done.from_sand),
        "rests_cells": kept(done.gap),
        "rise": kept(done.rise),
        "rises": kept(done.rises),
        "inside_cells": kept(done.depth),
        "trouble": done.trouble,
    }


def scatter(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """By density: between which heights boxes come to rest that differ in nothing but the grid's place."""
    out = []
    for ratio in RATIOS:
        rests = [row["rests_cells"] for row in rows if row["ratio"] == ratio]
        out.append({"name": "scatter", "ratio": ratio, "scatter_cells": kept(max(rests) - min(rests), 3)})
    return out


def measure(quick: bool) -> dict[str, Any]:
    """Drops of all densities at all places of the grid; on stiffer sand; with finer cells; in 3-D."""
    phases, finer = PHASES[:: 2 if quick else 1], FINER[: 1 if quick else 2]
    jobs = [("phase", 2, DX, ratio, E, phase) for phase in phases for ratio in RATIOS]
    jobs += [("stiffness", 2, DX, ratio, STIFF, phase) for phase in phases for ratio in STIFF_RATIOS]
    jobs += [("cell", 2, dx, ratio, E, 0.0) for dx in finer for ratio in REST_RATIOS]
    jobs += [("space", 3, DX if not quick else 2 * DX, ratio, E, 0.0) for ratio in SPACE_RATIOS]
    rows = [dict(part.say(case(*job))) for job in jobs]
    return {"rows": rows + scatter([row for row in rows if row["name"] == "phase"]), "bands": part.told(BANDS)}


if __name__ == "__main__":
    part.main("coupling_drop", measure, __doc__)
