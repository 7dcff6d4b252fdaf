"""What the continuum is made of: grains, the grid they meet on, and the walls around it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from jax import Array

MARGIN = 3  # cells outside the walls: a quadratic window reaches 1.5 cells, and a grain may overshoot by one
WALL_KINDS = ("slip", "stick", "separate", "open")


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["x", "v", "C", "e", "tau", "history", "m", "V0"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Particles:
    """Grains of any material. A slot with m == 0 is empty: padding, a bed below capacity, or a grain that left."""

    x: Array  # (d, n) m, from the grid's origin
    v: Array  # (d, n) m/s
    C: Array  # (d, d, n) 1/s
    e: Array  # (s, n) elastic strain b - I; s = 4 in plane strain, 6 in 3-D
    tau: Array  # (s, n) Pa, Kirchhoff stress that belongs to e
    history: Array  # (k, n) what the material remembers
    m: Array  # (n,) kg
    V0: Array  # (n,) m^3

    @property
    def dimension(self) -> int:
        """2 (plane strain) or 3."""
        return self.x.shape[0]

    @property
    def count(self) -> int:
        """Number of slots, empty ones included."""
        return self.x.shape[1]


@dataclass(frozen=True)
class Wall:
    """One side of the box.

    slip: no motion through it, either way, and free along it. stick: no motion at all. separate: material may leave it,
    and rubs on it with Coulomb friction. open: grains that cross are counted and taken out.
    """

    kind: str = "slip"
    friction: float = 0.0  # tangent of the wall friction angle; only for kind "separate"


@dataclass(frozen=True)
class Grid:
    """The regular grid over a box, static. Node (0, ..) lies MARGIN cells outside the box's lower corner."""

    lower: tuple[float, ...]  # (d,) m, the box's lower corner in the scene's frame
    cells: tuple[int, ...]  # (d,) cells inside the box
    cell_size: float  # m
    walls: tuple[tuple[Wall, Wall], ...]  # (d,) pairs: lower side, upper side

    @property
    def dimension(self) -> int:
        """2 (plane strain) or 3."""
        return len(self.cells)

    @property
    def shape(self) -> tuple[int, ...]:
        """Nodes along each axis."""
        return tuple(n + 1 + 2 * MARGIN for n in self.cells)

    @property
    def origin(self) -> np.ndarray:
        """(d,) m: where node (0, ..) is in the scene's frame."""
        return np.asarray(self.lower) - MARGIN * self.cell_size

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    def inner_shares(self) -> np.ndarray:
        """Share (*shape) of each node's window that lies inside the box; 1 for nodes that no grain inside reaches."""
        shares = []
        for n, cells in zip(self.shape, self.cells, strict=True):
            inside = np.minimum(np.arange(n) - MARGIN, MARGIN + cells - np.arange(n))  # cells from the nearer wall
            shares.append(np.select([inside == 0, inside == -1, inside == 1], [1 / 2, 1 / 48, 47 / 48], 1.0))
        out = shares[0]
        for more in shares[1:]:
            out = out[..., None] * more
        return out

    def node_positions(self) -> np.ndarray:
        """(N, d) m: node positions from the grid's origin, in the order of the flattened grid."""
        axes = [np.arange(n) * self.cell_size for n in self.shape]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, self.dimension)
