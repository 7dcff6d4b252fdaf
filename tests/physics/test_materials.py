"""What every constitutive model keeps: run over the table, in plane strain and 3-D, in both precisions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from benchmarks.validation.blocks import PARAMETERS, PATIENCE, example, update
from mpm_env.mpm.materials import MATERIALS, Material
from tests.physics.oracles import ORACLES, rotations, rows, tensors, turned

N = 256  # grains side by side: one shape, one program per material, dimension and precision
STRETCH = 0.06  # spread of the principal log strains: elastic, yielding and torn grains all occur
# Range of the history.
REMEMBERED = {
    "elastic": None,
    "sand": (0.0, 0.03),
    "snow": (-0.2, 0.05),
    "von_mises": (0.0, 0.1),
    "herschel_bulkley": None,
    "mu_i": (0.0, 0.03),
    "cam_clay": (-0.1, 0.0),
}
LAGS = {"cam_clay"}  # what the answer obeys is the strength of before the step

# Of the modulus times a strain of STRETCH. float32: the digits of 1 + e, 6e-8, times the hardening where there is one.
STRESS = {"float32": 4e-5, "float64": 1.5e-12}  # 8e-6, 3e-13 observed, both of snow packed to a factor 10
STRAIN = {"float32": 1e-6, "float64": 5e-14}  # of b; 2e-7, 1e-14 observed
HISTORY = {"float32": 1e-6, "float64": 1e-14}  # 1e-7, 2e-15 observed
SLOPE = 1e-13  # of the stress; exact differentiation in float64, 2e-14 observed

each_material = pytest.mark.parametrize("name", MATERIALS)
each_dimension = pytest.mark.parametrize("d", [2, 3])
each_precision = pytest.mark.parametrize("dtype", ["float32", "float64"])


@jax.jit
def energy(material: Material, e: Array, history: Array) -> Array:
    return material.energy(e, history)


def modulus(name: str) -> float:
    """Stress in Pa of the strain STRETCH."""
    return PARAMETERS[name]["E"] * STRETCH


def trials(name: str, d: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random trial gradients F (N, 3, 3) and histories (k, N)."""
    rng = np.random.default_rng(seed)
    eps = rng.normal(0, STRETCH, (N, 3)) - rng.uniform(0, STRETCH, (N, 1))
    R, Q = rotations(N, d, rng), rotations(N, d, rng)
    F = np.einsum("nik,nk,njk->nij", R, np.exp(eps), Q)
    between = REMEMBERED[name]
    return F, np.zeros((0, N)) if between is None else rng.uniform(*between, (1, N))


def strain(F: np.ndarray, d: int) -> np.ndarray:
    """e = F F^T - I as rows (s, n), float64."""
    return rows(F @ np.swapaxes(F, 1, 2) - np.eye(3), d)


def answer(
    name: str, e: np.ndarray, history: np.ndarray, dtype: str, **changes: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The library's e, history, tau in float64 numbers, computed in dtype."""
    with jax.enable_x64(dtype == "float64"):
        out = update(example(name, dtype, **changes), jnp.asarray(e, dtype), jnp.asarray(history, dtype))
        assert all(a.dtype == dtype for a in out)
        return tuple(np.asarray(a, np.float64) for a in out)


def start(name: str) -> np.ndarray:
    return np.repeat(np.array(MATERIALS[name].history_start, np.float64)[:, None], N, axis=1)


def test_table_has_an_example_and_an_oracle_for_every_material() -> None:
    assert MATERIALS.keys() == PARAMETERS.keys() == ORACLES.keys() == REMEMBERED.keys()


@each_material
@each_dimension
@each_precision
def test_answer_is_the_float64_oracles(name: str, d: int, dtype: str) -> None:
    F, history = trials(name, d)
    with jax.enable_x64(True):
        truth = ORACLES[name](F, history, example(name, "float64"))
    e, remembered, tau = answer(name, strain(F, d), history, dtype)
    np.testing.assert_allclose(tensors(tau), truth.tau, rtol=0, atol=STRESS[dtype] * modulus(name))
    np.testing.assert_allclose(tensors(e) + np.eye(3), truth.b, rtol=0, atol=STRAIN[dtype])
    np.testing.assert_allclose(remembered, truth.history, rtol=0, atol=HISTORY[dtype])


@each_material
@each_dimension
def test_no_strain_is_no_stress(name: str, d: int) -> None:
    e, history, tau = answer(name, np.zeros((4 if d == 2 else 6, N)), start(name), "float32")
    np.testing.assert_array_equal(tau, 0)
    np.testing.assert_array_equal(e, 0)
    np.testing.assert_array_equal(history, start(name))


@each_material
@each_dimension
@each_precision
def test_projected_state_is_not_projected_again(name: str, d: int, dtype: str) -> None:
    F, history = trials(name, d)
    once = answer(name, strain(F, d), history, dtype)
    obeyed = history if name in LAGS else once[1]
    twice = answer(name, once[0], obeyed, dtype)
    np.testing.assert_allclose(twice[0], once[0], rtol=0, atol=STRAIN[dtype])
    np.testing.assert_allclose(twice[1], obeyed, rtol=0, atol=HISTORY[dtype])
    np.testing.assert_allclose(twice[2], once[2], rtol=0, atol=STRESS[dtype] * modulus(name))


@each_material
@each_dimension
@each_precision
def test_answer_lies_inside_what_the_material_bears(name: str, d: int, dtype: str) -> None:
    """Its strain, given to the oracle as a trial, is left as it is; the trial itself was not."""
    F, history = trials(name, d)
    e, remembered, tau = answer(name, strain(F, d), history, dtype)
    root = np.linalg.cholesky(tensors(e) + np.eye(3))
    with jax.enable_x64(True):
        again = ORACLES[name](root, history if name in LAGS else remembered, example(name, "float64"))
    np.testing.assert_allclose(again.b, tensors(e) + np.eye(3), rtol=0, atol=STRAIN[dtype])
    np.testing.assert_allclose(again.tau, tensors(tau), rtol=0, atol=STRESS[dtype] * modulus(name))
    assert again.excess.max() <= STRESS[dtype]
    if name != "elastic":
        assert np.abs(strain(F, d) - e).max() > 0.05


@each_material
@each_dimension
@each_precision
def test_turned_strain_gives_turned_answer(name: str, d: int, dtype: str) -> None:
    F, history = trials(name, d)
    Q = rotations(N, d, np.random.default_rng(1))
    e, remembered, tau = answer(name, strain(F, d), history, dtype)
    e_t, remembered_t, tau_t = answer(name, strain(Q @ F, d), history, dtype)
    np.testing.assert_allclose(tensors(e_t), turned(Q, tensors(e)), rtol=0, atol=STRAIN[dtype])
    np.testing.assert_allclose(tensors(tau_t), turned(Q, tensors(tau)), rtol=0, atol=STRESS[dtype] * modulus(name))
    np.testing.assert_allclose(remembered_t, remembered, rtol=0, atol=HISTORY[dtype])


def awkward(d: int) -> np.ndarray:
    """Trial strains (s, N): the identity, (nearly) repeated values, stretches 1e-3 to 1e3, lost definiteness."""
    rng = np.random.default_rng(2)
    s = np.ones((N, 3))
    s[8:16] = rng.uniform(0.5, 2, (8, 1))
    s[16:24, 1:] = rng.uniform(0.5, 2, (8, 1))
    s[24:32] = 1 + 1e-7 * rng.normal(size=(8, 3))
    s[32:64] = rng.choice([1e-3, 1e-3, 1.0, 1e3], (32, 3))
    s[64:] = 10.0 ** rng.uniform(-3, 3, (N - 64, 3))
    Q = rotations(N, d, rng)
    Q[::2] = np.eye(3)
    e = rows(turned(Q, np.einsum("ni,ij->nij", s**2, np.eye(3))) - np.eye(3), d)
    e[:3, 200:208] -= np.array([1e-6, 1e-3, 1, 2, 4, 10, 100, 1000])  # det F <= 0: b is no longer positive
    return e


@each_material
@each_dimension
@each_precision
def test_awkward_strains_give_numbers(name: str, d: int, dtype: str) -> None:
    for e in (awkward(d), np.zeros_like(awkward(d))):
        out = answer(name, e, start(name), dtype)
        assert all(np.isfinite(a).all() for a in out)
        # And go on giving them: the answer is a state to start from.
        assert all(np.isfinite(a).all() for a in answer(name, out[0], out[1], dtype))


@each_material
@each_dimension
def test_gradients_are_finite_everywhere(name: str, d: int) -> None:
    def work(material: Material, e: Array, history: Array, dt: Array) -> Array:
        e, history, tau = material.update(e, history, dt)
        return jnp.sum(tau) / material.E + jnp.sum(e) + jnp.sum(history)

    material = example(name)
    slope = jax.jit(jax.grad(work, argnums=(0, 1, 2, 3)))  # reverse mode: a fixed few seconds of compilation in 3-D
    near = strain(trials(name, d)[0], d)
    for e in (np.zeros_like(near), near, awkward(d)[:, :32].repeat(8, axis=1)):
        for dt in (0.0, 1e-4, PATIENCE):
            given = (jnp.asarray(a, "float32") for a in (e, start(name), dt))
            leaves = jax.tree_util.tree_leaves(slope(material, *given))
            assert all(np.isfinite(np.asarray(a)).all() for a in leaves)


@each_material
@each_dimension
def test_stress_is_the_slope_of_the_energy(name: str, d: int) -> None:
    """d Psi = tau : G for a small motion b -> (I + G) b (I + G)^T at fixed history, inside what the material bears."""
    F, history = trials(name, d)
    e, remembered, tau = answer(name, strain(F, d), history, "float64")
    rng = np.random.default_rng(3)
    G = rng.normal(size=(N, 3, 3))
    if d == 2:
        G[:, 2], G[:, :, 2] = 0, 0
    change = rows(G @ (tensors(e) + np.eye(3)), d) + rows(np.swapaxes(G @ (tensors(e) + np.eye(3)), 1, 2), d)
    with jax.enable_x64(True):
        material = example(name, "float64")
        _, slope = jax.jvp(
            lambda e: energy(material, e, jnp.asarray(remembered)), (jnp.asarray(e),), (jnp.asarray(change),)
        )
    expected = np.einsum("nij,nij->n", tensors(tau), G)
    np.testing.assert_allclose(np.asarray(slope), expected, rtol=0, atol=SLOPE * modulus(name))


@each_material
def test_wave_speed_is_the_p_waves(name: str) -> None:
    given = PARAMETERS[name]
    E, nu, rho = given["E"], given["nu"], given["rho"]
    M = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    hardest = np.exp(given["xi"] * (1 - given["Jp_min"])) if name == "snow" else 1.0
    np.testing.assert_allclose(float(example(name).wave_speed()), np.sqrt(M * hardest / rho), rtol=1e-6)
