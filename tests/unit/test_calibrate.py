"""Parameters from curves: found again where a curve holds them, and not claimed where it does not."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from mpm_env import calibrate, calibrate_column, calibrate_friction, calibrate_repose, cli, laboratory
from mpm_env.scene_config import read_material

TRUE = {"friction_deg": 31.0, "E": 8e5}  # dry_sand starts from 35 degrees and 1 MPa
HOW = laboratory.Loading(test="biaxial", pressure=5e3, strain=0.06, steps=60)
NOISE = 100.0  # Pa, of a strength of 10 kPa
FOUND = 1e-5  # relative, without noise; 1e-8 observed
WITHIN = 4  # standard errors


def write(file: Path, noise: float = 0.0, seed: int = 0, upto: float = 1.0) -> Path:
    settings = tuple(f"{k}={v}" for k, v in TRUE.items())
    curve = laboratory.measure(read_material("dry_sand", settings), HOW)
    rows = slice(None, round(upto * HOW.steps) + 1)
    stress = curve.stress[rows, 0] + noise * np.random.default_rng(seed).normal(size=len(curve.strain[rows]))
    lines = [f"{e},{s}" for e, s in zip(curve.strain[rows], stress, strict=True)]
    file.write_text("\n".join(["strain,sxx_Pa", *lines]))
    return file


def found(file: Path, *free: str) -> calibrate.Fit:
    return calibrate.go("dry_sand", (), free, file, HOW)


def test_parameters_of_a_clean_curve_are_found_again(tmp_path: Path) -> None:
    result = found(write(tmp_path / "curve.csv"), *TRUE)
    np.testing.assert_allclose(result.values, list(TRUE.values()), rtol=FOUND)
    assert result.untold == () and result.misfit < FOUND


def test_errors_are_as_large_as_they_are_said_to_be(tmp_path: Path) -> None:
    """Over five noisy measurements; both too wide and too narrow errors would fail."""
    results = [found(write(tmp_path / "curve.csv", NOISE, seed), *TRUE) for seed in range(5)]
    off = np.array([(r.values - list(TRUE.values())) / r.errors for r in results])
    assert np.abs(off).max() < WITHIN and np.sqrt(np.mean(off**2)) > 1 / WITHIN, off


def test_friction_is_not_claimed_from_a_curve_that_never_yields(tmp_path: Path) -> None:
    result = found(write(tmp_path / "curve.csv", NOISE / 10, upto=0.1), *TRUE)
    assert result.untold == (("friction_deg",),) and np.isinf(result.errors[0])
    assert result.values[1] == pytest.approx(TRUE["E"], rel=0.05)


def test_calibrate_prints_what_it_found_and_leaves_a_material(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    given = ["--curve", str(write(tmp_path / "curve.csv", NOISE)), "--test", "biaxial", "--free", "friction_deg,E"]
    loading = ["--pressure", "5e3", "--steps", "60"]
    assert cli.main(["calibrate", "dry_sand", *given, *loading, "--out", str(out)]) == 0
    said = capsys.readouterr().out.splitlines()
    name, value, _, error = said[0].split()
    assert name == "friction_deg" and abs(float(value) - TRUE["friction_deg"]) < WITHIN * float(error)
    assert sorted(p.name for p in out.iterdir()) == sorted(calibrate.FILES)
    again = read_material(str(out / "fitted.yaml"))
    assert again.model == "sand" and again.friction_deg == pytest.approx(float(value), rel=1e-4)
    assert yaml.safe_load((out / "fitted.yaml").read_text())["rho"] == read_material("dry_sand").rho


REFUSED = {
    "strain,q\n0,0": "needs the columns strain and one of sxx_Pa",
    "strain,q_Pa\n0,a": "should hold two numbers in each row",
    "strain,q_Pa\n0,0\n0.1,.nan": "should hold",
    "strain,q_Pa\n0.1,1\n0,2": "strain should grow from row to row",
    "strain,q_Pa\n0,1\n0.1,2\n0.2,3": "2 parameters need at least 5 points, got 3",
    "strain,q_Pa\n0,0\n0.1,0\n0.2,0\n0.3,0\n0.4,0": "The curve is zero everywhere",
}


@pytest.mark.parametrize("text", REFUSED)
def test_unusable_curve_is_refused_in_one_sentence(text: str, tmp_path: Path) -> None:
    (tmp_path / "curve.csv").write_text(text)
    with pytest.raises(ValueError, match=REFUSED[text]):
        found(tmp_path / "curve.csv", *TRUE)


def test_unknown_parameter_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="sand has no parameter 'friction' to fit: did you mean 'friction_deg'"):
        found(write(tmp_path / "curve.csv"), "friction")


REPOSE = 5.0  # degrees of friction, two of repose
WALL = calibrate_column.Column(0.1, 0.1, 0.23)  # m


def test_friction_is_found_again_from_the_runout_of_a_column() -> None:
    """From that of a column of other grains: within what seeds are said to scatter."""
    sand = read_material("dry_sand")
    slice = WALL.slice(sand, calibrate_friction.ACROSS[0])
    far, near = (calibrate_column.front(slice, angle, 7) for angle in (28.0, 38.0))
    assert far > near + 0.02
    found = calibrate_column.fit_column(sand, WALL._replace(runout=far))
    assert 0 < found.scatter_deg < 1 and abs(found.resolution_deg) < 5
    assert found.friction_deg == pytest.approx(28, abs=WITHIN * found.scatter_deg + calibrate_friction.CLOSE)


@pytest.mark.slow
def test_friction_is_found_again_from_the_angle_of_repose() -> None:
    """27.5 degrees of repose are those of about 33 degrees of friction, since tan(repose) = sin(phi) (Davis 1968)."""
    found = calibrate_repose.fit_repose(read_material("dry_sand"), 27.5)
    assert 0 < found.scatter_deg < 1.5 and abs(found.resolution_deg) < 5
    law = np.degrees(np.arcsin(np.tan(np.radians(27.5))))
    assert found.friction_deg == pytest.approx(law, abs=REPOSE)
    assert found.friction_deg > 27.5 + REPOSE / 2, "the angle of repose taken for that of friction"


UNMEASURED = {
    ("dry_sand", "--column", "0.1", "0.1", "0.05"): "a runout beyond its width",
    ("dry_sand", "--column", "0.1", "0.1", "0.9"): "No friction from 12 to 50 degrees lets this column run to 0.9 m",
    ("snow_packed", "--column", "0.1", "0.1", "0.2"): "tells the friction_deg of sand, and snow has none",
    ("snow_packed", "--repose", "30"): "tells the friction_deg of sand, and snow has none",
    ("dry_sand", "--repose", "60"): "No friction from 10 to 65 degrees has this sand stand at 60 degrees",
}


@pytest.mark.parametrize("given", UNMEASURED, ids=" ".join)
def test_senseless_measurement_is_refused(given: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["calibrate", *given])
    said = capsys.readouterr()
    assert end.value.code == cli.REFUSED and said.out == ""
    assert said.err.startswith("mpm-env: ") and said.err.count("\n") == 1 and UNMEASURED[given] in said.err
