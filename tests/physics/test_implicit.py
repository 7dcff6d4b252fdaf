"""The semi-implicit solver: stable far beyond the sound's time step, and the explicit one's limit."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array, lax

from benchmarks.validation.blocks import alive, balance, block, box, example, go, lattice
from mpm_env import Scene, State, build, initial
from mpm_env.fidelity import Fidelity
from mpm_env.health import MOST_UNSOLVED, Health
from mpm_env.mpm import implicit
from mpm_env.mpm.materials import Material
from mpm_env.mpm.substep import Bed
from mpm_env.mpm.types import Grid, Particles
from mpm_env.scene_config import read_scene
from mpm_env.sim import advance, scripted

CELL = 1 / 8  # m
GRID = box((12, 8), CELL)
MODE = 0.05  # m/s, of the bar's swinging
DRIFT = (0.02, 0.01)  # m/s
FAR = 10.0  # Courant number, of the sound
HARD = 0.3  # m/s, enough to yield
MOMENTUM = 5e-7  # m/s of the mass, f32; 1e-7 observed
CHECKED = ("elastic", "sand", "snow", "cam_clay")  # the others differ in their law only; each compiles for 6 s
GAIN = 1e-4  # of the energy, f32


@partial(jax.jit, static_argnums=0)
def _advance(
    grid: Grid, material: Material, p: Particles, dt: Array, gravity: Array, steps: Array
) -> tuple[Particles, Array]:
    def one(_: Array, both: tuple[Particles, Array]) -> tuple[Particles, Array]:
        return implicit.substep(grid, (Bed(material, 0, p.count),), both[0], dt, gravity, both[1])

    return lax.fori_loop(0, steps, one, (p, jnp.zeros((), p.x.dtype)))


def going(
    material: Material, p: Particles, dt: float, steps: int, *, grid: Grid = GRID, gravity: tuple[float, ...] = (0, 0)
) -> tuple[Particles, float]:
    """The grains after so many semi-implicit substeps, and the largest share left unsolved."""
    dtype = p.x.dtype
    g = jnp.asarray(gravity, dtype)
    p, unsolved = _advance(grid, material, p, jnp.asarray(dt, dtype), g, jnp.int32(steps))
    return p, float(unsolved)


def bar(name: str, dtype: str = "float32", mode: float = MODE) -> tuple[Material, Particles]:
    """A free bar of 4 x 1 cells that swings along its length while it drifts."""
    material = example(name, dtype)
    sites = lattice((4.25 * CELL, 3.25 * CELL), (8, 4), CELL / 2)
    p = block(GRID, material, sites, volume=(CELL / 2) ** 2, v=np.array(DRIFT), dtype=dtype)
    here = alive(p)
    x = np.asarray(p.x)[0]
    middle, length = x[here].mean(), 4 * CELL
    v = np.asarray(p.v) + np.where(here, mode * np.sin(np.pi * (x - middle) / length), 0) * np.array([[1], [0]])
    return material, replace(p, v=jnp.asarray(v, dtype))


def sounding(material: Material, courant: float) -> float:
    """The time step (s) of a Courant number."""
    return courant * CELL / float(material.wave_speed())


def energy(material: Material, p: Particles) -> float:
    b = balance(GRID, material, p)
    return float(b.kinetic + b.elastic)


@pytest.mark.parametrize("courant", [2.0, FAR, 10 * FAR])
def test_swinging_bar_never_gains_energy_at_any_step(courant: float) -> None:
    material, p = bar("elastic")
    energies = [energy(material, p)]
    for _ in range(12):
        p, unsolved = going(material, p, sounding(material, courant), 1)
        assert unsolved < MOST_UNSOLVED
        energies.append(energy(material, p))
    assert np.all(np.diff(energies) <= GAIN * energies[0]), energies
    drift = float(np.asarray(p.m, float).sum()) * np.sum(np.square(DRIFT)) / 2
    assert 0.999 * drift < energies[-1] < 1.1 * drift  # the swing dies out, the drift does not


def test_explicit_solver_is_lost_there() -> None:
    """The negative control."""
    material, p = bar("elastic")
    first = energy(material, p)
    last = energy(material, go(GRID, material, p, dt=sounding(material, FAR), steps=12))
    assert not last < 100 * first


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKED)
def test_momentum_is_conserved_and_steps_are_solved(name: str) -> None:
    material, p = bar(name, mode=HARD)
    before = balance(GRID, material, p)
    p, unsolved = going(material, p, sounding(material, 5.0), 8)
    after = balance(GRID, material, p)
    np.testing.assert_allclose(after.momentum, before.momentum, rtol=0, atol=MOMENTUM * float(before.mass))
    turning = abs(float(after.angular_momentum[2] - before.angular_momentum[2]))
    assert turning < MOMENTUM * float(before.mass) * 12 * CELL
    assert unsolved < MOST_UNSOLVED


def test_it_comes_to_the_explicit_solver_in_the_first_order() -> None:
    """Both after the same time, float64; halved steps halve the difference."""
    with jax.enable_x64(True):
        material, start = bar("elastic", "float64")
        found = []
        for steps in (40, 80, 160):
            dt = sounding(material, 1.0) / steps
            one = go(GRID, material, start, dt=dt, steps=steps)
            other, _ = going(material, start, dt, steps)
            found.append(float(jnp.abs(one.v - other.v)[:, alive(start)].max()))
    orders = np.log2(np.array(found[:-1]) / np.array(found[1:]))
    np.testing.assert_allclose(orders, 1, atol=0.15)


COLLAPSE = read_scene("column_collapse_2d", ("speed=1.0", "grains.0.material.E=1e8", "duration=0.2"))


def collapsed(cells: int, **numerics: float | str) -> tuple[Scene, State]:
    """The column of stiff sand after 0.2 s."""
    scene = build(COLLAPSE, Fidelity(cells=cells, **numerics))  # type: ignore[arg-type]
    state = initial(scene, jax.random.key(0))
    steps = round(COLLAPSE.duration / scene.rigid_dt)
    return scene, jax.jit(partial(advance, scene))(state, scripted(scene, 0, steps))[0]


def middle(state: State) -> np.ndarray:
    """The column's centre of mass (2,) m in the world."""
    return np.average(np.asarray(state.grains.x, float), weights=np.asarray(state.grains.m), axis=1)


@pytest.mark.slow
def test_stiff_column_falls_nearer_to_a_fine_one_than_with_explicit_steps() -> None:
    """At 40 times the explicit step: each transfer dissipates, and there are as many fewer of them."""
    scene, state = collapsed(2, solver="semi_implicit", courant=20.0)
    coarse, explicit = collapsed(2)
    fine, reference = collapsed(4)
    assert int(state.health) == int(explicit.health) == int(reference.health) == 0
    assert scene.mpm_dt > 30 * coarse.mpm_dt
    ours, theirs, right = (
        middle(s) + sc.grid.origin for sc, s in ((scene, state), (coarse, explicit), (fine, reference))
    )
    assert np.linalg.norm(ours - right) < 0.7 * np.linalg.norm(theirs - right), (ours, theirs, right)


@pytest.mark.slow
def test_what_is_left_unsolved_gets_its_health_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(implicit, "TRIES", 1)
    _, state = collapsed(2, solver="semi_implicit", courant=20.0)
    assert int(state.health) & Health.NOT_SOLVED


def test_scenes_that_do_not_ask_for_it_have_none_of_it() -> None:
    """Nothing in an explicit step is repeated until it is solved."""
    texts = []
    for solver in ("explicit", "semi_implicit"):
        scene = build(COLLAPSE, Fidelity(cells=2, kernels="xla", solver=solver))
        state = initial(scene, jax.random.key(0))
        texts.append(str(jax.make_jaxpr(partial(advance, scene))(state, scripted(scene, 0, 1))))
    assert "while[" not in texts[0] and "while[" in texts[1]


@pytest.mark.parametrize(
    ("settings", "numerics", "words"),
    [
        (("walls.z_lower={kind: separate, friction: 0.5}",), {}, "no walls of kind 'separate'"),
        ((), {"kernels": "native"}, "has no native kernels"),
    ],
)
def test_what_the_solver_does_not_know_is_refused(settings: tuple[str, ...], numerics: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        build(read_scene("column_collapse_2d", settings), Fidelity(cells=2, solver="semi_implicit", **numerics))


def test_bodies_are_refused_too() -> None:
    with pytest.raises(ValueError, match="knows no bodies, only grains"):
        build(read_scene("box_drop"), Fidelity(cells=4, solver="semi_implicit"))
