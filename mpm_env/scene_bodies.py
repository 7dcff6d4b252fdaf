"""The rigid side of a scene: the MuJoCo model, what of it meets grains, and the room for that."""

from __future__ import annotations

import base64
import fnmatch
from typing import NamedTuple

import mujoco
import numpy as np

from coupling.bodies import Bodies, couple
from coupling.geoms import bounding_radius, thickness
from coupling.reach import points_near
from mpm_env.config import nearest
from mpm_env.fidelity import Fidelity
from mpm_env.health import MOST_TRAVEL
from mpm_env.mpm.types import Grid
from mpm_env.scene_config import BodiesConfig, SceneConfig, Vec3

CROWDED = 1.5  # grains near a tool may be packed this much denser than at the start
ICE = 917.0  # kg/m^3, beyond which no snow is packed
ROOM = 1.3  # how many more nodes than counted at the start may be near a tool, for how it turns and lies in the grid
NODE_DEPTH = 2.0  # cells inside a body down to which nodes are looked at: deeper ones carry no grains
THINNEST_BY_GRID = 2.5  # cells; nodes in front of and behind a thinner geom feel the same grains: at 2, 3 % leak


class Sizes(NamedTuple):
    """Static sizes of the buffers for points near bodies."""

    nodes: int
    grains: int


def model_of(bodies: BodiesConfig, fidelity: Fidelity, gravity: Vec3) -> mujoco.MjModel:
    assets = {name: base64.b64decode(text) for name, text in bodies.assets.items()}
    try:
        model = mujoco.MjModel.from_xml_string(bodies.mjcf, assets)
    except ValueError as error:
        raise ValueError(f"bodies.mjcf is not a model that MuJoCo can read: {' '.join(str(error).split())}") from None
    model.opt.timestep = fidelity.rigid_dt
    model.opt.gravity[:] = gravity  # the scene's, so that grains and bodies fall alike
    return model


def bodies_of(config: SceneConfig, model: mujoco.MjModel, grid: Grid, f: Fidelity) -> Bodies:
    """What of the model meets the grains. Raises ValueError for geoms that this fidelity cannot keep grains out of."""
    assert config.bodies is not None
    b = couple(model, _coupled(config.bodies, model, len(config.grains)))
    for name, shape in zip(b.names, b.shapes, strict=True):
        cells = thickness(shape) / grid.cell_size
        if not f.push_out and cells < THINNEST_BY_GRID:
            raise ValueError(
                f"The geom {name!r} is {cells:.2g} cells thick, and without push_out grains leak through geoms thinner"
                f" than {THINNEST_BY_GRID:g}: set fidelity.push_out = true, or use smaller cells or a thicker geom."
            )
    return b


def _coupled(bodies: BodiesConfig, model: mujoco.MjModel, grains: int) -> dict[int, tuple[float, ...]]:
    """Ids of the coupled geoms, and their friction to each of so many entries of grains."""
    names = {i: model.geom(i).name for i in range(model.ngeom)}
    known = [n for n in names.values() if n]
    out: dict[int, tuple[float, ...]] = {}
    for pattern in (*bodies.couple, *bodies.friction_of):
        if not fnmatch.filter(known, pattern):
            raise ValueError(f"The model has no geom named {pattern!r}{nearest(pattern, known)}")
    for i, name in names.items():
        if name and any(fnmatch.fnmatch(name, p) for p in bodies.couple):
            special = [mu for p, mu in bodies.friction_of.items() if fnmatch.fnmatch(name, p)]
            out[i] = per_grains("friction", special[-1] if special else bodies.friction, grains)
    return out


def per_grains(name: str, values: list[float], grains: int) -> tuple[float, ...]:
    """Values for each of so many entries of grains, of which one value serves all."""
    if len(values) not in (1, grains):
        raise ValueError(
            f"bodies.{name} has {len(values)} numbers for {grains} entries of grains: give one, or one each."
        )
    return tuple(values) if len(values) == grains else tuple(values * grains)


def sizes_of(bodies: Bodies, grid: Grid, config: SceneConfig, f: Fidelity, slots: int, middle: float) -> Sizes:
    """Room for the nodes and grains near bodies: their shells' volume, MOST_TRAVEL added for one rigid step."""
    snow = [ICE / g.material.rho for g in config.grains if g.material.model == "snow"]
    crowded = max([CROWDED, *snow])
    dx = grid.cell_size
    slice_at = middle if grid.dimension == 2 else None
    infinite = any(not np.isfinite(bounding_radius(s)) for s in bodies.shapes)
    bands = (-NODE_DEPTH * dx, (f.contact_band + MOST_TRAVEL) * dx), (-MOST_TRAVEL * dx, MOST_TRAVEL * dx)
    shell, near = points_near(bodies, bands, dx, middle=slice_at)
    nodes = grid.nodes if infinite else min(grid.nodes, int(ROOM * shell) + 64)
    grains = slots if infinite else min(slots, int(crowded * near * f.particles_per_axis**grid.dimension) + 64)
    return Sizes(nodes, grains if f.push_out else 0)
