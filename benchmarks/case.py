"""A case: one number held against a reference, and cases as a table."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from benchmarks.marks import marked, span, table
from benchmarks.part import kept

Band = tuple[float, float]  # the values that agree with a reference


class Case(NamedTuple):
    """A number held against its reference."""

    name: str
    source: str
    reference: float
    band: Band
    value: float
    resolution: str
    cpu_s: float  # of all runs behind it; nan where nobody took it
    health: int = 0
    note: str = ""  # where it misses: what is known about why

    @property
    def holds(self) -> bool:
        """Whether the value lies in the band, and the runs were well."""
        return self.band[0] <= self.value <= self.band[1] and self.health == 0

    def told(self) -> dict[str, Any]:
        """The case as it is kept. A reference of nothing has no relative error; no bound is kept as None."""
        return self._asdict() | {
            "reference": kept(self.reference),
            "band": [kept(b) for b in self.band],
            "value": kept(self.value),
            "error": kept(self.value / self.reference - 1, 3) if self.reference else None,
            "cpu_s": kept(self.cpu_s, 3),
            "verdict": "holds" if self.holds else "misses",
            "note": "" if self.holds else self.note,
        }


def within(reference: float, share: float) -> Band:
    """The band of so large a share on both sides of a reference."""
    return reference * (1 - share), reference * (1 + share)


def at_most(bound: float) -> Band:
    """The band of what should be nothing, or small, and cannot be negative."""
    return 0.0, bound


def at_least(bound: float) -> Band:
    """The band of what may be as large as it likes."""
    return bound, math.inf


def say(cases: Iterable[Case]) -> list[dict[str, Any]]:
    """Cases as they are kept, each printed as it is done."""
    told = []
    for one in (c.told() for c in cases):
        print(f"{one['verdict']:7}{one['name']:60}{one['value']!s:>11}{one['reference']!s:>11}", flush=True)
        told.append(one)
    return told


def table_of(cases: Sequence[Mapping[str, Any]]) -> str:
    """Kept cases; those that differ in nothing, or in the angle of friction alone, share a row."""
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for one in cases:
        name = re.sub(r",? phi [\d.]+", "", one["name"])
        groups.setdefault((name, one["source"], one["resolution"]), []).append(one)
    rows = []
    for (name, source, resolution), some in groups.items():
        several = f" ({len(some)} runs)" if len(some) > 1 else ""
        bands = list(dict.fromkeys(_band(one) for one in some))
        out = any(one["verdict"] == "misses" for one in some)
        value, reference = (span((one[k] for one in some), _short) for k in ("value", "reference"))
        off = [100 * one["error"] for one in some if one["error"] is not None]
        error = span(off, _percent) if off else "-"
        seconds = sum(one["cpu_s"] or 0 for one in some)
        cpu = f"{seconds:.{0 if seconds >= 10 else 1}f}" if seconds else "-"
        row = [name + several, source, resolution, reference, bands[0] if len(bands) == 1 else "its own"]
        rows.append([*row, marked(value, out), error, cpu])
    return table(["case", "reference", "resolution", "it says", "band", "measured", "off", "CPU s"], rows)


def missed(cases: Sequence[Mapping[str, Any]]) -> str:
    """How many cases lie in their bands, and a line on those that do not, with what is known about why."""
    wrong = [one for one in cases if one["verdict"] == "misses"]
    text = f"{len(cases) - len(wrong)} of {len(cases)} cases lie in the band of their reference.\n\n"
    notes: dict[str, dict[str, list[float | None]]] = {}  # note -> what was missed -> values
    for one in wrong:
        told = f"{one['name']} ({one['resolution']}), not {_band(one)}"
        notes.setdefault(one["note"] or "Why is not known", {}).setdefault(told, []).append(one["value"])
    for note, values in notes.items():
        told = "; ".join(f"{name}: {span(some, _short)}" for name, some in values.items())
        text += f"- **Missed**: {told}. {note}.\n"
    return text


def _short(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.3g}"


def _percent(value: float | None) -> str:
    digits = 0 if abs(value or 0) >= 10 else 1
    return f"{round(value or 0, digits) + 0:+.{digits}f} %"  # + 0: no minus before nothing


def _band(one: Mapping[str, Any]) -> str:
    low, high = one["band"]
    if high is None:
        return f"at least {low:.3g}"
    return f"at most {high:.3g}" if low == 0 else f"{low:.3g} to {high:.3g}"
