"""A program under way: which line is sent next, which waits for its answer, what is certainly executed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from machines.driver import ProgramLine, StreamProgress
from machines.errors import MachineError, ProgramChangedError
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState, Step
from machines.grbl.flow_control import AnswerCount, SendWindow, usable_bytes
from machines.grbl.link import GrblLink
from machines.grbl.states import Phase
from machines.grbl.tracking import SEGMENTS, Tracker
from phrases.phrase import Phrase

# Bytes that a block may consist of: printable, without the characters that act at once wherever they stand (! ? ~).
PLAIN = bytes(set(range(0x20, 0x7F)) - set(b"!?~"))
DEFAULT_PLANNER_BLOCKS = 15
Flight = tuple[ProgramLine, Step]


def name_line(number: int) -> Phrase:
    """Return the name of a line for a sentence; blocks of the way in have no number."""
    return Phrase("line {line}", line=number) if number else Phrase("a block of the way in")


class Stream:
    """Lines on their way. `fill` gives bytes to write now; they are counted the moment they are given."""

    def __init__(
        self,
        lines: Iterator[ProgramLine],
        *,
        capacity: int,
        interpreter: Interpreter,
        tracker: Tracker,
        count: AnswerCount,
    ) -> None:
        self._lines = lines
        self.interpreter = interpreter
        self._next: Flight | None = None
        self._rest = b""  # counted, not yet given out: the wire has no room for them now
        self._alone = False  # a line that writes settings is under way: no other line may be
        self.window: SendWindow[Flight] = SendWindow(capacity)
        self.tracker = tracker
        self.exhausted = False
        self.wants_wire = False  # more could be sent if the wire were less full
        self.sent_line = self.sent_offset = self.answered_line = 0
        self.echoed = False  # the oldest line under way has been echoed
        self.compared = False  # a reported position was found on the path
        self.agreed_line = 0  # when this line was answered, as many answers had come as lines
        self.count = count

    def fill(self, budget: int) -> bytes:
        """Return at most `budget` bytes to write now. Raises MachineError if the program cannot go on."""
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
            window.note_sent(size, following)
            self.tracker.note_sent(line.number, step)
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
            raise ProgramChangedError(
                Phrase("the program cannot be read further: {error}", error=str(error))
            ) from error
        if line is None:
            self.exhausted = True
            return None
        if len(line.text) >= self.window.capacity:
            raise MachineError(
                Phrase(
                    "line {line}: {count} characters and its end; the controller's buffer takes {most}: split the line",
                    line=line.number,
                    count=len(line.text),
                    most=self.window.capacity,
                )
            )
        if not line.text or line.text.translate(None, PLAIN):
            raise MachineError(
                Phrase(
                    "line {line}: {text} is not a plain block: run pre-flight again",
                    line=line.number,
                    text=repr(line.text),
                )
            )
        self._next = (line, self.interpreter.take(line.text))
        return self._next

    def take_answer(self) -> Flight:
        """Take the oldest line under way off: it was answered. IndexError if there is none."""
        flight = self.window.take_answer()
        self.tracker.take_answer()
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


@dataclass(slots=True, eq=False)
class Streamer:
    """Owns the program under way, from its start until the controller's buffers hold none of it.

    echoes       : the controller echoes every line it has read
    late_answers : answers to a program that is being stopped still count
    """

    link: GrblLink
    stream: Stream | None = None
    echoes: bool = False
    late_answers: bool = False
    _progress: StreamProgress = field(default_factory=StreamProgress)

    @property
    def window_bytes(self) -> int:
        return usable_bytes(self.link.options.rx_bytes or self.link.view.settings.rx_bytes)

    @property
    def planner_blocks(self) -> int:
        return self.link.view.settings.planner_blocks or DEFAULT_PLANNER_BLOCKS

    @property
    def corridor_mm(self) -> float:
        """How far a reported position may be off: the option, plus the errors of rounding, steps and chords."""
        view = self.link.view
        return self.link.options.corridor_mm + view.exact_mm + (view.settings.arc_tolerance_mm or 0.002)

    @property
    def progress(self) -> StreamProgress:
        if self.stream is None:
            return self._progress
        return self.stream.progress(streaming=self.link.phase is Phase.STREAMING)

    @property
    def first_line(self) -> int:
        """Number of the oldest line under way; 0 if none is."""
        return self.stream.first_line if self.stream is not None else 0

    @property
    def waits_for_person(self) -> bool:
        """The oldest line under way is answered when a person lets the mill go on."""
        first = self.stream.first if self.stream is not None else None
        return first is not None and first[1].withholds_ok

    def start(self, lines: Iterator[ProgramLine], now_s: float) -> None:
        """Begin a program where the mill stands, in the modes that it is in."""
        link, settings, modes = self.link, self.link.view.settings, self.link.view.modes.split()
        state = ModalState(
            position_mm=link.view.work_mm or (None, None, None),
            units="G20" if "G20" in modes else "G21",
            distance="G91" if "G91" in modes else "G90",
        )
        self.stream = Stream(
            lines,
            capacity=self.window_bytes,
            interpreter=Interpreter(state, dialect=link.options.dialect),
            tracker=Tracker(
                planner_blocks=self.planner_blocks,
                tolerance_mm=self.corridor_mm,
                segments=SEGMENTS[settings.firmware],
                least_block_mm=1.7321 * max(settings.step_mm or (0.01,)),  # then some axis makes a step
            ),
            count=AnswerCount(now_s),
        )
        link.paused = link.hold_wanted = self.late_answers = False
        link.enter(Phase.STREAMING, now_s)

    def end(self) -> None:
        """Forget the program except its progress, and the modes that it leaves if it was carried out completely."""
        stream, self.stream = self.stream, None
        if stream is not None:
            if self.link.phase is Phase.STREAMING and stream.drained:
                modes = stream.interpreter.state.words(with_motion=False)
                self.link.view.modes = modes or self.link.view.modes
            self._progress = stream.progress(streaming=False)

    def take_late_answer(self, error: int) -> None:
        """Count an answer to a line of a program that is being stopped."""
        stream = self.stream
        if stream is None or not self.late_answers or not stream.window.used:
            return
        if error or self.echoes:
            self.late_answers = False
        else:
            stream.take_answer()
