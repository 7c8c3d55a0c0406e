"""Decides which command is allowed in which state. Refusals name the command, the state and the remedy."""

from __future__ import annotations

from machines.driver import (
    CheckMode,
    Command,
    Home,
    Jog,
    JogCancel,
    MillState,
    Override,
    ProbeCorner,
    ProbeZ,
    ReadSettings,
    Reset,
    SendBlock,
    SetZero,
    Spindle,
    Travel,
    Triple,
    TrustPosition,
    Unlock,
)
from machines.errors import MillCode, NotAllowedError, WrongStateError
from machines.grbl.commands import find_refusal
from machines.grbl.sequences import find_reached_mm
from machines.grbl.settings import ControllerSettings
from machines.grbl.states import Phase
from machines.grbl.streaming import PLAIN
from phrases.phrase import Phrase

_REPORTED_MM = 0.01  # half a step and the digits of a report
_IDLE = frozenset({MillState.IDLE})
_STANDING = frozenset(
    {MillState.IDLE, MillState.ALARM, MillState.HELD, MillState.CHECK, MillState.SLEEP, MillState.DOOR}
)
_LINKED = frozenset(MillState) - {MillState.DISCONNECTED, MillState.CONNECTING}
ALLOWED: dict[type, frozenset[MillState]] = {
    Home: frozenset({MillState.IDLE, MillState.ALARM}),
    Unlock: frozenset({MillState.IDLE, MillState.ALARM}),
    Reset: _STANDING,
    Jog: _IDLE,
    Travel: _IDLE,
    JogCancel: _LINKED,
    ProbeZ: _IDLE,
    ProbeCorner: _IDLE,
    SetZero: _IDLE,
    TrustPosition: _IDLE | {MillState.HELD},
    Override: _LINKED - {MillState.HOMING, MillState.SLEEP},
    CheckMode: frozenset({MillState.IDLE, MillState.CHECK}),
    ReadSettings: frozenset({MillState.IDLE, MillState.ALARM}),
    Spindle: _IDLE,
    SendBlock: _IDLE,
}
# These are allowed alongside a command under way; all others need the link to themselves.
_BESIDE = (JogCancel, Override, TrustPosition)


def check_command(
    command: Command,
    state: MillState,
    phase: Phase,
    settings: ControllerSettings,
    *,
    machine_mm: Triple | None,
    trusted: bool,
    silent: bool,
) -> None:
    """Raise NotAllowedError unless the command may be carried out now.

    machine_mm, trusted : the mill's position, and whether it is trusted
    silent              : nothing answers, so a person may send a reset
    """
    name = "Line" if isinstance(command, SendBlock) else type(command).__name__
    if silent and isinstance(command, Reset):
        return
    allowed = ALLOWED[type(command)]
    if state not in allowed:
        states = ", ".join(sorted(one.value for one in allowed))
        words = f"{name}: the mill is {state.value}; allowed when {states}"
        raise WrongStateError(words, MillCode.MILL_STATE, state)
    if phase is Phase.STREAMING and isinstance(command, Reset):
        raise NotAllowedError(Phrase("Reset: a program is running; abort it"))
    sleeping = isinstance(command, Reset) and phase is Phase.HAILING
    if not isinstance(command, _BESIDE) and not sleeping:
        _require_ready(name, phase)
    if isinstance(command, SendBlock) and not _is_plain(command.text):
        words = f"{name}: '{command.text}' is not a plain block"
        raise NotAllowedError(words, code=MillCode.NO_BLOCK, values={"text": command.text})
    if refusal := _values(command, settings, machine_mm, trusted=trusted):
        raise NotAllowedError(Phrase("{command}: {refusal}", command=name, refusal=refusal))


def _require_ready(name: str, phase: Phase) -> None:
    if phase is not Phase.READY:
        raise NotAllowedError(
            Phrase("{name}: the link is busy ({phase}); wait until it is done", name=name, phase=phase.value)
        )


def check_start(state: MillState, phase: Phase, settings: ControllerSettings) -> None:
    """Raise NotAllowedError unless a program may start now."""
    if state not in (MillState.IDLE, MillState.CHECK):
        raise NotAllowedError(Phrase("start: the mill is {state}, it must be idle", state=state.words))
    _require_ready("start", phase)
    if settings.laser_mode:
        raise NotAllowedError(
            Phrase(
                "start: laser mode is on ($32=1): the spindle would stop whenever the mill stands still, and the "
                "next cut would begin with it off; send '$32=0' to mill"
            )
        )


def _values(
    command: Command, settings: ControllerSettings, machine_mm: Triple | None, *, trusted: bool
) -> Phrase | None:
    if isinstance(command, Override):
        return find_refusal(command.what, command.percent)
    if isinstance(command, Home) and settings.homing is False:
        return Phrase("homing is switched off ($22=0); set the zero by hand")
    if isinstance(command, SetZero):
        axes = command.axes
        if axes and not set(axes) - set("XYZ") and len(set(axes)) == len(axes):
            return None
        return Phrase("axes '{axes}'; allowed: X, Y, Z", axes=axes)
    if isinstance(command, Jog):
        if not 0.0 < command.feed_mm_per_min <= 100_000.0:
            return Phrase("feed {feed_mm_per_min} mm/min: above 0", feed_mm_per_min=command.feed_mm_per_min)
        return _jog(command.by_mm, settings, machine_mm) if settings.homing and trusted else None
    if isinstance(command, Travel):
        return _travel(command, settings, machine_mm)
    if isinstance(command, Spindle) and command.rpm is not None and settings.laser_mode:
        return Phrase("laser mode is on ($32=1): the spindle would not turn while the mill stands still")
    if isinstance(command, ProbeZ):
        return _probe(command)
    if isinstance(command, ProbeCorner):
        return _corner(command, settings, machine_mm)
    return _block(command.text) if isinstance(command, SendBlock) else None


def _travel(command: Travel, settings: ControllerSettings, machine_mm: Triple | None) -> Phrase | None:
    """Refuse a way with a place outside the travel, before its first leg."""
    if not (settings.homing or settings.soft_limits) or machine_mm is None:
        return None
    for leg in command.legs:
        x_mm, y_mm, z_mm = (to - at for to, at in zip(leg.to_mm, machine_mm, strict=True))
        if refusal := _jog((x_mm, y_mm, z_mm), settings, machine_mm):
            return refusal
    return None


def _jog(by_mm: Triple, settings: ControllerSettings, machine_mm: Triple | None) -> Phrase | None:
    """Refuse a jog of a homed mill that ends outside its travel: with $20=0 the controller itself would not.

    A mill that is already outside, by a pull-off or by hand, may come back.
    """
    if settings.reach_mm is None or machine_mm is None:
        return None
    for name, at, by, (low, high) in zip("XYZ", machine_mm, by_mm, settings.reach_mm, strict=True):
        end = at + by
        beyond_mm = max(low - end, end - high)
        if beyond_mm > _REPORTED_MM and beyond_mm > max(low - at, at - high):
            return Phrase(
                "{axis} would go to {end_mm:.3f} mm in machine coordinates; the machine reaches {low_mm:g} to "
                "{high_mm:g}",
                axis=name,
                end_mm=end,
                low_mm=low,
                high_mm=high,
            )
    return None


def _probe(command: ProbeZ) -> Phrase | None:
    if not 0.0 < command.depth_mm <= 200.0:
        return Phrase("depth {depth_mm} mm: above 0, at most 200", depth_mm=command.depth_mm)
    if not 0.0 < command.feed_mm_per_min <= 2000.0:
        return Phrase("feed {feed_mm_per_min} mm/min: above 0, at most 2000", feed_mm_per_min=command.feed_mm_per_min)
    if 0.0 <= command.retract_mm <= 200.0:
        return None
    return Phrase("retract {retract_mm} mm: from 0 to 200", retract_mm=command.retract_mm)


def _corner(command: ProbeCorner, settings: ControllerSettings, machine_mm: Triple | None) -> Phrase | None:
    radius_mm = command.cutter_radius_mm
    if min(command.below_mm, command.aside_mm) <= radius_mm:
        return Phrase(
            "a cutter of radius {radius_mm:g} mm touches with its side only when it goes further down and further "
            "aside than its radius",
            radius_mm=radius_mm,
        )
    reach_mm = settings.reach_mm if settings.homing or settings.soft_limits else None
    if reach_mm is None or machine_mm is None:
        return None
    for name, (least, most), (low, high) in zip("XYZ", find_reached_mm(command, machine_mm), reach_mm, strict=True):
        if least < low or most > high:
            return Phrase(
                "{axis} might go from {least_mm:.3f} to {most_mm:.3f} mm in machine coordinates; the machine reaches "
                "{low_mm:g} to {high_mm:g}",
                axis=name,
                least_mm=least,
                most_mm=most,
                low_mm=low,
                high_mm=high,
            )
    return None


def _is_plain(text: str) -> bool:
    data = text.strip().encode("ascii", "replace")
    return text.isascii() and data != b"" and data.translate(None, PLAIN) == b""


def _block(text: str) -> Phrase | None:
    data = text.strip().encode("ascii")
    if len(data) > 78:
        return Phrase("{count} characters; at most 78", count=len(data))
    first = data.replace(b" ", b"").upper()
    if first.startswith((b"$H", b"$C", b"$J", b"$X", b"$SLP")):
        return Phrase("'{text}': use its own command instead", text=text)
    return None
