"""Where a step's time goes: each stage alone, on grains as they are in the middle of a dig and of a collapse.

    python -m benchmarks.stages [--quick]

CPU time on one core, the least of some rounds, in which the stages take turns: other work on the machine only adds to
it, and small differences of medians would drown in that. A stage runs many times inside one compiled program, as it
does in a step, and a call in which it does not run at all is taken off: calls cost more than most stages. Those of the
continuum are in ns per grain and substep. Those of the dig's rigid step, in us, run after a substep of the grains that
is taken off too: it leaves cold caches, in which MJX takes about three times as long as alone. "rest" is what is left.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from benchmarks import job, limits, results
from benchmarks.clock import ROUNDS, cpu_seconds, in_turns, significant
from benchmarks.column import STRIDE, column, kernels_here, program
from benchmarks.coupled import DIG_STEPS, Run, digging
from coupling import bodies
from mpm_env import Scene, State, advance, scripted, sim
from mpm_env.log import Recorder
from mpm_env.mpm import sorting, substep, transfer
from mpm_env.mpm.types import Particles
from mpm_env.sim_contact import Contact, Touch
from mpm_env.view import View, no_reactions, write_frame

REPEAT = 50  # times a stage runs inside one call of its compiled program
DIG_AT = 1.0  # s: the bucket is in the bed
DIG_ROUNDS = 3 * ROUNDS  # most of its stages are small differences of large numbers
FIDELITIES = ("draft", "standard")
PER_SUBSTEP = ("exchange with nodes", "grains stopped")  # the other stages run once per rigid step

ORDERS = {  # substep on grains of which so many are out of order
    "whole substep, sorted": 0.0,
    "whole substep, nearly sorted": sorting.MOST_DISORDER,
    "whole substep, shuffled": 1.0,
}

Stage = Callable[[int], Any]  # runs it so many times


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NoStress:
    """A material without stress, to time the gather without one."""

    history_start: ClassVar[tuple[float, ...]] = (0.0,)

    def update(self, e: Array, history: Array, dt: Array) -> tuple[Array, Array, Array]:
        """Nothing to answer."""
        return e, history, e


def repeated(stage: Callable[[Any], Any], start: Any) -> Stage:
    """A stage run so many times, each on what the one before left, as one compiled call."""
    run = jax.jit(lambda start, times: lax.fori_loop(0, times, lambda _, now: stage(now), start))
    return lambda times: jax.block_until_ready(run(start, times))


def anew(stage: Callable[[Any], Any], given: Any) -> Stage:
    """A stage run so many times on the same values, as one compiled call.

    The barrier ties what it is given to its last result: else XLA would see that it need run only once.
    """

    def again(now: tuple[Any, Any, Array]) -> tuple[Any, Any, Array]:
        given, out, _ = now
        given, mark = lax.optimization_barrier((given, jax.tree.leaves(out)[0].reshape(-1)[-1]))
        return given, stage(given), mark

    out = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(stage, given))
    return repeated(again, (given, out, jnp.zeros((), jax.tree.leaves(out)[0].dtype)))


def seconds(stages: dict[str, Stage], rounds: int) -> dict[str, float]:
    """CPU seconds of each stage at its quickest, without those of a call in which it does not run at all."""
    times = in_turns({(name, n): partial(stage, n) for name, stage in stages.items() for n in (0, REPEAT)}, rounds)
    return {name: (min(times[name, REPEAT]) - min(times[name, 0])) / REPEAT for name in stages}


def continuum(scene: Scene, state: State) -> dict[str, Stage]:
    """The stages of a substep without bodies, and the substep itself."""
    grid, dt, p, kernels = scene.grid, scene.mpm_dt, state.grains, scene.kernels
    (bed,) = scene.beds(state.materials)
    gravity, nobody = jnp.asarray(scene.gravity, scene.dtype), jnp.zeros((0,), jnp.int32)
    to_nodes = partial(substep.to_nodes, grid, dt=dt, gravity=gravity, watched=nobody, kernels=kernels)
    nodes = jax.jit(to_nodes)(p)
    stages = {
        "whole substep": repeated(substeps(scene, state), (p, None)),
        "p2g and grid": anew(to_nodes, p),
        "g2p and material": repeated(lambda p: substep.move(grid, bed, p, nodes, dt, kernels), p),
        "sort, if it were done": repeated(lambda p: sorting.by_cell(sorting.cells(grid, p, scene.spans), p), p),
    }
    order = sorting.by_cell(sorting.cells(grid, p, scene.spans), jnp.arange(p.count))
    for name, share in ORDERS.items():
        now = jax.tree.map(partial(jnp.take, indices=strewn(order, share), axis=-1), p)
        stages[name] = repeated(substeps(scene, state), (now, None))
    if kernels == "xla":
        bare = bed._replace(material=NoStress())
        stages["p2g"] = anew(lambda p: transfer.p2g(grid, p, dt, substep.chunk_of(p)), p)
        stages["g2p"] = repeated(lambda p: substep.move(grid, bare, p, nodes, dt, kernels), p)
    return stages


def strewn(order: Array, share: float) -> Array:
    """Slots (n,) in this order, but for a share that changed places at random; of few, as many are out of order."""
    rng, n = np.random.default_rng(0), order.size
    some = rng.choice(n, round(share * n), replace=False)
    return order.at[some].set(order[rng.permutation(some)])


def substeps(scene: Scene, state: State, boundary: Any = None) -> Callable[[Any], tuple[Particles, Any]]:
    """A substep of the grains, paired with what their boundary carries."""
    beds, gravity = scene.beds(state.materials), jnp.asarray(scene.gravity, scene.dtype)

    def one(now: tuple[Particles, Any]) -> tuple[Particles, Any]:
        p, carry = lax.optimization_barrier(now)
        return substep.substep(scene.grid, beds, p, scene.mpm_dt, gravity, boundary, carry, scene.kernels)

    return one


class OnlyNodes(Contact):
    """The exchange of bodies with nodes alone, with joints that move each time as they did at first."""

    def nodes(self, touch: Touch, v: Array, m: Array) -> tuple[Touch, Array]:
        """See Contact."""
        done, change = super().nodes(touch, v, m)
        return done._replace(q=touch.q, time=touch.time, given=touch.given), change

    def grains(self, touch: Touch, p: Particles) -> tuple[Touch, Particles]:
        """Nothing happens to them."""
        return touch, p


def rigid(run: Run) -> dict[str, Stage]:
    """The whole rigid step, a substep of the grains without bodies, and each stage of the rigid side after such one."""
    scene, state, b = run.scene, run.state, run.scene.bodies
    drives = scripted(scene, run.steps, REPEAT)
    drive = jax.tree.map(lambda rows: rows[0], drives)
    one, p = substeps(scene, state), state.grains

    def after(stage: Callable[[Particles, Any], tuple[Particles, Any]], given: Any) -> Stage:
        return repeated(lambda now: stage(*lax.optimization_barrier((one((now[0], None))[0], now[1]))), (p, given))

    def again(stage: Callable[[Particles, Any], Any], given: Any) -> Stage:
        out = jax.jit(stage)(p, given)
        return after(lambda p, both: (p, (both[0], stage(p, both[0]))), (given, out))

    def whole(now: tuple[State, Array]) -> tuple[State, Array]:
        row = jax.tree.map(lambda rows: lax.dynamic_slice_in_dim(rows, now[1], 1), drives)
        return advance(scene, now[0], row)[0], now[1] + 1

    def opened(d: Any) -> tuple[Any, bodies.Stance]:
        d = d.replace(ctrl=drive.control)
        return bodies.open_step(b, d, bodies.drift(b, d, drive.position, drive.quaternion))

    def mjx(p: Particles, now: tuple[Any, bodies.Stance]) -> tuple[Particles, tuple[Any, bodies.Stance]]:
        d, stance = opened(now[0])
        d = bodies.close_step(b, d, state.rigid.qfrc_applied * scene.rigid_dt, bodies.foreseen(b, stance, d.qvel))
        return p, (bodies.refresh(b, bodies.place(d, drive.position, drive.quaternion)), stance)

    def lookup(p: Particles, stance: bodies.Stance) -> tuple[Array, ...]:
        return tuple(Contact.of(scene, stance, p))[2:]

    def health(p: Particles, touch: Touch) -> tuple[Array, Array]:
        examined = contact.examined(touch, contact.report(touch, touch.q))
        after = sim._examined(scene, state, replace(state, grains=p), examined)
        return after.health, after.left

    d, stance = jax.jit(opened)(state.rigid)
    here = jax.tree.map(lambda a: a.astype(scene.dtype), stance)
    contact = Contact(scene, here, *jax.jit(lookup)(p, here))
    touch = contact.start(d.qvel.astype(scene.dtype))
    return {
        "whole": repeated(whole, (state, jnp.zeros((), jnp.int32))),
        "grains": repeated(one, (p, None)),
        "lookup": again(lookup, here),
        "exchange with nodes": repeated(substeps(scene, state, OnlyNodes(*contact)), (p, touch)),
        "grains stopped": after(lambda p, touch: contact.grains(touch, p)[::-1], touch),
        "MJX": after(mjx, (d, stance)),
        "health check": again(health, touch),
    }


def rigid_step(run: Run) -> dict[str, float]:
    """CPU us of each stage of a rigid step, of the rest, and what it comes to."""
    count, us = run.scene.mpm_per_rigid, {k: 1e6 * s for k, s in seconds(rigid(run), DIG_ROUNDS).items()}
    whole, one = us.pop("whole"), us.pop("grains")
    us = {k: (t - one) * (count if k in PER_SUBSTEP else 1) for k, t in us.items()}
    us = {"grains": one * count} | us
    us |= {"rest": whole - sum(us.values()), "whole": whole, "share on top of grains": whole / us["grains"] - 1}
    us["a frame of the log"] = 1e6 * log_seconds(run.scene, run.state)
    return {k: significant(t, 3) for k, t in us.items()} | {"substeps": count, "slots for grains": run.scene.slots}


def log_seconds(scene: Scene, state: State, frames: int = 10) -> float:
    """CPU seconds to write a frame to a recording."""
    with tempfile.TemporaryDirectory() as folder:
        box, model = scene.config.box, scene.bodies.model if scene.bodies else None
        recipe = {"scene": scene.config.name}
        recorder = Recorder(Path(folder) / "run.rrd", recipe=recipe, model=model, box=(box.lower, box.upper))
        with recorder:
            view, still = View.of(scene, state), no_reactions(scene)
            write = partial(write_frame, recorder, reactions=still, quantity="speed", scalars={})

            def frame(step: int) -> None:
                write(replace(view, time=float(step)), step=step)

            frame(0)
            return median(cpu_seconds(partial(frame, step)) for step in range(1, frames + 1))


def collapse(kernels: str, quick: bool) -> tuple[Scene, State]:
    """The column on its way down."""
    scene = column(10 if quick else 20, kernels=kernels)
    step, state = program(scene)
    for _ in range(round(0.05 / scene.mpm_dt / STRIDE)):
        state = step(state)
    return scene, state


def per_grain(scene: Scene, state: State, rounds: int) -> dict[str, float]:
    """ns per grain and substep of each stage of the continuum, with those that come out as differences."""
    times = seconds(continuum(scene, state), rounds)
    if "p2g" in times:
        times["grid"] = times["p2g and grid"] - times["p2g"]
        times["material"] = times["g2p and material"] - times["g2p"]
    return {"grains": scene.slots} | {name: significant(1e9 * t / scene.slots, 3) for name, t in times.items()}


def measured(kernels: str, quick: bool) -> dict[str, Any]:
    """Both scenes with these kernels."""
    rounds, steps = 3 if quick else ROUNDS, {}
    out: dict[str, Any] = {"column": per_grain(*collapse(kernels, quick), rounds), "dig, rigid step": steps}
    for fidelity in FIDELITIES[:1] if quick else FIDELITIES:
        run = Run(digging(kernels, fidelity), DIG_STEPS)
        for _ in range(round(DIG_AT / run.per_call)):
            run.call()
        steps[fidelity] = rigid_step(run)
    return out | {"dig": per_grain(run.scene, run.state, rounds)}


def main() -> None:
    """Time all stages and write results/stages.json."""
    parser = argparse.ArgumentParser(description="Time by stage.")
    parser.add_argument("--quick", action="store_true", help="smaller scenes, three rounds")
    a = parser.parse_args()
    job.pin(1)
    found, missing = kernels_here()
    seen, by_kernels = [limits.core()], {}
    for kernels in found:
        by_kernels[kernels] = measured(kernels, a.quick)
        seen.append(limits.core())  # minutes after the first look
    content = {"quick": a.quick, "most_disorder": sorting.MOST_DISORDER, "kernels": by_kernels, "left_out": missing}
    results.write("stages", content | {"limits": limits.best(seen) | limits.substep_needs()})


if __name__ == "__main__":
    main()
