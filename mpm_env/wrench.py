"""What the grains do to a tool: force and torque about a site, as a force-torque sensor there would tell."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mpm_env.config import nearest
from mpm_env.scene import Scene, State


class Wrench(NamedTuple):
    """A force and the torque about the point where it is told."""

    force: Array  # (.., 3) N
    torque: Array  # (.., 3) N m


def wrench_at(
    scene: Scene, state: State, reaction: Array, site: str, frame: Literal["world", "site"] = "world"
) -> Wrench:
    """The wrench about a site, in world axes or the site's own, from reactions (.., G, 6) such as `sim.advance` gives.

    Counts the coupled geoms on the site's body and on bodies fixed to it. Reactions are means over a rigid step, about
    their body's centre of mass; a wrench about another point gains the lever times the force. Where several steps'
    reactions are given, all are taken at the state's pose. Raises ValueError for an unknown site.
    """
    b = scene.bodies
    known = [b.model.site(i).name for i in range(b.model.nsite)] if b else []
    if b is None or site not in known:
        raise ValueError(f"The model has no site {site!r}{nearest(site, known)}")
    model, d, at, reaction = b.model, state.rigid, b.model.site(site), jnp.asarray(reaction)
    carrier = model.geom_bodyid[np.asarray(b.geoms)]
    mine = np.flatnonzero(model.body_weldid[carrier] == model.body_weldid[at.bodyid[0]])
    lever = (d.xipos[carrier[mine]] - d.site_xpos[at.id]).astype(reaction.dtype)
    each = reaction[..., mine, :3]
    force = jnp.sum(each, axis=-2)
    torque = jnp.sum(reaction[..., mine, 3:] + jnp.cross(lever, each), axis=-2)
    if frame == "site":
        axes = d.site_xmat[at.id].reshape(3, 3).astype(reaction.dtype)
        force, torque = force @ axes, torque @ axes
    return Wrench(force, torque)


def low_pass(before: Wrench, now: Wrench, dt: float, time_constant: float) -> Wrench:
    """A first-order filter's output, `before` it dt (s) ago, that has since seen `now`.

    Grains push a tool in steps as it passes from cell to cell, so what is told to a controller is best averaged over
    the time in which the tool moves one cell: that is the time constant (s) to take. 0 filters nothing.
    """
    keep = math.exp(-dt / time_constant) if time_constant > 0 else 0.0
    return jax.tree.map(lambda old, new: keep * old + (1 - keep) * new, before, now)
