"""How finely a scene is simulated: everything that trades speed for accuracy, and nothing physical."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from mpm_env.config import Section, find, overlay, parse, read_yaml

Positive = Annotated[float, Field(gt=0)]


class Fidelity(Section):
    """Resolution, time step and numerics of a run."""

    about: str = ""
    dimension: Literal[2, 3] = Field(3, description="3, or 2 for the scene's middle slice in plane strain (x-z)")
    cells: int = Field(6, ge=2, description="grid cells along the scene's feature length")
    particles_per_axis: int = Field(2, ge=1, le=4, description="grains per cell along each axis, at the start")
    courant: Positive = Field(0.5, description="sound speed times substep over cell size")
    mpm_dt: Positive | None = Field(None, description="s; the substep, if not the longest that courant allows")
    rigid_dt: Positive = Field(0.004, description="s; one MJX step, a whole number of substeps")
    stiffness: Annotated[float, Field(gt=0, le=1)] = Field(
        1.0, description="factor on Young's modulus of sand, whose strength does not depend on it: softer is faster"
    )
    solver: Literal["explicit", "semi_implicit"] = Field(
        "explicit", description="of the grid; semi_implicit takes any courant, for stiff grains without bodies"
    )
    precision: Literal["f32", "f64"] = "f32"
    kernels: Literal["auto", "native", "xla"] = Field(
        "auto", description="native C++ where it can be had, or plain XLA: the same to rounding, far apart in speed"
    )
    contact_band: Annotated[float, Field(ge=0, le=1)] = Field(0.25, description="cells off a body where nodes feel it")
    contact_iterations: int = Field(4, ge=1, le=20, description="Newton iterations of the momentum exchange")
    two_way: bool = Field(
        True, description="grains push bodies; if not, bodies go as if there were none, and nothing is solved"
    )
    push_out: bool = Field(
        True, description="grains inside a body are put back to its surface, so thin tools do not leak"
    )


def load_fidelity(name: str, settings: Sequence[str] = ()) -> Fidelity:
    """A shipped fidelity by name, or one from a .yaml file, with settings like "cells=5" on top."""
    path = find("fidelities", name)
    data = read_yaml(path)
    overlay(data, settings)
    return parse(Fidelity, data, path.name)
