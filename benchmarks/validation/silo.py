"""Grains out of a slot: how fast, over the slot's width and over how full the silo still is.

    python -m benchmarks.validation.silo [--quick]

A slice of a flat silo, the plane x = 0 its mirror. The floor is a body that is moved aside, so that one scene serves
all slots; grains leave through the open wall below.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import case, job, part
from benchmarks.case import Case, at_most, within
from benchmarks.coupling.beds import RHO, G, sand
from benchmarks.coupling.fits import exponent
from benchmarks.coupling.scenes import Bed, about, planted, run
from benchmarks.validation import PLOTS
from benchmarks.validation.flows import Clock, mass
from mpm_env import scripted
from mpm_env.plot import Series, plot

CELL = 0.01  # m
HALF, HIGH, FLOOR, BELOW = 30, 80, 4, 6  # cells: half of the silo, grains, floor, and the fall below it
RIGID_DT, ROWS = 0.002, 10  # s, and rigid steps between two looks
PATIENCE = 10.0  # s
EARLY, LATE = (0.1, 0.25), (0.45, 0.55)  # share that has left, for the flow while the silo is full and half full

# Jop et al. 2006 with the numbers of the reference; E as soft as its weight allows
MU_I = {
    "model": "mu_i",
    "E": 1e6,
    "nu": 0.3,
    "rho": RHO,
    "mu_s": 0.32,
    "mu_2": 0.60,
    "I_0": 0.4,
    "grain_size": CELL / 2,
    "grain_density": 2500.0,
}


class Outflow(NamedTuple):
    """What left a silo, for both halves of the slot, per thickness."""

    width: float  # m, of the slot
    early: float  # kg/s per m
    late: float  # kg/s per m
    missing: float  # share of the mass that is neither there nor counted as gone
    health: int
    cpu_s: float

    @property
    def prefactor(self) -> float:
        """C of Q = C rho sqrt(g) D^1.5, rho that of the bed at rest."""
        return float(self.early / (RHO * np.sqrt(G) * self.width**1.5))


DRY, FLUID = sand(25.0, 1e6), sand(0.0, 1e6)  # of friction that does not know the speed, and of none


@cache
def silo(friction: str, half: int, high: int) -> Bed:
    """A silo so many cells wide, from its mirror, and high, of MU_I, DRY or FLUID; the floor covers all of it."""
    wide, ground = half * CELL, BELOW * CELL
    top, thick = ground + FLOOR * CELL, FLOOR * CELL / 2
    return Bed(
        f"""<worldbody><body mocap="true" pos="0 .05 {ground}">
          <geom name="floor" type="box" pos="{wide} 0 {thick}" size="{wide} .1 {thick}"/></body></worldbody>""",
        ("floor",),
        (wide, 0.1, top + (high + 4) * CELL),
        (((0, 0, top), (wide, 0.1, top + high * CELL)),),
        CELL,
        2,
        friction=0.5,
        rigid_dt=RIGID_DT,
        material={"mu_i": MU_I, "dry": DRY, "fluid": FLUID}[friction],
        walls={"z_lower": {"kind": "open"}},
        speed=3.0,
    )


def drain(friction: str, slot: float, *, half: int = HALF, high: int = HIGH) -> Outflow:
    """Open a slot whose half is so many cells wide, and let flow until more than half is out."""
    scene, bed = silo(friction, half, high).scene(), silo(friction, half, high)
    state = planted(scene, bed.start(), np.array([[slot * CELL, 0.05, BELOW * CELL]]), about("y", 0)[None])
    begin = mass(state)
    still = scripted(scene, 0, ROWS)._replace(position=jnp.tile(state.rigid.mocap_pos, (ROWS, 1, 1)))
    run(scene, state, ROWS, still, rows=ROWS)  # compiles
    clock, times, left = Clock(), [0.0], [0.0]
    while left[-1] < LATE[1] and times[-1] < PATIENCE:
        state, _ = run(scene, state, ROWS, still, rows=ROWS)
        times.append(times[-1] + ROWS * RIGID_DT)
        left.append(float(state.left) / begin)
    per_m = 2 * begin / 0.1

    def rate(window: tuple[float, float]) -> float:
        t = np.interp(window, left, times)
        return per_m * (window[1] - window[0]) / float(t[1] - t[0])

    there = mass(state) + float(state.left)
    return Outflow(2 * slot * CELL, rate(EARLY), rate(LATE), abs(1 - there / begin), int(state.health), clock.cpu_s)


SLOTS = (4.5, 6.5, 8.5, 10.5)  # cells, half a slot; its edge lies between nodes
STARON = "Staron et al. 2012, mu(I)"
REFERENCE = 1.435  # C of a slot in plane strain, both for mu(I) and for discs
NARROW = "Of the narrowest slots: from 13 to 21 cells the power is 1.6, from 9 to 13 it is 1.8"


def measure(quick: bool) -> dict[str, Any]:
    """Slots of both materials."""
    job.pin(1)
    slots, series, cases = SLOTS[::3] if quick else SLOTS, [], []
    for friction, told in {"mu_i": "mu(I)", "dry": "friction of 25 degrees"}.items():
        done = [drain(friction, slot) for slot in slots]
        wide, flows = np.array([d.width for d in done]), np.array([d.early for d in done])
        cpu_s, health = sum(d.cpu_s for d in done), int(np.bitwise_or.reduce([d.health for d in done]))
        kept = (f"slots of {2 * slots[0]:g} to {2 * slots[-1]:g} cells", cpu_s, health, NARROW)
        half_full = max((d.late / d.early for d in done), key=lambda r: abs(r - 1))
        lost = max(d.missing for d in done)
        cases += [
            Case(f"silo, {told}: power of the slot", STARON, 1.5, (1.35, 1.65), exponent(wide, flows), *kept),
            Case(f"silo, {told}: flow half full over full, the worst", "height", 1.0, within(1, 0.1), half_full, *kept),
            Case(f"silo, {told}: mass missing", "it is counted", 0.0, at_most(1e-5), lost, *kept),
        ]
        if friction == "mu_i":
            most = done[-1].prefactor
            name, kept = f"silo, {told}: C of the widest slot", (f"{2 * slots[-1]:g} cells", *kept[1:])
            cases.append(Case(name, STARON, REFERENCE, within(REFERENCE, 0.25), most, *kept))
        series.append(Series(f"here, {told}", wide / CELL, flows / (RHO * np.sqrt(G * CELL**3))))
    line = np.array([8.0, 24.0])
    plot(
        PLOTS / "silo.png",
        "Flow out of a slot",
        "width, cells",
        "flow / rho sqrt(g cell^3)",
        [*series, Series("Staron et al. 2012: 1.435 D^1.5", line, REFERENCE * line**1.5, joined=True)],
        log=True,
        names="below",
    )
    return {"cases": case.say(cases)}


if __name__ == "__main__":
    part.main("validation_silo", measure, __doc__)
