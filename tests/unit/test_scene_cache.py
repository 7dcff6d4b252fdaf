"""Building a scene has JAX keep its programs on disk, unless something speaks against it."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from mpm_env.scene_cache import LEAST_COMPILE_TIME, keep_programs

OPTIONS = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_enable_compilation_cache"
PROGRAM = """
import jax
from mpm_env.scene_cache import keep_programs
jax.jit(lambda x: x + 1)(1.0)  # programs of before do not matter
keep_programs()
asked = []
jax.monitoring.register_event_listener(lambda event, **_: asked.append(event.rsplit("/", 1)[-1]))
heavy = jax.jit(lambda k: jax.numpy.linalg.inv(jax.random.normal(k, (9, 9))) @ jax.random.gamma(k, 2.0, (9,)))
heavy(jax.random.key(0))
print(asked.count("cache_hits"))
"""


@pytest.fixture
def nothing_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """No folder of the user's own, and a home of this test's."""
    before = {name: getattr(jax.config, name) for name in OPTIONS}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield tmp_path / "cache" / "mpm_env" / "programs"
    for name, value in before.items():
        jax.config.update(name, value)


def test_programs_are_kept_in_the_users_cache(nothing_chosen: Path) -> None:
    keep_programs()
    assert jax.config.jax_compilation_cache_dir == str(nothing_chosen)
    assert nothing_chosen.is_dir()
    assert jax.config.jax_persistent_cache_min_compile_time_secs == LEAST_COMPILE_TIME


def test_a_folder_that_the_user_chose_stays(nothing_chosen: Path, tmp_path: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    keep_programs()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine")
    assert not nothing_chosen.exists()


def test_nothing_is_kept_where_the_cache_is_switched_off(nothing_chosen: Path) -> None:
    jax.config.update("jax_enable_compilation_cache", False)
    keep_programs()
    assert jax.config.jax_compilation_cache_dir is None
    assert not nothing_chosen.exists()


def test_a_cache_that_cannot_be_written_is_done_without(nothing_chosen: Path) -> None:
    nothing_chosen.parents[1].write_text("a file, where the folder would be")
    keep_programs()
    assert jax.config.jax_compilation_cache_dir is None


def test_a_second_process_finds_the_programs_of_the_first_and_says_nothing(tmp_path: Path) -> None:
    env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_COMPILATION", "JAX_PERSISTENT"))}
    env |= {"XDG_CACHE_HOME": str(tmp_path)}
    first, second = (
        subprocess.run([sys.executable, "-c", PROGRAM], env=env, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    # At least the one: on a busy machine a small program may take long enough to be kept too.
    assert int(first.stdout) == 0 and int(second.stdout) >= 1
    assert first.stderr == second.stderr == ""
