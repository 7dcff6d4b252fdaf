"""Grains in the order of their cells: when they are sorted, what that changes, and what it must not."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpm_env import scene as scenes
from mpm_env.mpm.sorting import MOST_DISORDER, disorder, in_order
from mpm_env.mpm.transfer import weights
from mpm_env.mpm.types import MARGIN, Grid, Particles, Wall
from mpm_env.scene import State, build, initial
from mpm_env.sim import advance, scripted
from mpm_env.view import View
from tests.unit.slices import NUMERICS, slice_of_sand

DX = 0.01
N = 4096
GRID = Grid((0.0, 0.0, 0.0), (12, 12, 12), DX, ((Wall(), Wall()),) * 3)
SPANS = ((0, 1024), (1024, N))
sort = jax.jit(lambda p, order: in_order(GRID, p, SPANS, order))


def grains(seed: int = 0) -> Particles:
    """Grains anywhere in the box, some slots empty; the mass names each of them."""
    rng = np.random.default_rng(seed)
    m = np.where(rng.random(N) < 0.1, 0, 1 + np.arange(N))
    rows = (MARGIN * DX + 12 * DX * rng.random((3, N)), rng.normal(size=(3, N)), np.zeros((3, 3, N)))
    rest = (np.zeros((6, N)), np.zeros((6, N)), np.zeros((1, N)), m, np.ones(N))
    return Particles(*(jnp.asarray(a, jnp.float32) for a in (*rows, *rest)))


def cells(p: Particles) -> np.ndarray:
    base = np.asarray(weights(p.x, DX, GRID.shape)[0])
    return np.ravel_multi_index(tuple(base), GRID.shape)


def test_grains_come_by_cell_within_their_material_and_empty_slots_last() -> None:
    p = grains()
    after, order = sort(p, jnp.arange(N, dtype=jnp.int32))
    cell, there = cells(after), np.asarray(after.m) > 0
    for start, stop in SPANS:
        mine = slice(start, stop)
        assert set(np.asarray(order)[mine]) == set(range(start, stop))
        count = np.count_nonzero(there[mine])
        assert there[mine][:count].all() and 0 < count < stop - start
        assert np.all(np.diff(cell[mine][:count]) >= 0)
    for name in Particles.__dataclass_fields__:
        np.testing.assert_array_equal(
            np.asarray(getattr(after, name)), np.asarray(getattr(p, name))[..., np.asarray(order)], name
        )


def test_what_is_in_order_stays_where_it_is() -> None:
    ordered, order = sort(grains(), jnp.arange(N, dtype=jnp.int32))
    a, b = (np.asarray(ordered.x[0, k]) for k in (10, 3000))
    nearly = replace(ordered, x=ordered.x.at[0, 10].set(b).at[0, 3000].set(a))
    there = np.asarray(nearly.m) > 0
    assert 0 < float(disorder(jnp.asarray(cells(nearly)[there]))) < MOST_DISORDER
    after, same = sort(nearly, order)
    np.testing.assert_array_equal(np.asarray(after.x), np.asarray(nearly.x))
    np.testing.assert_array_equal(np.asarray(same), np.asarray(order))


@pytest.fixture
def shuffled(monkeypatch: pytest.MonkeyPatch) -> tuple[State, State]:
    """A slice of sand after some steps, once with its grains sorted on the way and once without."""
    plain = build(slice_of_sand(False), NUMERICS)
    with monkeypatch.context() as patch:
        patch.setattr(scenes, "SORTED_FROM", 1)
        ordered = build(slice_of_sand(False), NUMERICS)
        start = initial(ordered, jax.random.key(1))
    assert start.order is not None and initial(plain, jax.random.key(1)).order is None
    rng = np.random.default_rng(0)
    (first, last) = plain.spans[0]
    order = jnp.asarray(first + rng.permutation(last - first), jnp.int32)
    mixed = replace(start, grains=jax.tree.map(lambda a: a[..., order], start.grains), order=order)
    move = jax.jit(partial(advance, plain))
    drives = scripted(plain, 0, 10)
    return move(mixed, drives)[0], move(initial(plain, jax.random.key(1)), drives)[0]


def test_who_follows_single_grains_sees_no_order(shuffled: tuple[State, State]) -> None:
    mixed, plain = shuffled
    assert not np.array_equal(np.asarray(mixed.order), np.arange(len(mixed.order)))
    scene = build(slice_of_sand(False), NUMERICS)
    one, other = View.of(scene, mixed), View.of(scene, plain)
    np.testing.assert_array_equal(one.slots, other.slots)
    assert np.abs(one.grains - other.grains).max() < 1e-5  # m: sums in another order; grains lie 17 mm apart
    home = mixed.grains_at_home
    assert np.abs(np.asarray(home.x) - np.asarray(plain.grains.x)).max() < 1e-5
    assert np.abs(np.asarray(mixed.grains.x) - np.asarray(plain.grains.x)).max() > 0.01
