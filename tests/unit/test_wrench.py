"""The wrench about a site is what a force-torque sensor there would tell."""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from coupling.bodies import couple, posed, start
from mpm_env.wrench import Wrench, low_pass, wrench_at

MODEL = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 .1"/>
  <body name="arm" pos="0.3 0.1 0.5" euler="20 30 40"><joint type="hinge" axis="0 1 0"/>
    <geom name="arm" type="box" size=".1 .05 .02" pos=".1 0 0"/>
    <body name="tip" pos=".2 0 0" euler="0 50 0"><geom name="tip" type="sphere" size=".04"/>
      <site name="sensor" pos="0.03 0.02 0.01" euler="10 20 30"/></body>
    <body name="paddle" pos="0 .2 0"><joint type="slide"/><geom name="paddle" type="box" size=".05 .05 .01"/></body>
  </body>
</worldbody></mujoco>"""
NAMES = ("floor", "arm", "tip", "paddle")
TOLERANCE = 2e-6  # of the largest number, float32


class Standing:
    """A scene's bodies in a pose, which is all that a wrench needs of it."""

    def __init__(self) -> None:
        model = mujoco.MjModel.from_xml_string(MODEL)
        self.bodies = couple(model, {model.geom(n).id: (0.4,) for n in NAMES})
        none = (np.zeros((0, 3)), np.zeros((0, 4)))
        self.rigid: Any = start(self.bodies, posed(self.bodies, np.array([0.4, 0.1]), np.zeros(2), np.zeros(0), none))


@pytest.fixture(scope="module")
def standing() -> Any:
    return Standing()


@pytest.mark.parametrize("frame", ["world", "site"])
def test_wrench_is_that_of_all_geoms_fixed_to_the_site(standing: Any, frame: Any) -> None:
    """Of the arm and its tip, one rigid body, and neither of the floor nor of the paddle on its own joint."""
    model, rng = standing.bodies.model, np.random.default_rng(0)
    d = mujoco.MjData(model)
    d.qpos[:] = standing.rigid.qpos
    mujoco.mj_forward(model, d)
    reaction = rng.normal(size=(5, len(NAMES), 6))
    told = wrench_at(standing, standing, jnp.asarray(reaction, jnp.float32), "sensor", frame)
    force, torque = np.zeros((5, 3)), np.zeros((5, 3))
    for name in ("arm", "tip"):
        one = reaction[:, NAMES.index(name)]
        force += one[:, :3]
        torque += one[:, 3:] + np.cross(d.body(name).xipos - d.site("sensor").xpos, one[:, :3])
    if frame == "site":
        force, torque = (a @ d.site("sensor").xmat.reshape(3, 3) for a in (force, torque))
    np.testing.assert_allclose(told.force, force, atol=TOLERANCE * np.abs(force).max())
    np.testing.assert_allclose(told.torque, torque, atol=TOLERANCE * np.abs(torque).max())


def test_an_unknown_site_is_named_with_one_like_it(standing: Any) -> None:
    with pytest.raises(ValueError, match=r"no site 'senso'.*sensor"):
        wrench_at(standing, standing, jnp.zeros((4, 6)), "senso")


def test_low_pass_forgets_at_its_rate_whatever_the_step() -> None:
    zero, one = (Wrench(jnp.full(3, a), jnp.full(3, 2 * a)) for a in (0.0, 1.0))
    for steps in (1, 7):
        now = zero
        for _ in range(steps):
            now = low_pass(now, one, 0.3 / steps, 0.2)
        np.testing.assert_allclose(now.force, 1 - np.exp(-1.5), rtol=1e-6)
        np.testing.assert_allclose(now.torque, 2 * (1 - np.exp(-1.5)), rtol=1e-6)
    np.testing.assert_array_equal(low_pass(zero, one, 0.1, 0.0).force, one.force)
