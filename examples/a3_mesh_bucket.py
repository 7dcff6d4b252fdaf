"""A tool of one's own as a mesh: a concave bucket, made here as an STL file, digs a scoop of sand."""

import itertools
from functools import partial
from pathlib import Path

import jax
import numpy as np

from mpm_env import Scene, State, advance, build, initial, load_fidelity, read_scene, scripted

SCENES = Path(__file__).resolve().parent.parent / "configs" / "scenes"
LENGTH, HALF_WIDTH, HEIGHT, LIP, PLATE = 0.2, 0.075, 0.1, 0.035, 0.015  # m; its plates are four voxels thick


def walls(plate: float = PLATE) -> np.ndarray:
    """The bucket's bottom, back, two sides and lip, (5, 2, 3) m: lower and upper corners."""
    ahead, aside = LENGTH - plate, HALF_WIDTH - plate
    return np.array(
        [
            [(0, -HALF_WIDTH, 0), (LENGTH, HALF_WIDTH, plate)],
            [(0, -HALF_WIDTH, 0), (plate, HALF_WIDTH, HEIGHT)],
            [(0, -HALF_WIDTH, 0), (LENGTH, -aside, HEIGHT)],
            [(0, aside, 0), (LENGTH, HALF_WIDTH, HEIGHT)],
            [(ahead, -HALF_WIDTH, 0), (LENGTH, HALF_WIDTH, LIP)],
        ]
    )


def triangles(boxes: np.ndarray) -> np.ndarray:
    """Closed surface (n, 3, 3) m of the union of boxes (k, 2, 3), counter-clockwise seen from outside.

    The planes of the boxes' sides cut space into blocks: a square is where a filled one meets an empty one.
    """
    planes = [np.unique(boxes[..., axis]) for axis in range(3)]
    middle = np.stack(np.meshgrid(*((p[1:] + p[:-1]) / 2 for p in planes), indexing="ij"), axis=-1)[..., None, :]
    filled = np.pad(np.any(np.all((boxes[:, 0] < middle) & (middle < boxes[:, 1]), axis=-1), axis=-1), 1)
    surface = []
    for axis, side in itertools.product(range(3), (0, 1)):
        for block in np.argwhere(filled & ~np.roll(filled, 1 - 2 * side, axis)) - 1:
            corners = np.tile(block, (4, 1))
            corners[:, axis] += side
            corners[:, (axis + 1) % 3] += (0, 1, 1, 0)
            corners[:, (axis + 2) % 3] += (0, 0, 1, 1)
            a, b, c, d = np.stack([p[n] for p, n in zip(planes, corners.T, strict=True)], axis=1)[:: 2 * side - 1]
            surface += [(a, b, c), (a, c, d)]
    return np.array(surface)


def stl(surface: np.ndarray) -> bytes:
    """Triangles (n, 3, 3) m as a binary STL file: 80 bytes of anything, a number, normal and corners of so many."""
    rows = np.zeros(len(surface), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])
    normal = np.cross(surface[:, 1] - surface[:, 0], surface[:, 2] - surface[:, 0])
    rows["normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    rows["corners"] = surface
    return bytes(80) + np.array(len(rows), "<u4").tobytes() + rows.tobytes()


def main(fidelity: str = "draft", dimension: int = 3) -> dict[str, float]:
    """Dig; returns the sand in the bucket at the end in kg, the weight it is felt by, and the largest force in N."""
    scene = build(read_scene(str(SCENES / "bucket_scoop.yaml")), load_fidelity(fidelity, [f"dimension={dimension}"]))
    state = jax.jit(partial(initial, scene))(jax.random.key(0))
    steps = round(scene.config.duration / scene.rigid_dt)
    state, reactions = jax.jit(partial(advance, scene))(state, scripted(scene, 0, steps))
    force = np.asarray(reactions)[:, 0, :3]
    return {
        "held_kg": held(scene, state),
        "felt_N": -float(force[-steps // 20 :, 2].mean()),
        "force_peak_N": float(np.linalg.norm(force, axis=1).max()),
        "health": float(state.health),
    }


def held(scene: Scene, state: State) -> float:
    """Sand in the bucket, heaped or not, kg."""
    (body,) = scene.bodies.bodies
    place, turn = (np.asarray(a[body]) for a in (state.rigid.xpos, state.rigid.xmat))
    x, y, z = turn.T @ (np.asarray(scene.world(state.grains.x)) - place[:, None])
    inside = (x > 0) & (x < LENGTH) & (abs(y) < HALF_WIDTH) & (z > 0) & (z < 2 * HEIGHT)
    return float(np.asarray(state.grains.m)[inside].sum())


if __name__ == "__main__":
    (SCENES / "bucket.stl").write_bytes(stl(triangles(walls())))
    for name, value in main().items():
        print(f"{name}: {value:.4g}")
