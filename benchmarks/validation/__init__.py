"""What the grains are worth: exact cases, experiments, and laws that every right answer obeys."""

from benchmarks import machine

PLOTS = machine.ROOT / "docs" / "validation"
