"""A batch of episodes as one compiled program: the functional form, one friction angle per environment."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mpm_env import make_task
from mpm_env.tasks import Task, reset, step


def episode(task: Task, actions: int, key: Array, friction: Array) -> Array:
    """Push straight ahead through sand of a given friction angle (rad); returns the pile's mean x (m)."""
    start = reset(task, key)
    materials = tuple(replace(m, friction=friction.astype(m.friction.dtype)) for m in start.state.materials)
    start = replace(start, state=replace(start.state, materials=materials))
    ahead = jnp.array([1.0, 0.0, 0.0])
    end = lax.fori_loop(0, actions, lambda _, e: step(task, e, ahead), start)
    return end.facts["pile_x_m"]


def main(fidelity: str = "draft", count: int = 3, actions: int = 15) -> dict[str, float]:
    """Run `count` environments; returns where the pile of each friction angle went, m."""
    task = make_task("push_sand", fidelity)
    degrees = np.linspace(25, 45, count)
    keys = jax.random.split(jax.random.key(0), count)
    run = jax.jit(lambda k, f: lax.map(lambda both: episode(task, actions, *both), (k, f)))
    places = np.asarray(run(keys, jnp.asarray(np.radians(degrees), jnp.float32)))
    return {f"pile_x_m at {d:.0f} deg": float(x) for d, x in zip(degrees, places, strict=True)}


if __name__ == "__main__":
    for name, value in main().items():
        print(f"{name}: {value:.3f}")
