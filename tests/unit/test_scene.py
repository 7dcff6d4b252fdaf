"""Building a scene: numbers that do not fit together are refused in a sentence, the others come out as asked."""

from typing import Any

import jax
import numpy as np
import pytest

from mpm_env.config import known, parse
from mpm_env.fidelity import Fidelity, load_fidelity
from mpm_env.scene import build, initial
from mpm_env.scene_config import SceneConfig, read_scene

SAND = {"model": "sand", "E": 1e6, "nu": 0.3, "rho": 1600.0, "friction_deg": 35.0}
BED = {"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [0.6, 0.2, 0.1]}
HAND = '<body name="hand" mocap="true" pos=".3 .1 .3"><geom name="paddle" type="box" size=".02 .05 .05"/></body>'
SLIDER = """
<body name="cart" pos=".3 .1 .3"><joint name="rail" type="slide" axis="1 0 0"/><geom name="wedge" size=".05"/></body>
"""
MJCF = f"""
<mujoco>
  <worldbody>{HAND}{SLIDER}</worldbody>
  <actuator><motor name="drive" joint="rail"/></actuator>
  <keyframe><key name="ready" qpos="0.1" mpos=".3 .1 .3"/></keyframe>
</mujoco>
"""


def scene(bodies: dict[str, Any] | None = None, fill: dict[str, Any] | None = None, **changed: Any) -> SceneConfig:
    """A bed of sand in a box of 6 x 2 x 4 features; with `bodies`, a mocap paddle and a cart above it."""
    data: dict[str, Any] = {
        "name": "bed",
        "box": {"lower": [0.0, 0.0, 0.0], "upper": [0.6, 0.2, 0.4]},
        "feature": 0.1,
        "duration": 1.0,
        "grains": [{"material": SAND, "fill": [{**BED, **(fill or {})}]}],
        **changed,
    }
    if bodies is not None:
        data["bodies"] = {"mjcf": MJCF, "couple": ["paddle"], **bodies}
    return parse(SceneConfig, data, "bed")


def at(t: float, x: float, z: float = 0.3) -> dict[str, Any]:
    """A waypoint of the paddle."""
    return {"t": t, "position": [x, 0.1, z]}


DRAFT = {"cells": 3}
# What does not fit: arguments of `scene`, those of Fidelity, and words of the sentence.
REFUSED: dict[str, tuple[dict[str, Any], dict[str, Any], tuple[str, ...]]] = {
    "box of broken cells": (
        {"feature": 0.11},
        {"cells": 3},
        ("The box is 0.6 m along x", "16.36 cells of 0.0366667 m", "cells = 11"),
    ),
    "substep too long": (
        {},
        {"cells": 3, "mpm_dt": 4e-3},
        ("mpm_dt = 0.004 s exceeds the stable", "sound speed 29", "of sand", "cell_size 0.03333 m"),
    ),
    "substep too long for the speed": (
        {"fill": {"velocity": [0.0, 0.0, 900.0]}},
        {"cells": 3, "mpm_dt": 1e-4},
        ("mpm_dt = 0.0001 s exceeds the stable", "speed 900 m/s of grains and tools"),
    ),
    "rigid step of broken substeps": (
        {},
        {"cells": 3, "rigid_dt": 1e-3, "mpm_dt": 3e-4},
        ("rigid_dt = 0.001 s is 3.333 substeps of mpm_dt = 0.0003 s", "mpm_dt = 0.00025"),
    ),
    "courant too high": ({}, {"cells": 3, "courant": 0.9}, ("courant = 0.9 exceeds the stable", "3-D")),
    "sand outside the box": (
        {"fill": {"upper": [0.6, 0.2, 0.5]}},
        DRAFT,
        ("A box of grains reaches from 0 to 0.5 m along z", "outside the simulated box from 0 to 0.4 m"),
    ),
    "sand inside out": ({"fill": {"upper": [0.6, 0.2, 0.0]}}, DRAFT, ("needs lower < upper on every axis",)),
    "no MJCF": ({"bodies": {"mjcf": "<mujoco"}}, DRAFT, ("bodies.mjcf is not a model that MuJoCo can read",)),
    "bad MJCF": (
        {"bodies": {"mjcf": "<mujoco><worldbody><geom/></worldbody></mujoco>"}},
        DRAFT,
        ("bodies.mjcf is not a model that MuJoCo can read", "size"),
    ),
    "unknown geom": (
        {"bodies": {"couple": ["padle"]}},
        DRAFT,
        ("no geom named 'padle'", "did you mean 'paddle'?", "Known: paddle, wedge"),
    ),
    "unknown geom with its own friction": (
        {"bodies": {"friction_of": {"wegde": 0.1}}},
        DRAFT,
        ("no geom named 'wegde'", "did you mean 'wedge'?"),
    ),
    "friction for materials that are not there": (
        {"bodies": {"friction": [0.2, 0.3]}},
        DRAFT,
        ("bodies.friction has 2 numbers for 1 entries of grains", "give one, or one each"),
    ),
    "adhesion for materials that are not there": (
        {"bodies": {"adhesion": [1.0, 2.0, 3.0]}},
        DRAFT,
        ("bodies.adhesion has 3 numbers for 1 entries of grains",),
    ),
    "a tool too thin for the grid": (
        {"bodies": {}},
        {"cells": 3, "push_out": False},
        ("The geom 'paddle' is", "cells thick", "leak through geoms thinner than 2.5", "push_out = true"),
    ),
    "unknown actuator": (
        {"bodies": {"controls": {"driv": [[0, 1]]}}},
        DRAFT,
        ("no actuator 'driv'", "did you mean 'drive'?"),
    ),
    "unknown mocap body": (
        {"bodies": {"motion": {"cart": [at(0, 0.3)]}}},
        DRAFT,
        ("no mocap body 'cart'", "Known: hand"),
    ),
    "unknown keyframe": (
        {"bodies": {"keyframe": "redy"}},
        DRAFT,
        ("no keyframe 'redy'", "did you mean 'ready'?"),
    ),
    "waypoints that go back in time": (
        {"bodies": {"motion": {"hand": [at(1, 0.3), at(0, 0.4)]}}},
        DRAFT,
        ("The waypoint times of 'hand' must increase, got [1.0, 0.0]",),
    ),
    "a quaternion of length zero": (
        {"bodies": {"motion": {"hand": [{**at(0, 0.3), "quaternion": [0, 0, 0, 0]}]}}},
        DRAFT,
        ("A quaternion of 'hand' is zero",),
    ),
    "a tool too fast for its step": (
        {"bodies": {"motion": {"hand": [at(0, 0.1), at(0.1, 0.5)]}}},
        DRAFT,
        ("rigid_dt = 0.004 s lets a tool of", "cells in one rigid step", "or a slower tool"),
    ),
    "a tool in the sand": (
        {"bodies": {"motion": {"hand": [at(0, 0.3, z=0.1)]}}},
        DRAFT,
        ("grains start inside the geom 'paddle'", "m deep", "move the body or the material apart"),
    ),
    "an integrator that grains cannot join": (
        {"bodies": {"mjcf": MJCF.replace("<mujoco>", '<mujoco><option integrator="RK4"/>'), "couple": ["wedge"]}},
        DRAFT,
        ("mjINT_RK4", "choose Euler or implicitfast"),
    ),
    "64 bits without them": ({}, {"cells": 3, "precision": "f64"}, ("precision = f64 needs 64-bit JAX",)),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_gets_its_sentence(case: str) -> None:
    changed, numerics, words = REFUSED[case]
    with pytest.raises(ValueError) as refusal:
        build(scene(**changed), Fidelity(**numerics))
    said = str(refusal.value)
    assert all(word in said for word in words), said
    assert "\n" not in said


def test_remedies_that_a_sentence_names_do_help() -> None:
    assert build(scene(feature=0.2), Fidelity(cells=3)).grid.cells == (9, 3, 6)
    with pytest.raises(ValueError, match=r"with cells = (\d+)") as refusal:
        build(scene(feature=0.4), Fidelity(cells=3))
    cells = int(str(refusal.value).split("with cells = ")[1].split()[0])
    build(scene(feature=0.4), Fidelity(cells=cells))


def test_mass_is_density_times_volume_at_every_fidelity() -> None:
    for cells in (3, 4, 5):
        state = initial(build(scene(), Fidelity(cells=cells)), jax.random.key(1))
        assert float(np.sum(np.asarray(state.grains.m, np.float64))) == pytest.approx(1600 * 0.6 * 0.2 * 0.1, rel=1e-5)


def test_plane_strain_scene_is_2d_whatever_the_fidelity_says() -> None:
    built = build(scene(plane_strain=True), Fidelity(cells=3, dimension=3))
    assert built.dimension == 2 and built.fidelity.dimension == 2
    assert float(initial(built, jax.random.key(0)).grains.m.sum()) == pytest.approx(1600 * 0.6 * 0.2 * 0.1, rel=1e-5)


def test_stiffness_softens_sand_only() -> None:
    """Snow yields at a critical strain, so that its modulus is its strength; rubber is nothing but its modulus."""
    soft = Fidelity(cells=3, stiffness=0.25)
    assert float(build(scene(), soft).materials[0].E) == 0.25e6
    rubber = {"model": "elastic", "E": 1e6, "nu": 0.3, "rho": 1000.0}
    assert float(build(scene(grains=[{"material": rubber, "fill": [BED]}]), soft).materials[0].E) == 1e6


def test_bodies_fall_with_the_gravity_of_the_scene() -> None:
    built = build(scene(bodies={}, gravity=[0.0, 0.0, -1.62]), Fidelity(cells=3))
    assert built.bodies is not None
    assert built.bodies.model.opt.gravity.tolist() == [0.0, 0.0, -1.62]


def test_room_for_grains_near_a_tool_grows_with_how_far_they_can_be_packed() -> None:
    snow = {"model": "snow", "E": 5e4, "nu": 0.2, "theta_c": 0.02, "theta_s": 0.005, "xi": 5.0}
    rooms = [
        build(scene(bodies={}, grains=[{"material": {**snow, "rho": rho}, "fill": [BED]}]), Fidelity(cells=6)).sizes
        for rho in (600.0, 300.0)
    ]
    assert rooms[1].grains == pytest.approx(2 * rooms[0].grains, rel=0.2)
    assert rooms[1].nodes == rooms[0].nodes


def test_same_seed_gives_the_same_grains_and_another_one_others() -> None:
    built = build(scene(), Fidelity(cells=3))
    first, again, other = (np.asarray(initial(built, jax.random.key(s)).grains.x) for s in (0, 0, 1))
    assert first.tobytes() == again.tobytes() != other.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", known("fidelities"))
@pytest.mark.parametrize("name", known("scenes"))
def test_every_shipped_scene_builds_at_every_fidelity(name: str, fidelity: str) -> None:
    built = build(read_scene(name), load_fidelity(fidelity))
    assert built.slots > 0
    assert round(1 / (25 * built.rigid_dt), 6).is_integer()  # frames at 25 per second, the command line's default
    assert round(built.config.duration * 25, 6).is_integer()


def test_controls_beyond_the_actuator_s_range_are_refused() -> None:
    settings = ("bodies.controls.boom=[[0.0, 5.0]]",)
    with pytest.raises(ValueError, match=r"The controls of 'boom' go from 5 to 5, beyond its range of -0\.35 to 1\.4"):
        build(read_scene("bucket_dig", settings), load_fidelity("draft"))


def test_friction_on_a_wall_that_does_not_rub_is_refused() -> None:
    settings = ("walls.x_lower={kind: slip, friction: 0.3}",)
    with pytest.raises(ValueError, match="a wall of kind 'slip' has no friction"):
        read_scene("column_collapse_2d", settings)


def test_a_keyframe_gives_bodies_their_velocity() -> None:
    ball = """<mujoco><worldbody><body name="ball" pos="0.2 0 0.3"><freejoint/><geom name="ball" size="0.03"/></body>
    </worldbody><keyframe><key name="thrown" qpos="0.2 0 0.3 1 0 0 0" qvel="1.5 0 0 0 0 0"/></keyframe></mujoco>"""
    config = parse(
        SceneConfig,
        {
            "name": "throw",
            "box": {"lower": [0, -0.2, 0], "upper": [0.8, 0.2, 0.4]},
            "feature": 0.1,
            "duration": 1.0,
            "bodies": {"mjcf": ball, "couple": ["ball"], "keyframe": "thrown"},
        },
        "throw",
    )
    state = initial(build(config, Fidelity()), jax.random.key(0))
    np.testing.assert_allclose(state.rigid.qvel, [1.5, 0, 0, 0, 0, 0])


def test_a_misspelt_required_key_gets_the_hint() -> None:
    with pytest.raises(ValueError, match="unknown key 'featur': did you mean 'feature'"):
        parse(SceneConfig, {"name": "x", "box": {}, "featur": 0.1, "duration": 1.0}, "x")
