"""Command sequences: a command as a generator that yields what to send or to wait for and gets the answer back.

One line at a time, the next only after the answer: settings and offsets are written to EEPROM, and while that is
written the controller hears nothing, so such lines must never be part of a counted stream.

Plates are touched only from above, or on the block's corner from above, from the left and from the front. Every move
has its own limit. The zeros of a corner are set in one line when all three touches are known, so a sequence that ends
before that changes none of them.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

from machines.driver import (
    CheckMode,
    Command,
    Home,
    Jog,
    ProbeCorner,
    ProbeZ,
    ReadSettings,
    SendBlock,
    SetZero,
    Spindle,
    Travel,
    Triple,
    Unlock,
)
from machines.grbl import replies
from machines.grbl.asking import (
    BLOCK_S,
    OFFSET_TAG,
    PARSER_TAG,
    PROBE_TAG,
    REPLY_S,
    VERSION_TAG,
    Answer,
    Ask,
    CommandSequence,
    Outcome,
    SequenceFailedError,
    WaitStill,
    ask_offsets,
    ask_twice,
    require_ok,
)
from machines.grbl.settings import ControllerSettings, read_settings
from machines.grbl.timeouts import SPINDLE_S, longest_homing_s
from phrases.phrase import Phrase

BACK_MM = 1.0  # from the fast touch to the start of the slow one
SLOW_MM_PER_MIN = 25.0
ARRIVED_MM = 0.02  # half a step of a coarse mill, and the digits of a report
APART_MM = 0.2  # between the two touches: a larger difference means that something else was touched
_Triple = Generator[Ask | WaitStill, Answer, Triple]
_Touch = Generator[Ask | WaitStill, Answer, tuple[Triple, bool]]
_Length = Generator[Ask | WaitStill, Answer, float]


def probe_z(command: ProbeZ, settings: ControllerSettings) -> CommandSequence:
    """Go down until contact; then set the zero so that the *contact point*, not the place after braking, has its Z."""
    contact_mm = yield from _keep_modes(_probe_height(command, settings))
    fresh, reported = yield from ask_offsets(settings)
    return Outcome({"contact_machine_mm": list(contact_mm), "offsets": reported}, fresh, vouched="Z")


def probe_corner(command: ProbeCorner, settings: ControllerSettings) -> CommandSequence:
    """Touch Z, X, Y of the plate, each fast, then slowly; then set their zeros at once, from where the tool stands."""
    contact_mm = yield from _keep_modes(_probe_corner(command, settings))
    fresh, reported = yield from ask_offsets(settings)
    return Outcome({"contact_machine_mm": list(contact_mm), "offsets": reported}, fresh, vouched="XYZ")


def _keep_modes(probing: _Triple) -> _Triple:
    """Restore the modes after probing, also after a failure. An alarm ends this sequence: see `leave_probing`."""
    modes = require_ok((yield Ask(b"$G", expect=PARSER_TAG)))
    restore = _words_to_restore(_parser_state(modes))
    try:
        contact_mm = yield from probing
    except SequenceFailedError:
        yield Ask(restore)  # the first failure is reported
        raise
    require_ok((yield Ask(restore)))
    return contact_mm


def leave_probing(modes: str) -> Generator[Ask | WaitStill, Answer, None]:
    """Leave the modes of a probe that ended in an alarm, when the controller takes lines again.

    G91 and G38 outlive alarm and unlocking: a line of axis words alone would probe from where the tool stands.
    modes : [GC:] words from before the probe
    """
    if any(word.startswith("G38") for word in _parser_state((yield Ask(b"$G", expect=PARSER_TAG))).split()):
        require_ok((yield Ask(_words_to_restore(modes))))


def _probe_height(command: ProbeZ, settings: ControllerSettings) -> _Triple:
    contact_mm = yield from _touch("Z", -abs(command.depth_mm), command.feed_mm_per_min, settings.unit_mm)
    height_mm = command.plate_mm + (yield from _stand())[2] - contact_mm[2]
    require_ok((yield Ask(f"G10L20P0Z{height_mm:.4f}".encode())))
    require_ok((yield Ask(f"G91G0Z{abs(command.retract_mm):.4f}".encode(), BLOCK_S)))
    require_ok((yield WaitStill()))
    return contact_mm


def _probe_corner(command: ProbeCorner, settings: ControllerSettings) -> _Triple:
    contact_mm = yield from _touch_corner(command, settings.unit_mm)
    zero_mm = find_zero_mm(command, contact_mm)
    at_mm = yield from _stand()
    words = "".join(f"{axis}{at - zero:.4f}" for axis, at, zero in zip("XYZ", at_mm, zero_mm, strict=True))
    require_ok((yield Ask(f"G21G10L20P0{words}".encode())))
    return contact_mm


def find_zero_mm(command: ProbeCorner, contact_mm: Triple) -> Triple:
    """Return the work zero in machine coordinates of a plate that was touched at these."""
    x, y, z = contact_mm
    inside_mm = command.cutter_radius_mm + command.margin_mm
    return x + inside_mm + command.wall_x_mm, y + inside_mm + command.wall_y_mm, z - command.plate_mm


def find_reached_mm(command: ProbeCorner, start_mm: Triple) -> tuple[tuple[float, float], ...]:
    """Return the least and greatest coordinate of each axis that the probing of a corner may reach from there."""
    x, y, z = start_mm
    lowest_mm = z - command.depth_mm - max(command.below_mm, BACK_MM)
    aside_mm = command.aside_mm
    return (x - aside_mm, x + BACK_MM), (y - aside_mm, y + BACK_MM), (lowest_mm, z + command.retract_mm)


def _touch_corner(command: ProbeCorner, unit_mm: float) -> _Triple:
    """Return where the plate was touched; the tool ends over the place where it began."""
    start_mm = yield from _stand()
    top_mm = yield from _touch_twice("Z", -command.depth_mm, command.feed_mm_per_min, unit_mm)
    over_mm, sides_mm = top_mm + command.retract_mm, []
    yield from _go("Z", over_mm)
    for axis, begun_mm in zip("XY", start_mm, strict=False):
        yield from _go(axis, begun_mm - command.aside_mm)
        yield from _lower(command, unit_mm)
        side_mm = yield from _touch_twice(axis, command.aside_mm, command.feed_mm_per_min, unit_mm)
        sides_mm.append(side_mm)
        yield from _go(axis, side_mm - BACK_MM)
        yield from _go("Z", over_mm)
        yield from _go(axis, begun_mm)
    return sides_mm[0], sides_mm[1], top_mm


def _lower(command: ProbeCorner, unit_mm: float) -> Generator[Ask | WaitStill, Answer, None]:
    """Go down beside the plate; a contact on the way down is not the plate's side."""
    down_mm = -command.retract_mm - command.below_mm
    _, touched = yield from _probe("G38.3", "Z", down_mm, command.feed_mm_per_min, unit_mm)
    if touched:
        raise SequenceFailedError(
            Phrase(
                "the tool touched on its way down beside the plate: begin nearer to the corner, or go further "
                "aside; no zero is set"
            )
        )


def _touch_twice(axis: str, by_mm: float, feed_mm_per_min: float, unit_mm: float) -> _Length:
    """Return the machine coordinate of the contact, the second, slower one."""
    back_mm, k = (BACK_MM if by_mm > 0.0 else -BACK_MM), "XYZ".index(axis)
    fast_mm = (yield from _touch(axis, by_mm, feed_mm_per_min, unit_mm))[k]
    yield from _go(axis, fast_mm - back_mm)
    slow_mm = (yield from _touch(axis, 2.0 * back_mm, min(feed_mm_per_min, SLOW_MM_PER_MIN), unit_mm))[k]
    if abs(slow_mm - fast_mm) > APART_MM:
        raise SequenceFailedError(
            Phrase(
                "{axis} was touched at {fast_mm:.3f} and at {slow_mm:.3f} mm: no zero is set",
                axis=axis,
                fast_mm=fast_mm,
                slow_mm=slow_mm,
            )
        )
    return slow_mm


def _touch(axis: str, by_mm: float, feed_mm_per_min: float, unit_mm: float) -> _Triple:
    """Return where the probe has touched, in machine coordinates."""
    contact_mm, touched = yield from _probe("G38.2", axis, by_mm, feed_mm_per_min, unit_mm)
    if not touched:
        raise SequenceFailedError(Phrase("the probe did not touch: no zero is set"))
    return contact_mm


def _probe(code: str, axis: str, by_mm: float, feed_mm_per_min: float, unit_mm: float) -> _Touch:
    seconds = 20.0 + 3.0 * abs(by_mm) / feed_mm_per_min * 60.0
    line = f"G21G91{code}{axis}{by_mm:.4f}F{feed_mm_per_min:.1f}"
    return _read_probe(require_ok((yield Ask(line.encode(), seconds, PROBE_TAG))), unit_mm)


def _go(axis: str, to_mm: float) -> Generator[Ask | WaitStill, Answer, None]:
    """Go straight to a machine coordinate, and wait for standstill."""
    require_ok((yield Ask(f"G21G90G53G0{axis}{to_mm:.4f}".encode(), BLOCK_S)))
    require_ok((yield WaitStill()))


def _stand() -> _Triple:
    """Return the position of the standing mill in machine coordinates."""
    still = require_ok((yield WaitStill()))
    if still.machine_mm is None:
        raise SequenceFailedError(Phrase("the controller reports no machine position: no zero is set"))
    return still.machine_mm


def _parser_state(answer: Answer) -> str:
    """Return the words of [GC:]; "" if it did not come."""
    return read_settings(answer.heard).parser_state


def _words_to_restore(parser_state: str) -> bytes:
    """Return a line that restores units and distance mode, as [GC:] reported them, and ends probing."""
    words = parser_state.split()
    return ("G0" + ("G20" if "G20" in words else "G21") + ("G91" if "G91" in words else "G90")).encode()


def _read_probe(answer: Answer, unit_mm: float) -> tuple[Triple, bool]:
    """Return where a probing move has ended, and whether by a contact."""
    for reply in answer.heard:
        if isinstance(reply, replies.Push) and reply.tag == PROBE_TAG:
            place, _, success = reply.body.rpartition(":")
            try:
                x, y, z = (float(part) * unit_mm for part in place.split(",")[:3])
            except ValueError:
                break
            return (x, y, z), success == "1"
    raise SequenceFailedError(Phrase("the controller does not tell where the probe touched: no zero is set"))


def identify(banner: str) -> CommandSequence:
    """Query $I, $$, $#, $G: the controller's identity and settings. Moves nothing, changes nothing."""
    heard: list[replies.Reply] = []
    version = Answer(Phrase("not asked"))
    for _ in range(3):
        # A line half sent by someone before us may be in the controller's reader: '$' makes it an error, not a motion.
        version = yield Ask(b"$I", expect=VERSION_TAG)
        if not version.failure:
            break
    heard += version.heard
    settings = yield from ask_twice(b"$$", "$")
    if version.failure and not settings:
        raise SequenceFailedError(Phrase("neither $I nor $$ is answered ({failure})", failure=version.failure))
    if commas := next((one for one in settings if isinstance(one, replies.Setting) and one.has_comma), None):
        text = f"${commas.number}={commas.value}"
        raise SequenceFailedError(Phrase("settings are written with decimal commas ({setting})", setting=text))
    heard += settings
    heard += yield from ask_twice(b"$#", OFFSET_TAG)
    heard += yield from ask_twice(b"$G", PARSER_TAG)
    found = read_settings(heard, banner)
    return Outcome(settings=found, answer=describe_settings(found))


def read_again(settings: ControllerSettings) -> CommandSequence:
    """Query again what may have changed since the handshake: $$, $#, $G."""
    heard = [*(yield from ask_twice(b"$$", "$")), *(yield from ask_twice(b"$#", OFFSET_TAG))]
    heard += yield from ask_twice(b"$G", PARSER_TAG)
    reported = read_settings(heard)
    found = replace(settings, values=reported.values, offsets=reported.offsets, parser_state=reported.parser_state)
    return Outcome(settings=found, answer=describe_settings(found))


def describe_settings(settings: ControllerSettings) -> dict[str, object]:
    """Return settings as plain data, for CommandDone."""
    return {
        "settings": settings.to_dict(),
        "offsets": {name: list(value) for name, value in settings.offsets.items()},
        "parser_state": settings.parser_state,
    }


def home(settings: ControllerSettings, modes: str) -> CommandSequence:
    yield Ask(b"$G", expect=PARSER_TAG)  # a probe's `ok` comes half a second behind its alarm: it is not the one of $H
    require_ok((yield Ask(b"$H", longest_homing_s(settings))))
    require_ok((yield WaitStill(REPLY_S)))
    yield from leave_probing(modes)
    return Outcome(vouched="XYZ")


def unlock(modes: str) -> CommandSequence:
    require_ok((yield Ask(b"$X")))
    yield from leave_probing(modes)
    return Outcome()


def ask_once(text: bytes, timeout_s: float = REPLY_S) -> CommandSequence:
    require_ok((yield Ask(text, timeout_s)))
    return Outcome()


def jog(command: Jog, settings: ControllerSettings) -> CommandSequence:
    axes = "".join(f"{axis}{value:.4f}" for axis, value in zip("XYZ", command.by_mm, strict=True) if value)
    if not axes:
        return Outcome()
    length_mm = sum(value * value for value in command.by_mm) ** 0.5
    require_ok((yield Ask(f"$J=G91G21{axes}F{command.feed_mm_per_min:.1f}".encode())))
    slowest = min((command.feed_mm_per_min, *(settings.max_rate_mm_per_min or (500.0,))))
    require_ok((yield WaitStill(10.0 + 3.0 * length_mm / max(slowest, 1.0) * 60.0)))
    return Outcome()


def travel(command: Travel, settings: ControllerSettings) -> CommandSequence:
    """Jog along each leg in machine coordinates, and compare the place where the mill then stands."""
    for leg in command.legs:
        axes = "".join(f"{axis}{value:.4f}" for axis, value in zip("XYZ", leg.to_mm, strict=True))
        require_ok((yield Ask(f"$J=G90G53G21{axes}F{leg.feed_mm_per_min:.1f}".encode())))
        at_mm = require_ok((yield WaitStill(_longest_s(settings, leg.feed_mm_per_min)))).machine_mm
        if at_mm is None or any(abs(at - to) > ARRIVED_MM for at, to in zip(at_mm, leg.to_mm, strict=True)):
            raise SequenceFailedError(Phrase("ended on the way; the rest of it is left out"))
    return Outcome()


def _longest_s(settings: ControllerSettings, feed_mm_per_min: float) -> float:
    """Return a time within which any way through the travel ends at this feed."""
    length_mm = sum(mm * mm for mm in settings.travel_mm or (1000.0,) * 3) ** 0.5
    slowest = min((feed_mm_per_min, *(settings.max_rate_mm_per_min or (500.0,))))
    return 10.0 + 3.0 * length_mm / max(slowest, 1.0) * 60.0


def set_zero(command: SetZero, settings: ControllerSettings) -> CommandSequence:
    words = "".join(f"{axis}0" for axis in command.axes)
    require_ok((yield Ask(f"G10L20P0{words}".encode())))
    fresh, reported = yield from ask_offsets(settings)
    return Outcome({"offsets": reported}, fresh, vouched=command.axes)


def send_block(command: SendBlock, settings: ControllerSettings) -> CommandSequence:
    text = command.text.strip().encode("ascii")
    answer = require_ok((yield Ask(text, BLOCK_S)))
    if not text.startswith(b"$"):
        require_ok((yield WaitStill()))
    heard = [*answer.heard]
    again = yield from identify(settings.version) if text.startswith(b"$") else _modal_again(settings)
    return Outcome(answer={"heard": [str(reply) for reply in heard]}, settings=again.settings)


def _modal_again(settings: ControllerSettings) -> CommandSequence:
    fresh, _ = yield from ask_offsets(settings)
    reported = read_settings((yield from ask_twice(b"$G", PARSER_TAG))).parser_state
    return Outcome(settings=replace(fresh, parser_state=reported or fresh.parser_state))


def make_sequence(command: Command, settings: ControllerSettings, modes: str) -> CommandSequence:
    """Return the sequence that carries out a command. A realtime byte or a note needs none.

    modes : the last known [GC:] words
    """
    match command:
        case Home():
            return home(settings, modes)
        case Unlock():
            return unlock(modes)
        case ReadSettings():
            return read_again(settings)
        case Jog():
            return jog(command, settings)
        case Travel():
            return travel(command, settings)
        case ProbeZ():
            return probe_z(command, settings)
        case ProbeCorner():
            return probe_corner(command, settings)
        case SetZero():
            return set_zero(command, settings)
        case CheckMode():
            return ask_once(b"$C")  # a toggle; off ends in a soft reset of the controller's own, with a banner
        case Spindle(rpm=rpm):
            return ask_once(b"M5" if rpm is None else f"M3S{rpm:.0f}".encode(), REPLY_S + SPINDLE_S)
        case SendBlock():
            return send_block(command, settings)
        case _:
            raise AssertionError(f"{type(command).__name__} has no sequence")
