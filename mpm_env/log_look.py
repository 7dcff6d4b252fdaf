"""How a recording looks in the Rerun viewer: colours, shapes of the bodies, arrangement. Used by `mpm_env.log`."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from mpm_env.log_read import rerun
from mpm_env.render_surface import colour_of_geoms, shown_geoms

# What colours the grains: the values from the dark to the light end. None: from the scene, or categories.
COLOUR_RANGES: dict[str, tuple[float, float] | None] = {"speed": (0.0, 0.5), "height": None, "material": None}
QUANTITY_UNITS = {"speed": "m/s", "height": "m"}
# Blue, red, yellow in nearly even steps of lightness, so that equal differences look equal, in grey too.
RAMP_RGB = np.stack(
    [
        np.interp(np.linspace(0, 8, 256), np.arange(9), channel).round()
        for channel in (
            (77, 110, 157, 204, 242, 255, 255, 253, 241),
            (93, 98, 99, 102, 114, 138, 172, 209, 238),
            (128, 167, 182, 173, 148, 119, 107, 133, 192),
        )
    ],
    axis=1,
).astype(np.uint8)
MATERIAL_RGB = np.array([(214, 178, 112), (150, 200, 235), (120, 170, 95), (200, 105, 90), (165, 130, 200)], np.uint8)
NOT_A_NUMBER_RGB = np.array((255, 0, 255), np.uint8)  # loud on purpose: no ramp colour comes near it
LINE_RGB = [(235, 90, 80), (95, 200, 110), (90, 150, 245), (240, 190, 70), (190, 130, 235), (80, 205, 205)]
BACKGROUND_RGB, BOX_RGB, ARROW_RGB = (24, 27, 33), (110, 115, 125), (235, 70, 50)
FLAT_SHARE = 0.1  # a box thinner than this in y, as in plane strain, is looked at from the front
SLAB_SHARE = 0.005  # thickness of a drawn plane, as a share of the box diagonal
ARROW_RADIUS_SHARE = 0.006  # of the box diagonal
ARROW_SHARE = 0.2  # an arrow of the moving bodies' weight is this share of the box diagonal
SHORT_TEXT = 80  # longer texts of a recipe (MJCF) are stored, but not spread over the panel of facts


def colour_range(
    quantity: str, given: tuple[float, float] | None, floor: float, ceiling: float
) -> tuple[float, float] | None:
    """The values at the dark and the light end; None for a category."""
    if given is not None:
        if not given[0] < given[1]:
            raise ValueError(f"value_range = {given} is empty: give (low, high) with low < high.")
        return float(given[0]), float(given[1])
    if quantity not in COLOUR_RANGES:
        raise ValueError(f"quantity {quantity!r} is none of {[*COLOUR_RANGES]}: give a value_range with it.")
    return (float(floor), float(ceiling)) if quantity == "height" else COLOUR_RANGES[quantity]


def colours(values: np.ndarray, span: tuple[float, float] | None) -> np.ndarray:
    """(n, 3) uint8."""
    finite = np.isfinite(values)
    known = np.where(finite, values, 0)
    if span is None:
        rgb = MATERIAL_RGB[known.astype(int) % len(MATERIAL_RGB)]
    else:
        share = np.clip((known - span[0]) / (span[1] - span[0]), 0.0, 1.0)
        rgb = RAMP_RGB[(255 * share).astype(int)]
    return np.where(finite[:, None], rgb, NOT_A_NUMBER_RGB)


def eye_and_target(
    view: tuple[Sequence[float], Sequence[float]] | None, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the 3-D view stands and what it looks at, (3,) m each; None: from the front right, above."""
    if view is not None:
        return np.asarray(view[0], float), np.asarray(view[1], float)
    target, size = (lower + upper) / 2, upper - lower
    flat = size[1] < FLAT_SHARE * float(np.linalg.norm(size))
    aside = np.array([0.0, -0.9, 0.1] if flat else [0.4, -0.8, 0.5])
    return target + float(np.linalg.norm(size)) * aside, target


def arrow_scale(model: mujoco.MjModel | None, diagonal: float) -> float:
    """Metres of arrow per newton, so that one metre is newtons of one digit."""
    weight = 0.0
    if model is not None:
        moving = [body for body in range(model.nbody) if moves(model, body)]
        weight = float(model.body_mass[moving].sum() * np.linalg.norm(model.opt.gravity))
    return 1.0 / float(f"{max(weight, 1.0) / (ARROW_SHARE * diagonal):.0e}")


def draw_scene(rec: Any, model: mujoco.MjModel | None, lower: np.ndarray, upper: np.ndarray) -> dict[int, str]:
    """Log what never changes: box, shapes, places of what stands still. Entity paths of the geoms that move."""
    rr = rerun()
    rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    wires = rr.components.FillMode.MajorWireframe
    box = rr.Boxes3D(mins=[lower], sizes=[upper - lower], colors=[BOX_RGB], fill_mode=wires)
    rec.log("world/box", box, static=True)
    moving: dict[int, str] = {}
    if model is None:
        return moving
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 3)
    for geom in np.flatnonzero(shown_geoms(model)).tolist():
        body = model.geom_bodyid[geom]
        names = [model.body(body).name or f"body {body}", model.geom(geom).name or f"geom {geom}"]
        path = rr.new_entity_path(["world", "bodies", *names])
        position, rotation = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
        rec.log(path, shape(model, geom, (corners - position) @ rotation), static=True)
        if moves(model, body):
            moving[geom] = path
        else:
            rec.log(path, rr.Transform3D(translation=position, mat3x3=rotation), static=True)
    return moving


def moves(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body is not fixed to the world; a mocap body has no joint and moves all the same."""
    return bool(model.body_weldid[body] or model.body_mocapid[model.body_rootid[body]] >= 0)


def shape(model: mujoco.MjModel, geom: int, corners: np.ndarray) -> Any:
    """The Rerun shape of a geom, in the geom's frame; `corners` (8, 3) m are those of the scene's box there."""
    rr, kind, size = rerun(), mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    rgba = np.round(255 * colour_of_geoms(model)[geom]).astype(np.uint8)
    if kind in MESH_OF:
        vertices, triangles = MESH_OF[kind](model, model.geom_dataid[geom])
        return rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, albedo_factor=rgba)
    fill = rr.components.FillMode.Solid if rgba[3] == 255 else rr.components.FillMode.TransparentFillMajorWireframe
    look = {"colors": [rgba], "fill_mode": fill}
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        # An endless plane is drawn as a thin slab below it, as far as the scene reaches.
        half = np.where(size[:2] > 0, size[:2], np.inf)
        lower, upper = np.maximum(corners.min(axis=0)[:2], -half), np.minimum(corners.max(axis=0)[:2], half)
        thickness = SLAB_SHARE * float(np.linalg.norm(np.ptp(corners, axis=0)))
        return rr.Boxes3D(mins=[[*lower, -thickness]], sizes=[[*(upper - lower), thickness]], **look)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        # Rerun's capsule starts at one end, MuJoCo's is centred.
        ends = [[0.0, 0.0, -size[1]]]
        return rr.Capsules3D(lengths=[2 * size[1]], radii=[size[0]], translations=ends, **look)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], **look)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return rr.Boxes3D(half_sizes=[size], **look)
    return rr.Ellipsoids3D(half_sizes=[size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[[0, 0, 0]]], **look)


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) m and triangles (t, 3)."""
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
    return vertices, model.mesh_face[face : face + model.mesh_facenum[mesh]]


def _height_field(model: mujoco.MjModel, hfield: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) m and triangles (t, 3) of its upper side."""
    rows, columns, start = model.hfield_nrow[hfield], model.hfield_ncol[hfield], model.hfield_adr[hfield]
    half_x, half_y, top, _ = model.hfield_size[hfield]
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    z = top * model.hfield_data[start : start + rows * columns]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, behind, across = corner + 1, corner + columns, corner + columns + 1
    triangles = np.concatenate([np.stack([corner, right, across], 1), np.stack([corner, across, behind], 1)])
    return np.stack([x.ravel(), y.ravel(), z], axis=1), triangles


MESH_OF: dict[mujoco.mjtGeom, Callable[[mujoco.MjModel, int], tuple[np.ndarray, np.ndarray]]] = {
    mujoco.mjtGeom.mjGEOM_MESH: _mesh,
    mujoco.mjtGeom.mjGEOM_SDF: _mesh,
    mujoco.mjtGeom.mjGEOM_HFIELD: _height_field,
}


def panel(recipe: Mapping[str, Any], quantity: str, span: tuple[float, float] | None, metres_per_newton: float) -> Any:
    """Facts beside the picture: the short entries of the recipe, and what the colours and arrows mean."""
    facts: dict[str, str] = {}
    for name, value in recipe.items():
        if name == "versions" and isinstance(value, Mapping):
            facts[name] = ", ".join(f"{package} {version}" for package, version in value.items())
        elif isinstance(value, str | bool | int | float) and len(str(value)) <= SHORT_TEXT:
            facts[name] = str(value)
    ends = f", {span[0]:.3g} (dark) to {span[1]:.3g} {QUANTITY_UNITS.get(quantity, '')} (light)" if span else ""
    facts |= {"grain colour": quantity + ends, "force arrow": f"1 m = {1.0 / metres_per_newton:.3g} N"}
    lines = [f"| {name} | {value.replace('|', ' ')} |" for name, value in facts.items()]
    return rerun().TextDocument("\n".join([lines[0], "|---|---|", *lines[1:]]), media_type="text/markdown")


def blueprint(keys: list[str], view: tuple[np.ndarray, np.ndarray]) -> Any:
    """The scene large, facts and the plots to watch beside it, the balances in a row below."""
    rerun()
    import rerun.blueprint as rrb

    eye, target = view
    scene = rrb.Spatial3DView(
        origin="world",
        name="Scene",
        background=BACKGROUND_RGB,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0.0, 0.0, 1.0)),
    )
    beside: list[Any] = [rrb.TextDocumentView(origin="facts", name="Run")]
    wrench: list[Any] = []
    below: list[Any] = []
    for name in dict.fromkeys(plot_of(key) for key in keys):
        contents = [f"plots/{key}" for key in keys if plot_of(key) == name]
        plot = rrb.TimeSeriesView(origin="plots", contents=contents, name=name, plot_legend=rrb.Corner2D.LeftTop)
        (wrench if name in ("Force", "Torque") else beside if name == "Reward" else below).append(plot)
    if wrench:
        beside.append(rrb.Tabs(*wrench))
    column = rrb.Vertical(*beside, row_shares=[1.4, 1, 1][: len(beside)])
    rows: list[Any] = [rrb.Horizontal(scene, column, column_shares=[5, 3])]
    if below:
        rows.append(rrb.Horizontal(*below))
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=[3, 1][: len(rows)]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="sim_time"),
    )


def plot_of(key: str) -> str:
    """The plot a scalar belongs to: one per group; budgets apart by what balances, forces from torques."""
    group, _, rest = key.partition("/")
    if group == "budget":
        return re.split(r"[_/]", rest)[0].capitalize() + " balance"
    if group == "wrench":
        return "Force" if "/force_" in key else "Torque"
    return group.capitalize()


def line(key: str, earlier: set[str]) -> Any:
    """Name and colour of a plot's line; Rerun's own colours may come out alike."""
    order = sum(plot_of(other) == plot_of(key) for other in earlier)
    return rerun().SeriesLines(colors=[LINE_RGB[order % len(LINE_RGB)]], names=[key.rpartition("/")[2]])
