"""Sand at rest: what a column bears and how far it settles, whether a heap lies still, and what f32 changes.

python -m benchmarks.validation.rest [--quick]
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import case, job, part
from benchmarks.case import Case, at_most, within
from benchmarks.validation import PLOTS
from benchmarks.validation.blocks import GRAVITY, alive, block, box, example, go, lattice, longest_step
from mpm_env.mpm.materials import Material
from mpm_env.mpm.materials.protocol import lame
from mpm_env.mpm.types import MARGIN, Grid, Particles, Wall
from mpm_env.plot import Series, plot

HEIGHT = 0.2  # m, of all of them
RHO = 1500.0  # kg/m^3
UNIT = float(np.sqrt(HEIGHT / GRAVITY))  # s, in which times are given
FALL = float(np.sqrt(HEIGHT * GRAVITY))  # m/s, in which speeds are
COURANT = 0.6  # of what is stable
DOWN = (0.0, -GRAVITY)

WIDE = 4  # cells, of a column between smooth walls
STIFF = 2e6  # Pa
# Sand that its walls hold up elastically, and sand that yields as it is loaded.
LAWS = {"elastic": {"nu": 0.3, "friction_deg": 30.0}, "yielding": {"nu": 0.1, "friction_deg": 20.0}}
SLOWLY = 20  # times as long as sound takes through the column: so slowly its weight comes up
PIECES = 40  # in which it does

HEAP = 20.0  # degrees, its slope
HEAP_FRICTION = 30.0  # degrees, in plane strain: what it stands up to
IDLE = 100_000  # substeps


def sand(E: float, nu: float, friction_deg: float, fit: str = "triaxial", dtype: str = "float32") -> Material:
    """Dry sand with its angle from a test."""
    return example("sand", dtype, E=E, nu=nu, rho=RHO, friction=np.deg2rad(friction_deg), friction_fit=fit)


def under_weight(grid: Grid, material: Material, p: Particles, surface: np.ndarray) -> Particles:
    """Grains that bear what lies between them and the surface (n,) m above each, strained along y only."""
    lam, mu = lame(material.E, material.nu)
    above = jnp.maximum(jnp.asarray(np.pad(surface, (0, p.count - len(surface)))) - p.x[1] + MARGIN * grid.cell_size, 0)
    strain = -material.rho * GRAVITY * above / (lam + 2 * mu)
    e = jnp.zeros_like(p.e).at[1].set(jnp.expm1(2 * strain))
    tau = jnp.zeros_like(p.tau).at[:3].set(lam * strain).at[1].set((lam + 2 * mu) * strain)
    return replace(p, e=e, tau=tau)


class Column(NamedTuple):
    """A column at rest."""

    depth: np.ndarray  # (n,) of grains below the surface, over HEIGHT
    stress: np.ndarray  # (2, n) on upright and level planes, over rho g HEIGHT, compression positive
    off: float  # rms of the stress on level planes from depth, two cells off the ends
    lateral: float  # stress on upright planes over that on level ones
    settled: float  # of the surface, over the closed form's
    noise: float  # rms speed over FALL
    cpu_s: float


def at_rest_pressure(law: str) -> float:
    """K0 of sand loaded from nothing: max(nu / (1 - nu), (1 - sin) / (1 + sin))."""
    nu, sin = LAWS[law]["nu"], np.sin(np.deg2rad(LAWS[law]["friction_deg"]))
    return float(max(nu / (1 - nu), (1 - sin) / (1 + sin)))


def settlement(law: str) -> float:
    """Of the surface in m: rho g H^2 / 2 M. Flow on the cone keeps the volume, so M = 3 K / (1 + 2 K0) if it yields."""
    nu = LAWS[law]["nu"]
    modulus = STIFF / (1 - 2 * nu) / (1 + 2 * at_rest_pressure(law))  # which is lam + 2 mu at nu / (1 - nu)
    return RHO * GRAVITY * HEIGHT**2 / 2 / modulus


def column(cells: int, law: str = "elastic", *, loaded: bool = False) -> Column:
    """A column with so many cells to its height; `loaded` from nothing, slowly, or started under its weight."""
    dx = HEIGHT / cells
    grid = box((WIDE, cells + 4), dx, lower=Wall("slip"), other=Wall("slip"))
    material = sand(STIFF, **LAWS[law])
    sites = lattice((0, 0), (2 * WIDE, 2 * cells), dx / 2)
    p = block(grid, material, sites, volume=dx**2 / 4)
    dt, n = COURANT * longest_step(grid, material), sites.shape[1]
    go(grid, material, p, dt=dt, steps=0)  # compiles
    began = time.process_time()
    q = p
    if loaded:
        steps = round(SLOWLY * HEIGHT / float(material.wave_speed()) / PIECES / dt)
        for k in range(2 * PIECES):
            share = min((k + 1) / PIECES, 1)
            q = go(grid, material, q, dt=dt, steps=steps, gravity=(0.0, -GRAVITY * share))
    else:
        q = under_weight(grid, material, p, np.full(n, HEIGHT))
        q = go(grid, material, q, dt=dt, steps=round(10 * UNIT / dt), gravity=DOWN)
    cpu = time.process_time() - began
    x, tau, v = (np.asarray(a, np.float64)[:, :n] for a in (q.x, q.tau, q.v))
    depth = 1 - (x[1] / dx - MARGIN) / cells
    stress = -tau[:2] / (RHO * GRAVITY * HEIGHT)
    inside = (depth > 2 / cells) & (depth < 1 - 2 / cells)
    top = sites[1] > HEIGHT - dx / 2
    fell = (np.asarray(p.x, np.float64)[1, :n] - x[1])[top].mean()
    return Column(
        depth,
        stress,
        float(np.sqrt(np.mean((stress[1] - depth)[inside] ** 2))),
        float(stress[0, inside].sum() / stress[1, inside].sum()),
        float(fell / settlement(law)),
        float(np.sqrt(np.square(v).sum(axis=0).mean()) / FALL),
        cpu,
    )


class Heap(NamedTuple):
    """A heap left alone."""

    noise: float  # rms speed over FALL, after ten UNITs
    creep: float  # cells, by the grain that went the furthest in the IDLE substeps after that
    typical: float  # cells, by the grain in the middle
    cpu_s: float


def heap(cells: int, slope_deg: float = HEAP, steps: int = IDLE) -> Heap:
    """Half a heap on a sticking floor, with so many cells to its height against a smooth wall."""
    dx, tan = HEIGHT / cells, np.tan(np.deg2rad(slope_deg))
    grid = box((int(cells / tan) + cells, cells + 4), dx, lower=Wall("stick"), other=Wall("slip"))
    material = sand(1e6, 0.3, HEAP_FRICTION, "plane_strain")
    sites = lattice((0, 0), (2 * grid.cells[0], 2 * cells), dx / 2)
    surface = HEIGHT - tan * sites[0]
    sites, surface = sites[:, sites[1] < surface], surface[sites[1] < surface]
    p = under_weight(grid, material, block(grid, material, sites, volume=dx**2 / 4), surface)
    dt = COURANT * longest_step(grid, material)
    go(grid, material, p, dt=dt, steps=0)  # compiles
    began = time.process_time()
    p = go(grid, material, p, dt=dt, steps=round(10 * UNIT / dt), gravity=DOWN)
    q = go(grid, material, p, dt=dt, steps=steps, gravity=DOWN)
    cpu = time.process_time() - began
    here = alive(p)
    way = np.hypot(*np.asarray(q.x - p.x)[:, here]) / dx
    noise = np.sqrt(np.square(np.asarray(p.v)[:, here]).sum(axis=0).mean()) / FALL
    return Heap(float(noise), float(way.max()), float(np.median(way)), cpu)


def collapse(cells: int, dtype: str, *, friction_deg: float = 30.0) -> tuple[np.ndarray, float]:
    """Grains (2, n), over HEIGHT, of a square column six UNITs after it was let go, and the seconds it took."""
    dx = HEIGHT / cells
    grid = box((5 * cells, cells + 4), dx, lower=Wall("stick"), other=Wall("slip"))
    with jax.enable_x64(dtype == "float64"):
        material = sand(1e6, 0.3, friction_deg, "plane_strain", dtype)
        sites = lattice((0, 0), (2 * cells, 2 * cells), dx / 2)
        p = block(grid, material, sites, volume=dx**2 / 4, dtype=dtype)
        dt = float(np.float32(COURANT * longest_step(grid, material)))  # the same to the bit
        go(grid, material, p, dt=dt, steps=0)  # compiles
        began = time.process_time()
        q = go(grid, material, p, dt=dt, steps=round(6 * UNIT / dt), gravity=DOWN)
        x = np.asarray(q.x, np.float64)[:, : sites.shape[1]] / HEIGHT
    return x, time.process_time() - began


def columns(cells: int) -> list[Case]:
    """Columns started under their weight and loaded slowly."""
    told = f"{cells} cells to the height, f32"
    start, k0 = column(cells), at_rest_pressure("elastic")
    kept = (told, start.cpu_s)
    out = [
        Case("column: stress off depth, rms / rho g H", "statics", 0, at_most(0.02), start.off, *kept),
        Case("column: K0", "nu / (1 - nu)", k0, within(k0, 0.08), start.lateral, *kept),
        Case("column: rms speed / sqrt(g H)", "it stands", 0, at_most(1e-3), start.noise, *kept),
    ]
    for law, why in {"elastic": "nu / (1 - nu)", "yielding": "Rankine, active"}.items():
        c, k0 = column(cells, law, loaded=True), at_rest_pressure(law)
        name, kept = f"{law} column loaded slowly", (told, c.cpu_s)
        out.append(Case(f"{name}: K0", why, k0, within(k0, 0.08), c.lateral, *kept))
        out.append(Case(f"{name}: settlement / closed form", "statics", 1, within(1, 0.1), c.settled, *kept))
    if cells == SHOWN:
        show(start)
    return out


SHOWN = 16  # cells of the column that is plotted


def show(c: Column) -> None:
    """Plot stress over depth."""
    ends, k0 = np.array([0.0, 1.0]), at_rest_pressure("elastic")
    series = [
        Series("on level planes", c.depth, c.stress[1], colour=0),
        Series("on upright planes", c.depth, c.stress[0], colour=1),
        Series("depth", ends, ends, True, 0),
        Series("K0 depth", ends, k0 * ends, True, 1),
    ]
    about = (f"A column at rest, {SHOWN} cells high, every grain", "depth / height", "stress / rho g H")
    plot(PLOTS / "column.png", *about, series)


def heaps(cells: int) -> list[Case]:
    """Heaps left alone."""
    h = heap(cells)
    kept, name = (f"{cells} cells to the height, f32", h.cpu_s), f"heap of {HEAP:g} degrees"
    creep = f"{name}: creep in {IDLE} substeps, cells"
    return [
        Case(f"{name}: rms speed / sqrt(g H)", "it stands", 0, at_most(1e-3), h.noise, *kept),
        Case(f"{creep}, the most", "it stands", 0, at_most(0.5), h.creep, *kept),
        Case(f"{creep}, the median", "it stands", 0, at_most(0.01), h.typical, *kept),
    ]


def precision(cells: int) -> list[Case]:
    """What f32 changes of a collapse."""
    (narrow, once), (wide, again) = (collapse(cells, dtype) for dtype in ("float32", "float64"))
    off, told = float(np.hypot(*(narrow - wide)).max()), f"{cells} cells to the height"
    return [Case("collapse in f32: largest way from f64's / H", "f64", 0, at_most(1e-3), off, told, once + again)]


def measure(quick: bool) -> dict[str, Any]:
    """All cases at two sizes, or one."""
    job.pin(1)
    cases = []
    for cells in (8,) if quick else (8, SHOWN, 32):
        cases += case.say(columns(cells))
    for cells in (8,) if quick else (8, SHOWN):
        cases += case.say(heaps(cells))
    return {"cases": cases + case.say(precision(8 if quick else SHOWN))}


if __name__ == "__main__":
    part.main("validation_rest", measure, __doc__)
