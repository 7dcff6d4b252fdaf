"""Building a scene: the one place where its numbers are held against each other, and refused before anything runs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from coupling.bodies import Bodies, posed, refresh, start
from coupling.reach import distances_from
from mpm_env.config import nearest
from mpm_env.fidelity import Fidelity
from mpm_env.health import ContactReport
from mpm_env.motion import Motion
from mpm_env.mpm import seeding
from mpm_env.mpm.materials import Material
from mpm_env.mpm.settling import Settling, at_rest, settling_of
from mpm_env.mpm.substep import Bed
from mpm_env.mpm.transfer import CHUNK
from mpm_env.mpm.types import Grid, Particles, Wall
from mpm_env.scene_bodies import Sizes, bodies_of, model_of, per_grains, sizes_of
from mpm_env.scene_cache import keep_programs
from mpm_env.scene_config import SceneConfig
from mpm_env.scene_grains import WHOLE, axes_of, fill_of, material_of, whole
from mpm_env.scene_steps import kernels_of, substeps

SORTED_FROM = 65_536  # grains; with fewer, order saves native kernels a tenth at most, and plain XLA nothing
OVERLAP = 0.25  # cells that a grain may start inside a body: the jitter of seeding, not a mistake


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything about a run that does not change while it runs."""

    config: SceneConfig
    fidelity: Fidelity
    grid: Grid
    materials: tuple[Material, ...]  # nominal; a State carries its own
    spans: tuple[tuple[int, int], ...]  # slots of each material
    fills: tuple[tuple[seeding.Fill, ...], ...]  # per material
    gravity: np.ndarray  # (d,) m/s^2
    rigid_dt: float  # s
    mpm_dt: float  # s
    mpm_per_rigid: int
    bodies: Bodies | None
    adhesion: tuple[float, ...]  # Pa, of each material to the bodies
    motion: Motion
    sizes: Sizes
    settling: Settling | None  # None where grains start unstrained
    middle: float  # m, the slice's y in plane strain
    dtype: Any
    kernels: str  # "native" or "xla"

    @property
    def dimension(self) -> int:
        """2 (plane strain) or 3."""
        return self.grid.dimension

    @property
    def node_volume(self) -> float:
        """What a grid node stands for, m^3: a cell, in plane strain of the slice's thickness."""
        thickness = self.config.box.upper[1] - self.config.box.lower[1]
        return float(self.grid.cell_size**self.dimension * (thickness if self.dimension == 2 else 1))

    @property
    def slots(self) -> int:
        """Room for grains."""
        return self.spans[-1][1] if self.spans else 0

    @property
    def sorts(self) -> bool:
        """Whether grains are put in order now and then: only where their grid outgrows the cache."""
        return self.slots >= SORTED_FROM

    def beds(self, materials: tuple[Material, ...]) -> tuple[Bed, ...]:
        """Materials with the slots that are theirs."""
        return tuple(Bed(mat, a, b) for mat, (a, b) in zip(materials, self.spans, strict=True))

    def world(self, x: Array) -> Array:
        """Grain positions (d, n) from the grid's origin, as points (3, n) m of the world."""
        x = x + jnp.asarray(self.grid.origin, x.dtype)[:, None]
        return lift(x, self.middle)

    @property
    def spacing(self) -> float:
        """Distance of neighbouring grains at the start, m."""
        return self.grid.cell_size / self.fidelity.particles_per_axis


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["rigid", "grains", "order", "materials", "steps", "health", "left", "reaction", "contact"],
    meta_fields=[],
)
@dataclass(frozen=True)
class State:
    """A moment of a run: a pytree, so it jits, vmaps and can be stored."""

    rigid: Any  # mjx.Data, or None where a scene has no bodies
    grains: Particles
    order: Array | None  # (n,) int32, the slot each grain had at the start; None where grains keep their slots
    materials: tuple[Material, ...]
    steps: Array  # () int32, rigid steps since the start
    health: Array  # () int32, sticky bits of mpm_env.health.Health
    left: Array  # () kg that left through open walls
    reaction: Array  # (G, 6) N and N m on each coupled geom about its body's centre, mean over the last rigid step
    contact: ContactReport | None  # how contact went in the last rigid step; None where a scene has no bodies

    @property
    def grains_at_home(self) -> Particles:
        """The grains in the slots they had at the start, as numpy arrays: for whoever follows single grains."""
        grains = jax.tree.map(np.asarray, self.grains)
        if self.order is None:
            return grains
        home = np.argsort(np.asarray(self.order))
        return jax.tree.map(lambda a: a[..., home], grains)


def lift(a: Any, y: float = 0.0) -> Any:
    """Rows (2, n) of plane strain as rows (3, n) of space, the middle one y; rows (3, n) as they are."""
    if a.shape[0] == 3:
        return a
    stack = np if isinstance(a, np.ndarray) else jnp
    return stack.stack([a[0], stack.full_like(a[0], y), a[1]])


def build(config: SceneConfig, fidelity: Fidelity) -> Scene:
    """A scene at a fidelity. Raises ValueError, in one sentence, for whatever cannot be simulated as asked.

    Has JAX keep compiled programs on disk from here on, unless you decided otherwise: see `scene_cache.keep_programs`.
    """
    keep_programs()
    dtype = _dtype(fidelity)
    if config.plane_strain:
        fidelity = fidelity.model_copy(update={"dimension": 2})
    grid = _grid(config, fidelity)
    d = grid.dimension
    materials = tuple(material_of(g.material, dtype, dimension=d, stiffness=fidelity.stiffness) for g in config.grains)
    fills = tuple(tuple(fill_of(f, config, grid, fidelity) for f in g.fill) for g in config.grains)
    spans, at = [], 0
    for some in fills:
        count = sum(len(f.sites) for f in some)
        chunked = -(-count // CHUNK) * CHUNK
        spans.append((at, at + chunked))
        at += chunked
    model = model_of(config.bodies, fidelity, config.gravity) if config.bodies else None
    motion = Motion.of(config.bodies, model)
    mpm_per_rigid = substeps(config, fidelity, grid, materials, motion)
    bodies = bodies_of(config, model, grid, fidelity) if model is not None else None
    middle = (config.box.lower[1] + config.box.upper[1]) / 2
    scene = Scene(
        config=config,
        fidelity=fidelity,
        grid=grid,
        materials=materials,
        spans=tuple(spans),
        fills=fills,
        gravity=np.asarray(config.gravity)[axes_of(d)],
        rigid_dt=fidelity.rigid_dt,
        mpm_dt=fidelity.rigid_dt / mpm_per_rigid,
        mpm_per_rigid=mpm_per_rigid,
        bodies=bodies,
        motion=motion,
        adhesion=per_grains("adhesion", config.bodies.adhesion, len(config.grains)) if config.bodies else (),
        sizes=sizes_of(bodies, grid, config, fidelity, at, middle) if bodies else Sizes(0, 0),
        settling=_settling(config, grid, materials, fills),
        middle=middle,
        dtype=dtype,
        kernels=kernels_of(config, fidelity, grid),
    )
    _refuse_overlap(scene)
    return scene


def initial(scene: Scene, key: Array, *, qpos: Array | None = None) -> State:
    """The start of a run: grains scattered by the key, bodies at their keyframe, or at qpos (nq,) instead."""
    g = scene.grid
    d = g.dimension
    rows: dict[str, list[Array]] = {"x": [], "v": [], "m": [], "V0": []}
    for material, fills, (a, b) in zip(scene.materials, scene.fills, scene.spans, strict=True):
        empty = b - a - sum(len(f.sites) for f in fills)
        for fill in fills:
            key, key_fill = jax.random.split(key)
            x, filled = seeding.scatter(fill, key_fill, scene.dtype, origin=g.origin)
            n = x.shape[1]
            rows["x"].append(x)
            rows["v"].append(jnp.broadcast_to(jnp.asarray(fill.velocity, scene.dtype)[:, None], (d, n)))
            rows["m"].append(jnp.where(filled, material.rho * fill.volume, 0).astype(scene.dtype))
            rows["V0"].append(jnp.full((n,), fill.volume, scene.dtype))
        centre = jnp.asarray(g.shape, scene.dtype)[:, None] * (g.cell_size / 2)
        rows["x"].append(jnp.broadcast_to(centre, (d, empty)).astype(scene.dtype))
        rows["v"].append(jnp.zeros((d, empty), scene.dtype))
        rows["m"].append(jnp.zeros((empty,), scene.dtype))
        rows["V0"].append(jnp.ones((empty,), scene.dtype))
    n, s = scene.slots, 4 if d == 2 else 6
    joined = {
        k: jnp.concatenate(v, axis=-1) if v else jnp.zeros((d, 0) if k in "xv" else (0,)) for k, v in rows.items()
    }
    depth = max((len(type(m).history_start) for m in scene.materials), default=0)
    history = np.zeros((depth, n))
    for material, (a, b) in zip(scene.materials, scene.spans, strict=True):
        for k, value in enumerate(type(material).history_start):
            history[k, a:b] = value
    grains = Particles(
        x=joined["x"],
        v=jnp.where(joined["m"] > 0, joined["v"], 0),
        C=jnp.zeros((d, d, n), scene.dtype),
        e=jnp.zeros((s, n), scene.dtype),
        tau=jnp.zeros((s, n), scene.dtype),
        history=jnp.asarray(history, scene.dtype),
        m=joined["m"],
        V0=joined["V0"],
    )
    if scene.settling:
        gravity = jnp.asarray(scene.gravity, scene.dtype)
        grains = at_rest(g, scene.beds(scene.materials), grains, gravity, scene.settling, scene.kernels)
    rigid = None
    if scene.bodies is not None:
        rigid = start(scene.bodies, _first_pose(scene))
        if qpos is not None:
            rigid = refresh(scene.bodies, rigid.replace(qpos=jnp.asarray(qpos, rigid.qpos.dtype)))
    geoms = len(scene.bodies.geoms) if scene.bodies else 0
    state = State(
        rigid=rigid,
        grains=grains,
        order=jnp.arange(n, dtype=jnp.int32) if scene.sorts else None,
        materials=scene.materials,
        steps=jnp.zeros((), jnp.int32),
        health=jnp.zeros((), jnp.int32),
        left=jnp.zeros((), scene.dtype),
        reaction=jnp.zeros((geoms, 6), scene.dtype),
        contact=ContactReport(*[jnp.zeros((), scene.dtype)] * 5) if scene.bodies else None,
    )
    # MJX commits its arrays to a device. The others go along, or the first step would compile a second time.
    return jax.device_put(state, jax.devices()[0])


def _dtype(fidelity: Fidelity) -> Any:
    if fidelity.precision == "f64" and jax.dtypes.canonicalize_dtype(np.float64) != np.float64:
        raise ValueError(
            'precision = f64 needs 64-bit JAX, which is off: call jax.config.update("jax_enable_x64", True)'
            " before building, or choose f32."
        )
    return jnp.float64 if fidelity.precision == "f64" else jnp.float32


def _grid(config: SceneConfig, fidelity: Fidelity) -> Grid:
    axes = axes_of(fidelity.dimension)
    dx = config.feature / fidelity.cells
    cells = []
    for a in axes:
        side = config.box.upper[a] - config.box.lower[a]
        n = whole(side / dx)
        if n is None:
            raise ValueError(
                f"The box is {side:.6g} m along {'xyz'[a]}, which is {side / dx:.4g} cells of {dx:.6g} m: make it a"
                f" whole number, with cells = {_fitting_cells(config, fidelity)} or a box of"
                f" {max(round(side / dx), 1) * dx:.6g} m."
            )
        cells.append(n)
    walls = [(_wall(config, f"{'xyz'[a]}_lower"), _wall(config, f"{'xyz'[a]}_upper")) for a in axes]
    return Grid(tuple(config.box.lower[a] for a in axes), tuple(cells), dx, tuple(walls))


def _wall(config: SceneConfig, side: str) -> Wall:
    return Wall(w.kind, w.friction) if (w := config.walls.get(side)) else Wall()


def _fitting_cells(config: SceneConfig, fidelity: Fidelity) -> str:
    """Numbers of cells per feature near the one asked for that cut every side of the box into whole cells."""
    sides = [config.box.upper[a] - config.box.lower[a] for a in axes_of(fidelity.dimension)]
    fits = [n for n in range(2, 200) if all(whole(s * n / config.feature) for s in sides)]
    return " or ".join(map(str, sorted(fits, key=lambda n: abs(n - fidelity.cells))[:2])) or "none (change the box)"


def _keyframe(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions (nq,) and velocities (nv,) at the start: the named keyframe's, or the model's pose at rest."""
    assert scene.bodies is not None and scene.config.bodies is not None
    model, name = scene.bodies.model, scene.config.bodies.keyframe
    if name is None:
        return model.qpos0, np.zeros(model.nv)
    known = [model.key(i).name for i in range(model.nkey)]
    if name not in known:
        raise ValueError(f"The model has no keyframe {name!r}{nearest(name, known)}")
    return model.key(name).qpos, model.key(name).qvel


def _settling(
    config: SceneConfig, grid: Grid, materials: tuple[Material, ...], fills: tuple[tuple[seeding.Fill, ...], ...]
) -> Settling | None:
    """How grains that start at rest come to it; None where none are to."""
    gravity = np.asarray(config.gravity)[axes_of(grid.dimension)]
    if config.start == "unstrained" or not fills or not gravity.any():
        return None
    sites = np.concatenate([fill.sites for some in fills for fill in some])
    return settling_of(materials, np.ptp(sites, axis=0) + grid.cell_size, gravity, grid.cell_size)


def _first_pose(scene: Scene) -> mujoco.MjData:
    """Where the bodies are at the start."""
    assert scene.bodies is not None
    return posed(scene.bodies, *_keyframe(scene), scene.motion.control(0.0), scene.motion.mocap(0.0))


def _refuse_overlap(scene: Scene) -> None:
    """Refuse grains that start inside a body, an uneven top at its mean: MPM would squeeze them out with a bang."""
    b, fills = scene.bodies, [fill for some in scene.fills for fill in some]
    if b is None or not fills:
        return
    sites = [f.sites if f.top is None else f.sites[f.sites[:, -1] < f.top] for f in fills]
    x, d = lift(np.concatenate(sites).T, scene.middle), _first_pose(scene)
    for body in range(len(b.bodies)):
        mine = [i for i, owner in enumerate(b.body_of) if owner == body]
        phi = distances_from(b, d, mine, x)
        inside = phi < -OVERLAP * scene.grid.cell_size
        if inside.any():
            worst = int(np.argmin(phi))
            name = min((float(distances_from(b, d, [i], x[:, worst : worst + 1])[0]), b.names[i]) for i in mine)[1]
            raise ValueError(
                f"{inside.sum()} grains start inside the geom {name!r}, up to {-phi[worst]:.3g} m deep: move the body"
                " or the material apart."
            )


def inside_grid(grid: Grid, x: Array) -> Array:
    """Which grains (n,) have their whole window on the grid."""
    s = x / grid.cell_size
    last = jnp.asarray([n - 1.5 for n in grid.shape], x.dtype)[:, None]
    return jnp.all((s >= 0.5) & (s < last), axis=0)


__all__ = ["WHOLE", "Scene", "State", "build", "initial", "inside_grid", "lift"]
