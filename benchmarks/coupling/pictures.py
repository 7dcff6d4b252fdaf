"""Pictures of bodies in beds for docs/coupling, and recordings of the runs they are taken from.

    python -m benchmarks.coupling.pictures [--quick] [--out coupling_out] [PICTURE ...]

A recording is one of mpm-env's own: `mpm-env replay FILE.rrd --view` or Rerun opens it. That of the bucket can be
simulated again as well; the others begin with a state that was prepared, which their file does not tell.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from benchmarks import machine, results
from benchmarks.coupling import blade, tell_apart
from benchmarks.coupling.beds import lighter, started
from benchmarks.coupling.drop import DX, RATIOS, drop, settled_below
from benchmarks.coupling.report import brief
from benchmarks.coupling.scenes import Steps, ride, run
from benchmarks.coupling.slices import LARGE, Panel, Window, draw, letters
from mpm_env import Scene, State, build, load_fidelity, read_scene
from mpm_env.log import Recorder
from mpm_env.plot import INK, Series, plot
from mpm_env.render import Camera
from mpm_env.run import recipe
from mpm_env.view import View, camera_of, no_reactions, write_frame

DOCS = machine.ROOT / "docs" / "coupling"
EVERY = 5  # rigid steps in a frame: 50 frames a second
WAY = 0.15  # m, of the blades
FRONT = Camera((1.22, -0.56, 0.72), (0.4, 0.1, 0.19), 34.0)  # looks at the face that pushes
CAPTION = 30  # pixels under a picture
COLOURS = 128  # of a picture in space: few enough for a small file


class Film(NamedTuple):
    """Frames of a run: the first state, and what follows each call of a program."""

    views: list[View]
    look: Callable[[State, Steps], None]


@contextmanager
def filmed(
    path: Path, scene: Scene, state: State, about: str, *, every: int = EVERY, prepared: bool = True
) -> Iterator[Film]:
    """Views of a run that starts here, each also written into a recording while bodies have a place."""
    told = recipe(scene, seed=0, steps_per_frame=every) | {"scene": about}
    box, camera, views = scene.config.box, camera_of(scene), [View.of(scene, state)]
    with Recorder(
        path,
        recipe=told | {"kind": "prepared"} if prepared else told,
        model=scene.bodies.model,
        box=(box.lower, box.upper),
        view=None if scene.dimension == 2 else (camera.eye, camera.target),
    ) as recorder:

        def frame(view: View, step: int, reactions: np.ndarray) -> None:
            if np.isfinite(view.poses).all() and np.isfinite(reactions).all():
                write_frame(recorder, view, step=step, reactions=reactions, quantity="speed", scalars={})

        def look(state: State, steps: Steps) -> None:
            views.append(View.of(scene, state))
            frame(views[-1], int(state.steps), steps.reaction)

        frame(views[0], 0, no_reactions(scene))
        yield Film(views, look)


def boxes(out: Path, quick: bool) -> dict[str, str]:
    """Boxes of all densities after their fall, on layers of sand."""
    scene, panels = drop(2, DX).scene(), []
    for ratio in RATIOS[:: 4 if quick else 1]:
        state = settled_below(drop(2, DX), ratio)
        with filmed(out / f"drop_{ratio:g}.rrd", scene, state, f"box {ratio:g} times as dense as sand") as film:
            run(scene, state, 50 if quick else 300, rows=EVERY, look=film.look)
        first, last = film.views[0], film.views[-1]
        height = np.full(scene.slots, np.nan)
        height[first.slots] = first.grains[:, 2]
        fell = 100 * (first.poses[-1, 2] - last.poses[-1, 2])
        panels.append(
            Panel(f"density ratio {ratio:g}", last, height[last.slots], f"{fell:.1f} cm down after {last.time:g} s")
        )
    window = Window((0.15, 0.65), (0.0, 0.36), 420)
    draw(DOCS / "drop.png", panels, window, (0.0, 0.2), "height of the grains before the fall, m")
    return {"drop": f"Boxes dropped from 5 cm, {last.time:g} s later, on layers of sand: from light to heavy."}


def buried(out: Path, quick: bool) -> dict[str, str]:
    """A light box buried in sand, by our scheme and by the negative controls; and how fast it moves."""
    base, when = tell_apart.buried().scene(), 0.1
    ratio, window = tell_apart.SCENES["buried"][1], Window((0.0, 0.6), (0.0, 0.4), 500)
    state, panels, series = lighter(started(base), ratio), [], []
    names = {
        "together": "solved together",
        "explicit": "explicit, each substep",
        "staggered": "staggered, each rigid step",
    }
    for name in list(names)[: 1 if quick else 3]:
        scheme = tell_apart.CONTROLS.get(name)
        scene = base if scheme is None else replace(base, kernels="xla")
        about = f"buried box {ratio:g} times as dense as sand, {names[name]}"
        with (
            tell_apart.control(scheme) if scheme else nullcontext(),
            filmed(out / f"buried_{name}.rrd", scene, state, about, every=1) as film,
        ):
            _, steps = run(scene, state, 50, rows=1, look=film.look)
        speed = np.linalg.norm(np.nan_to_num(steps.qvel[:, :3], posinf=0, neginf=0), axis=1)
        time = scene.rigid_dt * (1 + np.arange(len(speed)))
        series.append(Series(names[name], time[speed > 0], speed[speed > 0], joined=True))
        at = film.views[round(when / scene.rigid_dt)]
        gone = "" if 0 < at.poses[-1, 2] < window.z[1] else ", out of sight"
        panels.append(
            Panel(names[name], at, at.speed, f"after {at.time:g} s; box: up to {brief(speed[:25].max())} m/s{gone}")
        )
    draw(DOCS / "buried.png", panels, window, (0.0, 0.5), "speed of the grains, m/s")
    plot(
        DOCS / "buried_speed.png",
        f"A buried box {ratio:g} times as dense as sand",
        "time, s",
        "speed of the box, m/s",
        series,
        log=True,
        names="middle",
    )
    what = f"box {ratio:g} times as dense as sand, buried flush"
    return {
        "buried": f"A {what}, after {when:g} s: by our exchange, and by the negative controls.",
        "buried_speed": f"The speed of a {what}, by our exchange, and by the negative controls.",
    }


def blades(out: Path, quick: bool) -> dict[str, str]:
    """A blade of half a cell in its bed, and one of a fine grid; and a turned one in space."""
    panels = []
    jobs = (("a blade of half a cell", 0.5 * blade.DX, blade.DX), ("a fine grid: four cells", 0.025, blade.DX / 2))
    for k, (title, thick, dx) in enumerate(jobs[: 1 if quick else 2]):
        some, pose = blade.bed(thick, dx), blade.pose_of(blade.bed(thick, dx), 0.0, 0.0)
        state = blade.ready(some, thick, pose)
        with filmed(out / f"blade_{k}.rrd", some.scene(), state, title) as film:
            done = ride(some.scene(), state, blade.way(some, WAY), pose, rows=EVERY, look=film.look)
        at = film.views[-1]
        note = f"{1000 * thick:g} mm thick, cells of {1000 * dx:g} mm, after {100 * done.travel[-1]:.0f} cm at 0.3 m/s"
        panels.append(Panel(title, at, at.speed, note))
    draw(DOCS / "blade.png", panels, Window((0.0, 0.8), (0.0, 0.36), 800), (0.0, 0.3), "speed of the grains, m/s", 1)
    return {"blade": "A blade of half a cell on its way through a bed, above one that a fine grid resolves."}


def turned(out: Path, quick: bool) -> dict[str, str]:
    """A blade in space, turned by 20 degrees."""
    thick, dx = blade.YAW_THICK * blade.DX, 2 * blade.DX if quick else blade.DX
    some = blade.bed(thick, dx, 3)
    pose = blade.pose_of(some, 0.0, 20.0)
    state = blade.ready(some, thick, pose)
    with filmed(out / "blade_turned.rrd", some.scene(), state, "a blade turned by 20 degrees") as film:
        done = ride(some.scene(), state, blade.way(some, WAY), pose, rows=EVERY, look=film.look)
    words = ["at the start", f"after {100 * done.travel[-1]:.0f} cm"]
    strip(DOCS / "blade_turned.png", [film.views[0], film.views[-1]], words, camera=FRONT)
    return {"blade_turned": "A blade of half a cell, turned by 20 degrees, before and on its way through a bed."}


def bucket(out: Path, quick: bool) -> dict[str, str]:
    """The mesh bucket digs, scoops and lifts."""
    scene = build(read_scene("bucket_scoop"), load_fidelity("draft" if quick else "fast"))
    state, every = started(scene), round(0.04 / scene.rigid_dt)
    with filmed(out / "bucket.rrd", scene, state, scene.config.name, every=every, prepared=False) as film:
        run(scene, state, round(scene.config.duration / scene.rigid_dt), rows=every, look=film.look)
    times = (0.6, 1.2, 1.6, 2.0)
    shown = [film.views[round(t / 0.04)] for t in times]
    what = ("going in", "driven ahead", "curled up", "lifted")
    strip(DOCS / "bucket.png", shown, [f"{t:g} s: {word}" for t, word in zip(times, what, strict=True)])
    return {"bucket": "A bucket, a concave mesh, digs and lifts sand (`examples/a3_mesh_bucket.py`)."}


def strip(
    path: Path, views: Sequence[View], captions: Sequence[str], columns: int = 2, *, camera: Camera | None = None
) -> None:
    """Pictures in space with a caption under each, by the scene's own camera or another."""
    w, h = 480, 320
    rows = -(-len(views) // columns)
    sheet = Image.new("RGB", (columns * w + 8 * (columns - 1), rows * (h + CAPTION)), "white")
    pen = ImageDraw.Draw(sheet)
    for k, (view, caption) in enumerate(zip(views, captions, strict=True)):
        x, y = (k % columns) * (w + 8), (k // columns) * (h + CAPTION)
        sheet.paste(Image.fromarray(view.picture(width=w, height=h, samples=2, camera=camera)), (x, y))
        pen.text((x + w / 2, y + h + 7), caption, fill=INK, font=letters(LARGE), anchor="mt")
    sheet.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


PICTURES: dict[str, Callable[[Path, bool], dict[str, str]]] = {  # each gives what its files show
    "boxes": boxes,
    "buried": buried,
    "blades": blades,
    "turned": turned,
    "bucket": bucket,
}


def main() -> None:
    """Take the pictures asked for."""
    parser = argparse.ArgumentParser(description="Pictures of bodies in beds, and recordings of their runs.")
    parser.add_argument("pictures", nargs="*", metavar="PICTURE", help=f"{', '.join(PICTURES)}; default: all")
    parser.add_argument("--quick", action="store_true", help="fewer and coarser runs: to see that it works")
    parser.add_argument("--out", default="coupling_out", type=Path, metavar="FOLDER", help="where recordings go")
    a = parser.parse_args()
    if unknown := set(a.pictures) - set(PICTURES):
        parser.error(f"there is no picture {', '.join(sorted(unknown))}: use {', '.join(PICTURES)}")
    for folder in (a.out, DOCS):
        folder.mkdir(parents=True, exist_ok=True)
    shown = (results.read("coupling_pictures") or {}).get("pictures", {})
    for name in a.pictures or PICTURES:
        shown |= PICTURES[name](a.out, a.quick)
        print(f"{name}: taken", flush=True)
    results.write("coupling_pictures", {"quick": a.quick, "pictures": shown})


if __name__ == "__main__":
    main()
