"""Meshes as voxels: signed distances at the nodes of a grid of cubes, computed once and kept on disk.

Voxels are kept under a hash of the mesh's own numbers, so that a changed mesh is never taken for the one before. A mesh
that they cannot hold is refused: one with holes, one turned inside out, and one whose walls fall between the nodes.
"""

import hashlib
import os
import tempfile
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

MARGIN = 2
"""Voxels between a mesh and the edge of its grid, so that gradients just outside are sampled, not clamped."""
CELLS = (8, 256)
"""Fewest and most voxels along a grid: below, the margin eats it; above, it takes over 64 MB."""
WHOLE = 0.1
"""How far from a whole number of times a closed mesh may seem to wind around a node: libigl is off by 0.01 at most,
and from the node nearest to it a hole two voxels wide takes away more."""
ON_SURFACE = 0.01
"""Voxels, nearer than which a node is on the surface, and half of the mesh winds around it."""
CORE = 0.5
"""Voxels deep: a wall of two voxels has nodes this deep all over, however it lies in the grid, and one of less than a
voxel has none."""
EDGE = 6
"""Voxels from such nodes to the end of a cutting edge of 30 degrees; sharper ones count as thin walls."""


@dataclass(frozen=True, eq=False)
class Voxels:
    """Signed distances to a mesh at the nodes of a grid of cubes, in the geom's frame."""

    values: np.ndarray  # (nx, ny, nz) m, float32
    origin: np.ndarray  # (3,) m, place of values[0, 0, 0]
    spacing: float  # m


def voxels_of(model: mujoco.MjModel, geom: int, *, cells: int, cache_dir: Path | None = None) -> Voxels:
    """The voxels of a mesh geom, `cells` along its longest side: read from the cache, else computed and kept.

    Raises ValueError for a mesh without faces, one that voxels cannot hold, and `cells` outside `CELLS`.
    """
    name = model.geom(geom).name or f"number {geom}"
    if not CELLS[0] <= cells <= CELLS[1]:
        raise ValueError(f"cells = {cells} for the mesh of geom {name} is outside {CELLS[0]}..{CELLS[1]}.")
    data = int(model.geom_dataid[geom])
    if data < 0 or model.mesh_facenum[data] == 0:
        raise ValueError(f"geom {name} has a mesh without faces: give it faces, or use a primitive geom.")
    vertices, faces = _triangles(model, data)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    spacing = float((high - low).max()) / (cells - 2 * MARGIN)
    nodes = np.ceil((high - low) / spacing).astype(int) + 2 * MARGIN + 1
    origin = (low + high - spacing * (nodes - 1)) / 2

    recipe = repr((vertices.shape, faces.shape, cells, MARGIN, WHOLE, ON_SURFACE, CORE, EDGE)).encode()
    digest = hashlib.sha256(recipe + vertices.tobytes() + faces.tobytes()).hexdigest()
    file = (cache_dir or user_cache("sdf")) / f"{digest}.npz"
    values = _read(file, tuple(nodes))
    if values is None:
        places = origin + spacing * np.stack(np.meshgrid(*map(np.arange, nodes), indexing="ij"), axis=-1)
        found, turns = _mesh_distances(places.reshape(-1, 3), vertices, faces)
        values = found.reshape(nodes)
        for fault, badness, remedy in _faults(values / spacing, turns.reshape(nodes)):
            if badness.any():
                x, y, z = _in_file(model, data, places.reshape(-1, 3)[np.argmax(badness)])
                raise ValueError(
                    f"the mesh of geom {name} {fault} near ({x:.3g}, {y:.3g}, {z:.3g}) m of its file, by voxels of"
                    f" {spacing:.3g} m: {remedy.format(2 * spacing)}, or build it from boxes."
                )
        _write(file, values)
    return Voxels(values, origin, spacing)


def _triangles(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """A mesh's vertices (v, 3) m in the geom's frame, and the indices (f, 3) of its faces' corners."""
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[face : face + model.mesh_facenum[mesh]]
    return np.asarray(vertices, np.float64), np.asarray(faces, np.int64)


def _mesh_distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (n,) m, float32, of points (n, 3) m to a mesh, and how often (n,) it winds around them.

    Where it does, they are negative. That sign is right for concave meshes, and at edges (libigl; Barill et al. 2018,
    Fast Winding Numbers for Soups and Clouds).
    """
    import igl  # a compiled library that only scenes with meshes need

    turns = igl.fast_winding_number(vertices, faces, points)
    nearest = igl.point_mesh_squared_distance(points, vertices, faces)[2]
    distance = np.linalg.norm(points - nearest, axis=1)
    return np.where(turns > 0.5, -distance, distance).astype(np.float32), turns


def _faults(phi: np.ndarray, turns: np.ndarray) -> list[tuple[str, np.ndarray, str]]:
    """What voxels cannot hold, how bad it is at the nodes, and its remedy, which is to be told two voxels in m.

    From distances phi (nodes) in voxels and winding numbers turns (nodes).
    """
    unsure = np.abs(turns - np.round(turns))
    open_ = (unsure > WHOLE) & (np.abs(phi) > ON_SURFACE)
    thin = (phi < 1) & ~_around(phi <= -CORE, EDGE)
    return [
        ("is turned inside out", turns < WHOLE - 1, "turn its faces outward"),
        ("has a hole, or a face turned inward,", open_ * unsure, "mend it"),
        ("is too thin", thin * (1 - phi), "make walls at least {:.3g} m thick"),
    ]


def _around(mask: np.ndarray, reach: int) -> np.ndarray:
    """Nodes at most so many voxels along each axis from one that the mask (nodes) holds."""
    for axis in range(mask.ndim):
        sides = [(reach, reach) if other == axis else (0, 0) for other in range(mask.ndim)]
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(mask, sides), 2 * reach + 1, axis)
        mask = np.any(windows, axis=-1, keepdims=True)[..., 0]
    return mask


def _in_file(model: mujoco.MjModel, mesh: int, point: np.ndarray) -> np.ndarray:
    """A point (3,) m of the geom's frame as the mesh's file has it: MuJoCo moves a mesh to its axes of inertia."""
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, point, model.mesh_quat[mesh])
    return np.asarray(model.mesh_pos[mesh] + turned)


def user_cache(name: str) -> Path:
    """The folder `mpm_env/name` in `$XDG_CACHE_HOME` or `~/.cache`, there or not; RuntimeError if there is no home."""
    # An empty XDG_CACHE_HOME counts as not set (XDG Base Directory Specification).
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mpm_env" / name


def _read(file: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    """Kept distances, or None where there are none or the file is damaged (npz files hold a checksum)."""
    try:
        with file.open("rb") as opened, np.load(opened) as kept:
            values = kept["values"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return values if values.shape == shape and values.dtype == np.float32 else None


def _write(file: Path, values: np.ndarray) -> None:
    """Keep distances for next time, whole or not at all: another process may use the same file now."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=file.parent) as private:
            np.savez(Path(private) / file.name, values=values)
            os.replace(Path(private) / file.name, file)
    except OSError as error:
        warnings.warn(f"mesh distances cannot be kept and are computed each time: {error}", stacklevel=2)
