"""The wheel carries what the package reads, and the installed package works from any folder."""

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from mpm_env.native.build import build_or_say

ROOT = Path(__file__).resolve().parent.parent.parent
SUFFIXES_OF_DATA = {".xml", ".yaml", ".yml", ".json", ".stl", ".obj", ".png", ".typed"}

pytestmark = pytest.mark.slow


def run(*command: str | Path, cwd: Path, path: Path | None = None) -> str:
    """What a command prints; its whole output is the error if it fails."""
    environment = {**os.environ, "PYTHONPATH": str(path)} if path else None
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder, cwd=ROOT)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel alone in a folder; its dependencies are those of the running interpreter."""
    target = tmp_path_factory.mktemp("installed")
    options = ("--no-deps", "--no-index", "--no-compile", "--disable-pip-version-check", "--quiet")
    run(sys.executable, "-m", "pip", "install", *options, "--target", target, wheel, cwd=target)
    return target


def test_wheel_carries_every_config_and_model(wheel: Path) -> None:
    expected = {f"mpm_env/{path.relative_to(ROOT).as_posix()}" for path in files_under("configs")}
    for package in ("mpm_env", "coupling"):
        expected |= {path.relative_to(ROOT).as_posix() for path in files_under(package)}
    assert any(name.startswith("mpm_env/configs/") for name in expected)
    assert any(name.startswith("mpm_env/tasks/") and name.endswith(".xml") for name in expected)
    with zipfile.ZipFile(wheel) as archive:
        missing = expected - set(archive.namelist())
    assert not missing


def files_under(folder: str) -> list[Path]:
    """Code and data of a folder of the checkout."""
    return [path for path in (ROOT / folder).rglob("*") if path.suffix in SUFFIXES_OF_DATA | {".py"}]


def test_wheel_carries_the_licence_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    info = f"mpm_env-{project()['version']}.dist-info"
    assert f"{info}/licenses/LICENSE" in names
    assert {name.split("/")[0] for name in names} == {"mpm_env", "coupling", info}


def test_wheel_carries_the_kernels_and_is_for_this_kind_of_machine(wheel: Path) -> None:
    if shutil.which("g++") is None:
        assert wheel.name.endswith("py3-none-any.whl")
        return
    with zipfile.ZipFile(wheel) as archive:
        assert "mpm_env/native/kernels.so" in archive.namelist()
    assert "-py3-none-linux" in wheel.name


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"PATH": "/nowhere"}, "there is no C++ compiler"),
        ({"CXX": "/bin/false"}, "/bin/false failed: it said nothing"),
        ({"CXX": "/nowhere/g++"}, "/nowhere/g++ failed"),
    ],
)
def test_kernels_that_cannot_be_built_are_explained(
    settings: dict[str, str], word: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("CXX", raising=False)
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    (tmp_path / "kernels.so").write_text("of other sources")
    why_not = build_or_say(tmp_path / "kernels.so")
    assert why_not is not None and word in why_not
    (left,) = tmp_path.iterdir()
    assert left.name == "kernels.txt" and left.read_text() == why_not + "\n"


def project() -> dict[str, str]:
    """The table that describes the package."""
    table: dict[str, str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return table


def test_installed_package_finds_its_files_from_any_folder(installed: Path, tmp_path: Path) -> None:
    where = "import pathlib, mpm_env, coupling; print(pathlib.Path(mpm_env.__file__).parent)"
    assert (
        Path(run(sys.executable, "-c", where, cwd=tmp_path, path=installed).splitlines()[-1]) == installed / "mpm_env"
    )
    assert list((installed / "mpm_env" / "configs").rglob("*.yaml"))


def test_installed_command_line_runs_from_any_folder(installed: Path, tmp_path: Path) -> None:
    said = run(sys.executable, "-m", "mpm_env.cli", "--help", cwd=tmp_path, path=installed)
    assert "usage" in said.lower() and "demo" in said
    script = installed / "bin" / "mpm-env"
    assert "usage" in run(sys.executable, script, "--help", cwd=tmp_path, path=installed).lower()


def test_pins_are_exact_and_name_no_place() -> None:
    lines = [line.split("#")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines()]
    pins = [line.split(";")[0].strip() for line in lines if line]
    assert pins
    assert [pin for pin in pins if pin.count("==") != 1 or any(mark in pin for mark in "/@*<>~")] == []
