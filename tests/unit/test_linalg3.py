"""Eigen-decomposition of component rows against LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpm_env.mpm.linalg3 import compose, eigen, matrix_rows

N = 512
# Of the largest principal value: rounding of a few rotations. 4e-7 and 8e-16 observed.
VALUES = {"float32": 2e-6, "float64": 4e-15}
AXES = {"float32": 2e-6, "float64": 4e-15}  # orthogonality; 7e-7, 1e-15 observed
SLOPE = 1e-9  # relative to the largest; central differences in float64 with steps of 1e-6: 2e-10 observed

each_dimension = pytest.mark.parametrize("d", [2, 3])
each_precision = pytest.mark.parametrize("dtype", ["float32", "float64"])
decompose = jax.jit(eigen)


def tensors(e: np.ndarray) -> np.ndarray:
    """Rows (s, n) as (n, 3, 3), float64."""
    e = np.asarray(e, np.float64)
    zero = np.zeros_like(e[0])
    yz, xz, xy = (zero, zero, e[3]) if len(e) == 4 else (e[3], e[4], e[5])
    return np.moveaxis(np.array([[e[0], xy, xz], [xy, e[1], yz], [xz, yz, e[2]]]), -1, 0)


def samples(d: int) -> np.ndarray:
    """Rows (s, N): ordinary ones, tiny and huge ones, repeated values, zeros, and pure shears."""
    rng = np.random.default_rng(0)
    e = rng.normal(size=(4 if d == 2 else 6, N))
    e[:, 100:200] *= 10.0 ** rng.uniform(-6, 6, 100)
    e[:3, 200:250] = e[:1, 200:250]
    e[3:, 200:225] = 0
    e[3:, 225:250] *= 1e-6
    e[:3, 250:260] = 0
    e[:, 260:264] = 0
    e[1, 264:300] = e[0, 264:300]
    return e


def decomposed(e: np.ndarray, dtype: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values, axes, and the tensors that they make again, in float64 numbers."""
    with jax.enable_x64(dtype == "float64"):
        values, axes = decompose(jnp.asarray(e, dtype))
        again = compose(axes, values)
        assert values.dtype == axes.dtype == again.dtype == dtype
    return tuple(np.asarray(a, np.float64) for a in (values, axes, again))


@each_dimension
@each_precision
def test_principal_values_are_lapacks(d: int, dtype: str) -> None:
    e = samples(d).astype(dtype)
    values, _, _ = decomposed(e, dtype)
    truth = np.linalg.eigvalsh(tensors(e))
    scale = np.abs(truth).max(axis=1, keepdims=True)
    assert np.all(np.abs(np.sort(values.T, axis=1) - truth) <= VALUES[dtype] * scale)


@each_dimension
@each_precision
def test_axes_are_orthonormal_and_make_the_tensor_again(d: int, dtype: str) -> None:
    e = samples(d).astype(dtype)
    values, axes, again = decomposed(e, dtype)
    gram = np.einsum("ikn,iln->nkl", axes, axes)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(d), gram.shape), rtol=0, atol=AXES[dtype])
    assert np.all(np.abs(again - e) <= VALUES[dtype] * np.abs(values).max(axis=0))


@each_dimension
def test_derivative_of_an_isotropic_function_is_right_away_from_equal_values(d: int) -> None:
    e = np.random.default_rng(1).normal(size=(4 if d == 2 else 6, N))
    direction = np.random.default_rng(2).normal(size=e.shape)

    def function(e: jax.Array) -> jax.Array:
        values, axes = eigen(e)
        return compose(axes, jnp.sin(values))

    with jax.enable_x64(True):
        run = jax.jit(function)
        _, slope = jax.jit(lambda e, t: jax.jvp(function, (e,), (t,)))(jnp.asarray(e), jnp.asarray(direction))
        difference = (run(e + 1e-6 * direction) - run(e - 1e-6 * direction)) / 2e-6
    np.testing.assert_allclose(np.asarray(slope), np.asarray(difference), rtol=0, atol=SLOPE * np.abs(slope).max())


@each_dimension
def test_rows_are_the_matrix(d: int) -> None:
    e = np.arange(1.0, 5.0 if d == 2 else 7.0)[:, None]
    matrix = np.array(matrix_rows(e))[..., 0]
    np.testing.assert_array_equal(matrix, tensors(e)[0][:d, :d])
