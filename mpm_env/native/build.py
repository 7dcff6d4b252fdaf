"""Builds the kernels where a C++ compiler is at hand. Hatch calls this when the package is built or installed.

Without a compiler, or without jaxlib's headers, the package is built all the same, and the solver runs on plain XLA.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import runpy
import shlex
import shutil
import subprocess
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

HERE = Path(__file__).parent
# Hatch loads this file alone, before the package can be imported.
source_hash = runpy.run_path(str(HERE / "sources.py"))["source_hash"]
LIBRARY = "kernels.so"
# Vectorised by hand: what GCC 12 makes of the f64 kernels by itself is wrong.
FLAGS = [
    "-std=c++20",
    "-O3",
    "-fPIC",
    "-pthread",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-tree-vectorize",
]
# Kernels are compiled once per width of registers; which one runs is decided where they run.
WIDTHS = {"wide": "-march=x86-64-v4", "narrow": "-march=x86-64-v3"}


def build(library: Path) -> str | None:
    """Compile the library to this path. Returns why not, or None when it is there."""
    compiler = (
        shlex.split(os.environ.get("CXX", "")) or [found for c in ("g++", "c++") if (found := shutil.which(c))][:1]
    )
    if not compiler:
        return "there is no C++ compiler (g++, or what CXX names)"
    jaxlib = importlib.util.find_spec("jaxlib")
    if jaxlib is None or jaxlib.origin is None:
        return "jaxlib is not there to build against"
    headers = Path(jaxlib.origin).parent / "include"
    x86 = platform.machine() in ("x86_64", "AMD64")
    with tempfile.TemporaryDirectory() as scratch:

        def compiled(job: tuple[str, list[str]]) -> str:
            source, flags = job
            target = f"{scratch}/{abs(hash(tuple(job[1])))}-{source}.o"
            _run([*compiler, *FLAGS, *flags, "-c", str(HERE / source), "-o", target])
            return target

        narrow = "AVX2" if x86 else platform.machine()
        about = [f'-DMPM_SOURCE="{source_hash()}"', f'-DMPM_NARROW="{narrow}"', f"-I{headers}"]
        jobs = [
            (source, [f"-DMPM_ISA={isa}", *([flag] if x86 else [])])
            for source in ("kernels.cpp", "contact.cpp")
            for isa, flag in WIDTHS.items()
        ]
        try:
            with ThreadPoolExecutor(os.cpu_count()) as workers:
                objects = list(workers.map(compiled, [*jobs, ("ffi.cpp", about), ("threads.cpp", [])]))
            _run([*compiler, "-shared", "-pthread", *objects, "-o", f"{scratch}/{LIBRARY}"])
        except (OSError, subprocess.CalledProcessError) as error:
            said = (getattr(error, "stderr", None) or "it said nothing").strip().splitlines()
            return f"{compiler[0]} failed: {next((line for line in said if 'error' in line), said[-1])}"
        shutil.move(f"{scratch}/{LIBRARY}", library)
    return None


def build_or_say(library: Path) -> str | None:
    """Compile the library, or leave the reason why not in a text beside it, which this also returns."""
    why_not, reason = build(library), library.with_suffix(".txt")
    if why_not:
        library.unlink(missing_ok=True)  # of other sources
        reason.write_text(why_not + "\n")
    else:
        reason.unlink(missing_ok=True)
    return why_not


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)


class Hook(BuildHookInterface):
    """Puts the library beside its sources, and into the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Hatch calls this before it packs the wheel, or writes the editable one."""
        library = HERE / LIBRARY
        why_not = build_or_say(library)
        if why_not:
            build_data["artifacts"].append(f"mpm_env/native/{library.with_suffix('.txt').name}")
            self.app.display_warning(f"mpm-env is built without its native kernels: {why_not}.")
            return
        # It belongs to this kind of machine, but to any Python: it is loaded through ctypes.
        tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{tag}"
        build_data["artifacts"].append(f"mpm_env/native/{LIBRARY}")


def get_build_hook() -> type[BuildHookInterface]:
    """What hatch asks this file for."""
    return Hook


if __name__ == "__main__":
    raise SystemExit(build_or_say(HERE / LIBRARY))
