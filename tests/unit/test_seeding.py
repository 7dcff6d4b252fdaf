"""Filled shapes: what they weigh, where their grains are, and what the seed decides."""

from functools import partial

import jax
import numpy as np
import pytest

from mpm_env.mpm.seeding import JITTER, Fill, Relief, fill_ball, fill_box, fill_cylinder, relief_height, scatter

TARGETS = (0.013, 0.02, 0.037)  # m, spacings that fit no side exactly
EXACT = 1e-12  # float64 sums
FLOAT32 = 1e-6  # m; digits of a metre
THICKNESS = 0.25  # m, of the plane strain slice
ROUGH = 0.02  # of a relief's height and of the volume under it: eight waves, 10 and 40 seeds; 2e-3 observed

each_target = pytest.mark.parametrize("target", TARGETS)
each_dimension = pytest.mark.parametrize("d", [2, 3])


def unlike(d: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners (d,) m of a box of unlike sides."""
    return np.array([-0.3, 0.1, 0.05])[:d], np.array([0.11, 0.42, 0.17])[:d]


def box(d: int, target: float) -> Fill:
    lower, upper = unlike(d)
    return fill_box(lower, upper, target=target, thickness=THICKNESS if d == 2 else 1.0, velocity=(0.0,) * d)


def shapes(d: int, target: float) -> dict[str, tuple[Fill, float]]:
    """Every shape with its exact volume in m^3."""
    thickness = THICKNESS if d == 2 else 1.0
    lower, upper = unlike(d)
    common = {"target": target, "thickness": thickness, "velocity": (0.0,) * d}
    ball, cylinder = 4 / 3 * np.pi * 0.1**3, np.pi * 0.1**2 * 0.3
    if d == 2:
        ball, cylinder = np.pi * 0.1**2 * thickness, 0.2 * 0.3 * thickness
    return {
        "box": (box(d, target), float(np.prod(upper - lower)) * thickness),
        "ball": (fill_ball(np.full(d, 0.2), 0.1, **common), ball),
        "cylinder": (fill_cylinder(np.full(d, 0.2), 0.1, 0.3, **common), cylinder),
    }


@each_dimension
@each_target
@pytest.mark.parametrize("shape", ["box", "ball", "cylinder"])
def test_shape_weighs_the_same_whatever_the_number_of_grains(shape: str, d: int, target: float) -> None:
    fill, volume = shapes(d, target)[shape]
    assert len(fill.sites) > 1
    np.testing.assert_allclose(len(fill.sites) * fill.volume, volume, rtol=EXACT)


@each_dimension
@pytest.mark.parametrize("shape", ["box", "ball", "cylinder"])
def test_finer_target_gives_more_grains_about_that_far_apart(shape: str, d: int) -> None:
    counts = [len(shapes(d, t)[shape][0].sites) for t in TARGETS]
    assert counts[0] > counts[1] > counts[2]
    for t in TARGETS:
        assert np.all(np.abs(shapes(d, t)[shape][0].spacing / t - 1) <= 0.5)


@each_dimension
@each_target
def test_grains_stay_inside_and_each_in_its_own_place(d: int, target: float) -> None:
    fill = box(d, target)
    x, filled = scatter(fill, jax.random.key(0), np.dtype("float32"))
    assert x.shape == fill.sites.T.shape and bool(filled.all())
    lower, upper = unlike(d)
    moved = np.asarray(x, np.float64).T - fill.sites
    assert np.all(np.abs(moved) <= JITTER * fill.spacing + FLOAT32)
    beyond = np.maximum(lower - np.asarray(x).T, np.asarray(x).T - upper)
    assert beyond.max() <= FLOAT32
    # The jitter is all used, each way: a lattice that stayed crystal would pass the lines above.
    for sign in (-1, 1):
        assert (sign * moved / fill.spacing).max() > 0.8 * JITTER


def test_balls_and_cylinders_are_round() -> None:
    for name, height in (("ball", None), ("cylinder", 0.3)):
        fill, _ = shapes(3, 0.013)[name]
        off = fill.sites - 0.2
        radius = np.linalg.norm(off if height is None else off[:, :2], axis=1)
        assert 0.09 < radius.max() <= 0.1
        if height is not None:
            assert off[:, 2].min() > 0 and off[:, 2].max() < height


def test_box_thinner_than_the_spacing_still_holds_a_layer() -> None:
    lower, upper = np.zeros(3), np.array([0.2, 0.2, 0.001])
    fill = fill_box(lower, upper, target=0.02, thickness=1.0, velocity=(0.0,) * 3)
    assert np.all(fill.sites[:, 2] == 0.0005)
    np.testing.assert_allclose(len(fill.sites) * fill.volume, 0.2 * 0.2 * 0.001, rtol=EXACT)


def test_seed_decides_and_decides_alone() -> None:
    fill = box(3, 0.037)
    first, again, other = (np.asarray(scatter(fill, jax.random.key(k), np.dtype("float32"))[0]) for k in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0


@each_dimension
def test_relief_has_its_height_and_stays_in_its_bounds(d: int) -> None:
    relief = Relief(height=0.02, wavelength=0.1)
    x = np.random.default_rng(0).uniform(0, 5, (d - 1, 2000)).astype("float32")
    draw = jax.jit(partial(relief_height, relief))
    heights = np.stack([np.asarray(draw(x, jax.random.key(k))) for k in range(40)])
    np.testing.assert_allclose(heights.std(), relief.height, rtol=ROUGH)
    assert abs(heights.mean()) < ROUGH * relief.height
    assert np.abs(heights).max() <= 3 * relief.height * (1 + FLOAT32)


def test_relief_has_no_wave_shorter_than_its_wavelength() -> None:
    relief, step = Relief(height=0.02, wavelength=0.1), 0.005
    x = (np.arange(4096) * step).astype("float32")[None]
    power = np.zeros(2049)
    for k in range(10):
        h = np.asarray(relief_height(relief, x, jax.random.key(k)), np.float64) * np.hanning(4096)
        power += np.abs(np.fft.rfft(h)) ** 2
    short = np.fft.rfftfreq(4096, step) > 1.05 / relief.wavelength
    assert power[short].sum() < 0.01 * power.sum()


@each_dimension
def test_uneven_top_holds_the_volume_below_its_mean(d: int) -> None:
    lower, upper = np.zeros(d), np.array([1.0, 0.5, 0.3])[-d:]
    relief = Relief(height=0.02, wavelength=0.1)
    fill = fill_box(lower, upper, target=0.02, thickness=1.0, velocity=(0.0,) * d, relief=relief)
    draw = jax.jit(lambda key: scatter(fill, key, np.dtype("float32")))
    volumes = []
    for k in range(10):
        x, filled = draw(jax.random.key(k))
        volumes.append(float(np.sum(np.asarray(filled))) * fill.volume)
        assert np.asarray(x)[-1, np.asarray(filled)].max() <= upper[-1] + 3 * relief.height + fill.spacing[-1]
    np.testing.assert_allclose(np.mean(volumes), np.prod(upper), rtol=ROUGH)
    assert np.std(volumes) > 0
