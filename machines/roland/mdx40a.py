"""What the MDX-40A says and takes over its own USB link, as values of ours.

Source: rollingmill 0.1.0 (MIT), machine.py, usb.py and its docs (reverse engineered, run by its author on a real
MDX-40A). Bits of the 32-byte state block (GET 0x0100, big-endian) and of the ping word (GET 0x0001, little-endian).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Protocol

from machines.driver import Triple
from machines.errors import NotAllowedError
from machines.gcode.dialects import RML
from phrases.phrase import Phrase

STATE_BYTES = 32
DOOR, SPINDLE, COMMANDED, VIEW_LAMP = 0x1000_0000, 0x0800_0000, 0x0400_0000, 0x4000_0000
MOVING, ERROR, STATE_MASK, STATE_SHIFT = 0x0040_0000, 0x0000_1000, 0x0007_0000, 16
STATES = {0: "starting", 1: "homing", 2: "idle", 3: "moving", 4: "error"}
PING_ERROR = 0x0010_0000
COUNTER_MODULUS = 1 << 32
COMMAND_SETS = {0: "RML-1", 1: "NC code", 2: "selected automatically"}
_USER_SLOT, _EXOFS_SLOT, _G54_SLOT = 1, 2, 3


@dataclass(frozen=True, slots=True)
class DeviceState:
    """The state block: flags, machine position [mm], spindle target speed."""

    flags: int
    machine_mm: Triple
    spindle_rpm: int

    @property
    def door_open(self) -> bool:
        return bool(self.flags & DOOR)

    @property
    def view_lamp(self) -> bool:
        return bool(self.flags & VIEW_LAMP)

    @property
    def error(self) -> bool:
        return bool(self.flags & ERROR) or self.phase == "error"

    @property
    def moves(self) -> bool:
        return bool(self.flags & (MOVING | COMMANDED)) or self.phase in ("moving", "homing")

    @property
    def spindle_on(self) -> bool:
        return bool(self.flags & SPINDLE)

    @property
    def phase(self) -> str:
        return STATES.get((self.flags & STATE_MASK) >> STATE_SHIFT, "unknown")


def decode_state(block: bytes) -> DeviceState:
    """Return the state block of GET 0x0100; ValueError if it is too short to be one."""
    if len(block) < STATE_BYTES:
        raise ValueError(f"state block of {len(block)} bytes, {STATE_BYTES} expected")
    flags, x, y, z, _, rpm = struct.unpack_from(">I4iI", block)
    return DeviceState(flags, (x / 1000, y / 1000, z / 1000), rpm)


class Mdx40aDevice(Protocol):
    """The open mill. Every call may raise PortLostError; times are seconds of `clock`."""

    url: str

    def clock(self) -> float: ...
    def wait(self, timeout_s: float) -> None:
        """Let time pass; `wake` from any thread ends it."""
        ...

    def wake(self) -> None: ...
    def ping(self) -> int: ...
    def read_state(self) -> DeviceState: ...
    def read_counter(self) -> int:
        """Return bytes of program taken since power-up, modulo 2^32."""
        ...

    def begin_job(self) -> None: ...
    def end_job(self) -> None: ...
    def write_block(self, block: bytes) -> None: ...
    def stop_motion(self) -> None: ...
    def model(self) -> str: ...
    def command_set(self) -> int | None:
        """Return the key of COMMAND_SETS; None if it does not say."""
        ...

    def error_words(self) -> str: ...
    def origin_mm(self, slot: int) -> Triple | None:
        """Return the machine position of the origin of a work frame: 1 RML-1 user, 2 EXOFS, 3..8 G54..G59."""
        ...

    def set_feed_override(self, percent: int) -> None: ...
    def set_spindle_override(self, percent: int) -> None: ...
    def close(self) -> None: ...


def check_command_set(device: Mdx40aDevice, dialect: str) -> None:
    """Raise NotAllowedError where the mill reads the other language: that hangs it until it is switched off."""
    is_rml, found = dialect == RML, device.command_set()
    if found is not None and found == (1 if is_rml else 0):
        wanted = "RML-1" if is_rml else "NC code"
        raise NotAllowedError(
            Phrase(
                "the mill's command set is {found}, the program is {wanted}: set it to 'selected automatically' "
                "in the mill's setup",
                found=COMMAND_SETS[found],
                wanted=wanted,
            )
        )


def read_work_origin_mm(device: Mdx40aDevice, dialect: str) -> Triple | None:
    """Return the machine position of a program's zero; None where the mill does not say."""
    if dialect == RML:
        return device.origin_mm(_USER_SLOT)
    origin, extra = device.origin_mm(_G54_SLOT), device.origin_mm(_EXOFS_SLOT)
    if origin is None or extra is None:
        return None
    return (origin[0] + extra[0], origin[1] + extra[1], origin[2] + extra[2])


def to_work_mm(machine_mm: Triple, origin_mm: Triple | None) -> Triple | None:
    """Return a machine position in the work frame; None where its origin is not known."""
    if origin_mm is None:
        return None
    return (machine_mm[0] - origin_mm[0], machine_mm[1] - origin_mm[1], machine_mm[2] - origin_mm[2])
