"""The plan for a GPU, as far as shapes tell: CUDA can have the program, and its cost grows as planned."""

import jax
import jax.numpy as jnp
import pytest
from jax import lax

from benchmarks import gpu
from benchmarks.column import column
from mpm_env import initial

CPU_ONLY = "mpm_env_"  # the native kernels' custom calls


def test_program_for_cuda_is_made_without_a_gpu_and_holds_no_cpu_kernel() -> None:
    text = gpu.lowered(column(4, kernels="xla"))
    assert "stablehlo.scatter" in text
    assert CPU_ONLY not in text


def test_launches_do_not_grow_with_grains_when_all_go_at_once() -> None:
    with gpu.in_chunks_of(gpu.WHOLE):
        few, many = (gpu.substep_cost(column(n, kernels="xla")) for n in (4, 8))
    assert many.launches == few.launches > 0
    slots = [column(n, kernels="xla").slots for n in (4, 8)]
    assert many.bytes / few.bytes == pytest.approx(slots[1] / slots[0], rel=0.05)  # no more than a few fixed arrays


def test_launches_grow_with_grains_in_chunks_and_not_with_environments() -> None:
    small, large = column(4, kernels="xla"), column(8, kernels="xla")
    with gpu.in_chunks_of(512):
        assert gpu.substep_cost(large).launches > 4 * gpu.substep_cost(small).launches
    with gpu.in_chunks_of(gpu.WHOLE):
        assert gpu.substep_cost(small, envs=64).launches == gpu.substep_cost(small, envs=2).launches


def test_cost_counts_loops_and_bytes_by_hand() -> None:
    table, at = jnp.zeros((100, 4), jnp.float32), jnp.zeros((10,), jnp.int32)

    def sums(table: jax.Array) -> jax.Array:
        return lax.fori_loop(0, 3, lambda _, t: t + jnp.sum(t[at] * 2), table)

    found = gpu.cost(jax.make_jaxpr(sums)(table).jaxpr)
    gather, reduction = 10 * 4 + 2 * 10 * 4 * 4, 10 * 4 * 4 + 4
    assert found.launches == 3 * 2
    assert found.bytes == 3 * (gather + reduction)
    assert found.largest == gather


def test_chunks_are_as_before_after_a_count() -> None:
    grains = initial(column(4, kernels="xla"), jax.random.key(0)).grains
    before = gpu.substep.chunk_of(grains)
    with pytest.raises(ZeroDivisionError), gpu.in_chunks_of(7):
        assert before != gpu.substep.chunk_of(grains) == 7
        raise ZeroDivisionError
    assert before == gpu.substep.chunk_of(grains)


def test_chunks_can_be_asked_for_on_a_gpu_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """There the package takes all grains at once, and the benchmark still has both to compare."""
    grains = initial(column(8, kernels="xla"), jax.random.key(0)).grains
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert gpu.substep.chunk_of(grains) == grains.count > 512
    with gpu.in_chunks_of(512):
        assert gpu.substep.chunk_of(grains) == 512
