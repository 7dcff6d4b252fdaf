"""The command line: mpm-env run, demo, replay, element, calibrate, list."""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from mpm_env.config import folder, known, read_yaml

DIFFERS, REFUSED, INTERRUPTED = 1, 2, 130  # exit statuses
FOR_FIDELITY = "fidelity."  # begins the settings that are not the scene's
KINDS = ("scenes", "tasks", "materials", "fidelities")
START = """\
first steps:
  mpm-env demo dig
  mpm-env run column_collapse_2d --fidelity draft --out out
  mpm-env run blade_push --set bodies.friction=0.2 --set fidelity.cells=5 --out out
  mpm-env replay out/run.rrd --view
  mpm-env element dry_sand --test triaxial --out out

exit status: 0 done, 1 a replay differs, a run broke down or a demo missed its goal, 2 refused, 130 interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the arguments ask; returns the exit status."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.command(options))
    except KeyboardInterrupt:
        print("mpm-env: interrupted.", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mpm-env",
        description="Sand and snow that bodies dig into and push, and that push back.",
        epilog=START,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add in COMMANDS:
        add(commands)
    return parser


def _add_run(commands: Any) -> None:
    run = commands.add_parser("run", help="simulate a scene into a folder of results", allow_abbrev=False)
    run.add_argument("scene", metavar="SCENE", help="a name that `mpm-env list` shows, or a .yaml file")
    run.add_argument("--fidelity", metavar="F", help="a name, or a .yaml file (default: the one that the scene names)")
    run.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help="change the scene, as in grains.0.material.E=1e6, or the fidelity, as in fidelity.cells=4; repeatable",
    )
    run.add_argument("--seed", type=int, default=0, metavar="N", help="places the grains (default 0)")
    run.add_argument("--fps", type=float, default=25.0, metavar="HZ", help="frames per simulated second (default 25)")
    run.add_argument(
        "--snapshots-fps", type=float, metavar="HZ", help="how often run.npz keeps all grains (default: start and end)"
    )
    run.add_argument(
        "--quantity", default="speed", metavar="Q", help="colours the recording: speed (default), height or material"
    )
    run.add_argument("--out", required=True, metavar="DIR", help="folder for run.rrd, run.npz, run.png, summary.json")
    run.set_defaults(command=_run)


def _run(options: argparse.Namespace) -> int:
    with refusing():
        from mpm_env.fidelity import Fidelity, load_fidelity
        from mpm_env.run import FILES, prepare
        from mpm_env.scene_config import read_scene

        astray = [s for s in options.settings if s.partition("=")[0] in Fidelity.model_fields.keys() - {"about"}]
        if astray:
            raise ValueError(f"{astray[0]} is a setting of the fidelity: write --set {FOR_FIDELITY}{astray[0]}.")
        ours = [s.removeprefix(FOR_FIDELITY) for s in options.settings if s.startswith(FOR_FIDELITY)]
        config = read_scene(options.scene, tuple(s for s in options.settings if not s.startswith(FOR_FIDELITY)))
        fidelity = load_fidelity(options.fidelity or config.fidelity, ours)
        use_precision(fidelity.precision)
        session = prepare(
            config,
            fidelity,
            options.out,
            seed=options.seed,
            fps=options.fps,
            snapshots_fps=options.snapshots_fps,
            quantity=options.quantity,
        )
    summary = session.go(progress=sys.stderr.isatty())
    for line in report(summary):
        print(line)
    print(f"{session.out}: {', '.join(FILES)}")
    return 0 if summary["ended"] == "complete" else DIFFERS


def report(summary: dict[str, Any]) -> Iterator[str]:
    """A run's summary in a few lines."""
    numerics, wall, figures = summary["numerics"], summary["wall_s"], summary["figures"]
    yield f"{summary['scene']}: {figures['simulated_s']:.6g} s simulated, {summary['ended']}"
    cell_mm, dt_ms = 1000 * numerics["cell_size_m"], 1000 * numerics["mpm_dt_s"]
    yield f"{numerics['grains']} grains, cells of {cell_mm:.4g} mm, substeps of {dt_ms:.3g} ms"
    yield f"kernels: {numerics['kernels']}"
    if figures["mass_start_kg"]:
        top = "" if figures["top_of_grains_m"] is None else f"; top at {figures['top_of_grains_m']:.4g} m"
        yield (
            f"mass {figures['mass_end_kg']:.6g} kg of {figures['mass_start_kg']:.6g} kg,"
            f" {figures['mass_left_kg']:.4g} kg left the box{top}"
        )
    for snow in figures["snow"]:
        if snow["J_P_least"] < snow["Jp_min"]:
            yield (
                f"snow was packed to J_P = {snow['J_P_least']:.3g}, below its Jp_min = {snow['Jp_min']:.3g}: its"
                " hardening stayed at its cap there"
            )
    for name, force in figures["forces_of_grains"].items():
        yield f"grains on {name}: at most {force['peak_N']:.4g} N, at {force['peak_at_s']:.4g} s"
    yield (
        f"{wall['total']:.1f} s of work: {wall['build']:.1f} build, {wall['compile']:.1f} compile,"
        f" {wall['run']:.1f} run, {wall['log']:.1f} log, {wall['picture']:.1f} picture"
    )
    for sentence in summary["health"]["sentences"]:
        yield f"warning: {sentence}"


def _add_replay(commands: Any) -> None:
    replay = commands.add_parser(
        "replay", help="simulate a recording again and compare, or view it", allow_abbrev=False
    )
    replay.add_argument("file", metavar="FILE.rrd", help="a recording of mpm-env")
    replay.add_argument("--view", action="store_true", help="only open it in the Rerun viewer: nothing is simulated")
    replay.set_defaults(command=_replay)


def _replay(options: argparse.Namespace) -> int:
    with refusing():
        from mpm_env.log import open_viewer, read

        if options.view:
            open_viewer(options.file)
            return 0
        recording = read(options.file)
        fidelity = recording.recipe.get("fidelity")
        use_precision(fidelity.get("precision", "f32") if isinstance(fidelity, dict) else "f32")
        from mpm_env.replay import compare

        found = compare(recording, progress=sys.stderr.isatty())
    for name, (then, now) in found.versions.items():
        print(f"{name} was {then} when recorded and is {now} now")
    if not recording.complete:
        print("the recording was cut short: its whole frames are compared")
    if found.identical:
        print(f"identical: grains and bodies are the same to the bit over {found.frames} frames")
        return 0
    print(f"different over {found.frames} frames")
    for what, unit, most in (
        ("grains", "m", found.grains),
        ("bodies", "(m, or entries of a rotation matrix)", found.bodies),
    ):
        place = f", that of {most.where}," if most.where else ""
        at = f"{place} at {most.time:.6g} s (step {most.step})" if most.size else ""
        print(f"{what}: the largest difference is {most.size:.3g} {unit}{at}")
    return DIFFERS


def _add_list(commands: Any) -> None:
    listing = commands.add_parser("list", help="scenes, tasks, materials and fidelities that can be named")
    listing.set_defaults(command=_list)


def _list(options: argparse.Namespace) -> int:
    for kind in KINDS:
        print(f"{kind}:")
        for name in known(kind):
            print(f"  {name:20} {read_yaml(folder() / kind / f'{name}.yaml').get('about', '')}")
    return 0


DEMOS = {"dig": "dig_sand", "push": "push_sand"}  # short names; any task may be named in full


def _add_demo(commands: Any) -> None:
    demo = commands.add_parser("demo", help="a scripted policy does a task", allow_abbrev=False)
    demo.add_argument("task", metavar="TASK", help="dig, push, dig_snow, push_snow, or a .yaml file")
    demo.add_argument("--fidelity", metavar="F", help="a name, or a .yaml file (default: the one that the task names)")
    demo.add_argument("--seed", type=int, default=0, metavar="N", help="shapes the bed (default 0)")
    demo.add_argument(
        "--out",
        default="demo_out",
        metavar="DIR",
        help="folder for demo.rrd, demo.webp, demo.png, summary.json (default demo_out)",
    )
    demo.set_defaults(command=_demo)


def _demo(options: argparse.Namespace) -> int:
    with refusing():
        from mpm_env.demo import FILES, prepare
        from mpm_env.fidelity import load_fidelity
        from mpm_env.tasks import read_task

        task = read_task(DEMOS.get(options.task, options.task))
        fidelity = load_fidelity(options.fidelity or task.scene.fidelity)
        use_precision(fidelity.precision)
        show = prepare(task, fidelity, options.out, seed=options.seed)
    summary = show.go(progress=sys.stderr.isatty())
    facts, wall = summary["facts"], summary["wall_s"]
    outcome = "reached" if summary["success"] else "NOT reached"
    print(f"{summary['task']}: goal of {summary['target_kg']:g} kg {outcome}, {summary['time_s']:g} s simulated")
    print(", ".join(f"{k.removesuffix('_kg')} {v:.3g} kg" for k, v in facts.items() if k.endswith("_kg")))
    largest = summary["force_largest_mean_of_an_action_N"]
    print(f"force on the tool: mean {summary['force_mean_N']:.3g} N, largest mean of an action {largest:.3g} N")
    print(f"{summary['grains']} grains; kernels: {summary['versions']['kernels']}")
    print(f"wall time {', '.join(f'{k} {v:.1f} s' for k, v in wall.items())}")
    for sentence in summary["health"]["sentences"]:
        print(f"warning: {sentence}")
    print(f"{options.out}: {', '.join(FILES)}")
    return 0 if summary["success"] else DIFFERS


def _add_element(commands: Any) -> None:
    element = commands.add_parser("element", help="a laboratory's test on a material, one grain", allow_abbrev=False)
    _add_material(element)
    element.add_argument("--test", required=True, metavar="T", help="triaxial, biaxial, oedometer or shear")
    _add_loading(element)
    element.add_argument("--out", metavar="DIR", help="folder for element.csv and element.png (default: none written)")
    element.set_defaults(command=_element)


def _add_material(command: Any) -> None:
    command.add_argument("material", metavar="MATERIAL", help="a name that `mpm-env list` shows, or a .yaml file")
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help="as friction_deg=30",
    )


def _add_loading(command: Any) -> None:
    command.add_argument("--pressure", type=float, default=1e4, metavar="PA", help="held stress (default 10 kPa)")
    command.add_argument("--strain", type=float, metavar="E", help="how far, negative: extension (default: the test's)")
    command.add_argument("--rate", type=float, default=1.0, metavar="1/S", help="for materials that mind (default 1)")
    command.add_argument("--steps", type=int, default=1000, metavar="N", help="of the loading (default 1000)")
    command.add_argument("--dimension", type=int, metavar="D", help="2 is plane strain (default: the test's)")


def _element(options: argparse.Namespace) -> int:
    with refusing():
        from mpm_env import laboratory

        loading = laboratory.loading(**{k: getattr(options, k) for k in laboratory.Loading._fields})
        done = laboratory.put_through(options.material, tuple(options.settings), loading, options.out)
    print(f"{options.material}: {loading.test} test, {done.about}")
    for name, value in done.figures.items():
        print(f"  {name:45} {value:.5g}")
    if options.out:
        print(f"{options.out}: {', '.join(laboratory.FILES)}")
    return 0


def _add_calibrate(commands: Any) -> None:
    calibrate = commands.add_parser("calibrate", help="parameters from measurements", allow_abbrev=False)
    _add_material(calibrate)
    what = calibrate.add_mutually_exclusive_group(required=True)
    what.add_argument("--curve", metavar="FILE.csv", help="columns strain and q_Pa, or sxx_Pa, sxy_Pa, ...")
    what.add_argument(
        "--column", nargs=3, type=float, metavar=("WIDTH", "HEIGHT", "RUNOUT"), help="m; of sand, in plane strain"
    )
    what.add_argument("--repose", type=float, metavar="ANGLE", help="degrees at which a bank of sand stays")
    calibrate.add_argument("--test", default="triaxial", metavar="T", help="that measured the curve (default triaxial)")
    calibrate.add_argument("--free", default="friction_deg", metavar="NAMES", help="to find (default friction_deg)")
    _add_loading(calibrate)
    calibrate.add_argument("--out", metavar="DIR", help="folder for fitted.yaml and fit.png of a curve")
    calibrate.set_defaults(command=_calibrate)


def _calibrate(options: argparse.Namespace) -> int:
    return _calibrate_curve(options) if options.curve else _calibrate_friction(options)


def _calibrate_friction(options: argparse.Namespace) -> int:
    with refusing():
        from mpm_env.calibrate_column import Column, fit_column
        from mpm_env.calibrate_repose import fit_repose
        from mpm_env.scene_config import read_material

        material = read_material(options.material, tuple(options.settings))
        if options.column:
            found = fit_column(material, Column(*options.column))
        else:
            found = fit_repose(material, options.repose)
    print(f"friction_deg    {found.friction_deg:.4g} +- {found.scatter_deg:.2g} (seeds of the grains)")
    print(f"finer cells would change it by {found.resolution_deg:+.2g}; {found.runs} runs")
    return 0


def _calibrate_curve(options: argparse.Namespace) -> int:
    with refusing():
        from mpm_env import calibrate, laboratory

        found = calibrate.go(
            options.material,
            tuple(options.settings),
            tuple(name.strip() for name in options.free.split(",")),
            options.curve,
            laboratory.Loading(**{k: getattr(options, k) for k in laboratory.Loading._fields}),
            options.out,
        )
    for name, value, error in zip(found.names, found.values, found.errors, strict=True):
        print(f"{name:15} {value:.6g} +- {error:.2g}" if error < float("inf") else f"{name:15} not told by this curve")
    for names in found.untold:
        alone = "" if len(names) > 1 else ": it changes nothing here"
        print(f"warning: this curve cannot tell {' from '.join(names)}{alone}")
    print(f"misfit {100 * found.misfit:.3g} % of {len(found.strain)} points")
    if options.out:
        print(f"{options.out}: {', '.join(calibrate.FILES)}")
    return 0


COMMANDS = (_add_run, _add_demo, _add_replay, _add_element, _add_calibrate, _add_list)


@contextlib.contextmanager
def refusing() -> Iterator[None]:
    """What is wrong in here is the user's to mend: one line, and exit status 2."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that it lacks a package we do not use
            import mujoco.mjx  # noqa: F401
        yield
    except (ValueError, TypeError, FileNotFoundError, RuntimeError) as error:
        print(f"mpm-env: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(REFUSED) from None


def use_precision(precision: str) -> None:
    """Turn 64-bit JAX on where it is asked for, before anything is built."""
    if precision == "f64":
        import jax

        jax.config.update("jax_enable_x64", True)


if __name__ == "__main__":
    sys.exit(main())
