"""Pictures: bodies where geometry says, grains in front and behind, the same bytes twice, no GL anywhere."""

import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from mpm_env.render import Camera, _rays, camera_for, render, save_png, save_video
from mpm_env.render_light import SUN
from mpm_env.render_surface import FAR, see_bodies

WIDTH, HEIGHT = 96, 64
FLOAT32 = 1e-5  # m at a distance of a few metres: distances are kept in float32
SPHERE = 0.3  # m
FRONT = Camera(eye=(0, -2, 0.2), target=(0, 0, 0.2), fov_deg=40)
RED, GREEN = "1 0 0 1", "0 1 0 1"


def scene(geoms: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def draw(model=None, data=None, camera=FRONT, **options) -> np.ndarray:
    return render(model, data, camera, **{"width": WIDTH, "height": HEIGHT, **options})


def middle(picture: np.ndarray) -> np.ndarray:
    return picture[HEIGHT // 2, WIDTH // 2].astype(int)


def heap(n: int = 3000) -> np.ndarray:
    rng = np.random.default_rng(0)
    radius, turn = 0.3 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    height = rng.random(n) * (0.3 - radius) * 0.6
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], 1).astype(np.float32)


def test_a_sphere_is_as_far_as_geometry_says():
    rays = _rays(FRONT, HEIGHT, WIDTH)
    seen = see_bodies(*scene(f'<geom size="{SPHERE}" pos="0.1 0 0.3"/>'), rays, None)
    centre = np.array([0.1, 0, 0.3]) - FRONT.eye
    along = rays.direction.astype(float) @ centre
    inside = along**2 - centre @ centre + SPHERE**2
    clear = np.abs(inside) > 1e-3  # rays that only graze may round either way
    np.testing.assert_array_equal((seen.distance < FAR)[clear], (inside > 0)[clear])
    hit = (inside > 0) & clear
    assert hit.sum() > 100
    np.testing.assert_allclose(seen.distance[hit], along[hit] - np.sqrt(inside[hit]), atol=FLOAT32)
    outward = (rays.direction[hit] * seen.distance[hit, None] - centre) / SPHERE
    np.testing.assert_allclose(seen.normal[hit], outward, atol=FLOAT32 / SPHERE * 2)


def test_the_model_s_plane_and_ground_z_are_as_far_as_geometry_says():
    rays = _rays(FRONT, HEIGHT, WIDTH)
    plane = see_bodies(*scene('<geom type="plane" size="0 0 1"/>'), rays, None).distance
    ground = see_bodies(None, None, rays, 0.0).distance
    near = rays.direction[:, 2] < -0.05  # below the horizon
    expected = -FRONT.eye[2] / rays.direction[near, 2].astype(float)
    np.testing.assert_allclose(plane[near], expected, rtol=FLOAT32)
    np.testing.assert_allclose(ground[near], expected, rtol=FLOAT32)


def test_a_sphere_fills_the_pixels_it_should():
    picture = draw(*scene(f'<geom size="{SPHERE}" pos="0 0 0.2" rgba="{RED}"/>')).astype(int)
    red = picture[..., 0] > picture[..., 2] + 20
    focal = HEIGHT / 2 / np.tan(np.radians(FRONT.fov_deg / 2))
    across = 2 * focal * np.tan(np.arcsin(SPHERE / 2))
    assert abs(red[HEIGHT // 2].sum() - across) <= 1
    assert abs(red[:, WIDTH // 2].sum() - across) <= 1


@pytest.mark.parametrize("grain_radius", [0.001, 0.02, 0.2])  # below a pixel, pixels, a large part of the picture
def test_a_grain_before_a_body_is_seen_and_one_behind_is_hidden(grain_radius):
    model, data = scene(f'<geom type="box" size=".3 .1 .3" pos="0 0 .2" rgba="{RED}"/>')
    blue = np.array([[0, 0, 255]], np.uint8)
    x = 0.5 * 2 / (HEIGHT / 2 / np.tan(np.radians(FRONT.fov_deg / 2)))  # half a pixel: the middle of a pixel
    before, behind = np.array([[[x, -0.6, 0.2 - x]], [[x, 0.6, 0.2 - x]]])
    r, _, b = middle(draw(model, data, grains=before, colors=blue, grain_radius=grain_radius))
    assert b > r + 50
    np.testing.assert_array_equal(
        draw(model, data, grains=behind, colors=blue, grain_radius=grain_radius)[HEIGHT // 2, WIDTH // 2],
        draw(model, data)[HEIGHT // 2, WIDTH // 2],
    )


def test_the_nearer_of_two_grains_is_seen_whatever_their_order():
    pair, colors = np.array([[0, -0.5, 0.2], [0, 0.5, 0.2]]), np.array([[255, 0, 0], [0, 0, 255]], np.uint8)
    one = draw(grains=pair, colors=colors, grain_radius=0.05)
    two = draw(grains=pair[::-1], colors=colors[::-1], grain_radius=0.05)
    np.testing.assert_array_equal(one, two)
    assert middle(one)[0] > middle(one)[2] + 50


def test_the_same_call_gives_the_same_bytes_and_leaves_its_arguments():
    model, data = scene('<geom type="plane" size="0 0 1"/><geom size=".1" pos="0 -.4 .2" rgba="1 1 1 .3"/>')
    grains, group = heap(), model.geom_group.copy()
    kept = grains.copy()
    first, second = (draw(model, data, grains=grains, grain_radius=0.01) for _ in range(2))
    assert first.tobytes() == second.tobytes()
    np.testing.assert_array_equal(grains, kept)
    np.testing.assert_array_equal(model.geom_group, group)


def test_glass_is_seen_through_and_alpha_zero_and_high_groups_are_not_seen():
    ball = f'<geom size=".2" pos="0 .5 .2" rgba="{GREEN}"/>'
    pane = '<geom type="box" size=".5 .01 .5" pos="0 -.5 .2" rgba="1 0 0 {}" group="{}"/>'
    bare, glass = middle(draw(*scene(ball))), middle(draw(*scene(ball + pane.format(0.3, 0))))
    assert glass[0] > bare[0] + 30 and bare[1] * 0.5 < glass[1] < bare[1]
    for alpha, group in ((0, 0), (1, 3), (0.3, 3)):
        np.testing.assert_array_equal(draw(*scene(ball + pane.format(alpha, group))), draw(*scene(ball)))


def test_grains_and_bodies_cast_a_shadow_on_the_ground():
    above = Camera(eye=(0, 0, 3), target=(0, 0, 0), up=(0, 1, 0))
    foot = np.array([[0.0, 0.0, 0.5]]) - SUN * 0.5 / SUN[2]  # where the sun throws (0, 0, 0.5)
    focal = HEIGHT / 2 / np.tan(np.radians(above.fov_deg / 2))
    column, row = int(WIDTH / 2 + focal * foot[0, 0] / 3), int(HEIGHT / 2 - focal * foot[0, 1] / 3)
    ground = '<geom type="plane" size="0 0 1" rgba=".5 .5 .5 1"/>'
    lit = draw(*scene(ground), camera=above)[row, column].astype(int)
    body = draw(*scene(ground + '<geom size=".15" pos="0 0 .5"/>'), camera=above)[row, column]
    cloud = np.random.default_rng(0).uniform((-0.15, -0.15, 0.35), (0.15, 0.15, 0.65), (4000, 3))
    grains = draw(*scene(ground), camera=above, grains=cloud, grain_radius=0.01)[row, column]
    assert (body < 0.8 * lit).all() and (grains < 0.8 * lit).all()


@pytest.mark.parametrize("lower, upper", [((-1, -2, 0), (1, 2, 0.5)), ((0, 0, 0), (0.1, 0, 0.3))])
def test_camera_for_holds_the_box_and_is_not_far_from_it(lower, upper):
    camera = camera_for(lower, upper)
    rays = _rays(camera, HEIGHT, WIDTH)
    corners = np.stack(np.meshgrid(*np.stack([lower, upper], 1)), -1).reshape(-1, 3) - camera.eye
    x = corners @ rays.basis.T
    reach = np.abs(x[:, :2] * rays.focal / x[:, 2:]) / [WIDTH / 2, HEIGHT / 2]
    assert 0.85 < reach.max() < 1


def test_samples_smooth_and_keep_the_size():
    model, data = scene(f'<geom size="{SPHERE}" pos="0 0 .2"/>')
    assert draw(model, data, samples=3).shape == (HEIGHT, WIDTH, 3)
    assert len(np.unique(draw(model, data, samples=3))) > len(np.unique(draw(model, data)))


@pytest.mark.parametrize(
    "grains",
    [np.zeros((0, 3)), np.full((5, 3), np.nan), [[0, 0, 0], [np.inf, 0, 0]], [[0, -2, 0.2]], [[1e30, 0, 0]]],
    ids=["none", "nan", "infinite", "in the eye", "very far"],
)
def test_sick_grains_are_drawn_without_a_warning(grains):
    assert draw(grains=np.array(grains), ground_z=0.0).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize(
    "options, sentence",
    [
        ({"grains": np.zeros((4, 2))}, r"grains have shape \(4, 2\): give \(n, 3\)"),
        ({"grains": np.zeros((4, 3)), "colors": np.zeros((3, 3), np.uint8)}, r"give uint8 \(4, 3\)"),
        ({"grains": np.zeros((4, 3)), "colors": np.zeros((4, 3))}, "colors are float64"),
        ({"grains": np.zeros((4, 3)), "grain_radius": 0.0}, r"grain_radius = 0.0 m is no size"),
        ({"width": 0}, "picture of 0 x 64"),
        ({"samples": 0}, "samples = 0"),
    ],
)
def test_what_does_not_fit_is_refused(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        draw(**options)


def test_a_model_without_its_data_is_refused():
    with pytest.raises(ValueError, match="only one of model and data"):
        draw(scene("")[0])


@pytest.mark.parametrize(
    "fields, sentence",
    [
        ({"eye": (0, 1)}, "camera eye"),
        ({"target": (0, np.nan, 0)}, "camera target"),
        ({"fov_deg": 180}, "fov_deg = 180"),
        ({"eye": (0, 0, 1)}, "looks along up"),
        ({"eye": (0, 0, 0)}, "looks along up"),
    ],
)
def test_a_camera_that_cannot_see_is_refused(fields, sentence):
    with pytest.raises(ValueError, match=sentence):
        Camera(**{"eye": (1, 0, 0), "target": (0, 0, 0), **fields})


@pytest.mark.parametrize("lower, upper", [((0, 0, 0), (0, 0, 0)), ((0, 0, 1), (1, 1, 0)), ((0, 0), (1, 1))])
def test_a_box_that_is_none_is_refused(lower, upper):
    with pytest.raises(ValueError, match="is no box"):
        camera_for(lower, upper)


def test_a_png_comes_back_as_it_was(tmp_path):
    picture = draw(ground_z=0.0)
    save_png(tmp_path / "picture.png", picture)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "picture.png")), picture)
    with pytest.raises(ValueError, match="picture is float64"):
        save_png(tmp_path / "picture.png", picture / 255)


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_a_video_keeps_its_frames_and_its_time(tmp_path, suffix):
    frames = [draw(grains=heap() + np.array([0.05 * k, 0, 0]), ground_z=0.0, grain_radius=0.01) for k in range(6)]
    save_video(tmp_path / f"film{suffix}", frames, fps=30)
    with Image.open(tmp_path / f"film{suffix}") as film:
        assert film.n_frames == len(frames)
        time = 0
        for k, frame in enumerate(frames):
            film.seek(k)
            film.load()
            time += film.info["duration"]
            # grey levels of 255: lost colours stay below, a wrong frame does not
            assert np.abs(np.asarray(film.convert("RGB")).astype(int) - frame).mean() < 8
    assert time == 200  # 6 frames at 30 per s, though neither format can keep 33.3 ms


@pytest.mark.parametrize(
    "name, frames, fps, sentence",
    [
        ("a.mp4", [np.zeros((4, 4, 3), np.uint8)], 25, r"ends in '.mp4': use one of .webp, .gif"),
        ("a.gif", [], 25, "got 0 frames"),
        ("a.gif", [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5, 3), np.uint8)], 25, "all of one size"),
        ("a.gif", [np.zeros((4, 4), np.uint8)], 25, r"picture is uint8 \(4, 4\)"),
        ("a.webp", [np.zeros((4, 4, 3), np.uint8)], 0, "fps = 0 is outside"),
    ],
)
def test_a_video_that_cannot_be_is_refused(tmp_path, name, frames, fps, sentence):
    with pytest.raises(ValueError, match=sentence):
        save_video(tmp_path / name, frames, fps)


def test_no_gl_is_touched():
    """MuJoCo's own switch keeps every GL binding out of the process; the picture must not notice."""
    program = """
import sys, mujoco, numpy
from mpm_env.render import camera_for, render
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.2'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
camera = camera_for((-1, -1, 0), (1, 1, 1))
picture = render(model, data, camera, grains=numpy.zeros((1, 3)), width=30, height=20)
assert len(numpy.unique(picture)) > 5
print([name for name in sys.modules if name.split(".")[0] in ("OpenGL", "glfw")])
"""
    root = Path(__file__).parents[2]
    bare = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "PYOPENGL_PLATFORM")}
    bare |= {"MUJOCO_GL": "disabled", "PYTHONPATH": str(root), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", program], env=bare, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
