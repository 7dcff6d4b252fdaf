"""A long rigid footing pressed into a weightless clay and into sand, in plane strain, against limit loads.

    python -m benchmarks.validation.footing [--quick]

The plane x = 0 is a mirror, and the footing a body that is told to go down slowly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from benchmarks import case, job, part
from benchmarks.case import Case, within
from benchmarks.coupling.beds import RHO, G, at_rest, sand
from benchmarks.coupling.scenes import Bed, about, planted, ride, soft_travel
from benchmarks.validation import PLOTS
from mpm_env.plot import Series, plot

CELL = 0.025  # m
HALF = 6.5  # cells of the footing's half: its edge lies between nodes, see the footings of benchmarks/coupling
WIDE, DEEP = 4.0, 2.0  # bed in widths of the footing, from the mirror and down; the slip lines stay inside
FRICTION = 0.6  # of footing and bed: rough
SPEED, RAMP, RIGID_DT = 0.05, 0.05, 0.004  # m/s, s, s
STRENGTH = 5e3  # Pa, of the clay in shear
TRESCA = 2 + np.pi  # Prandtl's q / c
# Exact for a rough footing on sand of 30 degrees whose flow is associated (Martin, program ABC, 2004).
NQ, NGAMMA = 18.40, 14.75
FRICTION_DEG = 30.0

FLOWS = (1.0, 2.0)  # cells of travel over which the load is read off: forces have the period of the grid
CLAY = {"model": "von_mises", "E": 400 * STRENGTH, "nu": 0.3, "rho": RHO}


class Press(NamedTuple):
    """Pressure under a footing on its way down."""

    travel: np.ndarray  # (k,) widths
    pressure: np.ndarray  # (k,) Pa
    width: float  # m
    health: int
    cpu_s: float

    def mean(self, low: float, high: float) -> float:
        """Over a stretch of travel, cells."""
        cells = self.travel * self.width / CELL
        return float(self.pressure[(cells >= low) & (cells < high)].mean())


def press(material: dict[str, Any], gravity: float, *, half: float = HALF, cells: float = 2.2) -> Press:
    """Press a footing so many cells into a bed."""
    width = 2 * half * CELL
    across, deep = (np.ceil(a * width / CELL) * CELL for a in (WIDE, DEEP))
    size = width / 2
    bed = Bed(
        f"""<worldbody><body mocap="true" pos="0 .05 {deep}">
          <geom name="footing" type="box" pos="0 0 {size}" size="{size} .1 {size}"/></body></worldbody>""",
        ("footing",),
        (across, 0.1, deep + 8 * CELL),
        (((0, 0, 0), (across, 0.1, deep)),),
        CELL,
        2,
        friction=FRICTION,
        gravity=gravity,
        rigid_dt=RIGID_DT,
        material=material,
        walls={"z_lower": {"kind": "stick"}},
        speed=1.0,
    )
    scene = bed.scene()

    def pose(travel: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([[0, 0.05, deep - travel]]), about("y", 0)[None]

    state = planted(scene, at_rest(scene, bed.start(), deep, gravity), *pose(0.0))
    steps = int((cells * CELL / SPEED + RAMP / 2) / RIGID_DT)
    done = ride(scene, state, soft_travel(RIGID_DT * np.arange(1, 1 + steps), SPEED, RAMP), pose)
    return Press(done.travel / width, done.force(0)[:, 2] / (0.1 * width / 2), width, int(done.last.health), done.cpu_s)


def bearing(p: Press) -> float:
    """q / c of clay, over a cell of travel once it flows."""
    return p.mean(*FLOWS) / STRENGTH


def weight_factor(p: Press) -> float:
    """N_gamma of sand, over the same cell; what the sand beside the sunken footing adds is taken off by N_q."""
    sunk = CELL * sum(FLOWS) / 2
    return (p.mean(*FLOWS) - RHO * G * sunk * NQ) / (RHO * G * p.width / 2)


def clay(half: float = HALF, yields: float = 2 / np.sqrt(3)) -> Press:
    """Clay without weight; `yields` is twice the shear strength over the uniaxial one."""
    return press(CLAY | {"yield_stress": 2 * STRENGTH / yields}, 0.0, half=half)


def dry(half: float = HALF, friction_fit: str = "plane_strain") -> Press:
    """Dry sand."""
    return press(sand(FRICTION_DEG, 2e6, friction_fit), G, half=half)


def measure(quick: bool) -> dict[str, Any]:
    """Both materials."""
    job.pin(1)
    half = 4.5 if quick else HALF
    soft, hard, told = clay(half), dry(half), f"{2 * half:g} cells wide"
    plot(
        PLOTS / "footing.png",
        f"Pressure under a footing {told}",
        "travel over width",
        "pressure over its limit",
        [
            Series("clay, 5.14 c", soft.travel, soft.pressure / STRENGTH / TRESCA, joined=True),
            Series(
                "sand of 30 degrees, N_gamma 14.75 and N_q 18.4",
                hard.travel,
                hard.pressure / (RHO * G * hard.width * (NGAMMA / 2 + NQ * hard.travel)),
                joined=True,
            ),
        ],
        names="below",
    )
    low, high = NGAMMA * 0.65, NGAMMA * 1.25
    clay_case = Case(
        "footing on clay: q / c", "Prandtl", TRESCA, within(TRESCA, 0.1), bearing(soft), told, soft.cpu_s, soft.health
    )
    name = "footing on sand, phi 30: N_gamma"
    sand_case = Case(name, "Martin 2004", NGAMMA, (low, high), weight_factor(hard), told, hard.cpu_s, hard.health)
    return {"cases": case.say([clay_case, sand_case])}


if __name__ == "__main__":
    part.main("validation_footing", measure, __doc__)
