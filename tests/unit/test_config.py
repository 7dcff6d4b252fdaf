"""Files and settings: what is read, and the sentence for what is refused."""

import math
from pathlib import Path

import pytest

from mpm_env.config import known, parse
from mpm_env.fidelity import Fidelity, load_fidelity
from mpm_env.scene_config import SceneConfig, read_scene

SCENE = "column_collapse_3d"  # sand in a cylinder, one wall, no bodies

# A setting on top of SCENE, and what its refusal must say.
REFUSED = {
    "grains.0.material.Efoo=3": ("unknown key 'grains.0.material.Efoo'", "Known: model, about, E, nu, rho"),
    "grains.0.material.cohesoin=3": ("unknown key 'grains.0.material.cohesoin'", "did you mean 'cohesion'?"),
    "walls.z_lower.kinds=slip": ("unknown key 'walls.z_lower.kinds'", "did you mean 'kind'?"),
    "duratoin=3": ("unknown key 'duratoin'", "did you mean 'duration'?"),
    "grains.0.fill.0.radus=1": ("unknown key 'grains.0.fill.0.radus'", "did you mean 'radius'?"),
    "walls.z_loer={kind: slip}": ("walls has no side 'z_loer'", "did you mean 'z_lower'?"),
    "walls.z_lower.kind=sticky": ("walls.z_lower.kind should be 'slip', 'stick'", "got 'sticky'"),
    "grains.0.material.model=sandd": ("grains.0.material has no model 'sandd'", "did you mean 'sand'?"),
    "grains.0.material={E: 2}": ("grains.0.material needs the key 'model'",),
    "grains.0.material.friction_fit=best": ("friction_fit should be 'triaxial'", "got 'best'"),
    "grains.0.material=dry_san": ("There is no material 'dry_san'", "did you mean 'dry_sand'?", "wet_sand"),
    "grains.0.material=mine.yaml": ("There is no file mine.yaml",),
    "grains.0.material=3": ("grains.0.material should be", "got 3"),
    "grains.0.material.E='1e6'": ("grains.0.material.E should be a valid number", "got '1e6'"),
    "grains.0.material.E=yes": ("grains.0.material.E should be a valid number", "got True"),
    "grains.0.material.E=-1": ("grains.0.material.E should be greater than 0", "got -1"),
    "grains.0.material.nu=0.5": ("grains.0.material.nu should be less than 0.5", "got 0.5"),
    "grains.0.material.E=.inf": ("grains.0.material.E should be a finite number", "got inf"),
    "gravity=[0, 0, .nan]": ("gravity.2 should be a finite number", "got nan"),
    "gravity=[0, 0]": ("the key 'gravity.2' is missing",),
    "feature=0": ("feature should be greater than 0", "got 0"),
    "feature=null": ("feature should be a valid number", "got None"),
    "grains=3": ("grains should be", "got 3"),
    "grains.0.fill=[]": ("grains.0.fill", "at least 1"),
    "box.lower=[9, 9, 9]": ("box needs lower < upper along x", "9.0 and 0.4"),
    "bodies={mjcf: none.xml, couple: [a]}": ("bodies.mjcf: there is no file", "none.xml"),
    "bodies={couple: [a]}": ("the key 'bodies.mjcf' is missing",),
    "bodies.friction=1": ("'bodies.friction' names nothing here", "known at that place: name, about, box"),
    "grains.7.material.E=1": ("'grains.7.material.E' names nothing here", "known at that place: 0"),
    "about.x=1": ("'about.x' names nothing here", "nothing below that place"),
    "feature": ("A setting is key=value", "got 'feature'"),
    "feature=[1": ("The value in 'feature=[1' cannot be read",),
}
FIDELITY_REFUSED = {
    "cell=4": ("unknown key 'cell'", "did you mean 'cells'?"),
    "cells=4.5": ("cells should be a valid integer", "got 4.5"),
    "cells=1": ("cells should be greater than or equal to 2", "got 1"),
    "dimension=1": ("dimension should be 2 or 3", "got 1"),
    "precision=f16": ("precision should be 'f32' or 'f64'", "got 'f16'"),
    "rigid_dt=0": ("rigid_dt should be greater than 0", "got 0"),
    "stiffness=2": ("stiffness should be less than or equal to 1", "got 2"),
}


@pytest.mark.parametrize("setting", REFUSED)
def test_refused_setting_gets_its_sentence(setting: str) -> None:
    with pytest.raises(ValueError) as refusal:
        read_scene(SCENE, (setting,))
    said = str(refusal.value)
    assert all(words in said for words in REFUSED[setting]), said
    assert said.endswith(".") and "\n" not in said


@pytest.mark.parametrize("setting", FIDELITY_REFUSED)
def test_refused_fidelity_setting_gets_its_sentence(setting: str) -> None:
    with pytest.raises(ValueError) as refusal:
        load_fidelity("draft", (setting,))
    assert all(words in str(refusal.value) for words in ("draft.yaml", *FIDELITY_REFUSED[setting])), refusal.value


def test_unknown_scene_and_fidelity_name_the_nearest() -> None:
    with pytest.raises(ValueError, match=r"There is no scene 'box_drp': did you mean 'box_drop'\? Known: .*blade_push"):
        read_scene("box_drp")
    with pytest.raises(ValueError, match=r"There is no fidelity 'drafty': did you mean 'draft'\? Known: .*standard"):
        load_fidelity("drafty")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: [1", "is not YAML"),
        ("- 1", "must hold keys and values, got list"),
        ("", "must hold keys and values, got NoneType"),
        ("\x00", "is not YAML"),
    ],
)
def test_broken_file_is_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=words):
        read_scene(str(file))


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"There is no file .*none\.yaml"):
        read_scene(str(tmp_path / "none.yaml"))
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(ValueError, match=r"There is no file .*folder\.yaml"):
        read_scene(str(tmp_path / "folder.yaml"))


@pytest.mark.parametrize("number", ["5e-5", "1.4e5", "1E6", "1e+6", "2.", ".5", "3", "-0.0"])
def test_numbers_are_numbers_however_they_are_written(number: str) -> None:
    config = read_scene(SCENE, (f"gravity=[0, 0, {number}]",))
    assert config.gravity[2] == float(number)


def test_settings_reach_numbers_lists_and_new_keys() -> None:
    config = read_scene(SCENE, ("grains.0.material.E=2e5", "grains.0.fill.0.radius=0.05", "speed=2", "feature=0.04"))
    assert config.grains[0].material.E == 2e5
    assert config.grains[0].fill[0].radius == 0.05  # type: ignore[union-attr]
    assert (config.speed, config.feature) == (2.0, 0.04)
    assert read_scene(SCENE, ("grains.0.material=wet_sand",)).grains[0].material.cohesion > 0  # type: ignore[union-attr]
    assert load_fidelity("draft", ("cells=5",)).cells == 5


def test_own_material_and_model_lie_beside_the_scene(tmp_path: Path) -> None:
    (tmp_path / "mud.yaml").write_text("{model: sand, E: 1e5, nu: 0.3, rho: 1900, friction_deg: 5, cohesion: 200}")
    (tmp_path / "ball.xml").write_text("<mujoco/>")
    (tmp_path / "mine.yaml").write_text("""
        box: {lower: [0, 0, 0], upper: [1, 1, 1]}
        feature: 0.1
        duration: 1
        grains: [{material: mud.yaml, fill: [{shape: sphere, centre: [0.5, 0.5, 0.5], radius: 0.1}]}]
        bodies: {mjcf: ball.xml, couple: [ball]}
    """)
    config = read_scene(str(tmp_path / "mine.yaml"))
    assert config.name == "mine"
    assert config.grains[0].material.rho == 1900
    assert config.bodies is not None and config.bodies.mjcf == "<mujoco/>"


def test_configuration_survives_json_unchanged() -> None:
    config = read_scene("bucket_dig")
    assert parse(SceneConfig, config.model_dump(mode="json"), "again") == config
    fidelity = load_fidelity("reference")
    assert parse(Fidelity, fidelity.model_dump(mode="json"), "again") == fidelity


def test_configuration_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="frozen"):
        read_scene(SCENE).duration = 2.0  # type: ignore[misc]


@pytest.mark.parametrize("name", known("materials"))
def test_shipped_material_is_valid_and_says_what_it_is(name: str) -> None:
    material = read_scene(SCENE, (f"grains.0.material={name}",)).grains[0].material
    assert material.about.endswith(".") and math.isfinite(material.E)


@pytest.mark.parametrize("name", known("fidelities"))
def test_shipped_fidelity_is_valid_and_says_what_it_is(name: str) -> None:
    assert load_fidelity(name).about.endswith(".")


@pytest.mark.parametrize("name", known("scenes"))
def test_shipped_scene_is_valid_and_says_what_it_is(name: str) -> None:
    config = read_scene(name)
    assert config.about.endswith(".") and config.camera is not None
    assert config.fidelity in known("fidelities")
