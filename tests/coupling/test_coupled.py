"""Grains and bodies together, in plane strain on small grids: books, balances, and what explicit coupling cannot do."""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from coupling.contact import Points, impulses
from coupling.exchange import Exchange, Twists
from mpm_env import sim
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.health import Health
from mpm_env.mpm.budgets import budgets
from mpm_env.scene import Scene, Sizes, State, build, initial
from mpm_env.scene_config import SceneConfig

DX = 0.025  # m
DT = 0.004  # s, rigid
WIDTH = 0.1  # m, of the slice
G = 9.81
RHO, E = 1500.0, 1e6

SAND = {"model": "sand", "E": E, "nu": 0.3, "rho": RHO, "friction_deg": 35.0}


def fill(x0: float, x1: float, z0: float, z1: float, velocity: tuple = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    return {"shape": "box", "lower": (x0, 0.0, z0), "upper": (x1, WIDTH, z1), "velocity": velocity}


def scene_of(mjcf: str, couple: list[str], fills: list[dict], *, gravity: float = -G, friction: float = 0.4, **bodies: Any) -> Scene:
    config = {
        "name": "small",
        "box": {"lower": (0, 0, 0), "upper": (0.6, WIDTH, 0.4)},
        "feature": 4 * DX,
        "duration": 1.0,
        "gravity": (0, 0, gravity),
        "grains": [{"material": SAND, "fill": fills}],
        "bodies": {"mjcf": mjcf, "couple": couple, "friction": friction, **bodies},
    }
    return build(parse(SceneConfig, config, "test"), Fidelity(dimension=2, cells=4, rigid_dt=DT))


@cache
def program(scene: Scene) -> Any:
    return jax.jit(partial(sim.advance, scene))


def run(scene: Scene, state: State, steps: int) -> tuple[State, np.ndarray]:
    state, reaction = program(scene)(state, sim.scripted(scene, int(state.steps), steps))
    return state, np.asarray(reaction, np.float64)


@cache
def started(scene: Scene, seed: int = 0) -> State:
    return initial(scene, jax.random.key(seed))


def with_sand(state: State, *, density: float = 1.0, friction_deg: float | None = None) -> State:
    """The state with sand so many times as dense and as stiff: the same wave speed, and the same compiled program."""
    (sand,) = state.materials
    sand = replace(sand, rho=sand.rho * density, E=sand.E * density)
    if friction_deg is not None:
        sand = replace(sand, friction=jax.numpy.full_like(sand.friction, np.radians(friction_deg)))
    return replace(state, materials=(sand,), grains=replace(state.grains, m=state.grains.m * density))


@cache
def buried() -> Scene:
    """A free box in sand, its top flush with the surface; as dense as the sand unless that is changed."""
    return scene_of(
        f"""<mujoco><worldbody><body name="box" pos=".3 {WIDTH / 2} .15"><freejoint/>
          <geom name="box" type="box" size=".1 {WIDTH / 2} .05" density="{RHO}"/></body></worldbody></mujoco>""",
        ["box"],
        [fill(0, 0.2, 0, 0.2), fill(0.4, 0.6, 0, 0.2), fill(0.2, 0.4, 0, 0.1)],
    )


@cache
def can() -> Scene:
    """A closed free can full of sand that flies through it, without gravity and far from the walls."""
    wall = f'<geom class="wall" name="{{}}" pos="{{}} 0 {{}}" size="{{}} {WIDTH / 2} {{}}"/>'
    walls = [("left", -0.125, 0, 0.025, 0.15), ("right", 0.125, 0, 0.025, 0.15)]
    walls += [("low", 0, -0.125, 0.1, 0.025), ("high", 0, 0.125, 0.1, 0.025)]
    return scene_of(
        f"""<mujoco><default><default class="wall"><geom type="box" mass=".5"/></default></default>
          <worldbody><body name="can" pos=".2 {WIDTH / 2} .2"><freejoint/>{"".join(wall.format(*w) for w in walls)}
          </body></worldbody></mujoco>""",
        ["*"],
        [fill(0.1, 0.3, 0.1, 0.3, velocity=(1.0, 0.0, 0.0))],
        gravity=0.0,
        friction=2.0,
    )


BLADE = f'<geom name="blade" type="box" size=".025 {WIDTH / 2} .1"/>'
BED = [fill(0, 0.6, 0, 0.2)]
SPEED = 0.3


@cache
def told() -> Scene:
    """A blade on a mocap body, driven through a bed."""
    return scene_of(
        f'<mujoco><worldbody><body name="tool" mocap="true" pos=".2 {WIDTH / 2} .3">{BLADE}</body></worldbody></mujoco>',
        ["blade"],
        [fill(0, 0.175, 0, 0.2), fill(0.225, 0.6, 0, 0.2), fill(0.175, 0.225, 0, 0.15)],
        motion={"tool": [{"t": t, "position": (0.2 + SPEED * t, WIDTH / 2, 0.25)} for t in (0.0, 1.0)]},
    )


@cache
def weighty() -> Scene:
    """The same blade on a slide, so heavy that sand cannot slow it."""
    return scene_of(
        f"""<mujoco><worldbody><body name="tool" pos=".2 {WIDTH / 2} .25"><joint type="slide" axis="1 0 0"/>
          <geom name="blade" type="box" size=".025 {WIDTH / 2} .1" mass="1e9"/></body></worldbody></mujoco>""",
        ["blade"],
        [fill(0, 0.175, 0, 0.2), fill(0.225, 0.6, 0, 0.2), fill(0.175, 0.225, 0, 0.15)],
    )


@cache
def arm() -> Scene:
    """An arm of two links over a bed, its paddle told to go into it."""
    return scene_of(
        f"""<mujoco><worldbody>
          <body pos=".1 {WIDTH / 2} .35"><joint name="shoulder" axis="0 1 0" damping="2" armature=".01"/>
            <geom type="capsule" size=".01" fromto="0 0 0 .2 0 0" mass=".3"/>
            <body pos=".2 0 0"><joint name="elbow" axis="0 1 0" damping="1"/>
              <geom name="paddle" type="box" size=".025 {WIDTH / 2} .05" pos="0 0 -.05" mass=".5"/>
            </body></body></worldbody>
          <actuator><position name="shoulder" joint="shoulder" kp="60"/><position name="elbow" joint="elbow" kp="60"/></actuator>
        </mujoco>""",
        ["paddle"],
        [fill(0, 0.6, 0, 0.2)],
        controls={"shoulder": [(0.0, 0.0), (0.3, 0.6)], "elbow": [(0.0, 0.0), (0.3, -0.3)]},
    )
