"""Surfaces that hold on to what touches them: up to the stress that the scene names, and no more."""

from functools import partial

import jax
import numpy as np
import pytest

from mpm_env import native, sim
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.health import Health
from mpm_env.scene import Scene, build, initial
from mpm_env.scene_config import SceneConfig
from tests.coupling import encounters as enc
from tests.coupling.encounters import REACH, met
from tests.coupling.test_meeting import assert_same, each_precision

DX = 0.025  # m
WIDTH, HALF = 0.1, 0.1  # m, of the slice, and half the plate's length
ADHESION = 300.0  # Pa
STEPS, DT = 300, 0.002  # s
AVERAGE = 25  # rigid steps, over which the peak is taken

# How much of the adhesion is seen depends on where the plate's face lies between planes of nodes: 0.96, 0.98, 0.88 and
# 0.67 at 0, 1/4, 1/2 and 3/4 of a cell, where part of its layer of nodes has no mass to hold.
SEEN = (0.6, 1.02)
LEAST_PUSH = 500.0  # N per m of width, with which the plate is pressed on first
NOTHING = 0.03  # of ADHESION times the face: what a plate without it may pull; 0.02 observed


def sticky(adhesion: float, phase: float) -> Scene:
    """A block on a floor it sticks to, and a plate pressed on it that then goes up; no gravity."""
    top = 0.1 + phase * DX
    up = [(0.0, 0.0), (0.02, -0.2 * DX), (1.0, 0.04)]
    height = top + 0.05
    config = {
        "name": "pull",
        "plane_strain": True,
        "box": {"lower": (0, 0, 0), "upper": (0.6, WIDTH, 0.3)},
        "feature": 4 * DX,
        "duration": 1.0,
        "gravity": (0, 0, 0),
        "walls": {"z_lower": {"kind": "stick"}},
        "grains": [
            {
                "material": {"model": "elastic", "E": 1e5, "nu": 0.2, "rho": 400.0},
                "fill": [{"shape": "box", "lower": (0.1, 0, 0), "upper": (0.5, WIDTH, top)}],
            }
        ],
        "bodies": {
            "mjcf": f"""<mujoco><worldbody><body name="plate" mocap="true" pos="0.3 {WIDTH / 2} {height}">
              <geom name="plate" type="box" size="{HALF} {WIDTH} 0.05"/></body></worldbody></mujoco>""",
            "couple": ["*"],
            "friction": 0.5,
            "adhesion": adhesion,
            "motion": {"plate": [{"t": t, "position": [0.3, WIDTH / 2, height + z]} for t, z in up]},
        },
    }
    return build(parse(SceneConfig, config, "test"), Fidelity(cells=4, rigid_dt=DT, contact_band=0.5))


def pulled(adhesion: float, phase: float) -> tuple[float, float]:
    """The largest pull on the plate and the largest push, N, of means over AVERAGE rigid steps."""
    scene = sticky(adhesion, phase)
    run = jax.jit(partial(sim.advance, scene))
    end, reaction = run(initial(scene, jax.random.key(0)), sim.scripted(scene, 0, STEPS))
    assert int(end.health) == Health.WELL
    force = np.convolve(np.asarray(reaction, np.float64)[:, 0, 2], np.ones(AVERAGE) / AVERAGE, "valid")
    return -force.min(), force.max()


@pytest.mark.parametrize("phase", [0.25, pytest.param(0.75, marks=pytest.mark.slow)])
def test_a_plate_is_held_back_by_the_adhesion_of_its_face(phase: float) -> None:
    pull, push = pulled(ADHESION, phase)
    assert push / WIDTH > LEAST_PUSH
    assert SEEN[0] < pull / (ADHESION * 2 * HALF * WIDTH) < SEEN[1]


def test_a_plate_without_adhesion_comes_off_freely() -> None:
    """Negative control."""
    pull, push = pulled(0.0, 0.25)
    assert push / WIDTH > LEAST_PUSH
    assert pull / (ADHESION * 2 * HALF * WIDTH) < NOTHING


@pytest.mark.skipif(native.why_not() is not None, reason="no native kernels, whose presence test_meeting sees to")
@each_precision
def test_materials_have_their_own_friction_and_adhesion(dtype: str) -> None:
    case = enc.sticky(dtype)
    truth = met(enc.crowd("xla"), case, REACH, "float64", "batch")
    got = met(enc.crowd("native"), case, REACH, dtype, "batch")
    assert_same(got, truth, case, dtype)
    pull = -np.sum(got.exchange.impulse * got.n, axis=1)
    share = case.shares[:, 0]
    weight = np.maximum(1 - np.abs(got.phi - (REACH - enc.LAYER)) / enc.LAYER, 0)
    assert np.all(pull <= share * 0.05 * weight * (1 + 1e-5)), "held back by more than the surface can"
    assert np.mean(pull > 0) > 0.1, "hardly any point is held back"
    plain = met(
        enc.crowd("native"), case._replace(hold=0 * case.hold, shares=case.shares[:, ::-1]), REACH, dtype, "batch"
    )
    assert np.abs(plain.exchange.impulse - got.exchange.impulse).max() > 0.01
