"""The words of a scene file: what is simulated. Nothing here says how finely."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from mpm_env.config import Section, find, nearest, overlay, parse, read_yaml

Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
PACKAGE = "package:"  # before the name of an .xml that this package ships
SIDES = ("x_lower", "x_upper", "y_lower", "y_upper", "z_lower", "z_upper")


class Box(Section):
    """An upright box."""

    lower: Vec3  # m
    upper: Vec3  # m

    @model_validator(mode="after")
    def _ordered(self) -> Box:
        for axis, low, high in zip("xyz", self.lower, self.upper, strict=True):
            if not low < high:
                raise ValueError(f"needs lower < upper along {axis}, got {low} and {high}")
        return self


class WallConfig(Section):
    """A side of the simulated box; see mpm_env.mpm.types.Wall."""

    kind: Literal["slip", "stick", "separate", "open"] = "slip"
    friction: NotNegative = 0.0  # only for "separate"

    @model_validator(mode="after")
    def _rubs(self) -> WallConfig:
        if self.friction and self.kind != "separate":
            raise ValueError(f"a wall of kind {self.kind!r} has no friction, got {self.friction}: use 'separate'")
        return self


class SolidConfig(Section):
    """What every material has; rho is that of the bed."""

    model: str
    about: str = ""
    E: Positive  # Pa
    nu: Annotated[float, Field(ge=0, lt=0.5)]
    rho: Positive  # kg/m^3


class ElasticConfig(SolidConfig):
    """Elastic solid."""

    model: Literal["elastic"]
    nu: Annotated[float, Field(gt=-1, lt=0.5)]


class SandConfig(SolidConfig):
    """Drucker-Prager sand."""

    model: Literal["sand"]
    friction_deg: Annotated[float, Field(ge=0, lt=90)]
    friction_fit: Literal["triaxial", "plane_strain", "mc2d"] = "triaxial"  # "mc2d": plane strain only
    cohesion: NotNegative = 0.0  # Pa
    volume_correction: bool = True


class SnowConfig(SolidConfig):
    """Stomakhin snow."""

    model: Literal["snow"]
    theta_c: Annotated[float, Field(gt=0, lt=1)]
    theta_s: Annotated[float, Field(gt=0, lt=1)]
    xi: NotNegative
    Jp_min: Annotated[float, Field(gt=0, le=1)] = 0.8


class VonMisesConfig(SolidConfig):
    """Metal-like solid with linear hardening."""

    model: Literal["von_mises"]
    yield_stress: Positive  # Pa, uniaxial
    hardening: NotNegative = 0.0  # Pa


class HerschelBulkleyConfig(SolidConfig):
    """Viscoplastic mud, paste or foam."""

    model: Literal["herschel_bulkley"]
    yield_stress: NotNegative  # Pa, in shear
    consistency: NotNegative  # Pa s^flow_index
    flow_index: Annotated[float, Field(ge=0.1, le=10)] = 1.0


class MuIConfig(SolidConfig):
    """Granular flow with the friction mu(I)."""

    model: Literal["mu_i"]
    mu_s: Positive
    mu_2: Positive
    I_0: Positive
    grain_size: Positive  # m
    grain_density: Positive  # kg/m^3, of a grain
    volume_correction: bool = True

    @model_validator(mode="after")
    def _speeds_up(self) -> MuIConfig:
        if not self.mu_s < self.mu_2:
            raise ValueError(f"needs mu_s < mu_2, got {self.mu_s} and {self.mu_2}")
        return self


class CamClayConfig(SolidConfig):
    """Cam-Clay snow or soil that hardens, softens and breaks."""

    model: Literal["cam_clay"]
    M: Positive
    beta: NotNegative
    xi: Positive
    compaction: NotNegative


MaterialConfig = Annotated[
    ElasticConfig | SandConfig | SnowConfig | VonMisesConfig | HerschelBulkleyConfig | MuIConfig | CamClayConfig,
    Field(discriminator="model"),
]


class MaterialFile(Section):
    """A material on its own."""

    material: MaterialConfig


def read_material(name: str, settings: tuple[str, ...] = ()) -> MaterialConfig:
    """A shipped material by name, or one from a .yaml file, with settings like "friction_deg=30" on top."""
    path = find("materials", name)
    data = read_yaml(path)
    overlay(data, settings)
    return parse(MaterialFile, {"material": data}, path.name).material


class ReliefConfig(Section):
    """A seeded uneven top."""

    height: Positive  # m, standard deviation
    wavelength: Positive  # m


class BoxFill(Section):
    """A box full of grains, its top uneven if it has a relief."""

    shape: Literal["box"]
    lower: Vec3
    upper: Vec3
    velocity: Vec3 = (0.0, 0.0, 0.0)
    relief: ReliefConfig | None = None


class SphereFill(Section):
    """A ball of grains; in plane strain a disc."""

    shape: Literal["sphere"]
    centre: Vec3
    radius: Positive
    velocity: Vec3 = (0.0, 0.0, 0.0)


class CylinderFill(Section):
    """An upright cylinder of grains, standing on its base centre."""

    shape: Literal["cylinder"]
    base: Vec3
    radius: Positive
    height: Positive
    velocity: Vec3 = (0.0, 0.0, 0.0)


class GrainsConfig(Section):
    """Some shapes filled with one material."""

    material: MaterialConfig
    fill: Annotated[
        list[Annotated[BoxFill | SphereFill | CylinderFill, Field(discriminator="shape")]], Field(min_length=1)
    ]


class Waypoint(Section):
    """Where a mocap body is at a time; positions are joined by a monotone cubic, turns by slerp."""

    t: NotNegative
    position: Vec3
    quaternion: Quaternion | None = None  # w x y z; None keeps the model's


PerGrains = Annotated[
    list[NotNegative], Field(min_length=1), BeforeValidator(lambda v: v if isinstance(v, list | tuple) else [v])
]


class BodiesConfig(Section):
    """A MuJoCo model and what of it meets the grains."""

    # The MJCF text itself, whose timestep gives way to the fidelity's rigid_dt. In a file: the name of an .xml beside
    # it, or package:NAME.
    mjcf: str
    assets: dict[str, str] = {}  # mesh and texture files the model needs, base64; filled when a file is read
    couple: Annotated[list[str], Field(min_length=1)]  # names or patterns of the coupled geoms
    # Numbers below are for all grains, or a list with one for each entry of `grains`.
    friction: PerGrains = [0.4]  # between coupled geoms and grains
    friction_of: dict[str, PerGrains] = {}  # pattern -> friction, where it differs
    adhesion: PerGrains = [0.0]  # Pa, the pull at which grains come off the coupled geoms: cohesive snow, wet sand
    keyframe: str | None = None  # joint positions and velocities at the start
    controls: dict[str, list[tuple[NotNegative, float]]] = {}  # actuator -> (t, value), joined by a monotone cubic
    motion: dict[str, Annotated[list[Waypoint], Field(min_length=1)]] = {}  # mocap body -> waypoints


class Camera(Section):
    """A view for pictures."""

    eye: Vec3
    target: Vec3
    fov_deg: Annotated[float, Field(gt=1, lt=170)] = 40.0


class SceneConfig(Section):
    """What is simulated."""

    name: str
    about: str = ""
    box: Box  # the simulated space
    plane_strain: bool = False  # simulated in 2-D, its middle slice, whatever the fidelity's dimension
    feature: Positive  # m; the length that a fidelity cuts into its number of cells
    gravity: Vec3 = (0.0, 0.0, -9.81)
    duration: Positive  # s
    speed: Positive | None = None  # m/s, the fastest grain expected; default: free fall through the box
    walls: dict[str, WallConfig] = {}  # side -> wall; sides not named slip
    grains: list[GrainsConfig] = []
    start: Literal["unstrained", "geostatic"] = "unstrained"  # geostatic: beds start at rest, see mpm_env.mpm.settling
    bodies: BodiesConfig | None = None
    fidelity: str = "standard"  # used where none is asked for
    camera: Camera | None = None

    @model_validator(mode="after")
    def _sides(self) -> SceneConfig:
        for side in self.walls:
            if side not in SIDES:
                raise ValueError(f"walls has no side {side!r}{nearest(side, SIDES)}")
        return self


def read_scene(name: str, settings: tuple[str, ...] = ()) -> SceneConfig:
    """A shipped scene by name, or one from a .yaml file, with settings like "grains.0.material.E=1e6" on top.

    Names of materials and MJCF files are replaced by what they hold, so that the result stands on its own.
    """
    path = find("scenes", name)
    data: dict[str, Any] = {"name": path.stem, **read_yaml(path)}
    resolve(data, path.parent)
    overlay(data, settings)
    resolve(data, path.parent)
    return parse(SceneConfig, data, path.name)


def resolve(data: dict[str, Any], folder: Path) -> None:
    """Replace, in place, the names of materials and of MJCF files by their contents."""
    beds = data.get("grains")
    for grains in beds if isinstance(beds, list) else []:
        if isinstance(grains, dict) and isinstance(grains.get("material"), str):
            grains["material"] = read_yaml(find("materials", grains["material"], folder))
    bodies = data.get("bodies")
    if isinstance(bodies, dict) and isinstance(bodies.get("mjcf"), str) and bodies["mjcf"].endswith(".xml"):
        name = bodies["mjcf"]
        file = Path(__file__).parent / name.removeprefix(PACKAGE) if name.startswith(PACKAGE) else folder / name
        if not file.is_file():
            raise ValueError(f"bodies.mjcf: there is no file {file}.")
        bodies["mjcf"] = file.read_text(encoding="utf-8")
        bodies["assets"] = assets_of(bodies["mjcf"], file.parent)


def assets_of(xml: str, folder: Path) -> dict[str, str]:
    """The files that a model's meshes, textures and height fields name, base64."""
    import base64
    import xml.etree.ElementTree as ET

    try:
        root = ET.fromstring(xml)
    except ET.ParseError:
        return {}  # MuJoCo will say what is wrong with it, better than we can
    compiler = root.find("compiler")
    sub = {k: (compiler.get(k, "") if compiler is not None else "") for k in ("meshdir", "texturedir", "assetdir")}
    out = {}
    for kind, key in (("mesh", "meshdir"), ("texture", "texturedir"), ("hfield", "meshdir")):
        for node in root.iter(kind):
            name = node.get("file")
            file = folder / (sub[key] or sub["assetdir"]) / name if name else None
            if name and file and file.is_file():
                out[name] = base64.b64encode(file.read_bytes()).decode()
    return out
