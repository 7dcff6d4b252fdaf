"""Parameters of a material from a measured curve, with what the curve can and cannot tell of them."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from jax import Array

from mpm_env import element
from mpm_env.config import nearest, parse
from mpm_env.element import SETTLING, TESTS
from mpm_env.laboratory import Loading, loading
from mpm_env.mpm.materials import Material
from mpm_env.plot import Series, plot
from mpm_env.scene_cache import keep_programs
from mpm_env.scene_config import MaterialConfig, MaterialFile, read_material
from mpm_env.scene_grains import material_of

FILES = ("fitted.yaml", "fit.png")
# What may be fitted to, as the columns of `mpm-env element` name it: rows of the stress xx, yy, zz, xy, or of q and p.
MEASURED = ("sxx_Pa", "syy_Pa", "szz_Pa", "sxy_Pa", "q_Pa", "p_Pa")
IN_DEGREES = {"friction_deg": "friction"}  # of a file, and what the solver calls it, in radians
MOST = {"friction_deg": 89.0, "nu": 0.49, "flow_index": 10.0}  # beyond these a file would be refused
UNTOLD = 1e-4  # of the largest sensitivity to a relative change: directions below it are told by rounding, not by data
PART = 0.3  # share of a parameter in such a direction from which on it is named
LEAST = 1e-6  # of the value at the start: parameters stay positive
FEWEST = 3  # points beyond as many as there are parameters


@dataclass(frozen=True)
class Fit:
    """What a curve told."""

    names: tuple[str, ...]
    values: np.ndarray  # (k,) in the units of a material's file
    errors: np.ndarray  # (k,) standard errors; inf where the data tells nothing
    untold: tuple[tuple[str, ...], ...]  # parameters, or combinations of them, that the data cannot tell
    misfit: float  # rms of model minus measurement over the rms of the measurement
    strain: np.ndarray  # (m,) where it was measured
    measured: np.ndarray  # (m,) Pa
    model: np.ndarray  # (m,) Pa


def go(
    name: str,
    settings: tuple[str, ...],
    free: tuple[str, ...],
    curve: str | Path,
    how: Loading,
    out: str | Path | None = None,
) -> Fit:
    """Fit a material by name to a curve in a file, and write FILES to a folder if one is given.

    The strain of the loading is the curve's. Raises ValueError, in one sentence, for what cannot be fitted as asked.
    """
    keep_programs()
    config = read_material(name, settings)
    what, strain, measured = read_curve(curve)
    result = fit(config, free, what, strain, measured, loading(**how._replace(strain=float(strain[-1]))._asdict()))
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        values = fitted(config, result).model_dump() | {"about": f"{name}, fitted to {Path(curve).name}"}
        (folder / FILES[0]).write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
        series = [Series("measured", strain, measured / 1e3), Series(name, strain, result.model / 1e3, joined=True)]
        plot(folder / FILES[1], f"{how.test} test, fitted: {', '.join(free)}", "strain", what[:-3] + ", kPa", series)
    return result


def read_curve(file: str | Path) -> tuple[str, np.ndarray, np.ndarray]:
    """What was measured (one of MEASURED), strains (m,) and values (m,) Pa of a table with two named columns.

    Signs are those of `mpm-env element`: compression positive. Raises ValueError for what is no such table.
    """
    path = Path(file)
    if not path.is_file():
        raise ValueError(f"There is no file {path}.")
    with path.open(newline="", encoding="utf-8-sig") as text:
        rows = [[cell.strip() for cell in row] for row in csv.reader(text) if row and not row[0].startswith("#")]
    if not rows or rows[0][0] != "strain" or len(rows[0]) != 2 or rows[0][1] not in MEASURED:
        got = ", ".join(rows[0]) if rows else "nothing"
        raise ValueError(f"{path.name} needs the columns strain and one of {', '.join(MEASURED)}, got {got}.")
    try:
        table = np.array(rows[1:], float).reshape(-1, 2)
    except ValueError:
        raise ValueError(f"{path.name} should hold two numbers in each row below its first.") from None
    if not np.isfinite(table).all():
        raise ValueError(f"{path.name} should hold finite numbers only.")
    strain = table[:, 0]
    if len(strain) < 2 or np.any(np.diff(np.abs(strain)) <= 0) or strain.min() * strain.max() < 0:
        raise ValueError(f"{path.name}: strain should grow from row to row, one way.")
    return rows[0][1], strain, table[:, 1]


def fit(
    config: MaterialConfig, free: tuple[str, ...], what: str, strain: np.ndarray, measured: np.ndarray, how: Loading
) -> Fit:
    """Least squares over the named parameters, from the material's own values, with exact derivatives.

    how.strain is the data's. Standard errors are those of independent errors of one size, s^2 (J^T J)^-1. Raises
    ValueError for parameters that the material does not have, or too few points.
    """
    from scipy.optimize import least_squares

    start = np.array([_value(config, name) for name in free])
    if len(set(free)) < len(free):
        raise ValueError(f"Each parameter can be fitted once, got {', '.join(free)}.")
    if len(strain) < len(free) + FEWEST:
        raise ValueError(f"{len(free)} parameters need at least {len(free) + FEWEST} points, got {len(strain)}.")
    size = float(np.sqrt(np.mean(measured**2)))
    if size == 0:
        raise ValueError("The curve is zero everywhere: there is nothing to fit.")
    scale = np.where(start > 0, start, 1.0)
    most = np.array([MOST.get(name, np.inf) for name in free]) / scale
    with jax.enable_x64(True):
        material = material_of(config, "float64", dimension=how.dimension or TESTS[how.test].dimension)
        curve = _curve(material, free, what, strain, how)
        slope = jax.jit(jax.jacfwd(curve))

        def misfit(x: np.ndarray) -> np.ndarray:
            return (np.asarray(_finite(curve(jnp.asarray(x * scale)), how)) - measured) / size

        def sensitivity(x: np.ndarray) -> np.ndarray:
            return np.asarray(slope(jnp.asarray(x * scale))) * scale / size

        found = least_squares(misfit, start / scale, sensitivity, (LEAST, most), x_scale="jac", xtol=1e-10)
        J = sensitivity(found.x) * np.maximum(found.x, LEAST)  # by a relative change
        model = found.fun * size + measured
    errors, untold = _told(J, found.fun, free)
    return Fit(
        free, found.x * scale, errors * found.x * scale, untold, float(np.sqrt(np.mean(found.fun**2))), strain,
        measured, model,
    )  # fmt: skip


def fitted(config: MaterialConfig, result: Fit) -> MaterialConfig:
    """The material with what was found, checked as its file would be."""
    found = dict(zip(result.names, map(float, result.values), strict=True))
    return parse(MaterialFile, {"material": config.model_dump() | found}, "the fit").material


def _value(config: MaterialConfig, name: str) -> float:
    known = [k for k, v in config.model_dump().items() if isinstance(v, float) and k != "rho"]
    if name not in known:
        raise ValueError(f"{config.model} has no parameter {name!r} to fit{nearest(name, known)}")
    return float(getattr(config, name))


def _curve(
    material: Material, free: tuple[str, ...], what: str, strain: np.ndarray, how: Loading
) -> Callable[[Array], Array]:
    """What is measured (m,) Pa as a function of the free parameters (k,) in the units of a file."""
    kind, end, dimension = element.checked(*how)
    drive = element.driven(kind, how.steps, how.pressure, end, how.rate)
    at = np.abs(strain) / abs(end) * how.steps

    def curve(theta: Array) -> Array:
        given = {
            IN_DEGREES.get(name, name): jnp.deg2rad(theta[k]) if name in IN_DEGREES else theta[k]
            for k, name in enumerate(free)
        }
        _, stress, miss = element.path(dimension, replace(material, **given), drive)  # type: ignore[type-var]
        stress = jnp.where(
            (miss[SETTLING - 1 :] < element.HELD * how.pressure)[:, None], stress[SETTLING - 1 :], jnp.nan
        )
        xx, yy, zz, xy = -stress[:, 0], -stress[:, 1], -stress[:, 2], stress[:, 3]
        q2 = ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) / 2 + 3 * xy**2
        tiny = (1e-9 * how.pressure) ** 2  # keeps the slope of the root at no shear
        rows = dict(zip(MEASURED, (xx, yy, zz, xy, jnp.sqrt(q2 + tiny), (xx + yy + zz) / 3), strict=True))
        return jnp.interp(jnp.asarray(at), jnp.arange(how.steps + 1.0), rows[what])

    return jax.jit(curve)


def _finite(values: Array, how: Loading) -> Array:
    if not np.isfinite(np.asarray(values)).all():
        raise ValueError(
            f"On the way to a fit the material could not bear {how.pressure:.4g} Pa: start from other values."
        )
    return values


def _told(J: np.ndarray, left: np.ndarray, free: tuple[str, ...]) -> tuple[np.ndarray, tuple[tuple[str, ...], ...]]:
    """Relative standard errors (k,), and what the sensitivities J (m, k) to relative changes cannot tell apart."""
    _, S, V = np.linalg.svd(J, full_matrices=False)
    told = UNTOLD * S[0] < S if S[0] > 0 else np.zeros(len(S), bool)
    variance = float(left @ left) / max(len(left) - len(free), 1)
    inverse = np.where(told, 1 / np.where(told, S, 1), 0)
    errors = np.sqrt(variance * np.sum((V * inverse[:, None]) ** 2, axis=0))
    untold = tuple(
        tuple(name for name, part in zip(free, np.abs(row), strict=True) if part > PART)
        for row, known in zip(V, told, strict=True)
        if not known
    )
    lost = {name for names in untold for name in names}
    return np.array([np.inf if name in lost else e for name, e in zip(free, errors, strict=True)]), untold
