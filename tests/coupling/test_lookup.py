"""Who is near a body is looked up alike by both kernels, in any precision, and in any mixture of materials."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from coupling.bodies import open_step
from mpm_env import native
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.scene import Scene, State, build, initial
from mpm_env.scene_config import SceneConfig
from mpm_env.sim_contact import Contact
from tests.unit import slices

KERNELS = ["xla"] if native.why_not() else ["xla", "native"]


def looked_up(scene: Scene, state: State, kernels: str) -> Contact:
    """What a rigid step finds near the bodies at its start."""
    assert scene.bodies is not None
    still = jnp.zeros((len(scene.bodies.bodies), 6), state.rigid.qpos.dtype)
    stance = open_step(scene.bodies, state.rigid, still)[1]
    stance = jax.tree.map(lambda a: a.astype(scene.dtype), stance)
    return Contact.of(replace(scene, kernels=kernels), stance, state.grains)


def two_beds() -> Scene:
    """Two materials side by side under a plate that treats them differently, in plane strain."""
    config = {
        "name": "beds",
        "plane_strain": True,
        "box": {"lower": (0, 0, 0), "upper": (0.4, 0.1, 0.3)},
        "feature": 0.1,
        "duration": 1.0,
        "grains": [
            {"material": slices.SAND, "fill": [{"shape": "box", "lower": (a, 0, 0), "upper": (a + 0.2, 0.1, 0.1)}]}
            for a in (0.0, 0.2)
        ],
        "bodies": {
            "mjcf": """<mujoco><worldbody><body name="plate" mocap="true" pos="0.2 0.05 0.13">
              <geom name="plate" type="box" size="0.1 0.1 0.03"/></body></worldbody></mujoco>""",
            "couple": ["*"],
            "friction": [0.2, 0.6],
        },
    }
    return build(parse(SceneConfig, config, "test"), Fidelity(cells=4, dimension=2))


@pytest.mark.parametrize("wide", [False, True])
def test_both_kernels_watch_the_same_also_with_64_bit_jax(wide: bool) -> None:
    with jax.enable_x64(wide):
        scene = two_beds()
        state = initial(scene, jax.random.key(0))
        assert scene.dtype == np.float32
        some = [looked_up(scene, state, kernels) for kernels in KERNELS]
        for one in some:
            assert np.count_nonzero(np.asarray(one.watched) < scene.grid.nodes) > 20
            np.testing.assert_array_equal(one.watched, some[0].watched)
            np.testing.assert_array_equal(one.grains_near, some[0].grains_near)


@pytest.mark.parametrize("kernels", KERNELS)
def test_watched_nodes_know_the_materials_around_them_and_those_without_take_the_middle(kernels: str) -> None:
    scene = two_beds()
    one = looked_up(scene, initial(scene, jax.random.key(0)), kernels)
    shares, here = np.asarray(one.shares), np.asarray(one.watched) < scene.grid.nodes
    np.testing.assert_allclose(shares.sum(axis=0)[here], 1, rtol=1e-6)
    x, z = np.asarray(one.nodes_x)[[0, 2]]
    low = here & (z < 0.11)
    for expected, some in (([1, 0], low & (x < 0.14)), ([0, 1], low & (x > 0.26)), ([0.5, 0.5], here & (z > 0.14))):
        assert some.any()
        assert np.abs(shares[:, some].T - expected).max() < 1e-6


def test_no_shares_are_kept_where_materials_are_treated_alike() -> None:
    scene = two_beds()
    assert scene.bodies is not None
    alike = replace(scene, bodies=replace(scene.bodies, friction=((0.2, 0.2),)))
    assert looked_up(alike, initial(alike, jax.random.key(0)), "xla").shares is None
