"""How a rigid step is cut into substeps, and what the solvers of the grid can do."""

from __future__ import annotations

import math

import numpy as np

from mpm_env import native
from mpm_env.fidelity import Fidelity
from mpm_env.health import MOST_TRAVEL
from mpm_env.motion import Motion
from mpm_env.mpm.implicit import WALLS
from mpm_env.mpm.materials import Material
from mpm_env.mpm.stability import courant_limit, largest_dt
from mpm_env.mpm.types import Grid
from mpm_env.scene_config import SceneConfig
from mpm_env.scene_grains import WHOLE, whole


def kernels_of(config: SceneConfig, f: Fidelity, grid: Grid) -> str:
    """The kernels that run, "native" or "xla". Raises ValueError for what the semi-implicit solver cannot do."""
    if f.solver == "explicit":
        return native.chosen(f.kernels)
    kinds = sorted({wall.kind for pair in grid.walls for wall in pair} - set(WALLS))
    if config.bodies is not None or kinds:
        what = "no bodies" if config.bodies is not None else f"no walls of kind {kinds[0]!r}"
        raise ValueError(
            f"solver = semi_implicit knows {what}, only grains between walls of kind {', '.join(WALLS)}:"
            " use solver = explicit."
        )
    if f.kernels == "native":
        raise ValueError("solver = semi_implicit has no native kernels: use kernels = auto or solver = explicit.")
    return "xla"


def substeps(config: SceneConfig, f: Fidelity, grid: Grid, materials: tuple[Material, ...], motion: Motion) -> int:
    """How many substeps make a rigid step. Raises ValueError for a substep longer than the stable one."""
    explicit = f.solver == "explicit"
    fall = math.sqrt(2 * float(np.linalg.norm(config.gravity)) * (config.box.upper[2] - config.box.lower[2]))
    thrown = max((float(np.linalg.norm(s.velocity)) for g in config.grains for s in g.fill), default=0.0)
    tool = motion.top_speed()
    speed = max(config.speed or fall, thrown, tool)
    bound = largest_dt(materials if explicit else (), grid.cell_size, grid.dimension, speed)
    if tool * f.rigid_dt > MOST_TRAVEL * grid.cell_size:
        raise ValueError(
            f"rigid_dt = {f.rigid_dt:.4g} s lets a tool of {tool:.3g} m/s move"
            f" {tool * f.rigid_dt / grid.cell_size:.2g} cells in one rigid step:"
            f" use <= {MOST_TRAVEL * grid.cell_size / tool:.3g} s or a slower tool."
        )
    wave = max((float(m.wave_speed()) for m in materials), default=0.0)
    if f.mpm_dt is not None:
        if f.mpm_dt > bound.dt * (1 + WHOLE):
            raise ValueError(
                f"mpm_dt = {f.mpm_dt:.4g} s exceeds the stable {bound.dt:.4g} s set by {bound.reason} at cell_size"
                f" {grid.cell_size:.4g} m: use a smaller mpm_dt or fewer cells."
            )
        n = whole(f.rigid_dt / f.mpm_dt)
        if n is None:
            raise ValueError(
                f"rigid_dt = {f.rigid_dt:.6g} s is {f.rigid_dt / f.mpm_dt:.4g} substeps of mpm_dt = {f.mpm_dt:.6g} s:"
                f" make it a whole number, with mpm_dt = {f.rigid_dt / math.ceil(f.rigid_dt / f.mpm_dt):.6g}."
            )
        return n
    limit = min((courant_limit(float(m.nu), grid.dimension) for m in materials), default=f.courant)
    if explicit and f.courant > limit:
        raise ValueError(
            f"courant = {f.courant:.3g} exceeds the stable {limit:.3g} for the Poisson ratios of this scene in"
            f" {grid.dimension}-D: use <= {limit:.3g}, or solver = semi_implicit."
        )
    longest = min(f.courant * grid.cell_size / wave if wave else f.rigid_dt, bound.dt, f.rigid_dt)
    return math.ceil(f.rigid_dt / longest - WHOLE)
