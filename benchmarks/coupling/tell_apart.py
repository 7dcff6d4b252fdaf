"""The scenes that tell coupling schemes apart: light bodies that much sand holds, alone, at a wall, at a joint's limit.

A dropped box hardly does: it is caught by the light nodes above the bed. In plane strain; bodies are 100 times as light
as their volume of sand, unless said.

    python -m benchmarks.coupling.tell_apart [--quick]
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import part
from benchmarks.coupling.beds import lighter
from benchmarks.coupling.scenes import Bed, Steps, run, trouble
from benchmarks.part import Band, kept
from coupling import meeting
from coupling.contact import Points, Surface
from coupling.exchange import Exchange, Twists, exchange
from mpm_env import Scene, State

DX = 0.025  # m
WIDE = 0.1  # m, of the slice
MID = WIDE / 2
LAST = 50  # rigid steps at the end, over which forces are looked at

STEPS = 250  # rigid steps, a second
ASTRAY_STEPS = 100  # of a negative control, which has been thrown about by then
OURS = "together"
BANDS = (
    Band("fastest", 0.0, 0.5, where={"scheme": OURS, "told": False}),
    Band("fastest", 0.0, 4.0, where={"scheme": OURS, "told": True}),
    Band("noise", 0.0, 0.1, where={"scheme": OURS}),
    Band("astray_cells", 0.0, 0.01, where={"scheme": OURS}),
    Band("unpaid", 0.0, 1e-6, where={"scheme": OURS}),
)

BOX = f'<geom name="box" type="box" size=".1 {MID} .05" density="1500"/>'
# MuJoCo's contacts are as soft as a body is light: its default lets sand press a box of foam centimetres into a floor.
HARD = 'priority="1" solimp=".9999 .9999 .001"'
WALL = f'<geom name="wall" type="plane" size="1 1 1" zaxis="1 0 0" {HARD}/>'
FLOOR = f'<geom name="floor" type="plane" size="1 1 1" {HARD}/>'


def bed(mjcf: str, couple: tuple[str, ...], *fills: tuple[float, float, float, float], **more: object) -> Bed:
    """A bed of 0.6 x 0.4 m with sand in these (x, x, z, z) m."""
    corners = tuple(((a, 0.0, c), (b, WIDE, d)) for a, b, c, d in fills)
    how = {"contact_iterations": 8}  # light bodies take more than the default
    return Bed(mjcf, couple, (0.6, WIDE, 0.4), corners, DX, 2, fidelity=how, **more)  # type: ignore[arg-type]


@cache
def buried() -> Bed:
    """A free box, its top flush with the surface."""
    body = f'<worldbody><body pos=".3 {MID} .15"><freejoint/>{BOX}</body></worldbody>'
    return bed(body, ("box",), (0, 0.2, 0, 0.2), (0.4, 0.6, 0, 0.2), (0.2, 0.4, 0, 0.1))


@cache
def at_the_wall() -> Bed:
    """A free box between sand and a rigid wall, on a rigid floor."""
    body = f'<worldbody>{WALL}{FLOOR}<body pos=".1 {MID} .05"><freejoint/>{BOX}</body></worldbody>'
    return bed(body, ("box",), (0.2, 0.5, 0, 0.25))


@cache
def on_the_floor() -> Bed:
    """A free box under sand on a rigid floor."""
    body = f'<worldbody>{FLOOR}<body pos=".3 {MID} .05"><freejoint/>{BOX}</body></worldbody>'
    return bed(body, ("box",), (0, 0.2, 0, 0.2), (0.4, 0.6, 0, 0.2), (0.2, 0.4, 0.1, 0.2))


@cache
def squeezed() -> Bed:
    """Two boxes on slides that press on the sand between them, with 10 N each."""
    sides = "".join(
        f"""<body pos="{x} {MID} .1"><joint name="{name}" type="slide" axis="{axis} 0 0"/>
          <geom name="{name}" type="box" size=".05 {MID} .095" density="1500"/></body>"""
        for name, x, axis in (("left", 0.1, 1), ("right", 0.5, -1))
    )
    motors = "".join(f'<motor name="{name}" joint="{name}"/>' for name in ("left", "right"))
    model = f"<worldbody>{sides}</worldbody><actuator>{motors}</actuator>"
    push = {name: [(0.0, 0.0), (0.1, 10.0)] for name in ("left", "right")}
    return bed(model, ("left", "right"), (0.15, 0.45, 0, 0.15), bodies={"controls": push})


def arm(mass: float, limit: str = "") -> str:
    """An arm of two links with a paddle of this mass (kg), over a bed."""
    return f"""<worldbody><body pos=".1 {MID} .35">
        <joint name="shoulder" axis="0 1 0" damping="{2.2 * mass}" armature="{0.02 * mass}"/>
        <geom type="capsule" size=".01" fromto="0 0 0 .2 0 0" mass="{0.6 * mass}"/>
        <body pos=".2 0 0"><joint name="elbow" axis="0 1 0" damping="{2.2 * mass}" armature="{0.02 * mass}" {limit}/>
          <geom name="paddle" type="box" size=".025 {MID} .05" pos="0 0 -.05" mass="{mass}"/></body>
      </body></worldbody>
      <actuator><position name="shoulder" joint="shoulder" kp="{100 * mass}"/>
        <position name="elbow" joint="elbow" kp="{100 * mass}"/></actuator>"""


@cache
def light_arm() -> Bed:
    """An arm with a paddle of 20 g that is told to press into the bed."""
    controls = {"shoulder": [(0.0, 0.0), (0.3, 0.6)], "elbow": [(0.0, 0.0), (0.3, -0.3)]}
    return bed(arm(0.02), ("paddle",), (0, 0.6, 0, 0.2), bodies={"controls": controls})


@cache
def at_the_limit() -> Bed:
    """A gate of 20 g on a hinge, which sand on one side presses against its limit."""
    gate = f"""<worldbody><body pos=".2 {MID} .3">
        <joint name="hinge" axis="0 1 0" limited="true" range="-1 0" damping=".001"/>
        <geom name="gate" type="box" size=".025 {MID} .14" pos="0 0 -.14" mass=".02"/></body></worldbody>"""
    return bed(gate, ("gate",), (0.225, 0.6, 0, 0.2), friction=0.2)


def explicit(p: Points, t: Twists, q_free: jax.Array, surface: Surface, body_of: tuple[int, ...], _: int) -> Exchange:
    """Negative control: the same law at the velocity without contact, its impulses paid at once."""
    done = staggered(p, t, q_free, surface, body_of, 0)
    pull = jnp.einsum("gkn,gk->n", t.J[np.asarray(body_of)], done.wrench)
    return done._replace(q=q_free + jnp.linalg.solve(t.M, pull))


def staggered(p: Points, t: Twists, q_free: jax.Array, surface: Surface, body_of: tuple[int, ...], _: int) -> Exchange:
    """Negative control: bodies go as without grains, and get the impulses at the rigid step's end."""
    as_told = t._replace(J=t.J[:, :, :0], M=t.M[:0, :0], d=t.J @ q_free + t.d, rows=None)
    done = exchange(p, as_told, q_free[:0], surface, body_of, 0)
    return done._replace(q=q_free, given=jnp.zeros_like(t.rows.D) if t.rows else done.given)


@contextmanager
def control(scheme: Callable[..., Exchange]) -> Iterator[None]:
    """Contact by a negative control, in scenes that are first compiled here; on plain XLA."""
    ours = meeting.exchange
    meeting.exchange = scheme
    try:
        yield
    finally:
        meeting.exchange = ours


class Held(NamedTuple):
    """How a body was held."""

    fastest: float  # m/s or rad/s, of any joint
    force: float  # N, size of the mean force on all bodies at the end
    noise: float  # rms of each rigid step's force about the mean, over the mean
    astray: float  # cells, by which MJX moved a body otherwise than grains saw
    unpaid: float  # share of the impulse
    trouble: list[str]


def held(scene: Scene, state: State, count: int) -> tuple[Held, Steps]:
    """So many rigid steps from here."""
    _, steps = run(scene, state, count)
    force = (
        steps.reaction[-LAST:, :, :3].sum(axis=1) if len(scene.bodies.bodies) == 1 else steps.reaction[-LAST:, 0, :3]
    )
    mean = force.mean(axis=0)
    size = np.linalg.norm(mean)
    return Held(
        float(np.abs(steps.qvel).max()),
        float(size),
        float(np.sqrt(np.mean(np.sum((force - mean) ** 2, axis=1))) / size) if size else np.inf,
        float(steps.contact.astray.max() / scene.grid.cell_size),
        float(steps.contact.unpaid.max()),
        trouble(steps),
    ), steps


SCENES: dict[str, tuple[Callable[[], Bed], float]] = {  # with the density ratio
    "buried": (buried, 0.01),
    "at the wall": (at_the_wall, 0.01),
    "on the floor": (on_the_floor, 0.01),
    "squeezed": (squeezed, 0.01),
    "light arm": (light_arm, 1.0),
    "at the limit": (at_the_limit, 1.0),
}


def told_apart(name: str, scheme: Callable[..., Exchange] | None = None, count: int = 150) -> Held:
    """A scene by our scheme or by a control."""
    make, ratio = SCENES[name]
    scene, state = make().scene(), lighter(make().start(), ratio)
    if scheme is None:
        return held(scene, state, count)[0]
    with control(scheme):
        return held(replace(scene, kernels="xla"), state, count)[0]


CONTROLS: dict[str, Callable[..., Exchange]] = {"explicit": explicit, "staggered": staggered}
UNDER_CONTROL = "buried"


def measure(quick: bool) -> dict[str, Any]:
    """All scenes by our scheme, and one by the negative controls."""
    jobs = [(name, OURS) for name in SCENES] + [(UNDER_CONTROL, scheme) for scheme in CONTROLS]
    rows = []
    for name, scheme in jobs:
        count = (STEPS if scheme == OURS else ASTRAY_STEPS) // (2 if quick else 1)
        done = told_apart(name, CONTROLS.get(scheme), count)
        row = {
            "name": name,
            "scheme": scheme,
            "told": name == "light arm",
            "ratio": SCENES[name][1],
            "seconds": count * 0.004,
            "fastest": kept(done.fastest),
            "force_N": kept(done.force),
            "noise": kept(done.noise),
            "astray_cells": kept(done.astray),
            "unpaid": kept(done.unpaid),
            "trouble": done.trouble,
        }
        rows.append(part.say(row))
    return {"rows": rows, "bands": part.told(BANDS)}


if __name__ == "__main__":
    part.main("coupling_tell_apart", measure, __doc__)
