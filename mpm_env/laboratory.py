"""Element tests on materials by name, with what they measured as files."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import jax

from mpm_env import element
from mpm_env.element import Curve, figures
from mpm_env.plot import Series, plot
from mpm_env.scene_cache import keep_programs
from mpm_env.scene_config import MaterialConfig, read_material
from mpm_env.scene_grains import material_of

FILES = ("element.csv", "element.png")
COLUMNS = ("strain", "volume_strain", "sxx_Pa", "syy_Pa", "szz_Pa", "sxy_Pa", "p_Pa", "q_Pa", "mobilised_deg")


class Loading(NamedTuple):
    """How a test is done; see `element.run`."""

    test: str
    pressure: float = 1e4  # Pa
    strain: float | None = None
    rate: float = 1.0  # 1/s
    steps: int = 1000
    dimension: int | None = None


class Done(NamedTuple):
    """A test that was done."""

    curve: Curve
    figures: dict[str, float]  # what a laboratory would report, by name with its unit
    about: str


def loading(**asked: object) -> Loading:
    """A checked loading, strain and dimension filled in. Raises ValueError for what makes no sense."""
    wanted = Loading(**asked)  # type: ignore[arg-type]
    _, strain, dimension = element.checked(*wanted)
    return wanted._replace(strain=strain, dimension=dimension)


def put_through(name: str, settings: tuple[str, ...], how: Loading, out: str | Path | None = None) -> Done:
    """Test a material by name, with settings on top, and write FILES to a folder if one is given.

    Raises ValueError, in one sentence, for what cannot be tested as asked.
    """
    keep_programs()
    curve = measure(read_material(name, settings), how)
    words = f"{how.dimension}-D, to a strain of {how.strain:g} at {how.rate:g} /s"
    holds = f"{how.pressure:g} Pa held, " if element.TESTS[how.test].holds else ""
    done = Done(curve, figures(curve, how.test), holds + words)
    if out is not None:
        save(done, name, how, Path(out))
    return done


def measure(config: MaterialConfig, how: Loading) -> Curve:
    """The curve of a material, whose numbers are taken in float64."""
    test, *_, dimension = how
    with jax.enable_x64(True):
        material = material_of(config, "float64", dimension=dimension or element.TESTS[test].dimension)
    return element.run(material, **how._asdict())


def save(done: Done, name: str, how: Loading, folder: Path) -> None:
    """Write the stress path as a table and a plot."""
    folder.mkdir(parents=True, exist_ok=True)
    c = done.curve
    with (folder / FILES[0]).open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        table.writerows(
            [f"{v:.9g}" for v in (c.strain[i], c.volume_strain[i], *c.stress[i], c.p[i], c.q[i], c.mobilised_deg[i])]
            for i in range(len(c.strain))
        )
    strain = "shear strain" if how.test == "shear" else "log strain along x"
    along = [
        Series(what, c.strain, c.stress[:, k] / 1e3, joined=True) for k, what in enumerate(("xx", "yy", "zz", "xy"))
    ]
    plot(folder / FILES[1], f"{name}: {how.test} test, {done.about}", strain, "stress, kPa", along)
