"""A slice of sand to run, with or without bodies in it."""

from __future__ import annotations

from typing import Any

from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.scene_config import SceneConfig

SAND = {"model": "sand", "E": 1e5, "nu": 0.3, "rho": 1600.0, "friction_deg": 35.0}
MODEL = """
<mujoco>
  <worldbody>
    <body name="hand" mocap="true" pos=".08 .1 .09"><geom name="paddle" type="box" size=".02 .1 .06"/></body>
    <geom name="kerb" type="box" pos=".36 .1 .01" size=".02 .1 .02"/>
  </worldbody>
</mujoco>
"""
SPEED = 0.5  # m/s of the paddle
NUMERICS = Fidelity(cells=3, rigid_dt=0.004)
F32 = 1e-5  # share that sums over some hundred numbers of f32 may be off


def slice_of_sand(bodies: bool, **changed: Any) -> SceneConfig:
    """Sand in a slice 0.4 m long, 0.2 m thick; with bodies, a paddle moves through it towards a kerb."""
    data: dict[str, Any] = {
        "name": "slice",
        "plane_strain": True,
        "box": {"lower": [0.0, 0.0, 0.0], "upper": [0.4, 0.2, 0.2]},
        "feature": 0.1,
        "duration": 0.2,
        "walls": {"z_lower": {"kind": "separate", "friction": 0.5}},
        "grains": [
            {"material": SAND, "fill": [{"shape": "box", "lower": [0.13, 0.0, 0.0], "upper": [0.33, 0.2, 0.1]}]}
        ],
        **changed,
    }
    if bodies:
        path = [{"t": t, "position": [0.08 + SPEED * t, 0.1, 0.09]} for t in (0.0, 0.2)]
        data["bodies"] = {"mjcf": MODEL, "couple": ["paddle", "kerb"], "motion": {"hand": path}}
    return parse(SceneConfig, data, "slice")
