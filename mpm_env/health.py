"""How a simulation says that it is unwell: sticky bits, and a sentence for each."""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

MOST_DEPTH = 0.5  # cells a grain may stand inside a body before contact is called lost
MOST_TRAVEL = 0.25  # cells a body may move in one rigid step: the points near it are looked up once per rigid step
MOST_ASTRAY = 0.1  # cells by which a rigid step may end apart from where grains saw the bodies go
MOST_UNPAID = 1e-3  # share of the exchanged impulse by which what grains got and what bodies got may differ
MOST_UNSOLVED = 0.1  # share of a substep's forces that the semi-implicit solver may leave over


class Health(IntFlag):
    """What has gone wrong since the state was made. 0 is well."""

    WELL = 0
    NOT_FINITE = 1
    LEFT_GRID = 2
    TOO_FAST = 4
    INVERTED = 8
    TOO_DEEP = 16
    NODES_OVERFLOW = 32
    GRAINS_OVERFLOW = 64
    NOT_CONVERGED = 128
    BODY_TOO_FAST = 256
    BODY_ASTRAY = 512
    NOT_PAID = 1024
    NOT_SOLVED = 2048


SENTENCES: dict[Health, str] = {
    Health.NOT_FINITE: "A grain or a body has a value that is not finite: the run is lost from here on.",
    Health.LEFT_GRID: "A grain went through a closed wall and left the grid: the time step is too long for its speed.",
    Health.TOO_FAST: "A grain crossed over half a cell in one substep: use a smaller courant or a lower speed.",
    Health.INVERTED: "A grain's velocity gradient would turn it inside out in one substep: use a smaller courant.",
    Health.TOO_DEEP: "A grain stands half a cell, or a quarter of the thickness, inside a body: too thin or too fast.",
    Health.NODES_OVERFLOW: "More grid nodes are near bodies than were set aside: contact is incomplete.",
    Health.GRAINS_OVERFLOW: "More grains are near bodies than were set aside: contact is incomplete.",
    Health.NOT_CONVERGED: "Contact between grains and bodies was not solved: raise contact_iterations.",
    Health.BODY_TOO_FAST: "A body moved over a quarter of a cell in one rigid step: use a smaller fidelity.rigid_dt.",
    Health.BODY_ASTRAY: "MJX moved a body otherwise than its grains saw: raise the model's option iterations.",
    Health.NOT_PAID: "Grains and bodies did not get opposite impulses: contact lost digits, use precision f64.",
    Health.NOT_SOLVED: "The semi-implicit solver left a part of the forces unsolved: use a smaller courant.",
}


class ContactReport(NamedTuple):
    """How contact went in a rigid step: numbers to watch, all but the peak with a health bit for too much."""

    depth: Array  # () m, deepest grain inside a body before it was stopped
    peak: Array  # () N, largest force on the bodies over a substep; with the mean force, how rough contact is
    unpaid: Array  # () share of the exchanged impulse by which what grains got and what bodies got differ
    unsolved: Array  # () worst share of the exchange's equation left over
    astray: Array  # () m, how far MJX left the bodies from where the grains saw them go


def sentences(bits: int) -> list[str]:
    """One sentence for each bit that is set."""
    return [SENTENCES[bit] for bit in Health if bit and bit & bits]


def names(bits: int) -> list[str]:
    """The names of the bits that are set."""
    return [bit.name or "" for bit in Health if bit and bit & bits]


def as_bits(faults: dict[Health, Array]) -> Array:
    """Faults as one integer of health bits."""
    return sum((jnp.where(at, int(bit), 0) for bit, at in faults.items()), start=jnp.zeros((), jnp.int32)).astype(
        jnp.int32
    )
