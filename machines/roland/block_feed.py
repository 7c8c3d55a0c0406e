"""Feeds one program to the MDX-40A, a block at a time: the mill's byte counter shows when the next block may be sent,
and its reported positions show which lines are certainly cut.

Lines are executed in order. If a report lies on several lines (a path that comes back), the earliest of those not yet
known to be cut is assumed: the line being cut matches its own position, so nothing before the earliest match can be
uncut. If no line matches (blended corner, dwell off the path), nothing is concluded.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain

from machines.driver import FaultCause, ProgramLine, Require, Triple
from machines.errors import MachineError, PortError
from machines.gcode.dialects import RML
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState, Step
from machines.roland.rml import RmlFault, RmlInterpreter, parse
from machines.roland.usb_device import COUNTER_MODULUS, Mdx40aDevice
from phrases.phrase import Phrase

NEAR_MM = 0.01  # reports are in 0.001 mm, a step is 0.002 mm; closer than the finest pitch of rows in use (0.02 mm)
_MOST_PENDING = 5000  # the mill holds a few blocks; more than this is not a buffer
MOST_BLOCK_BYTES = 512  # one line; writes of 32 KB hang the mill
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.001, 0.02
_MOVES_FRAME = re.compile(rb"G(5[5-9]|92|10|52|43|68)(?!\d)")  # G54 is read before the start; these leave it


@dataclass(frozen=True, slots=True)
class Travel:
    """The motion of one line: its moves, and their highest Z [mm, work frame], None if that is not known."""

    ways: tuple[Step, ...]
    highest_z_mm: float | None


def nc_reader(dialect: str, start_mm: Triple | None = None) -> Callable[[bytes], Travel]:
    """Return a function that turns lines of G-code, in order, into their motion. `start_mm` is the mill's position
    (work frame): without it the first moves have no beginning and could be under way anywhere, and it would never be
    known that the mill has left them.
    """
    interpreter = Interpreter(ModalState(position_mm=start_mm) if start_mm else None, dialect=dialect)

    def read(text: bytes) -> Travel:
        step = interpreter.take(text)
        ends = [z for z in (step.start_mm[2], step.end_mm[2]) if z is not None]
        return Travel((step,), max(ends) if ends else None) if step.moves else Travel((), None)

    return read


def rml_reader(start_mm: Triple | None = None) -> Callable[[bytes], Travel]:
    """Return a function that turns lines of RML-1, each with any number of commands, into their motion."""
    interpreter = RmlInterpreter(position_mm=start_mm or (None, None, None))

    def read(text: bytes) -> Travel:
        commands = [parse(part) for part in text.split(b";")]
        return Travel(tuple(move for c in commands if c is not None for move in interpreter.take(c)), None)

    return read


@dataclass(slots=True)
class Follower:
    """Tracks the lines that the mill has taken and that are not yet known to be cut."""

    executed_line: int = 0
    lost: bool = False  # too many lines without a match: nothing is known until the mill stands still
    _pending: deque[tuple[int, tuple[Step, ...]]] = field(default_factory=deque)
    _last_line: int = 0

    def take(self, line: int, ways: Iterable[Step]) -> None:
        self._last_line = line or self._last_line
        if self.lost:
            return
        self._pending.append((line, tuple(ways)))
        if len(self._pending) > _MOST_PENDING:
            self._pending.clear()
            self.lost = True

    def take_position(self, work_mm: Triple) -> None:
        if self.lost:
            return
        for index, (_, ways) in enumerate(self._pending):
            if any(way.distance_mm(work_mm) <= NEAR_MM for way in ways):
                for _ in range(index):
                    self._note_done(self._pending.popleft()[0])
                return

    def finish(self) -> None:
        """Count all lines sent to the mill as executed."""
        self._pending.clear()
        self._note_done(self._last_line)
        self.lost = False

    def _note_done(self, line: int) -> None:
        self.executed_line = line or self.executed_line


class FeedFault(Exception):
    """The reason why no further block may be sent."""

    def __init__(self, cause: FaultCause, words: Phrase, line: int) -> None:
        super().__init__(words)
        self.words = words
        self.cause = cause
        self.line = line


@dataclass(frozen=True, slots=True, kw_only=True)
class ByteBlock:
    """The block under way: its line, its bytes, its motion, and the counter when the mill has all of it."""

    line: ProgramLine
    data: bytes
    travel: Travel
    counter_after: int


class BlockFeed:
    """`turn` does all the work; the other members report its state.

    origin_mm : machine position of the program's zero; None if not known, then positions say nothing about lines
    here_mm   : where the mill stands before the first block, in the program's frame
    """

    def __init__(
        self,
        device: Mdx40aDevice,
        lines: Iterator[ProgramLine],
        *,
        dialect: str,
        origin_mm: Triple | None,
        here_mm: Triple | None,
    ) -> None:
        self._is_rml = dialect == RML
        self._line_end = b"\n" if self._is_rml else b"\r\n"
        self._read = rml_reader(here_mm) if self._is_rml else nc_reader(dialect, here_mm)
        self._lines = lines
        self._opened = False
        self._counter = device.read_counter()
        self.origin_mm = origin_mm
        self.follower = Follower()
        self.block: ByteBlock | None = None
        self._next: ByteBlock | None = None  # read, not sent
        self.ended = False  # every line has been given and counted
        self.changed_s = device.clock()  # when the counter last moved
        self.wait_s = _FIRST_WAIT_S  # before the counter is read again
        self.sent_line = self.sent_offset = self.answered_line = 0
        self.frame_left_at = 0  # line that left the frame whose origin we know

    def turn(self, device: Mdx40aDevice, *, may_send: bool, require: Require) -> None:
        """Read the mill's byte count; then send the next block if `may_send`. FeedFault ends the feed.

        require : called when only the write of the block is left; the block waits if it raises
        """
        if self.block is not None and not self._count(device, self.block):
            return
        if not may_send or self.ended:
            return
        try:
            self._next = self._next or self._read_next(device)
        except PortError:
            raise
        except (MachineError, RmlFault, OSError) as error:
            raise FeedFault(FaultCause.PROGRAM_CHANGED, Phrase("{error}", error=str(error)), self.sent_line) from error
        if self._next is None:
            self.ended = True
            return
        require()
        block, self._next = self._next, None
        self._send(device, block)

    def _count(self, device: Mdx40aDevice, block: ByteBlock) -> bool:
        counter, now_s = device.read_counter(), device.clock()
        if (block.counter_after - counter) % COUNTER_MODULUS > len(block.data):
            words = Phrase(
                "the byte counter is {counter}, at most {most} can be right: blocks do not match",
                counter=counter,
                most=block.counter_after,
            )
            raise FeedFault(FaultCause.REPLY_COUNT, words, block.line.number)
        if counter != self._counter:
            self._counter, self.changed_s = counter, now_s
        if counter != block.counter_after:
            self.wait_s = min(2 * self.wait_s, _LONGEST_WAIT_S)
            return False
        self.block = None
        self.follower.take(block.line.number, block.travel.ways)
        self.answered_line = block.line.number or self.answered_line
        return True

    def _read_next(self, device: Mdx40aDevice) -> ByteBlock | None:
        """Return the next block of the program; None at its end."""
        line = next(self._lines, None)
        if line is not None and not self._opened:
            self._opened = True
            self._lines = chain(self._begin_program(line), [line], self._lines)
            line = next(self._lines)
        if line is None:
            return None
        data = line.text + self._line_end
        if len(data) > MOST_BLOCK_BYTES:
            raise MachineError(
                Phrase(
                    "line {line} has {count} bytes; the mill is fed at most {most}",
                    line=line.number,
                    count=len(data),
                    most=MOST_BLOCK_BYTES,
                )
            )
        travel = self._read(line.text)
        if self.origin_mm is not None and not self._is_rml and _MOVES_FRAME.search(line.text):
            self.origin_mm, self.follower.lost, self.frame_left_at = None, True, line.number
        self._refuse_above_the_top(line, travel)
        self._counter = device.read_counter()
        after = (self._counter + len(data)) % COUNTER_MODULUS
        return ByteBlock(line=line, data=data, travel=travel, counter_after=after)

    def _send(self, device: Mdx40aDevice, block: ByteBlock) -> None:
        line, self.block = block.line, block
        device.write_block(block.data)
        self.wait_s = _FIRST_WAIT_S
        if line.number:
            self.sent_line, self.sent_offset = line.number, line.offset

    def _refuse_above_the_top(self, line: ProgramLine, travel: Travel) -> None:
        """Refuse moves above machine Z0, because the mill clips them: all that follows becomes rapids at Z0
        (rollingmill's notes).
        """
        if self.origin_mm is None or travel.highest_z_mm is None:
            return
        machine_z_mm = travel.highest_z_mm + self.origin_mm[2]
        if machine_z_mm > 0:
            raise MachineError(
                Phrase(
                    "line {line}: '{text}' lifts to machine Z {machine_z_mm:.3f} mm, above the top (0): the mill "
                    "would run all that follows as rapids; lower the safe Z or the stock",
                    line=line.number,
                    text=line.text.decode("latin-1"),
                    machine_z_mm=machine_z_mm,
                )
            )

    def _begin_program(self, first: ProgramLine) -> tuple[ProgramLine, ...]:
        """Begin NC code with % and O and eight digits, as required; a program read from the middle lacks them."""
        if self._is_rml or first.text[:1] in (b"%", b"("):
            return ()
        mark = ProgramLine(0, first.offset, b"%")
        return (mark,) if first.text[:1] == b"O" else (mark, ProgramLine(0, first.offset, b"O00000001"))
