"""The house rules that a parser can check: imports go one way down the floors, and a few habits of style."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
PACKAGES = ("coupling", "mpm_env")
LINES_AT_MOST = 400  # longer files are a sign of a missing noun

# A module stands on the floor of the longest name here that it belongs to: `mpm_env.tasks.dig` on that of
# `mpm_env.tasks`, and `mpm_env.log_replay` on that of `mpm_env.log`. The package's front door is above all.
FLOORS = {
    "coupling": 1,
    "mpm_env.mpm": 1,
    "mpm_env.native": 0,
    "mpm_env.native.build": 0,  # runs when the package is built, and may use what builds it
    "mpm_env.config": 2,
    "mpm_env.fidelity": 2,
    "mpm_env.health": 2,
    "mpm_env.motion": 2,
    "mpm_env.scene": 2,
    "mpm_env.sim": 2,
    "mpm_env.wrench": 2,
    "mpm_env.tasks": 3,
    "mpm_env.calibrate": 4,
    "mpm_env.cli": 4,
    "mpm_env.demo": 4,
    "mpm_env.element": 4,
    "mpm_env.env": 4,
    "mpm_env.ledger": 4,
    "mpm_env.laboratory": 4,
    "mpm_env.log": 4,
    "mpm_env.plot": 4,
    "mpm_env.render": 4,
    "mpm_env.replay": 4,
    "mpm_env.run": 4,
    "mpm_env.view": 4,
    "mpm_env": 5,
}

# What a part may import besides the standard library and itself, where it is less than everything below it.
ALLOWED = {
    "coupling": {"igl", "jax", "mujoco", "numpy"},
    "mpm_env.mpm": {"jax", "numpy"},
}
ONLY_IN_LOG = "rerun"  # heavy, and its API moves: one family of files, inside the function that needs it
NOT_BELOW_TASKS = "gymnasium"  # physics knows nothing of environments


def belongs(module: str, part: str) -> bool:
    """Whether `module` is `part`, lies inside it, or is of its family (`log_replay` of `log`)."""
    return module == part or module.startswith((part + ".", part + "_"))


def part_of(module: str) -> str | None:
    """The entry of FLOORS that a module belongs to; only the front door itself is plain `mpm_env`."""
    parts = [part for part in FLOORS if (module == part if part == "mpm_env" else belongs(module, part))]
    return max(parts, key=len, default=None)


def imports(tree: ast.Module, known: set[str]) -> Iterator[tuple[str, bool, int]]:
    """Every import as (module, whether it runs on loading, line); `from a import b` is a.b if known."""

    def walk(node: ast.AST, top: bool) -> Iterator[tuple[str, bool, int]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from ((alias.name, top, child.lineno) for alias in child.names)
            elif isinstance(child, ast.ImportFrom) and child.level == 0:
                base = child.module or ""
                inner = {f"{base}.{alias.name}" for alias in child.names}
                yield from ((name, top, child.lineno) for name in sorted(inner & known))
                if inner - known:
                    yield base, top, child.lineno
            inside = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from walk(child, top and not inside and not for_types_only(child))

    def for_types_only(node: ast.AST) -> bool:
        return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")

    return walk(tree, True)


def faults(module: str, text: str, known: set[str]) -> list[str]:
    """One sentence for each house rule that this module's text breaks."""
    here = part_of(module)
    if here is None:
        return [f"{module} has no floor: give it one in FLOORS and in the plan of the house"]
    found = []
    tree = ast.parse(text)
    for name, top, line in imports(tree, known):
        where = f"{module}:{line} imports {name}"
        outer = name.split(".")[0]
        if outer in PACKAGES:
            there = part_of(name)
            if there is None:
                found.append(f"{where}, which has no floor")
            elif there != here and (FLOORS[there] > FLOORS[here] or FLOORS[there] == FLOORS[here] == 1):
                found.append(f"{where}, from floor {FLOORS[here]} to floor {FLOORS[there]}: arrows go down only")
        elif outer not in sys.stdlib_module_names:
            if here in ALLOWED and outer not in ALLOWED[here]:
                found.append(f"{where}, but {here} may use only {', '.join(sorted(ALLOWED[here]))}")
            if outer == ONLY_IN_LOG and here != "mpm_env.log":
                found.append(f"{where}, which only mpm_env.log may")
            if outer == ONLY_IN_LOG and top:
                found.append(f"{where} at the top of the file: import it in the function that needs it")
            if outer == NOT_BELOW_TASKS and FLOORS[here] < FLOORS["mpm_env.tasks"]:
                found.append(f"{where}, but floor {FLOORS[here]} knows no environments")
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level:
            found.append(f"{module}:{node.lineno} has a relative import: write it in full")
        called = node.func if isinstance(node, ast.Call) else None
        if isinstance(called, ast.Name) and called.id == "print" and here != "mpm_env.cli":
            found.append(f"{module}:{called.lineno} prints: only the command line may")
    return found


def undeclared(text: str, project: dict[str, Any]) -> set[str]:
    """The packages a text imports that neither the dependencies nor an extra of a pyproject table brings."""
    extras = project["optional-dependencies"].values()
    wanted = [*project["dependencies"], *(line for extra in extras for line in extra)]
    declared = {plain(re.split(r"[\[<>=!~; ]", line)[0]) for line in wanted}
    outers = {name.split(".")[0] for name, _, _ in imports(ast.parse(text), set())}
    brought_by = packages_distributions()
    return {
        outer
        for outer in outers - set(PACKAGES) - set(sys.stdlib_module_names)
        if not declared & {plain(name) for name in brought_by.get(outer, [])}
    }


def plain(name: str) -> str:
    """A distribution's name as every spelling of it is compared: PyYAML and pyyaml are one."""
    return re.sub(r"[-_.]+", "-", name).lower()


def circles(arrows: dict[str, set[str]]) -> list[str]:
    """Every module that reaches itself again by imports that run when the file is loaded."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        ahead = [start]
        while ahead:
            new = arrows.get(ahead.pop(), set()) - seen
            seen |= new
            ahead += new
        return seen

    return sorted(module for module in arrows if module in reached(module))


def shape_faults(path: Path, text: str) -> list[str]:
    """One sentence for each rule that a file's name or length breaks."""
    found = []
    if path.stem.lower() in ("utils", "util", "helpers", "misc"):
        found.append(f"{path} is named after no idea: split it by what its parts are about")
    if len(text.splitlines()) > LINES_AT_MOST:
        found.append(f"{path} has {len(text.splitlines())} lines, at most {LINES_AT_MOST}: find the missing noun")
    return found


def module_name(path: Path) -> str:
    """`mpm_env/tasks/__init__.py` is `mpm_env.tasks`."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


LIBRARY = {module_name(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EVERY_FILE = [
    path for folder in (*PACKAGES, "benchmarks", "examples", "tests") for path in sorted((ROOT / folder).rglob("*.py"))
]


@pytest.mark.parametrize("module", LIBRARY)
def test_module_keeps_the_house_rules(module: str) -> None:
    found = faults(module, LIBRARY[module].read_text(), set(LIBRARY))
    assert not found, "\n".join(found)


@pytest.mark.parametrize("module", LIBRARY)
def test_module_imports_only_declared_dependencies(module: str) -> None:
    assert undeclared(LIBRARY[module].read_text(), PROJECT) == set()


def test_no_module_imports_itself_in_a_circle() -> None:
    arrows = {
        module: {name for name, top, _ in imports(ast.parse(path.read_text()), set(LIBRARY)) if top} - {module}
        for module, path in LIBRARY.items()
    }
    assert circles(arrows) == []


def test_files_are_short_and_named_after_an_idea() -> None:
    found = [fault for path in EVERY_FILE for fault in shape_faults(path.relative_to(ROOT), path.read_text())]
    assert not found, "\n".join(found)


def test_rules_see_both_packages_and_every_floor() -> None:
    parts = {part_of(module) for module in LIBRARY}
    assert {FLOORS[part] for part in parts if part} == {0, 1, 2, 3, 4, 5}
    assert {"coupling", "mpm_env.mpm"} <= parts


KNOWN = {"mpm_env.sim", "mpm_env.scene", "mpm_env.env"}


@pytest.mark.parametrize(
    ("module", "text", "word"),
    [
        ("mpm_env.mpm.transfer", "import mujoco", "may use only jax, numpy"),
        ("mpm_env.mpm.transfer", "def f():\n    from gymnasium import spaces", "may use only jax, numpy"),
        ("mpm_env.mpm.substep", "from coupling import contact", "arrows go down only"),
        ("mpm_env.mpm.substep", "from mpm_env.scene import Scene", "arrows go down only"),
        ("coupling.contact", "import mpm_env.mpm.types", "arrows go down only"),
        ("coupling.contact", "import scipy", "may use only igl, jax, mujoco, numpy"),
        ("mpm_env.scene", "from mpm_env import env", "arrows go down only"),
        ("mpm_env.scene", "from mpm_env import Scene", "arrows go down only"),
        ("mpm_env.sim", "import gymnasium", "knows no environments"),
        ("mpm_env.tasks.dig", "def f():\n    import rerun", "only mpm_env.log may"),
        ("mpm_env.log", "import rerun as rr", "in the function that needs it"),
        ("mpm_env.log", "if True:\n    from rerun.chunk import RrdReader", "in the function that needs it"),
        ("mpm_env.env", "from . import sim", "relative import"),
        ("mpm_env.sim", "def f(x):\n    print(x)", "prints"),
        ("mpm_env.newcomer", "import numpy", "has no floor"),
        ("mpm_env.env", "from mpm_env.newcomer import Thing", "which has no floor"),
    ],
)
def test_broken_rule_is_found(module: str, text: str, word: str) -> None:
    assert any(word in fault for fault in faults(module, text, KNOWN)), faults(module, text, KNOWN)


@pytest.mark.parametrize(
    ("module", "text"),
    [
        (
            "mpm_env.mpm.substep",
            "import jax.numpy as jnp\nimport numpy as np\nfrom mpm_env.mpm.types import Grid",
        ),
        ("coupling.geoms", "from mujoco import mjx\nimport igl\nfrom coupling.bodies import Bodies"),
        ("mpm_env.sim", "from coupling import contact\nfrom mpm_env import scene\nimport mujoco"),
        ("mpm_env.log_replay", "def f():\n    from rerun.chunk import RrdReader"),
        ("mpm_env.log", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import rerun"),
        ("mpm_env.cli", "from mpm_env.log import record\nprint('ran')"),
        ("mpm_env", "from mpm_env.env import Env"),
    ],
)
def test_kept_rule_is_left_alone(module: str, text: str) -> None:
    assert faults(module, text, KNOWN) == []


def test_undeclared_dependency_is_found() -> None:
    text = "import os\nimport yaml\nfrom mpm_env import sim\ndef f():\n    import pluggy, nowhere"
    project = {"dependencies": ["PyYAML>=6"], "optional-dependencies": {"some": ["jax[cuda12]"]}}
    assert undeclared(text, project) == {"pluggy", "nowhere"}


def test_circle_is_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == ["a", "b", "c"]


def test_misshapen_file_is_found() -> None:
    assert shape_faults(Path("mpm_env/utils.py"), "")
    assert shape_faults(Path("mpm_env/sim.py"), "\n" * (LINES_AT_MOST + 1))
    assert not shape_faults(Path("mpm_env/sim.py"), "\n" * LINES_AT_MOST)
