"""Tables and numbers as the report writes them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any


def table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A table in Markdown."""
    lines = [tuple(head), *([str(cell) for cell in row] for row in rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def brief(value: dict[str, float] | float | None) -> str:
    """A spread as median [least, most]; a dash for nothing."""
    if value is None:
        return "-"
    if isinstance(value, dict):
        return f"{value['median']:.3g} [{value['min']:.3g}, {value['max']:.3g}]"
    return f"{value:.3g}"


def span(values: Iterable[float | None], how: Callable[[float | None], str]) -> str:
    """From the least to the most."""
    values = list(values)
    if None in values:
        return "not finite"
    low, high = how(min(values)), how(max(values))
    return low if low == high else f"{low} to {high}"


def marked(text: str, outside: bool) -> str:
    """Text that stands out where a band is missed."""
    return f"**{text}** (missed)" if outside else text
