"""How far points are from the bodies, and how many are near: on the host, before anything runs."""

from __future__ import annotations

from functools import partial

import jax
import mujoco
import numpy as np
from jax import Array

from coupling.bodies import Bodies
from coupling.contact import distances
from coupling.geoms import Shape, bounding_radius, centre, half_extents

AT_ONCE = 8192  # points whose distances are computed on the host in one call


def points_near(
    b: Bodies, bands: tuple[tuple[float, float], ...], spacing: float, *, middle: float | None = None
) -> tuple[int, ...]:
    """About how many points of a lattice of this spacing (m) lie in each band (low, high) m of distance to the geoms.

    Sizes node and grain buffers on the host, at the initial pose, body by body. With `middle`, only the plane
    y = middle is counted (plane strain). A geom without bounds counts as nothing: the caller takes the whole grid.
    """
    d = mujoco.MjData(b.model)
    mujoco.mj_forward(b.model, d)
    step = spacing / 2
    high = max(top for _, top in bands)
    total = np.zeros(len(bands), int)
    for body in range(len(b.bodies)):
        mine = [i for i, owner in enumerate(b.body_of) if owner == body and np.isfinite(bounding_radius(b.shapes[i]))]
        if not mine:
            continue
        lows, highs = np.asarray([_box_around(b, d, i) for i in mine]).swapaxes(0, 1)
        ends = list(zip(lows.min(0) - high, highs.max(0) + high, strict=True))
        counts = []
        for shift in (0, step / 2):  # a lattice may lie on the edges of a plate's band, and miss them all by a hair
            axes = [np.arange(lo + shift, hi + step - shift, step) for lo, hi in ends]
            if middle is not None:
                axes[1] = np.asarray([middle])
            phi = distances_from(b, d, mine, np.stack(np.meshgrid(*axes, indexing="ij")).reshape(3, -1))
            counts.append([np.count_nonzero((phi > low) & (phi < top)) for low, top in bands])
        total += -(-np.max(counts, axis=0) // (8 if middle is None else 4))
    return tuple(int(n) for n in total)


def _box_around(b: Bodies, d: mujoco.MjData, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (3,) m of the box along the world's axes around the coupled geom i."""
    mat = d.geom_xmat[b.geoms[i]].reshape(3, 3)
    middle, half = d.geom_xpos[b.geoms[i]] + mat @ centre(b.shapes[i]), np.abs(mat) @ half_extents(b.shapes[i])
    return middle - half, middle + half


def distances_from(b: Bodies, d: mujoco.MjData, some: list[int], x: np.ndarray) -> np.ndarray:
    """Distance (n,) m of points x (3, n) m to the nearest of some coupled geoms, on the host."""
    ids = np.asarray(b.geoms)[some]
    shapes, pos, mat = tuple(b.shapes[i] for i in some), d.geom_xpos[ids], d.geom_xmat[ids].reshape(-1, 3, 3)
    pos, mat = pos.astype(np.float32), mat.astype(np.float32)
    out = []
    for k in range(0, x.shape[1], AT_ONCE):  # of one size, so that one program serves all
        few = x[:, k : k + AT_ONCE].astype(np.float32)
        padded = np.pad(few, ((0, 0), (0, AT_ONCE - few.shape[1])))
        out.append(np.asarray(_distances(shapes, padded, pos, mat))[: few.shape[1]])
    return np.concatenate(out)


@partial(jax.jit, static_argnums=0)
def _distances(shapes: tuple[Shape, ...], x: Array, pos: Array, mat: Array) -> Array:
    return distances(shapes, x, pos, mat)
