"""What sand does to a body hardly depends on how time is cut: rigid steps of 1, 4 or 16 substeps, or of halved ones.

Two scenes in plane strain: a box as dense as sand that falls on a bed, and an arm that presses its paddle into one.
Other schemes hand MJX a force that is a rigid step old, or pay a rigid step's impulse at once: there the number of
substeps changes the answer. Half a second: while an arm moves, MuJoCo's own answer to its motors differs by more (its
speed by a quarter between steps of 4 ms and of 0.25 ms, without any sand).

    python -m benchmarks.coupling.refined
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from benchmarks import part
from benchmarks.clock import significant
from benchmarks.coupling import tell_apart as ta
from benchmarks.coupling.drop import drop
from benchmarks.coupling.scenes import Bed, run, trouble
from benchmarks.part import Band

DX = 0.025  # m
H = 2.5e-4  # s, of a substep: half of what the sound speed allows
SECONDS = 0.5
FALL = 0.05  # m, of the box
TIMES = {"16": (H, 16), "4": (H, 4), "1": (H, 1), "half": (H / 2, 16)}  # substep, and substeps a rigid step

HALVED = "Each transfer between grains and grid dissipates, and twice as many do so more: that is the sand, not contact"
WANDERS = "Sand that is seeded at random tips a box a little, which then wanders aside, by less than a tenth of a cell"
BANDS = [
    *(Band("impulse_off", 0.0, 0.02, where={"how": how}) for how in ("1", "4")),
    *(Band("way_off", 0.0, 0.02, WANDERS, {"how": how}) for how in ("1", "4")),
    *(Band(off, 0.0, 0.05, HALVED, {"how": "half"}) for off in ("impulse_off", "way_off")),
]


def dropped() -> Bed:
    """The box above its bed."""
    return drop(2, DX, E=1e6, gap=FALL)


def pressing() -> Bed:
    """The arm above its bed, heavy enough to plough."""
    controls = {"shoulder": [(0.0, 0.0), (0.4, 0.6)], "elbow": [(0.0, 0.0), (0.4, -0.3)]}
    return ta.bed(ta.arm(0.5), ("paddle",), (0, 0.6, 0, 0.2), bodies={"controls": controls})


SCENES: dict[str, Callable[[], Bed]] = {"dropped box": dropped, "pressing arm": pressing}


class Done(NamedTuple):
    """What became of the body."""

    impulse: np.ndarray  # (3,) N s, by the sand, all in all
    moved: np.ndarray  # from the start: (3,) m of a free body, (nq,) rad of an arm
    trouble: list[str]


@cache
def done(name: str, how: str) -> Done:
    """A scene with time cut in one of TIMES."""
    base = SCENES[name]()
    h, substeps = TIMES[how]
    bed = replace(base, rigid_dt=h * substeps, fidelity=base.fidelity | {"mpm_dt": h})
    scene, state = bed.scene(), bed.start()
    assert scene.mpm_per_rigid == substeps
    start = np.asarray(state.rigid.qpos, np.float64)
    count = round(SECONDS / bed.rigid_dt)
    _, steps = run(scene, state, count)
    impulse = steps.reaction[:count, :, :3].sum(axis=(0, 1)) * bed.rigid_dt
    return Done(impulse, (steps.qpos[count - 1] - start)[:3], trouble(steps))


def off(name: str, how: str) -> tuple[float, float]:
    """By what share impulse and way differ from those with 16 substeps a rigid step."""
    one, other = done(name, "16"), done(name, how)
    return tuple(  # type: ignore[return-value]
        float(np.linalg.norm(b - a) / np.linalg.norm(a)) for a, b in zip(one[:2], other[:2], strict=True)
    )


def measure(quick: bool) -> dict[str, Any]:
    """Both scenes, all ways to cut time."""
    rows = []
    for name in SCENES:
        for how in TIMES:
            impulse, way = off(name, how)
            row = {"name": name, "how": how, "impulse_N_s": significant(float(np.linalg.norm(done(name, how).impulse)))}
            row |= {"impulse_off": significant(impulse, 3), "way_off": significant(way, 3)}
            rows.append(dict(part.say(row | {"trouble": done(name, how).trouble})))
    return {"rows": rows, "bands": part.told(BANDS)}


if __name__ == "__main__":
    part.main("coupling_refined", measure, __doc__)
