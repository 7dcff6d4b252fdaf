"""What bodies in the sand cost: the digging scene as users run it, and a box dropped on 48 672 grains.

    python -m benchmarks.coupled [--quick]

CPU seconds per simulated second on one core. The drop is a test as well: a box as dense as sand falls 5 cm on a bed,
and must settle on it, not bounce. Other codes do the same job in benchmarks/peers.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks import box, job, results
from benchmarks.clock import ROUNDS, cpu_seconds, significant, spread
from benchmarks.column import MATERIALS, kernels_here
from benchmarks.compare import in_rounds
from mpm_env import Fidelity, Scene, SceneConfig, State, advance, build, initial, load_fidelity, read_scene, scripted

DIG_STEPS, DROP_STEPS = 25, 5  # rigid steps in one call; the box is looked at after each
XML = """
<mujoco>
  <worldbody>
    <body name="box" pos="0 0 {z}">
      <freejoint/>
      <geom name="box" type="box" size="{size}" density="{rho}"/>
    </body>
  </worldbody>
</mujoco>
"""


def box_drop(kernels: str) -> Scene:
    """The box above its bed."""
    width, _, height = box.BED
    lower, upper = [-width / 2, -width / 2, 0.0], [width / 2, width / 2]
    fill = {"shape": "box", "lower": lower, "upper": [*upper, height]}
    size = " ".join(map(str, box.HALF))
    data = {
        "name": "box_drop",
        "box": {"lower": lower, "upper": [*upper, 2 * height]},
        "feature": 2 * box.DX,
        "gravity": [0.0, 0.0, -job.GRAVITY],
        "duration": box.DURATION,
        "walls": {"z_lower": {"kind": "separate", "friction": job.FLOOR_FRICTION}},
        "grains": [{"material": MATERIALS["sand"] | {"E": box.E}, "fill": [fill]}],
        "bodies": {
            "mjcf": XML.format(z=height + box.DROP + box.HALF[2], size=size, rho=job.RHO),
            "couple": ["box"],
            "friction": box.FRICTION,
        },
    }
    return build(SceneConfig(**data), Fidelity(cells=2, kernels=kernels))


def digging(kernels: str, fidelity: str) -> Scene:
    """The shipped digging scene."""
    return build(read_scene("bucket_dig"), load_fidelity(fidelity, [f"kernels={kernels}"]))


class Run:
    """A scene on its way, timed call by call."""

    def __init__(self, scene: Scene, stride: int) -> None:
        self.scene, self.stride, self.steps = scene, stride, 0
        self.program = jax.jit(partial(advance, scene))
        self.state: State = initial(scene, jax.random.key(0))
        jax.block_until_ready(self.program(self.state, scripted(scene, 0, stride)))  # compiles
        self.speeds: list[float] = []  # m/s upward, of the first body

    def call(self) -> None:
        """A stride of rigid steps further."""
        self.state, _ = jax.block_until_ready(self.program(self.state, scripted(self.scene, self.steps, self.stride)))
        self.steps += self.stride
        self.speeds.append(float(self.state.rigid.qvel[2]))

    @property
    def per_call(self) -> float:
        """Seconds simulated by a call."""
        return self.stride * self.scene.rigid_dt

    def timed(self, calls: int) -> dict[str, Any]:
        """CPU seconds per simulated second over the next calls."""
        seconds = [cpu_seconds(self.call) / self.per_call for _ in range(calls)]
        return {
            "grains": int(np.count_nonzero(np.asarray(self.state.grains.m))),
            "substeps": self.scene.mpm_per_rigid,
            "t_sim": significant(calls * self.per_call),
            "cpu_per_sim_s": spread(seconds),
            "mean_cpu_per_sim_s": significant(sum(seconds) / len(seconds)),
            "health": int(self.state.health),
        }


def dropped(run: Run) -> dict[str, Any]:
    """What became of the box after a whole run, and how much of its weight the bed carries."""
    weight = float(run.scene.bodies.model.body_mass.sum() * job.GRAVITY)
    carried = significant(float(run.state.reaction[0, 2]) / weight, 4)
    return box.verdict(run.speeds, run.per_call) | {"reaction_over_weight": carried}


def measured(kernels: str, quick: bool) -> dict[str, Any]:
    """Both jobs with these kernels."""
    run = Run(digging(kernels, "draft" if quick else "standard"), DIG_STEPS)
    out = {"dig": run.timed(ROUNDS)}
    drop = Run(box_drop(kernels), DROP_STEPS)
    calls = ROUNDS if quick else round(box.DURATION / drop.per_call)
    out["drop"] = drop.timed(calls) | ({} if quick else dropped(drop))
    return out


def newton(venvs: Path | None, quick: bool) -> tuple[dict[str, Any], list[str]]:
    """The drop in Newton, with its default single coupling pass and with four; and a word if it is not here."""
    python = (venvs or Path()) / "newton" / "bin" / "python"
    if venvs is None or not python.exists():
        return {}, ["newton: needs an environment called newton in the folder of --peers."]
    tend = str(0.2 if quick else box.DURATION)
    words = [str(python.absolute()), "-m", "benchmarks.peers.newton_box", "--tend", tend, "--iterations"]
    return in_rounds({f"{passes} passes": [*words, str(passes)] for passes in ((1,) if quick else (1, 4))}, 1, {})


def main() -> None:
    """Time both jobs and write results/coupled.json."""
    parser = argparse.ArgumentParser(description="Cost of coupled scenes.")
    parser.add_argument("--quick", action="store_true", help="coarser, and only the start of the drop")
    parser.add_argument("--peers", type=Path, help="folder of virtual environments; see compare.py")
    a = parser.parse_args()
    job.pin(1)
    found, missing = kernels_here()
    content: dict[str, Any] = {"quick": a.quick}
    content["kernels"] = {kernels: measured(kernels, a.quick) for kernels in found}
    content["newton"], failed = newton(a.peers, a.quick)
    content["left_out"] = [*missing, *failed]
    results.write("coupled", content)


if __name__ == "__main__":
    main()
