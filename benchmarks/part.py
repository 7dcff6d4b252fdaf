"""A part of benchmarks against references: rows of numbers, bands they are to lie in, and where both are kept."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from benchmarks import results
from benchmarks.clock import significant

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Band:
    """Where a number of some rows is to lie."""

    measure: str  # the number's name in a row
    low: float
    high: float
    note: str = ""  # where it is missed: what is known about why
    where: dict[str, Any] = field(default_factory=dict)  # what rows it is for have, all of them if empty

    def holds(self, value: float | None) -> bool:
        """Whether a number lies in it; one that is not finite is kept as None, and does not."""
        return value is not None and self.low <= value <= self.high

    def asks(self, row: Row) -> bool:
        """Whether it is for this row."""
        return self.measure in row and all(row.get(k) == v for k, v in self.where.items())

    def misses(self, row: Row, key: str | None = None) -> bool:
        """Whether it is for this row and the row's number, or any of its numbers, lies outside; or the one of a key."""
        if not self.asks(row):
            return False
        value = row[self.measure]
        values = [value] if not isinstance(value, Mapping) else value.values() if key is None else [value[key]]
        return not all(map(self.holds, values))


def told(bands: Iterable[Band]) -> list[dict[str, Any]]:
    """Bands as they are kept."""
    return [asdict(band) for band in bands]


def kept(value: float, digits: int = 4) -> float | None:
    """A number as it is kept: so many digits, nothing where it is not finite."""
    return significant(value, digits) if math.isfinite(value) else None


def bands_of(result: Row) -> list[Band]:
    """The bands of a part's result."""
    return [Band(**band) for band in result["bands"]]


def misses(result: Row) -> Iterator[tuple[Band, list[Row]]]:
    """The bands that a part's result misses, each with the rows that lie outside."""
    for band in bands_of(result):
        if outside := [row for row in result["rows"] if band.misses(row)]:
            yield band, outside


def say(row: Row) -> Row:
    """Print a row as it is done."""
    print("  ".join(f"{k} {v}" for k, v in row.items()), flush=True)
    return row


def main(name: str, measure: Callable[[bool], dict[str, Any]], about: str) -> None:
    """Measure a part and write results/<name>.json."""
    parser = argparse.ArgumentParser(description=about.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer and coarser runs")
    quick = parser.parse_args().quick
    began = time.perf_counter()
    content = measure(quick)
    results.write(name, {"quick": quick, "wall_s": round(time.perf_counter() - began), **content})
