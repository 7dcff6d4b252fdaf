"""Free bodies at the extremes: thrown at 50 m/s, of a milligram or a thousand tonnes, in any gravity.

Either all is finite, bounded and keeps its mass, or a health bit says what is wrong by the first step that is not. In
plane strain; one scene for each rigid step, whose gravity, speeds and masses differ between runs.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.coupling.beds import RHO, G, at_rest, started
from benchmarks.coupling.scenes import Bed, body_energy, shifted
from mpm_env import Scene, State, build
from mpm_env.health import MOST_TRAVEL, Health
from mpm_env.scene_config import WallConfig
from tests.extremes.watch import FEW, Watch, assert_kept, assert_sound, assert_told, fall, mass_of, too_fast, watched

DX = 0.025  # m
WIDE, LENGTH, HIGH, SURFACE = 0.1, 0.6, 0.4, 0.2  # m, of the slice, the box and the bed
HALF = (0.1, 0.05)  # m, of the body along x and z
REACH = 0.1  # m, from its middle, over which a bound on speeds is one on rad/s
ABOVE = 0.06  # m, over the sand
MASS = RHO * 4 * HALF[0] * HALF[1] * WIDE  # kg, 3: as dense as sand
ON, CLOSE = 0.001, 0.01  # m, over the sand: as good as on it, and just before the impact
WEIGHT = 0.02  # of the weight, as is asked; 4e-3 observed
CALM = 0.5  # m/s and rad/s; 0.4 rad/s observed, of a milligram that is set down on uneven grains
STIR = 0.2  # of a fall through the box, to which a box set down stirs the sand; 0.04 observed
GAIN = 1e-3  # of the throw's energy; it never rose
DT, SHORT = 0.004, 0.0001  # s, rigid steps for usual speeds and for those of up to 60 m/s


@cache
def room(rigid_dt: float, lid: bool = False) -> Scene:
    """A box over a bed on a rigid floor, below open sky or a lid."""
    planes = '<geom name="floor" type="plane" size="1 1 1"/>'
    if lid:
        planes += f'<geom name="lid" type="plane" size="1 1 1" pos="0 0 {HIGH}" zaxis="0 0 -1"/>'
    body = f"""<body pos="{LENGTH / 2} {WIDE / 2} {SURFACE + ABOVE + HALF[1]}"><freejoint/>
      <geom name="box" type="box" size="{HALF[0]} {WIDE / 2} {HALF[1]}" density="{RHO}"/></body>"""
    bed = Bed(
        f"<worldbody>{planes}{body}</worldbody>",
        ("box",),
        (LENGTH, WIDE, HIGH),
        (((0, 0, 0), (LENGTH, WIDE, SURFACE)),),
        DX,
        2,
        rigid_dt=rigid_dt,
        fidelity={"contact_iterations": 8},
    )
    if lid:
        return bed.scene()
    config = bed.scene().config
    return build(
        config.model_copy(update={"walls": config.walls | {"z_upper": WallConfig(kind="open")}}), bed.scene().fidelity
    )


def over(scene: Scene, above: float, speed: float = 0.0, gravity: float = G) -> State:
    """The bed at rest in this gravity, the box so high (m) over it, thrown down at this speed (m/s)."""
    state = at_rest(scene, started(scene), SURFACE, gravity)
    q = np.array(state.rigid.qpos)
    q[2] = SURFACE + above + HALF[1]
    return shifted(scene, state, q, [0, 0, -speed, 0, 0, 0])


class Throw(NamedTuple):
    """What became of a throw."""

    watch: Watch
    mass: float  # kg, of the sand
    most: float  # m/s, that grains may reach
    gain: float  # the most that the energy of all was above that at the start, over the throw's


@cache
def thrown(speed: float, heavier: float, rigid_dt: float) -> Throw:
    """The box thrown down (m/s), so many times as dense as sand."""
    scene = room(rigid_dt)
    state = over(scene, ABOVE if rigid_dt == DT else CLOSE, speed)
    count = 50 if rigid_dt == DT else int(np.clip(25 * np.ceil(0.25 / speed / SHORT / 25), 100, 400))
    _, w = watched(scene, state, count, heavier=heavier)
    first = w._replace(qpos=np.asarray(state.rigid.qpos)[None], qvel=np.asarray(state.rigid.qvel)[None])
    gain = w.rise + heavier * (body_energy(scene, w) - body_energy(scene, first))
    energy = heavier * MASS * speed**2 / 2
    return Throw(w, mass_of(state), FEW * speed + fall(HIGH), float(gain.max()) / energy)


def assert_thrown_soundly(done: Throw, allowed: set[str]) -> None:
    assert_sound(done.watch, done.mass, done.most, done.most / REACH)
    assert set(done.watch.trouble) <= allowed
    assert done.gain < GAIN
    assert np.abs(done.watch.reaction[:, 0, 2]).max() > 0, "it never met the sand"


@pytest.mark.parametrize("heavier", [0.001, 1.0, 5.0])
def test_a_thrown_box_of_any_density_moves_sand_soundly(heavier: float) -> None:
    """Observed at 1 m/s: grains of up to 1.3 m/s, and no energy from nowhere."""
    assert_thrown_soundly(thrown(1.0, heavier, DT), set())


@pytest.mark.slow
@pytest.mark.parametrize("heavier", [0.001, 1.0, 5.0])
@pytest.mark.parametrize("speed", [1.0, 5.0, 20.0, 50.0])
def test_a_box_thrown_at_any_speed_that_its_rigid_step_suits_moves_sand_soundly(speed: float, heavier: float) -> None:
    """Observed: grains as fast as the box, at most, 0.07 cells deep; some impacts of foam stay unsolved, and say so."""
    assert not too_fast(room(SHORT), speed)
    assert_thrown_soundly(thrown(speed, heavier, SHORT), {"NOT_CONVERGED"} if heavier < 0.01 else set())


@pytest.mark.parametrize("heavier", [0.001, 1.0, 5.0, 1000.0])
@pytest.mark.parametrize("speed", [5.0, 20.0, 50.0])
def test_a_box_thrown_too_fast_for_its_rigid_step_says_so_at_once(speed: float, heavier: float) -> None:
    """A thousand times as dense it also rams sand into the floor, at 126 m/s in the third step."""
    done = thrown(speed, heavier, DT)
    assert done.watch.health[0] & Health.BODY_TOO_FAST
    assert_told(done.watch, done.most, done.most / REACH)
    assert_kept(done.watch, done.mass)


@pytest.mark.parametrize(
    ("speed", "rigid_dt"),
    [(1.0, DT), *(pytest.param(v, SHORT, marks=pytest.mark.slow) for v in (5.0, 20.0, 50.0))],
)
def test_a_box_that_rams_sand_into_the_floor_is_told(speed: float, rigid_dt: float) -> None:
    """A thousand times as dense as sand: at 50 m/s, the first grain goes wild 22 steps after the first bit."""
    done = thrown(speed, 1000.0, rigid_dt)
    assert_told(done.watch, done.most, done.most / REACH)
    assert_kept(done.watch, done.mass)


def test_a_box_that_sand_stops_within_a_step_still_says_how_far_it_went() -> None:
    """A box of foam that goes over a quarter of a cell, and is slow again at the end of the step."""
    _, w = watched(room(DT), over(room(DT), 0.02, 5.0), 25, heavier=0.001)
    assert np.abs(w.qvel[0, :3]).max() * DT < MOST_TRAVEL * DX, "its last speed would tell"
    assert w.health[0] & Health.BODY_TOO_FAST


@pytest.mark.parametrize("mass", [1e-6, 1e-3, 1.0])
def test_a_box_of_a_milligram_lies_still_and_weighs_itself(mass: float) -> None:
    """Of 1 mg to 1 kg; a third of the sand that it takes the place of is 1 kg."""
    state = over(room(DT), ON)
    _, w = watched(room(DT), state, 200, heavier=mass / MASS)
    assert_sound(w, mass_of(state), CALM, CALM)
    assert w.trouble == []
    assert w.reaction[-100:, 0, 2].mean() == pytest.approx(mass * G, rel=WEIGHT)
    assert abs(w.qpos[-1, 2] - (SURFACE + HALF[1])) < 0.25 * DX


@pytest.mark.parametrize("mass", [1e3, 1e6])
def test_a_box_of_a_thousand_tonnes_sinks_and_says_what_sand_cannot_bear(mass: float) -> None:
    """Of 1 t and of 1000 t; the latter falls past 1.6 m/s, and then presses the last sand under it to nothing."""
    state = over(room(DT), ON)
    _, w = watched(room(DT), state, 100, heavier=mass / MASS)
    most = FEW * fall(SURFACE)
    assert_kept(w, mass_of(state))
    assert_told(w, most, most / REACH)
    assert w.qpos[-1, 2] < SURFACE, "it did not sink"
    if mass < 1e6:
        assert_sound(w, mass_of(state), most, most / REACH)
        assert w.trouble == []


@pytest.mark.parametrize("gravity", [1.62, G, 10 * G])
def test_a_box_on_sand_weighs_itself_in_any_gravity(gravity: float) -> None:
    state = over(room(DT), ON, gravity=gravity)
    _, w = watched(room(DT), state, 200, gravity=gravity)
    most = STIR * fall(HIGH, gravity)
    assert_sound(w, mass_of(state), most, most / REACH)
    assert w.trouble == []
    assert w.gone[-1] == 0
    assert w.reaction[-100:, 0, 2].mean() == pytest.approx(MASS * gravity, rel=WEIGHT)


def test_without_gravity_nothing_moves() -> None:
    state = over(room(DT), ON, gravity=0.0)
    _, w = watched(room(DT), state, 100, gravity=0.0)
    assert_sound(w, mass_of(state), 1e-6, 1e-6)
    assert w.trouble == []


@pytest.mark.parametrize("gravity", [-G, -10 * G])
def test_in_reversed_gravity_all_sand_leaves_through_the_open_top_and_is_counted(gravity: float) -> None:
    """A box that falls for 0.8 s crosses over a quarter of a cell a step, and says so."""
    state = over(room(DT), ON, gravity=0.0)
    end, w = watched(room(DT), state, 200, gravity=gravity)
    assert_sound(w, mass_of(state), fall(HIGH, gravity), 1.001 * abs(gravity) * 200 * DT)
    assert set(w.trouble) == {"BODY_TOO_FAST"}
    assert not np.asarray(end.grains.m).any()
    assert float(end.left) == pytest.approx(mass_of(state), rel=1e-6)


@pytest.mark.slow
def test_in_reversed_gravity_sand_and_box_fall_up_to_a_lid_and_rest_there() -> None:
    scene = room(DT, lid=True)
    state = over(scene, ON, gravity=0.0)
    end, w = watched(scene, state, 300, gravity=-G)
    most = FEW * fall(HIGH)
    assert_sound(w, mass_of(state), most, most / REACH)
    assert set(w.trouble) <= {"BODY_TOO_FAST"}  # of the fall, at 1.9 m/s
    assert w.gone[-1] == 0
    m, z = np.asarray(end.grains.m), np.asarray(scene.world(end.grains.x))[2]
    assert m @ z / m.sum() > HIGH - 0.75 * SURFACE, "it did not fall up"  # m; 0.1 at the start
    assert w.joint[-50:].max() < CALM
