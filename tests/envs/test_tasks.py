"""The contract of every task, over the registered ids: spaces, seeds, reward terms, refusals, determinism."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium as gym
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mpm_env  # noqa: F401  registers the ids
from mpm_env.env import GrainsEnv, GrainsVectorEnv
from mpm_env.health import Health
from mpm_env.tasks import TASKS, make_task, read_task
from mpm_env.tasks.episode import actions_per_episode, scripted_action

IDS = sorted(spec for spec in gym.registry if spec.startswith("mpm_env/"))
ACTIONS = 8
F32 = 1e-6  # a weighted sum of six terms in f32 against the same in f64


@pytest.fixture(scope="module", params=IDS)
def env(request: pytest.FixtureRequest) -> Iterator[GrainsEnv]:
    """One environment per id for all tests of this file: it compiles once."""
    made = gym.make(request.param, fidelity="draft", render_mode="rgb_array").unwrapped
    assert isinstance(made, GrainsEnv)
    yield made
    made.close()


def rollout(env: GrainsEnv, seed: int, count: int = ACTIONS) -> list[tuple[Any, ...]]:
    """Some scripted, some random actions from a seed."""
    chance = np.random.default_rng(seed)
    steps: list[tuple[Any, ...]] = [env.reset(seed=seed)]
    for k in range(count):
        assert env.episode is not None
        random = chance.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        steps.append(env.step(scripted_action(env.task, env.episode) if k % 2 else random))
    return steps


def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([observation[k].ravel() for k in sorted(observation)])


def test_every_task_file_has_an_id_and_a_model() -> None:
    named = {gym.spec(i).kwargs["task"] for i in IDS}
    assert len(IDS) == 4
    for name in named:
        assert read_task(name).model in TASKS


@pytest.mark.slow
def test_env_checker_finds_nothing(env: GrainsEnv) -> None:
    check_env(env)  # warnings are errors


@pytest.mark.slow
def test_observations_are_in_their_space_and_finite(env: GrainsEnv) -> None:
    for step in rollout(env, seed=3):
        assert env.observation_space.contains(step[0])
        assert np.isfinite(flat(step[0])).all()


@pytest.mark.slow
def test_reward_is_the_weighted_sum_of_terms_in_the_unit_interval(env: GrainsEnv) -> None:
    weights = env.task.term_weights
    assert sum(weights.values()) == pytest.approx(1.0)
    for _, reward, _, _, info in rollout(env, seed=4)[1:]:
        assert set(info["terms"]) == set(weights)
        assert all(0.0 <= v <= 1.0 for v in info["terms"].values())
        assert reward == pytest.approx(sum(weights[k] * v for k, v in info["terms"].items()), abs=F32)


@pytest.mark.slow
def test_a_seed_decides_everything(env: GrainsEnv) -> None:
    once, again, other = rollout(env, seed=5), rollout(env, seed=5), rollout(env, seed=6)
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(flat(a[0]), flat(b[0]))
    assert not np.array_equal(once[0][0]["height_map"], other[0][0]["height_map"])


@pytest.mark.slow
def test_no_observed_quantity_is_constant(env: GrainsEnv) -> None:
    env.reset(seed=7)
    seen = []
    for _ in range(16):  # long enough for the tool to meet the material
        assert env.episode is not None
        seen.append(env.step(scripted_action(env.task, env.episode))[0])
    for name in seen[0]:
        moving = np.ptp(np.stack([o[name] for o in seen]), axis=0) > 0
        if name == "height_map":
            assert moving.any()
        elif name != "mass":  # the next test moves the masses
            # A straight push leaves the targets of slide y and yaw where they are.
            assert moving.any() if name == "targets" else moving.all(), name


@pytest.mark.slow
def test_masses_follow_the_grains(env: GrainsEnv) -> None:
    env.reset(seed=0)
    assert env.episode is not None
    state, scene = env.episode.state, env.task.scene
    total = float(np.sum(np.asarray(state.grains.m)))
    goal = {"dig": "bin_kg", "push": "goal_kg"}[env.task.config.model]
    place = np.asarray([1.0, 0.0, 0.1]) - scene.grid.origin
    there = replace(state.grains, x=jnp.broadcast_to(jnp.asarray(place, jnp.float32)[:, None], state.grains.x.shape))
    assert float(env.task.facts(state)[goal]) == 0.0
    assert float(env.task.facts(replace(state, grains=there))[goal]) == pytest.approx(total, rel=1e-5)
    gone = env.task.facts(replace(state, left=jnp.float32(2.0)))
    assert float(gone["spilled_kg"]) == pytest.approx(2.0)
    assert float(gone["moved_kg"]) == pytest.approx(2.0)


@pytest.mark.slow
def test_a_varied_episode_compiles_once(env: GrainsEnv) -> None:
    rollout(env, seed=9)
    assert env._step._cache_size() == 1
    assert env._reset._cache_size() == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        ([0.0, np.nan, 0.0], "finite"),
        ([0.0, np.inf, 0.0], "finite"),
        ([0.0, 1.5, 0.0], r"\[-1, 1\]"),
        ([0.0, 0.0], "shape"),
        ([[0.0, 0.0, 0.0]], "shape"),
        ("dig", "numbers"),
    ],
)
def test_a_bad_action_gets_a_sentence(env: GrainsEnv, action: Any, sentence: str) -> None:
    env.reset(seed=0)
    with pytest.raises(ValueError, match=sentence):
        env.step(action)


@pytest.mark.slow
def test_time_runs_out_with_a_reason(env: GrainsEnv) -> None:
    env.reset(seed=0)
    assert env.episode is not None
    last = jnp.asarray(actions_per_episode(env.task) - 1, jnp.int32)
    env.episode = replace(env.episode, actions=last)
    *_, truncated, info = env.step(np.zeros(3, np.float32))
    assert truncated
    assert "time limit" in info["truncated_because"]


@pytest.mark.slow
def test_a_state_that_is_not_finite_is_truncated_and_its_numbers_stay_finite(env: GrainsEnv) -> None:
    env.reset(seed=0)
    assert env.episode is not None
    grains = env.episode.state.grains
    sick = replace(env.episode.state, grains=replace(grains, v=grains.v.at[0, 0].set(jnp.nan)))
    env.episode = replace(env.episode, state=sick)
    observation, reward, terminated, truncated, info = env.step(np.zeros(3, np.float32))
    assert truncated and not terminated
    assert Health(info["health"]) & Health.NOT_FINITE
    assert "not finite" in info["truncated_because"]
    assert np.isfinite(flat(observation)).all() and np.isfinite(reward)


@pytest.mark.slow
def test_a_step_writes_over_the_episode_before(env: GrainsEnv) -> None:
    env.reset(seed=0)
    assert env.episode is not None
    before = env.episode
    env.step(np.zeros(3, np.float32))
    assert before.state.grains.x.is_deleted()
    assert before.state.rigid.xpos.is_deleted()
    assert np.isfinite(np.asarray(env.task.scene.materials[0].rho)), "the scene's own arrays went with it"


@pytest.mark.slow
def test_a_picture_shows_robot_and_grains(env: GrainsEnv) -> None:
    env.reset(seed=0)
    image = env.render()
    assert image is not None and image.shape == (320, 480, 3) and image.dtype == np.uint8
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 500


def test_a_step_before_reset_is_refused() -> None:
    env = GrainsEnv("push_sand", "draft")
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(3, np.float32))


def test_an_unknown_render_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="render_mode"):
        GrainsEnv("push_sand", "draft", render_mode="human")


def test_a_control_step_that_is_no_whole_number_of_rigid_steps_is_refused() -> None:
    config = read_task("push_sand", ("control_dt=0.03",))
    with pytest.raises(ValueError, match=r"control_dt = 0\.03 s is 7\.5 times 0\.004 s"):
        make_task(config, "draft")


@pytest.mark.slow
def test_a_batch_equals_its_environments_one_by_one_across_a_partial_reset() -> None:
    batch = GrainsVectorEnv(2, "push_sand", "draft")
    alone = GrainsEnv("push_sand", "draft")
    seeds = [11, 12]
    first, _ = batch.reset(seed=seeds)
    chance = np.random.default_rng(0)
    actions = chance.uniform(-1, 1, (4, 2, 3)).astype(np.float32)
    assert batch.episodes is not None
    last = actions_per_episode(batch.task) - 3
    batch.episodes = replace(batch.episodes, actions=jnp.asarray([last, 0], jnp.int32))
    seen = [batch.step(a) for a in actions]
    assert [bool(s[3][0]) for s in seen] == [False, False, True, False]  # the first ends, and starts anew
    for i, seed in enumerate(seeds):
        observation, _ = alone.reset(seed=seed)
        np.testing.assert_array_equal(flat(observation), flat({k: v[i] for k, v in first.items()}))
        for k, step in enumerate(seen):
            if i == 0 and k == 3:
                assert step[1][0] == 0.0
                observation, _ = alone.reset()
            else:
                observation, reward, *_ = alone.step(actions[k, i])
                assert reward == pytest.approx(step[1][i], abs=F32)
            np.testing.assert_allclose(flat(observation), flat({k: v[i] for k, v in step[0].items()}), atol=1e-5)
