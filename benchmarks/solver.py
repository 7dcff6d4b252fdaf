"""The trade of the semi-implicit solver: cost and error of a sand column's collapse, soft and as stiff as sand is.

python -m benchmarks.solver    # five minutes; results/solver.json and docs/solver.md
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks import clock, machine, results
from mpm_env import Scene, State, build, initial
from mpm_env.fidelity import Fidelity
from mpm_env.scene_config import read_scene
from mpm_env.sim import advance, scripted

COARSE, FINE, REFERENCE = 2, 4, 8  # cells to 25 mm: 16, 32 and 64 to the column's height
BIN, RHO, THICKNESS = 0.025, 1600.0, 0.1  # m, kg/m^3, m
WALK = 0.04  # s that one program simulates
COURANTS = {1e6: (0.5, 2.0, 5.0, 10.0, 20.0), 1e8: (2.0, 5.0, 10.0, 20.0, 50.0, 100.0)}  # by Young's modulus, Pa


def column(E: float, cells: int, **numerics: Any) -> Scene:
    """The shipped collapse in plane strain, 1 s of it, with sand of this modulus."""
    settings = (f"grains.0.material.E={E}", "speed=1.0")
    return build(read_scene("column_collapse_2d", settings), Fidelity(cells=cells, **numerics))


def fall(scene: Scene) -> Callable[[], State]:
    """One run from start to end."""
    start = jax.jit(partial(initial, scene))(jax.random.key(0))
    program = jax.jit(partial(advance, scene))
    drive = scripted(scene, 0, round(WALK / scene.rigid_dt))

    def go() -> State:
        state = start
        for _ in range(round(scene.config.duration / WALK)):
            state, _ = program(state, drive)
        return jax.block_until_ready(state)

    return go


def profile(scene: Scene, state: State) -> np.ndarray:
    """Mean height (m) of the sand in bins of an eighth of the column's height."""
    x, m = np.asarray(scene.world(state.grains.x), float)[0], np.asarray(state.grains.m, float)
    edges = np.arange(0, scene.config.box.upper[0] + BIN / 2, BIN)
    return np.histogram(x, edges, weights=m / (RHO * THICKNESS * BIN))[0]


def measure(E: float) -> list[dict[str, Any]]:
    """A row for each variant, against explicit steps on the finest grid."""
    fine = column(E, REFERENCE)
    right = profile(fine, fall(fine)())
    scenes = {
        "explicit, native": column(E, COARSE),
        "explicit, native, twice as fine": column(E, FINE),
        "explicit, plain XLA": column(E, COARSE, kernels="xla"),
    } | {f"semi_implicit, courant {c:g}": column(E, COARSE, solver="semi_implicit", courant=c) for c in COURANTS[E]}
    jobs = {name: fall(scene) for name, scene in scenes.items()}
    times = clock.in_turns(jobs)
    rows = []
    for name, scene in scenes.items():
        state = jobs[name]()
        reached = float(scene.materials[0].wave_speed()) * scene.mpm_dt / scene.grid.cell_size
        error = np.abs(profile(scene, state) - right).sum() / right.sum()
        rows.append(
            {
                "E_Pa": E,
                "variant": name,
                "kernels": scene.kernels,
                "courant": clock.significant(reached, 3),
                "cpu_per_sim_s": clock.spread(times[name], 3),
                "profile_error": clock.significant(float(error), 3),
                "health": int(state.health),
            }
        )
        print(rows[-1], flush=True)
    return rows


def page(rows: list[dict[str, Any]], about: dict[str, Any]) -> str:
    """docs/solver.md."""
    lines = [
        "# Explicit or semi-implicit",
        "",
        "Made by `python -m benchmarks.solver`; not written by hand. A column of sand, 16 cells high, collapses in"
        " plane strain (512 grains). Cost is CPU seconds per simulated second, the median of five with the least and"
        " the most; the error that of the final profile (area between it and that of explicit steps at 64 cells, over"
        " the area of the sand). The Courant number is the one reached: grains may cross half a cell in a substep."
        " Sand's strength does not depend on its modulus: where softer sand will do, explicit steps are cheapest.",
        "",
        f"{about['cpu']}, {about['cores']} cores; {about['versions']}; commit {about['commit']}, {about['date']}.",
    ]
    for E in COURANTS:
        lines += ["", f"## E = {E:.0e} Pa", "", "| variant | Courant | CPU s | error |", "| --- | --- | --- | --- |"]
        for row in rows:
            if row["E_Pa"] == E:
                t = row["cpu_per_sim_s"]
                cost = f"{t['median']:g} ({t['min']:g} to {t['max']:g})"
                well = "" if row["health"] == 0 else " (unwell)"
                lines.append(f"| {row['variant']} | {row['courant']:g} | {cost} | {row['profile_error']:.3f}{well} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, keep, tell."""
    rows = [row for E in COURANTS for row in measure(E)]
    results.write("solver", {"rows": rows})
    kept = results.read("solver") or {}
    (machine.ROOT / "docs" / "solver.md").write_text(page(rows, kept["about"]))


if __name__ == "__main__":
    main()
