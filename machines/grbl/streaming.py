"""A program under way: which line is sent next, which waits for its answer, what is certainly executed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from machines.driver import ProgramLine, StreamProgress
from machines.errors import MachineError, ProgramChangedError
from machines.gcode.step import Step
from machines.grbl.counting import AnswerCount
from machines.grbl.tracking import Tracker
from machines.grbl.window import SendWindow

# Bytes that a block may consist of: printable, without the characters that act at once wherever they stand (! ? ~).
PLAIN = bytes(set(range(0x20, 0x7F)) - set(b"!?~"))
Flight = tuple[ProgramLine, Step]


class Stream:
    """Lines on their way. `fill` gives bytes to write now; they are counted the moment they are given."""

    def __init__(
        self,
        lines: Iterator[ProgramLine],
        *,
        capacity: int,
        interpret: Callable[[bytes], Step],
        tracker: Tracker,
        count: AnswerCount,
    ) -> None:
        self._lines = lines
        self._interpret = interpret
        self._next: Flight | None = None
        self._rest = b""  # counted, not yet given out: the wire has no room for them now
        self._alone = False  # a line that writes settings is under way: nothing else may be
        self.window: SendWindow[Flight] = SendWindow(capacity)
        self.tracker = tracker
        self.exhausted = False
        self.wants_wire = False  # more could be sent if the wire were less full
        self.sent_line = self.sent_offset = self.answered_line = 0
        self.echoed = False  # the oldest line under way has been echoed
        self.agreed_line = 0  # as many answers had come as lines, when this one was answered
        self.count = count

    def fill(self, budget: int) -> bytes:
        """At most `budget` bytes to write now. Raises MachineError where the program cannot go on."""
        out = self._rest
        window = self.window
        while len(out) < budget and not self._alone and not self.count.closed:
            following = self._next
            if following is None:
                following = self._read()
                if following is None:
                    break
            line, step = following
            size = len(line.text) + 1
            if not window.accepts(size) or (step.writes_settings and window.used):
                break
            window.sent(size, following)
            self.tracker.sent(line.number, step)
            out = out + line.text + b"\n" if out else line.text + b"\n"
            self._next = None
            if line.number:
                self.sent_line, self.sent_offset = line.number, line.offset
            if step.writes_settings:
                self._alone = True
        self.wants_wire = len(out) >= budget
        if len(out) > budget:
            budget = max(budget, 0)
            self._rest, out = out[budget:], out[:budget]
        else:
            self._rest = b""
        return out

    def _read(self) -> Flight | None:
        try:
            line = next(self._lines, None)
        except OSError as error:
            raise ProgramChangedError(f"the program cannot be read further: {error}") from error
        if line is None:
            self.exhausted = True
            return None
        if len(line.text) >= self.window.capacity:
            raise MachineError(
                f"line {line.number}: {len(line.text)} characters and its end; the controller's buffer takes "
                f"{self.window.capacity}: split the line"
            )
        if not line.text or line.text.translate(None, PLAIN):
            raise MachineError(f"line {line.number}: {line.text!r} is not a plain block: run pre-flight again")
        self._next = (line, self._interpret(line.text))
        return self._next

    def answered(self) -> Flight:
        """The oldest line under way was taken. IndexError if there is none."""
        flight = self.window.answered()
        self.tracker.answered()
        number = flight[0].number
        if number:
            self.answered_line = number
        self._alone = False
        self.echoed = False
        if not self.window.used:
            self.agreed_line = self.answered_line
        return flight

    @property
    def first(self) -> Flight | None:
        """The line the next answer belongs to."""
        return self.window.first

    @property
    def first_line(self) -> int:
        first = self.window.first
        return first[0].number if first else 0

    @property
    def drained(self) -> bool:
        """Everything was sent and answered."""
        return self.exhausted and not self.window.used

    def progress(self, *, streaming: bool) -> StreamProgress:
        return StreamProgress(
            sent_line=self.sent_line,
            sent_offset=self.sent_offset,
            answered_line=self.answered_line,
            executed_line=self.tracker.executed_line,
            bytes_in_flight=self.window.used,
            lines_in_flight=len(self.window),
            streaming=streaming,
        )
