"""Tests on materials by name: what the command prints, what it leaves, and what it refuses."""

import csv
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mpm_env import cli, laboratory
from mpm_env.config import known
from mpm_env.scene_config import read_material

QUICK = ("--steps", "60")


def test_element_prints_its_figures_and_leaves_the_path(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert cli.main(["element", "dry_sand", "--test", "biaxial", *QUICK, "--strain", "0.4", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    (line,) = (x for x in said.splitlines() if "mobilised angle at the end" in x)
    assert float(line.split()[-1]) == pytest.approx(35, abs=0.01)  # dry_sand's angle is that of plane strain
    assert sorted(p.name for p in out.iterdir()) == sorted(laboratory.FILES)
    with (out / "element.csv").open(encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert tuple(head) == laboratory.COLUMNS and len(rows) == 61
    table = np.array(rows, float)
    np.testing.assert_allclose(table[:, head.index("syy_Pa")], 1e4, rtol=1e-6)
    assert table[-1, head.index("mobilised_deg")] == pytest.approx(35, abs=0.01)
    with Image.open(out / "element.png") as picture:
        assert picture.size == (640, 440)


REFUSED = {
    ("dry_sad", "--test", "shear"): "There is no material 'dry_sad': did you mean 'dry_sand'?",
    ("dry_sand", "--test", "sheer"): "There is no test 'sheer': known are triaxial",
    ("dry_sand", "--test", "shear", "--pressure", "-3"): "pressure should be positive and finite, got -3.0 Pa.",
    ("dry_sand", "--test", "triaxial", "--dimension", "2"): "it needs dimension 3",
    ("dry_sand", "--test", "shear", "--set", "friction_deg=95"): "friction_deg should be less than 90, got 95",
    ("glass_beads", "--test", "shear", "--set", "mu_2=0.3"): "needs mu_s < mu_2, got 0.3819 and 0.3",
    ("dry_sand", "--test", "triaxial", "--set", "friction_fit=mc2d"): "'mc2d' knows plane strain only",
}


@pytest.mark.parametrize("arguments", REFUSED, ids=" ".join)
def test_refused_element_prints_one_line(
    arguments: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["element", *arguments, "--out", str(tmp_path / "out")])
    said = capsys.readouterr()
    assert end.value.code == cli.REFUSED and said.out == "" and not (tmp_path / "out").exists()
    assert said.err.startswith("mpm-env: ") and said.err.count("\n") == 1 and REFUSED[arguments] in said.err


@pytest.mark.parametrize("name", known("materials"))
def test_every_shipped_material_names_its_source_and_can_be_tested(name: str) -> None:
    """In shear, plane strain, which every model knows: finite, and it bears shear."""
    from mpm_env.config import folder

    text = (folder() / "materials" / f"{name}.yaml").read_text(encoding="utf-8")
    assert text.startswith("# ") and len(text.split("\nabout:")[0]) > 80  # where its numbers come from
    assert read_material(name).about
    how = laboratory.loading(test="shear", pressure=500.0, strain=0.02, steps=60)
    curve = laboratory.measure(read_material(name), how)
    assert np.isfinite(curve.stress).all() and curve.stress[-1, 3] > 1
