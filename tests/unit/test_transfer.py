"""Scatter and gather: the identities of quadratic B-splines, of APIC and of MLS-MPM's force."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from mpm_env.mpm.linalg3 import matrix_rows
from mpm_env.mpm.substep import node_velocities
from mpm_env.mpm.transfer import g2p, p2g, weights
from mpm_env.mpm.types import Grid, Particles, Wall

DX = 1 / 16  # a power of two: a shift by whole cells loses no digit
UNIT = 1e-6  # float32 rounding of sums over 9 and 27 nodes, relative to the terms; 4e-7 observed
FIELD = 2e-6  # the same for C, whose sums divide by D; 3e-7 observed
N = 256
CELLS = {2: (20, 18), 3: (10, 9, 8)}

each_dimension = pytest.mark.parametrize("d", [2, 3])


def grid_of(d: int) -> Grid:
    return Grid((0.0,) * d, CELLS[d], DX, ((Wall("stick"), Wall("stick")),) * d)


def grains(d: int, seed: int = 0) -> Particles:
    """Random grains with a margin of two cells to every wall, at positions of 16 binary digits."""
    rng = np.random.default_rng(seed)
    s = 4 if d == 2 else 6
    x = (5 + (np.array(CELLS[d])[:, None] - 4) * rng.uniform(size=(d, N))) * DX
    x = np.round(x * 2**16) / 2**16
    m = rng.uniform(0.5, 2, N)
    rows = (x, rng.normal(size=(d, N)), rng.normal(size=(d, d, N)), np.zeros((s, N)), rng.normal(size=(s, N)))
    return Particles(*(jnp.asarray(a, "float32") for a in (*rows, np.zeros((0, N)), m, rng.uniform(0.5, 2, N))))


@partial(jax.jit, static_argnums=(0, 3))
def scattered(grid: Grid, p: Particles, dt: Array, chunk: int = N) -> Array:
    return p2g(grid, p, dt, chunk)


@partial(jax.jit, static_argnums=0)
def carried(grid: Grid, p: Particles, dt: Array) -> tuple[Array, Array, Array]:
    """Node velocities, and velocity and affine velocity of the grains after the way there and back."""
    v, _ = node_velocities(p2g(grid, p, dt, N), dt, jnp.zeros(grid.dimension, p.x.dtype))
    return v, *g2p(grid, v, p.x)


def affine(d: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.normal(size=(d, 1)), rng.normal(size=(d, d))


def stressless(p: Particles) -> Particles:
    return replace(p, tau=jnp.zeros_like(p.tau))


NO_TIME, TIME = np.float32(0), np.float32(1)


@each_dimension
def test_weights_have_the_moments_of_quadratic_splines(d: int) -> None:
    """Sum 1, first moment 0, second moment dx^2/4, wherever a grain sits in its cell, nodes and faces included."""
    grid, p = grid_of(d), grains(d)
    x = p.x.at[:, :4].set(jnp.asarray([5.0, 5.25, 5.5, 5.75]) * DX)
    base, w, r = jax.jit(lambda x: weights(x, DX, grid.shape))(x)
    for a in range(d):
        W, R = np.stack(w[a]), np.stack(r[a])
        assert W.min() >= 0
        np.testing.assert_allclose(W.sum(axis=0), 1, rtol=0, atol=UNIT)
        np.testing.assert_allclose((W * R).sum(axis=0) / DX, 0, rtol=0, atol=UNIT)
        np.testing.assert_allclose((W * R * R).sum(axis=0) / DX**2, 0.25, rtol=0, atol=UNIT)
        np.testing.assert_allclose(np.asarray(base[a]) * DX, np.asarray(x[a]) + R[0], rtol=0, atol=UNIT)


@each_dimension
def test_affine_field_is_gathered_exactly(d: int) -> None:
    grid, p = grid_of(d), grains(d)
    a, B = affine(d)
    nodes = (a + B @ grid.node_positions().T).T.reshape(*grid.shape, d)
    v, C = g2p(grid, jnp.asarray(nodes, "float32"), p.x)
    np.testing.assert_allclose(np.asarray(v), a + B @ np.asarray(p.x), rtol=0, atol=UNIT * np.abs(nodes).max())
    expected = np.broadcast_to(B[..., None], C.shape)
    np.testing.assert_allclose(np.asarray(C), expected, rtol=0, atol=FIELD * np.abs(nodes).max() / DX)


@each_dimension
def test_affine_field_survives_the_way_there_and_back(d: int) -> None:
    grid, p = grid_of(d), stressless(grains(d))
    a, B = affine(d)
    field = a + B @ np.asarray(p.x, np.float64)
    p = replace(p, v=jnp.asarray(field, "float32"), C=jnp.broadcast_to(jnp.asarray(B, "float32")[..., None], p.C.shape))
    _, v, C = carried(grid, p, NO_TIME)
    size = np.abs(field).max()
    np.testing.assert_allclose(np.asarray(v), field, rtol=0, atol=UNIT * size)
    np.testing.assert_allclose(np.asarray(C), np.asarray(p.C), rtol=0, atol=FIELD * size / DX)
    # The control: without C on the way there it does not survive.
    _, v, C = carried(grid, replace(p, C=jnp.zeros_like(p.C)), NO_TIME)
    assert np.abs(np.asarray(C) - B[..., None]).max() > 1e3 * FIELD * size


@each_dimension
def test_scatter_keeps_mass_and_momentum(d: int) -> None:
    grid, p = grid_of(d), grains(d)
    nodes = np.asarray(scattered(grid, p, TIME, N), np.float64).reshape(-1, d + 1)
    np.testing.assert_allclose(nodes[:, d].sum(), np.asarray(p.m, np.float64).sum(), rtol=UNIT)
    expected = np.sum(np.asarray(p.m * p.v, np.float64), axis=1)
    np.testing.assert_allclose(nodes[:, :d].sum(axis=0), expected, rtol=0, atol=UNIT * np.abs(nodes[:, :d]).sum())


@each_dimension
def test_force_has_the_moments_of_the_stress(d: int) -> None:
    """Grain by grain: sum f = 0 and sum f (x_i - x_p)^T = -V0 tau."""
    grid, p = grid_of(d), grains(d)
    p = replace(p, v=jnp.zeros_like(p.v), C=jnp.zeros_like(p.C))
    one = jax.jit(lambda q: p2g(grid, q, TIME, 1))
    position = grid.node_positions()
    for k in range(0, N, 16):
        q = Particles(*(getattr(p, f)[..., k : k + 1] for f in p.__dataclass_fields__))
        f = np.asarray(one(q), np.float64).reshape(-1, d + 1)[:, :d]
        r = position - np.asarray(q.x, np.float64).T
        tau = np.array(matrix_rows(np.asarray(q.tau, np.float64)))[..., 0]
        np.testing.assert_allclose(f.sum(axis=0), 0, rtol=0, atol=UNIT * np.abs(f).sum())
        moment, expected = f.T @ r, -float(q.V0[0]) * tau
        np.testing.assert_allclose(moment, expected, rtol=0, atol=UNIT * np.abs(expected).max())


@each_dimension
def test_shift_by_whole_cells_shifts_the_nodes_to_the_bit(d: int) -> None:
    grid, p = grid_of(d), grains(d)
    here = np.asarray(scattered(grid, p, TIME, N))
    there = np.asarray(scattered(grid, replace(p, x=p.x + DX), TIME, N))
    np.testing.assert_array_equal(there[(slice(1, None),) * d], here[(slice(None, -1),) * d])


@each_dimension
def test_mirror_image_has_mirrored_nodes(d: int) -> None:
    grid, p = grid_of(d), grains(d)
    flip = np.ones(d)
    flip[0] = -1
    sign = np.array([1, 1, 1, -1] if d == 2 else [1, 1, 1, 1, -1, -1])
    image = replace(
        p,
        x=p.x.at[0].set((grid.shape[0] - 1) * DX - p.x[0]),
        v=p.v * flip[:, None].astype("float32"),
        C=p.C * np.outer(flip, flip)[..., None].astype("float32"),
        tau=p.tau * sign[:, None].astype("float32"),
    )
    here, there = (np.asarray(scattered(grid, q, TIME, N)) for q in (p, image))
    expected = np.flip(here, axis=0) * np.append(flip, 1)
    np.testing.assert_allclose(there, expected, rtol=0, atol=UNIT * np.abs(here).max())


@each_dimension
def test_common_velocity_is_carried_along(d: int) -> None:
    """Galilei: the same motion seen from a moving frame."""
    grid, p = grid_of(d), grains(d)
    c = np.arange(1, d + 1, dtype="float32")[:, None]
    dt = np.float32(1e-3)
    _, v, C = carried(grid, p, dt)
    _, v_c, C_c = carried(grid, replace(p, v=p.v + c), dt)
    size = float(np.abs(v_c).max())
    np.testing.assert_allclose(np.asarray(v_c), np.asarray(v) + c, rtol=0, atol=2 * UNIT * size)
    np.testing.assert_allclose(np.asarray(C_c), np.asarray(C), rtol=0, atol=FIELD * size / DX)


@each_dimension
def test_chunks_change_only_the_order_of_sums(d: int) -> None:
    grid, p = grid_of(d), grains(d)
    whole, cut = (np.asarray(scattered(grid, p, TIME, chunk)) for chunk in (N, N // 4))
    np.testing.assert_allclose(cut, whole, rtol=0, atol=UNIT * np.abs(whole).max())


@each_dimension
def test_empty_slots_leave_the_nodes_alone(d: int) -> None:
    """A grain that left keeps its last stress and volume; neither may reach the grid."""
    grid, p = grid_of(d), grains(d)
    gone = jnp.arange(N) % 3 == 0
    p = replace(p, m=jnp.where(gone, 0, p.m))
    erased = replace(p, tau=jnp.where(gone, 0, p.tau))
    np.testing.assert_array_equal(*(np.asarray(scattered(grid, q, TIME, N)) for q in (p, erased)))
