"""What can be said where the link does not tell positions: the sequence numbers between which the control stopped."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from machines.errors import MachineError
from machines.gcode.program import ProgramReader
from machines.preflight.preflight import Preflight

_SEQUENCE = re.compile(rb"^/?N0*([0-9]+)")
_LOOK_BACK = 2000  # lines


def by_sequence_number(record: Mapping[str, Any], facts: Preflight, reader: ProgramReader) -> str:
    """Return why there is no recovery by position, and how a person restarts at the control's own panel."""
    executed, sent = int(record.get("executed_line") or 0), int(record.get("sent_line") or 0)
    return (
        f"dialect {facts.dialect}: this link does not tell where the control stopped, so there is no recovery by "
        f"position. It was given lines up to {_name_line(reader, sent)} and has executed at least those up to "
        f"{_name_line(reader, executed)}. Read the sequence number on its screen, bring the tool to a safe height, "
        "check the zero, and restart at its panel from the last tool entry at or before that number, or park a program "
        "of the rest"
    )


def _name_line(reader: ProgramReader, line: int) -> str:
    """Return a line with the sequence number that holds there."""
    number = None
    try:
        for one in reader.lines(max(1, line - _LOOK_BACK)) if line else ():
            if one.number > line:
                break
            if (found := _SEQUENCE.match(one.text)) is not None:
                number = found[1].decode()
    except MachineError:
        number = None  # the file is refused elsewhere
    return f"line {line} (N{number})" if number is not None else f"line {line}"
