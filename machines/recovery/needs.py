"""Needs that must be met before a run can go on: a link, standstill, a trusted position, the same work zero."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from machines.driver import MillState, MillStatus
from machines.errors import MillCode
from machines.grbl.view import has_kept_count
from machines.recovery.entry import EntryPoint
from machines.recovery.plan_model import Need, Present
from phrases.phrase import Phrase

_FRAMES = ("G54", "G55", "G56", "G57", "G58", "G59")
OFFSET_TOLERANCE_MM = 0.0015  # offsets are reported with three decimals
_PLACE_MM = (
    0.004  # a place is reported with three decimals, in inch with four, and may have been in the other unit before
)


DOUBTS = {  # why machine coordinates may have changed since the run was cut
    "restarted": Phrase("the controller has restarted since the run stopped, its position is lost"),
    "unconfirmed": Phrase("nobody had confirmed the position when the run stopped"),
    "settings": Phrase("settings that define the position have changed since the run stopped"),
    "unseen": Phrase("the controller may have restarted while the link was lost"),
}
_MOVES = (MillState.RUN, MillState.HOLDING, MillState.JOG, MillState.HOMING)


def needs_of_standing_mill(status: MillStatus) -> Iterator[Need]:
    """Return what prevents a mill from taking any program: at most one need."""
    state = status.state
    values = {"state": state.value}
    if state in (MillState.DISCONNECTED, MillState.CONNECTING):
        yield Need(
            MillCode.CONNECT,
            Phrase("the mill is {state}: connect it; connecting moves nothing", state=state.words),
            values,
        )
    elif state is MillState.ALARM:
        yield Need(
            MillCode.UNLOCK,
            Phrase(
                "the mill is locked ({detail}): home it, which finds its position, or unlock it",
                detail=status.detail or Phrase("alarm"),
            ),
            {"alarm": status.alarm},
        )
    elif state in _MOVES:
        words = Phrase("the mill is {state}: wait until that has ended, or hold it", state=state.words)
        yield Need(MillCode.WAIT, words, values)
    elif state is not MillState.IDLE:
        words = Phrase(
            "the mill is {state} and may hold unfinished blocks: reset it, which clears them and, from standstill, "
            "keeps the position",
            state=state.words,
        )
        yield Need(MillCode.STAND_STILL, words, values)


def find_needs(record: Mapping[str, Any], present: Present) -> Iterator[Need]:
    status = present.status
    yield from needs_of_standing_mill(status)
    if status.state in (MillState.DISCONNECTED, MillState.CONNECTING):
        return
    if status.machine_mm is None and status.state is not MillState.IDLE:
        return  # a held controller does not state the unit of its reports: the position is known after the reset
    if status.state is MillState.IDLE and status.work_mm is None:
        words = Phrase("the mill has not reported its position yet: wait a second")
        yield Need(MillCode.CONNECT, words, {"state": status.state.value})
    if changes := ", ".join(present.frame_changes):
        words = Phrase(
            "settings that define the position have changed since the part was cut ({settings}): put them back and "
            "home the mill, or, if you know that the position is right, confirm it (trust position)",
            settings=changes,
        )
        yield Need(MillCode.POSITION, words, {"doubt": "settings", "settings": changes})
    elif doubt := position_doubt(record, present):
        words = Phrase(
            "{doubt}: home the mill, or touch off again at the same points of the part (zero of X, Y, Z), or, if "
            "you know that the position is right, confirm it (trust position)",
            doubt=DOUBTS[doubt],
        )
        yield Need(MillCode.POSITION, words, {"doubt": doubt})


def position_doubt(record: Mapping[str, Any], present: Present) -> str:
    """Return the key in DOUBTS that applies; "" if machine coordinates are the same as when the run was cut.

    Every link is judged here alike, old or new. Either of two facts proves that a controller has kept its count while
    unattended: its feed or spindle is still set, or it stands where it was left. If settings of the frame have changed,
    there is doubt even after homing, because the part was cut with the old ones.
    """
    if present.frame_changes:
        return "settings"
    status = present.status
    if status.position_trusted:
        return ""
    if present.restarted:
        return "restarted"
    if record.get("reframed"):
        return "settings"
    if not record.get("position_trusted"):
        return "unconfirmed"
    left_mm = record.get("stood_mm") or record.get("machine_mm")
    if has_kept_count(left_mm, status.machine_mm, _PLACE_MM) or never_restarted(
        present.parser_state, record.get("state_before")
    ):
        return ""
    return "unseen"


def never_restarted(parser_state: str | None, at_start: str | None = None) -> bool:
    """Return the modes that prove that there was no restart: a restart clears feed, speed and spindle ($G: M5 F0 S0),
    so a value that the program has set shows that none happened.

    at_start : $G before the program, when it was first started. A value that was there already proves nothing: start-up
    blocks ($N0) may have set it.
    """
    before = (at_start or "").split()
    words = [word for word in (parser_state or "").split() if word not in before]
    return any(word in ("M3", "M4") or (word[0] == "F" and _number(word[1:]) > 0.0) for word in words)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def compare_offsets(
    record: Mapping[str, Any], present: Present, entry: EntryPoint | None
) -> tuple[tuple[Phrase, ...], tuple[Need, ...]]:
    """Return offsets then and now: each difference in words, and whether one of them moves this program."""
    then: Mapping[str, Sequence[float]] = record.get("offsets") or {}
    if not then or present.offsets is None:
        return (), ()
    used = {entry.state.wcs if entry else "G54", "G92", "TLO"}
    words, moving = [], []
    for name in sorted(then):
        was, now = then[name], present.offsets.get(name)
        if now is None:
            words.append(
                Phrase("{name} was {was_mm}, the controller does not report it now", name=name, was_mm=axes_words(was))
            )
            axes = "XYZ"
        else:
            pairs = zip("XYZ", was, now, strict=False)
            axes = "".join(axis for axis, a, b in pairs if abs(a - b) > OFFSET_TOLERANCE_MM)
            if not axes:
                continue
            words.append(
                Phrase("{name} was {was_mm}, is {now_mm}", name=name, was_mm=axes_words(was), now_mm=axes_words(now))
            )
        if name in used and set(axes) - set(present.vouched_axes):
            moving.append(name)
    if not moving:
        return tuple(words), ()
    need = Phrase(
        "{names} differs from when the program was cut: restore it (G10 L2, G92, G43.1), or touch off again at the "
        "same points of the part",
        names=", ".join(moving),
    )
    return tuple(words), (Need(MillCode.ZERO, need),)


def zero_back(record: Mapping[str, Any], present: Present, entry: EntryPoint | None) -> str:
    """Return the block that restores the work zero of this program; "" if it has not changed, or is not certain.

    Machine coordinates are the same as then only if the mill was homed then and is homed now.
    """
    wcs = entry.state.wcs if entry else "G54"
    then, now = (record.get("offsets") or {}).get(wcs), (present.offsets or {}).get(wcs)
    certain = record.get("homed") and present.homed and present.status.position_trusted
    if not certain or then is None or now is None:
        return ""
    if wcs not in _FRAMES or all(abs(a - b) <= OFFSET_TOLERANCE_MM for a, b in zip(then, now, strict=False)):
        return ""
    return f"G10 L2 P{_FRAMES.index(wcs) + 1} {axes_words(then)}"


def axes_words(values: Sequence[float]) -> str:
    return " ".join(f"{axis}{value:.3f}" for axis, value in zip("XYZ", values, strict=False))
