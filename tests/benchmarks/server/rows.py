"""A row: a figure with how often it was measured, the machine's load then, and the budget beside it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

from tests.benchmarks.timing import Figure


def row(
    name: str,
    value: float,
    unit: str,
    *,
    n: int,
    most: float | None = None,
    least: float | None = None,
    note: str = "",
) -> Figure:
    """most, least: the budget. A figure that misses it says so; nothing is asserted."""
    words = [f"n={n}", f"load {os.getloadavg()[0]:.1f}"]
    if most is not None:
        words.append(f"budget <= {most:g} {unit}{', MISSED' if value > most else ''}")
    if least is not None:
        words.append(f"budget >= {least:g} {unit}{', MISSED' if value < least else ''}")
    return Figure(f"server: {name}", value, unit, "; ".join([*words, note] if note else words))


def spread(
    name: str, seconds: Sequence[float], *, unit: str = "ms", most: float | None = None, note: str = ""
) -> Iterator[Figure]:
    """Median, and the 99th percentile with the budget."""
    factor = 1000.0 if unit == "ms" else 1.0
    n, slowest = len(seconds), f"slowest {factor * max(seconds):.3g} {unit}"
    yield row(f"{name}, p50", factor * percentile(seconds, 0.5), unit, n=n)
    words = f"{slowest}; {note}" if note else slowest
    yield row(f"{name}, p99", factor * percentile(seconds, 0.99), unit, n=n, most=most, note=words)


def percentile(values: Sequence[float], share: float) -> float:
    """The smallest value that so many are not above: of few values the largest."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]
