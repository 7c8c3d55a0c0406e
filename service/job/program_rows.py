"""The programs of a job as one list, for the setup sheet and for what a person sets up before each of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from service.job.files import AFTER_PASSES, CUT_OUT, FACE, is_program, program_order
from service.job.finite_json import table


def list_programs(spec: Mapping[str, Any], report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each program, in the order in which they are run: the spec's values and over them the report's.

    number    : of the pass, as in its file's name: 0 for the facing, from 1 for the passes, then what comes after them
    is_around : not one of the lens
    is_made   : written and checked; the others are what the spec asks for
    """
    return [
        {
            **({"tool": "flat"} if is_around else {}),
            **wanted,
            **table(made.get("settings")),
            **made,
            "number": number,
            "is_around": is_around,
            "is_made": bool(made),
        }
        for number, is_around, wanted, made in _pair(spec, report)
    ]


def _pair(
    spec: Mapping[str, Any], report: Mapping[str, Any]
) -> Iterator[tuple[int, bool, Mapping[str, Any], Mapping[str, Any]]]:
    """Yield (number, is_around, row of the spec, row of the report), either of them empty where there is none."""
    wanted, made = _rows(spec.get("passes")), _rows(report.get("passes"))
    stock, around = table(spec.get("stock")), table(report.get("around"))
    if FACE in around or stock.get("face"):
        yield 0, True, table(stock.get("face")), table(around.get(FACE))
    count = max(len(wanted), len(made))
    for at in range(count):
        yield at + 1, False, wanted[at] if at < len(wanted) else {}, made[at] if at < len(made) else {}
    number = count
    for name in AFTER_PASSES:
        row, asked = table(around.get(name)), table(stock.get("cut_out")) if name == CUT_OUT else {}
        if row or asked:
            # where no witness marks could be made, no program has their number
            file = str(row.get("file"))
            number = program_order(file)[0] if is_program(file) else number + 1
            yield number, True, asked, row


def _rows(value: Any) -> Sequence[Mapping[str, Any]]:
    return [table(row) for row in value] if isinstance(value, Sequence) and not isinstance(value, str) else []
