"""Tools that are told where to go, at the extremes: far too fast, rough beyond measure, born inside sand, pressing it.

Either all is finite, bounded and keeps its mass, or a health bit says what is wrong by the first step that is not. In
plane strain; a scene compiles once, and cases differ in drives and states.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from benchmarks.coupling.beds import SAND, G, at_rest, without
from benchmarks.coupling.scenes import Bed, planted
from benchmarks.coupling.tell_apart import squeezed
from mpm_env import Drive, State, build, read_scene
from mpm_env.health import Health
from tests.extremes.watch import (
    FEW,
    Watch,
    assert_kept,
    assert_sound,
    assert_told,
    fall,
    mass_of,
    straight,
    too_fast,
    velocities,
    watched,
    work,
)

DX = 0.025  # m
WIDE = 0.1  # m, of the slice
MID = WIDE / 2
HIGH = 0.4  # m, of the box
DT, SHORT = 0.004, 0.0001  # s, rigid steps for usual tools and for those of up to 60 m/s
SOUND = 30.0  # m/s, of the sand: what was pressed hard comes off about as fast
SPENT = 1e-3  # of a tool's work, by which the grains' energy may rise above it: sums in float32; it never did


def told(geoms: dict[str, str], at: dict[str, tuple[float, float]]) -> str:
    """Mocap bodies of one box each, with these sizes, at these places (x, z) m."""
    return "".join(
        f"""<body name="{name}" mocap="true" pos="{at[name][0]} {MID} {at[name][1]}">
          <geom name="{name}" type="box" size="{size}"/></body>"""
        for name, size in geoms.items()
    )


# One bed on a rigid plane for all tools, which wait beyond its ends until they are wanted.
LENGTH, PLANE, SURFACE = 1.0, 0.05, 0.2  # m
THIN = 0.5 * DX  # of the blade, which reaches from below the floor to above the lid: nothing goes around it
TOOLS = {"blade": (THIN / 2, 0.3), "box": (0.08, 0.05), "left": (0.1, 0.25), "right": (0.1, 0.25), "ram": (0.15, 0.1)}
HALF = np.asarray(list(TOOLS.values()))  # (k, 2) m, half sizes along x and z
AWAY = {name: (-2.0 - i, 0.0) for i, name in enumerate(TOOLS)}  # m, along x and z


@cache
def bed(rigid_dt: float) -> Bed:
    tools = told({name: f"{a} {MID} {c}" for name, (a, c) in TOOLS.items()}, AWAY)
    floor = f'<geom name="floor" type="plane" size="1 1 1" pos="0 0 {PLANE}"/>'
    fill, size = ((0.0, 0.0, PLANE), (LENGTH, WIDE, SURFACE)), (LENGTH, WIDE, HIGH)
    return Bed(f"<worldbody>{floor}{tools}</worldbody>", ("*",), size, (fill,), DX, 2, rigid_dt=rigid_dt)


def places(some: dict[str, tuple[float, float]]) -> np.ndarray:
    """Positions (k, 3) m of the tools, some of them at these (x, z), the others where they wait."""
    return np.array([(x, MID, z) for x, z in (AWAY | some).values()])


def speeds(some: dict[str, tuple[float, float]]) -> np.ndarray:
    """Velocities (k, 3) m/s of the tools, of some of them these along x and z."""
    return np.array([(x, 0, z) for x, z in (dict.fromkeys(TOOLS, (0.0, 0.0)) | some).values()])


def inside(state: State, at: np.ndarray, half: np.ndarray = HALF) -> Any:
    """Which grains (n,) are inside tools at these positions (k, 3) m."""
    x = bed(DT).scene().world(state.grains.x)[jnp.asarray([0, 2])]
    return jnp.any(jnp.all(jnp.abs(x - at[:, [0, 2], None]) < half[..., None], axis=1), axis=0)


def placed(rigid_dt: float, at: np.ndarray, *, full: bool = False) -> State:
    """The bed at rest with its tools at these positions (k, 3) m, without the sand that is there, unless left full."""
    scene = bed(rigid_dt).scene()
    state = at_rest(scene, bed(rigid_dt).start(), SURFACE)
    state = planted(scene, state, at, np.tile([1.0, 0, 0, 0], (len(at), 1)))
    return state if full else without(state, inside(state, at))


def spent(rigid_dt: float, w: Watch, at: np.ndarray, drives: Drive) -> np.ndarray:
    """Work (k,) J so far of the tools that are driven so from these positions (k, 3) m."""
    scene = bed(rigid_dt).scene()
    moving = velocities(scene, at, drives)
    return work(scene, w, np.insert(moving, 0, 0, axis=1))  # the plane is the first geom


# The blade, at speeds (m/s) with the rigid step that suits them.
START, TRAVEL = 0.2, 0.3  # m
LEAK = 0.2  # of the swept sand, through the blade at 8 cells a step; 0.88 observed
SPEEDS = {0.01: DT, 0.1: DT, 1.0: DT, 5.0: SHORT, 20.0: SHORT, 50.0: SHORT}


class Cut(NamedTuple):
    """What a blade did."""

    watch: Watch
    mass: float  # kg, of the bed
    swept: float  # kg
    leaked: float  # kg of it to the blade's other side
    work: np.ndarray  # (k,) J so far


@cache
def cut(speed: float, rigid_dt: float) -> Cut:
    scene, at = bed(rigid_dt).scene(), places({"blade": (START, HIGH / 2)})
    state = placed(rigid_dt, at)
    count = int(np.clip(25 * np.ceil(TRAVEL / speed / rigid_dt / 25), 25, 400))
    drives = straight(scene, at, speeds({"blade": (speed, 0)}), count, TRAVEL / speed)
    end, w = watched(scene, state, count, drives)
    m, (x0, x1) = np.asarray(end.grains.m), (np.asarray(scene.world(s.grains.x))[0] for s in (state, end))
    ahead, there = x0 > START, float(drives.position[-1, 0, 0])
    swept, leaked = (float(m @ (ahead & (x < there))) for x in (x0, x1))
    return Cut(w, mass_of(state), swept, leaked, spent(rigid_dt, w, at, drives))


@pytest.mark.parametrize("speed", SPEEDS)
def test_a_blade_moves_sand_soundly_at_any_speed_that_its_rigid_step_suits(speed: float) -> None:
    """Observed: grains of up to 1.2 times 1 m/s and more, 0.1 cells deep, and half the work or more in heat."""
    done = cut(speed, SPEEDS[speed])
    assert_sound(done.watch, done.mass, FEW * speed + fall(SURFACE - PLANE))
    assert done.watch.trouble == []
    assert done.leaked == 0
    assert speed < 1 or done.swept > 0.05 * done.mass, "it hardly moved anything"
    assert np.all(done.work - done.watch.rise > -SPENT * np.abs(done.work).max())


@pytest.mark.parametrize("speed", [v for v, dt in SPEEDS.items() if dt != DT])
def test_a_blade_too_fast_for_its_rigid_step_says_so_at_once(speed: float) -> None:
    """0.8 to 8 cells a step. At 50 m/s all stays finite and bounded, yet most sand passes through: the bit tells."""
    assert too_fast(bed(DT).scene(), speed)
    done = cut(speed, DT)
    assert done.watch.health[0] & Health.BODY_TOO_FAST
    assert_told(done.watch, FEW * speed + fall(SURFACE - PLANE))
    assert_kept(done.watch, done.mass)
    assert speed < 50 or done.leaked > LEAK * done.swept, "no negative control of what leaks"


def test_a_tool_told_to_go_nowhere_is_noticed_even_where_no_sand_is() -> None:
    scene, at = bed(DT).scene(), places({})
    drives = straight(scene, at, speeds({}), 25)
    lost = drives._replace(position=drives.position.at[10:, 0, 0].set(jnp.nan))
    _, w = watched(scene, placed(DT, at), 25, lost)
    assert np.all((w.health & Health.NOT_FINITE != 0) == (np.arange(25) >= 10))


# Blocks of ever greater friction in one bed, pushed along and down.
FRICTIONS = (0.0, 0.5, 10.0, 1e3, 1e6)
PITCH, LAST = 0.5, 0.3  # m, between blocks, and behind the last one


@cache
def rubbed() -> Bed:
    """Each 5 cm high above its trench in the bed."""
    length = PITCH * len(FRICTIONS) + LAST
    names = [f"block{i}" for i in range(len(FRICTIONS))]
    at = {name: (PITCH * i + 0.15, 0.22) for i, name in enumerate(names)}
    edges = [0.0, *(x + side for x, _ in at.values() for side in (-0.05, 0.05)), length]
    fills = [((0.0, 0.0, 0.0), (length, WIDE, 0.12))]
    fills += [((a, 0.0, 0.12), (b, WIDE, SURFACE)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return Bed(
        f"<worldbody>{told(dict.fromkeys(names, f'.05 {MID} .1'), at)}</worldbody>",
        ("*",),
        (length, WIDE, HIGH),
        tuple(fills),
        DX,
        2,
        bodies={"friction_of": dict(zip(names, FRICTIONS, strict=True))},
    )


ROUGH = 0.9  # of the force on a block with friction 10, on rougher ones; they stick alike, 1.3 and more observed


@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_friction_from_none_to_a_million_moves_sand_soundly(speed: float) -> None:
    scene, count = rubbed().scene(), 50
    state = at_rest(scene, rubbed().start(), SURFACE)
    at = np.asarray(state.rigid.mocap_pos, np.float64)
    pushed = np.tile([speed, 0, -speed / 4], (len(at), 1))
    drives = straight(scene, at, pushed, count, 0.15 / speed)
    _, w = watched(scene, state, count, drives)
    assert_sound(w, mass_of(state), FEW * speed + fall(SURFACE))
    assert w.trouble == []
    done = work(scene, w, velocities(scene, at, drives))
    assert np.all(done - w.rise > -SPENT * np.abs(done).max())
    drag = -w.reaction[5 : int(0.15 / speed / DT), :, 0].mean(axis=0)
    assert 0 < drag[0] < drag[1] < drag[2]
    assert np.all(drag[3:] > ROUGH * drag[2])


BAD_FRICTION = {
    "friction: -0.1": "bodies.friction.0 should be greater than or equal to 0, got -0.1",
    "friction: .nan": "bodies.friction.0 should be a finite number, got nan",
    "friction: .inf": "bodies.friction.0 should be a finite number, got inf",
    "friction: rough": "bodies.friction.0 should be a valid number, got 'rough'",
    "friction_of: {tool: -1}": "bodies.friction_of.tool.0 should be greater than or equal to 0, got -1",
    "friction_of: {tool: [.inf]}": "bodies.friction_of.tool.0 should be a finite number, got inf",
}


@pytest.mark.parametrize("line", BAD_FRICTION)
def test_a_scene_file_with_friction_that_is_none_is_refused(tmp_path: Path, line: str) -> None:
    data = bed(DT).scene().config.model_dump(exclude={"name"}, exclude_none=True)
    data["bodies"] = {"mjcf": data["bodies"]["mjcf"], "couple": ["*"]}
    good = yaml.safe_load(yaml.safe_dump(data | {"box": {k: list(v) for k, v in data["box"].items()}}, sort_keys=False))
    path = tmp_path / "bed.yaml"
    path.write_text(yaml.safe_dump(good))
    assert read_scene(str(path)).bodies is not None
    key, value = line.split(": ", 1)
    path.write_text(path.read_text().replace("  couple:", f"  {key}: {value}\n  couple:"))
    with pytest.raises(ValueError) as refused:
        read_scene(str(path))
    assert BAD_FRICTION[line] in str(refused.value)
    assert str(refused.value).count("\n") == 0


# Tools that start inside sand.
INSIDE = {"blade": (0.5, 0.35), "box": (0.5, 0.12)}
PUT_OUT = 0.5  # m/s; 5e-3 and 0.02 observed


def test_a_scene_whose_tool_starts_full_of_sand_is_refused() -> None:
    scene = bed(DT).scene()
    bodies, (x, z) = scene.config.bodies, AWAY["box"]
    assert bodies is not None
    moved = bodies.model_copy(update={"mjcf": bodies.mjcf.replace(f'pos="{x} {MID} {z}"', f'pos=".5 {MID} .12"')})
    with pytest.raises(ValueError, match=r"grains start inside the geom 'box', up to 0\.0\d+ m deep: move the body"):
        build(scene.config.model_copy(update={"bodies": moved}), scene.fidelity)


@pytest.mark.parametrize("name", INSIDE)
def test_sand_inside_a_tool_is_put_out_gently_and_told_where_it_was_deep(name: str) -> None:
    """As where a state is made by hand; a blade of half a cell holds none deeper than seeding's jitter."""
    scene, at = bed(DT).scene(), places({name: INSIDE[name]})
    state = placed(DT, at, full=True)
    held = float(jnp.sum(jnp.where(inside(state, at), state.grains.m, 0)))
    assert held > 0.1  # kg
    end, w = watched(scene, state, 50, straight(scene, at, speeds({}), 50))
    assert_sound(w, mass_of(state), PUT_OUT)
    assert bool(w.health[0] & Health.TOO_DEEP) == (name == "box")
    assert not inside(end, at, HALF - 1e-3).any()
    assert w.rise.max() < held * G * min(TOOLS[name]), "it gained more than by being lifted out"


# Sand pressed between tools, against a wall of the box, and against a rigid plane, until no gap is left.
class Pressing(NamedTuple):
    """Where tools start, which way they go, and how far until they meet what they press against."""

    at: dict[str, tuple[float, float]]  # (x, z) m
    way: dict[str, tuple[int, int]]
    travel: float  # m


CASES = {
    "two jaws": Pressing({"left": (0.1, 0.25), "right": (0.7, 0.25)}, {"left": (1, 0), "right": (-1, 0)}, 0.2),
    "a jaw and a wall": Pressing({"right": (0.5, 0.25)}, {"right": (-1, 0)}, 0.4),
    "a ram and a plane": Pressing({"ram": (0.4, 0.32)}, {"ram": (0, -1)}, 0.22 - PLANE),
}


DEEP = {"TOO_DEEP"}  # 0.16 cells of the half cell that tools so thick bear: the thin blade's limit holds for all


@pytest.mark.parametrize("speed", [0.5, 1.5, 5.0, 20.0])
@pytest.mark.parametrize("name", CASES)
def test_sand_pressed_until_no_gap_is_left_stays_sound_or_says_why_not(name: str, speed: float) -> None:
    """Observed: grains of up to 4.8 and 8.7 m/s at the slower two, from under the ram as it meets the plane."""
    scene, case = bed(DT).scene(), CASES[name]
    at = places(case.at)
    state = placed(DT, at)
    count = 25 * int(np.ceil((case.travel / speed / DT + 5) / 25))
    velocity = speeds({tool: (speed * x, speed * z) for tool, (x, z) in case.way.items()})
    drives = straight(scene, at, velocity, count, case.travel / speed)
    _, w = watched(scene, state, count, drives)
    most = FEW * speed + fall(HIGH) + SOUND
    assert_kept(w, mass_of(state))
    assert_told(w, most)
    if too_fast(scene, speed):
        assert w.health[0] & Health.BODY_TOO_FAST
        return
    assert_sound(w, mass_of(state), most)
    assert set(w.trouble) <= DEEP
    done = spent(DT, w, at, drives)
    assert np.all(done - w.rise > -SPENT * done.max())
    assert done.max() > 100, "nothing was pressed"  # J; 8e3 to 2e4 observed


@pytest.mark.slow
@pytest.mark.parametrize("force", [1e2, 1e3, 1e4, 1e6])
@pytest.mark.parametrize("lighter", [1.0, 0.01])
def test_sand_pressed_by_actuators_stays_sound_or_says_why_not(force: float, lighter: float) -> None:
    """Observed: well up to 1e3 N, where 15 cm of sand are left of 30; lighter plates are too fast there, and say so."""
    scene, state = squeezed().scene(), squeezed().start()
    drives = Drive(jnp.full((100, 2), force), jnp.zeros((100, 0, 3)), jnp.zeros((100, 0, 4)))
    _, w = watched(scene, state, 100, drives, heavier=lighter)
    assert_kept(w, mass_of(state))
    assert_told(w, SOUND, SOUND)
    if force <= 1e3 and lighter == 1:
        assert_sound(w, mass_of(state), SOUND, SOUND)
        assert w.trouble == []


# Negative controls: what the assertions above would say of garbage.
def test_the_watch_sees_what_is_wrong_and_when() -> None:
    w, mass = cut(0.1, DT).watch, cut(0.1, DT).mass
    most = float(w.grain.max())
    assert not w.wrong(most).any()
    fast = w._replace(grain=np.where(np.arange(len(w.grain)) == 7, 2 * most, w.grain))
    lost = w._replace(finite=np.arange(len(w.grain)) < 7, grain=np.where(np.arange(len(w.grain)) < 7, w.grain, np.nan))
    for garbage in (fast, lost):
        assert int(np.argmax(garbage.wrong(most))) == 7
        with pytest.raises(AssertionError, match=r"step 7: .* but well"):
            assert_told(garbage, most)
        with pytest.raises(AssertionError, match="step 7"):
            assert_sound(garbage, mass, most)
        late = garbage._replace(health=np.where(np.arange(len(w.grain)) >= 8, 4, 0))
        with pytest.raises(AssertionError, match="but well"):
            assert_told(late, most)
        assert_told(garbage._replace(health=np.where(np.arange(len(w.grain)) >= 7, 4, 0)), most)


def test_the_watch_sees_mass_that_is_missing() -> None:
    w, mass = cut(0.1, DT).watch, cut(0.1, DT).mass
    assert_kept(w, mass)
    for garbage in (w._replace(gone=w.gone + 1e-4 * mass), w._replace(kept=np.arange(len(w.kept)) != 3)):
        with pytest.raises(AssertionError):
            assert_kept(garbage, mass)


GARBAGE = {  # what is put into a grain's field, and the bit that must be set a step later
    "a grain without a place": ("x", np.nan, Health.NOT_FINITE),
    "a grain without a velocity": ("v", np.nan, Health.NOT_FINITE),
    "a grain without a strain": ("e", np.nan, Health.NOT_FINITE),
    "a grain without a stress": ("tau", np.nan, Health.NOT_FINITE),
    "a grain of 1 km/s": ("v", 1e4, Health.TOO_FAST),
    "a grain under ten thousand times its modulus": ("tau", -1e10, Health.TOO_FAST),
}


@pytest.mark.parametrize("what", GARBAGE)
def test_one_sick_grain_is_noticed(what: str) -> None:
    """Negative control of the health bits: the scene is well without it, and says what is wrong with it."""
    scene, at = bed(SHORT).scene(), places({})
    field, value, bit = GARBAGE[what]
    state = placed(SHORT, at)
    grain = int(np.argmax(np.asarray(state.grains.m) > 0))
    sick = {field: getattr(state.grains, field).at[..., grain].set(value)}
    state = replace(state, grains=replace(state.grains, **sick))
    _, w = watched(scene, state, 25, straight(scene, at, speeds({}), 25))
    assert w.wrong(FEW * fall(SURFACE - PLANE))[0], "it is no garbage"
    assert w.health[0] & bit
    assert_told(w, FEW * fall(SURFACE - PLANE))


def test_sand_is_what_the_bounds_take_it_for() -> None:
    (material,) = bed(DT).scene().materials
    assert float(material.wave_speed()) == pytest.approx(SOUND, rel=0.01)
    assert SAND["rho"] == 1500.0
