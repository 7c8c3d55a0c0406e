"""What can be wrong between a program and a mill. Every message is one line: the thing, the value, the way out."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import overload

from machines.codes import MillCode
from phrases.phrase import Phrase


class MachineError(Exception):
    """Base of all errors of this package; `str(error)`, the same as `words`, is fit to be shown to the operator.

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
    """Something answers, or nothing does, but no controller of the expected kind."""


class NotAllowedError(MachineError):
    """What was asked for is not allowed in the state the mill or the run is in; the message names both."""


class WrongStateError(NotAllowedError):
    """It is the mill's state (MILL_STATE), or the run's (RUN_STATE), that does not allow it."""

    def __init__(self, words: str, code: MillCode, state: Enum) -> None:
        super().__init__(words, code=code, values={"state": state.value})


class ProgramRefusedError(MachineError):
    """A program may not be sent. `line` counts from 1; 0 where the fault is not in one line."""

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
