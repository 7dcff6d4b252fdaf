"""A scene of one's own, in Python: a light box dropped on sand, simulated as pure functions."""

from functools import partial

import jax
import numpy as np

from mpm_env import Fidelity, SceneConfig, advance, build, initial, scripted

BOX = """
<mujoco>
  <worldbody>
    <body name="box" pos="0.2 0 0.2">
      <freejoint/>
      <geom name="box" type="box" size="0.06 0.06 0.03" density="150"/>
    </body>
  </worldbody>
</mujoco>
"""

SCENE = {
    "name": "light_box",
    "box": {"lower": [0, -0.2, 0], "upper": [0.4, 0.2, 0.32]},
    "feature": 0.08,
    "duration": 1.0,
    "walls": {"z_lower": {"kind": "separate", "friction": 0.5}},
    "grains": [
        {
            "material": {"model": "sand", "E": 1e6, "nu": 0.3, "rho": 1500, "friction_deg": 35},
            "fill": [{"shape": "box", "lower": [0, -0.2, 0], "upper": [0.4, 0.2, 0.12]}],
        }
    ],
    "bodies": {"mjcf": BOX, "couple": ["box"]},
}


def main(cells: int = 2, dimension: int = 3, seconds: float = 0.6) -> dict[str, float]:
    """Drop the box; returns its weight, the sand's push on it at the end in N, and how fast it still moves in m/s."""
    scene = build(SceneConfig.model_validate(SCENE), Fidelity(cells=cells, dimension=dimension))
    state = initial(scene, jax.random.key(0))
    run = jax.jit(partial(advance, scene))
    steps = round(seconds / scene.rigid_dt)
    state, reactions = run(state, scripted(scene, 0, steps))
    model = scene.bodies.model
    return {
        "weight_N": float(9.81 * model.body_subtreemass[0]),
        "push_N": float(np.asarray(reactions)[-steps // 4 :, 0, 2].mean()),
        "speed_m_per_s": float(np.linalg.norm(np.asarray(state.rigid.qvel[:3]))),
        "health": float(state.health),
    }


if __name__ == "__main__":
    for name, value in main().items():
        print(f"{name}: {value:.4g}")
