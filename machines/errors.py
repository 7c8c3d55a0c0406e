"""Errors between a program and a mill. Every message is one line: the thing, the value, the remedy.

`MillCode` lists the codes of a mill's statements and refusals, for programs: a closed list, as are `Refusal`, `Stop`
and `FaultCause`. A code comes with values and with words. The words are for terminals and for people who read the
interface directly; a program with its own user interface has a sentence for each code. A code that no longer exists
stays readable by its words.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum, StrEnum
from typing import overload

from phrases.phrase import Phrase


class MillCode(StrEnum):
    # Why an order was refused, or why its outcome is not known.
    OWNER_ENDED = "owner_ended"  # reason
    OWNER_SILENT = "owner_silent"  # seconds, taken_back
    NO_BLOCK = "no_block"  # text
    MILL_STATE = "mill_state"  # state
    RUN_STATE = "run_state"  # state
    RUN_LIVE = "run_live"
    RUN_UNSTARTED = "run_unstarted"
    TRAVEL = "travel"  # detail: a line for each way in which the program leaves the travel

    # Why a run is in its state, in addition to FaultCause (detail, alarm).
    OWNER_LOST = "owner_lost"  # state
    ABORTED = "aborted"
    TAKEN_BACK = "taken_back"

    # Why a mill is in its state.
    LOCKED = "locked"  # alarm
    LOCKED_UNTIL_RESET = "locked_until_reset"  # alarm
    SILENT = "silent"

    # Needs that a person must meet first.
    CONNECT = "connect"  # state
    WAIT = "wait"  # state
    STAND_STILL = "stand still"  # state
    UNLOCK = "unlock"  # alarm
    POSITION = "position"  # doubt
    ZERO = "zero"

    # Events.
    ORDER_TAKEN = "order_taken"  # order
    ORDER_REFUSED = "order_refused"  # order, and code, values and words of the refusal
    SETTINGS_READ = "settings_read"
    RUN_PARKED = "run_parked"  # name
    RUN_LEFT = "run_left"  # name, state
    OWNER_FAILED = "owner_failed"  # reason


class MachineError(Exception):
    """Base of all errors of this package; `str(error)`, the same as `words`, may be shown to the operator.

    code, values : the same for programs; "" where no code exists. Without a code, only a phrase can be shown in
                   another language.
    """

    @overload
    def __init__(self, words: Phrase) -> None: ...
    @overload
    def __init__(self, words: str, *, code: str, values: Mapping[str, object] | None = None) -> None: ...
    def __init__(self, words: str, *, code: str = "", values: Mapping[str, object] | None = None) -> None:
        super().__init__(words)
        self.words = words if isinstance(words, Phrase) else Phrase("{words}", words=words)
        self.code = code
        self.values = dict(values or {})


class PortError(MachineError):
    """The link cannot be opened, or was lost. `url` names it."""

    def __init__(self, url: str, text: str) -> None:
        super().__init__(Phrase("port {url}: {text}", url=url, text=text))
        self.url = url


class PortLostError(PortError):
    """A link that was open is gone: cable, power, or the far end closed it."""


class NotAControllerError(PortError):
    """Nothing answers, or something that is not a controller of the expected kind."""


class NotAllowedError(MachineError):
    """The request is not allowed in the present state of the mill or the run; the message names both."""


class WrongStateError(NotAllowedError):
    """The state of the mill (MILL_STATE) or of the run (RUN_STATE) does not allow it."""

    def __init__(self, words: str, code: MillCode, state: Enum) -> None:
        super().__init__(words, code=code, values={"state": state.value})


class ProgramRefusedError(MachineError):
    """A program may not be sent. `line` counts from 1; 0 if the fault is not in one line."""

    def __init__(self, line: int, text: str, reason: Phrase) -> None:
        where = Phrase("line {line}: '{text}': {reason}", line=line, text=text, reason=reason)
        super().__init__(where if line else reason)
        self.line = line
        self.text = text
        self.reason = reason


class ProgramChangedError(MachineError):
    """The file on disk is not the one that pre-flight read."""


class JournalError(MachineError):
    """The journal cannot be written or read back; nothing may run without one."""
