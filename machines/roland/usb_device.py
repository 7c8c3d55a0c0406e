"""The MDX-40A through the `rollingmill` library (extra [roland]), as the device that usb_driver works with.

State, ping, counter, job bracket and program bytes go straight to the library's transfers: its machine class swallows
link errors in these and logs every block. One-time queries (command set, origins, error text) go through the machine
class.

The mill's answers are decoded into our own types. Source: rollingmill 0.1.0 (MIT), machine.py, usb.py and its docs
(reverse engineered, run by its author on a real MDX-40A). Bits of the 32-byte state block (GET 0x0100, big-endian) and
of the ping word (GET 0x0001, little-endian).
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from machines.clock import make_running_clock
from machines.driver import Triple
from machines.errors import NotAControllerError, NotAllowedError, PortError, PortLostError
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
        """Wait; `wake` from any thread ends the wait."""
        ...

    def wake(self) -> None: ...
    def ping(self) -> int: ...
    def read_state(self) -> DeviceState: ...
    def read_counter(self) -> int:
        """Return the number of program bytes taken since power-up, modulo 2^32."""
        ...

    def begin_job(self) -> None: ...
    def end_job(self) -> None: ...
    def write_block(self, block: bytes) -> None: ...
    def stop_motion(self) -> None: ...
    def model(self) -> str: ...
    def command_set(self) -> int | None:
        """Return the key of COMMAND_SETS; None if the mill does not report it."""
        ...

    def error_words(self) -> str: ...
    def origin_mm(self, slot: int) -> Triple | None:
        """Return the machine position of the origin of a work frame: 1 RML-1 user, 2 EXOFS, 3..8 G54..G59."""
        ...

    def set_feed_override(self, percent: int) -> None: ...
    def set_spindle_override(self, percent: int) -> None: ...
    def close(self) -> None: ...


def check_command_set(device: Mdx40aDevice, dialect: str) -> None:
    """Raise NotAllowedError if the mill reads the other language: such a program hangs it until it is switched off."""
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
    """Return the machine position of a program's zero; None if the mill does not report it."""
    if dialect == RML:
        return device.origin_mm(_USER_SLOT)
    origin, extra = device.origin_mm(_G54_SLOT), device.origin_mm(_EXOFS_SLOT)
    if origin is None or extra is None:
        return None
    return (origin[0] + extra[0], origin[1] + extra[1], origin[2] + extra[2])


def to_work_mm(machine_mm: Triple, origin_mm: Triple | None) -> Triple | None:
    """Return a machine position in the work frame; None if its origin is not known."""
    if origin_mm is None:
        return None
    return (machine_mm[0] - origin_mm[0], machine_mm[1] - origin_mm[1], machine_mm[2] - origin_mm[2])


URL = "usb:mdx-40a"
_PING, _STATE, _COUNTER, _KEEPALIVE, _BRACKET, _STOP = 0x0001, 0x0100, 0x0200, 0x03F5, 0x1109, 0x03F3
_READ_TRIES = 3
T = TypeVar("T")


class Link(Protocol):
    """Transfers of the library's link: vendor control out and in, bulk out."""

    def vend_set(self, wValue: int, data: bytes = b"") -> None: ...
    def vend_get(self, wValue: int, length: int) -> bytes: ...
    def bulk_write(self, data: bytes) -> int: ...
    def release(self) -> None: ...


class RollingmillDevice:
    """machines.roland.usb_device.Mdx40aDevice. `machine` is rollingmill's MDX40A on the same link."""

    def __init__(
        self,
        link: Link,
        machine: Any,
        *,
        link_errors: tuple[type[Exception], ...],
        clock: Callable[[], float] | None = None,
        wait: Callable[[float], None] | None = None,
    ) -> None:
        self.url = URL
        self._link = link
        self._machine = machine
        self._errors = link_errors
        self._clock = clock or make_running_clock()
        self._woken = threading.Event()
        self._wait = wait or self._wait_really

    def clock(self) -> float:
        return self._clock()

    def wait(self, timeout_s: float) -> None:
        self._wait(timeout_s)

    def wake(self) -> None:
        self._woken.set()

    def ping(self) -> int:
        return int(struct.unpack("<I", self._get(_PING, 4))[0])

    def read_state(self) -> DeviceState:
        self._do(lambda: self._link.vend_set(_KEEPALIVE, b"\0"))
        return decode_state(self._get(_STATE, STATE_BYTES))

    def read_counter(self) -> int:
        return int(struct.unpack(">I", self._get(_COUNTER, 4))[0])

    def begin_job(self) -> None:
        self._do(lambda: self._link.vend_set(_BRACKET, b"\x00"))

    def end_job(self) -> None:
        self._do(lambda: self._link.vend_set(_BRACKET, b"\xff"))

    def write_block(self, block: bytes) -> None:
        written = self._do(lambda: self._link.bulk_write(block))
        if written != len(block):
            raise PortLostError(
                self.url,
                Phrase("the mill took {written} of {count} bytes of a block", written=written, count=len(block)),
            )

    def stop_motion(self) -> None:
        self._do(lambda: self._link.vend_set(_STOP))

    def model(self) -> str:
        return str(self._machine.firmware_id or "MDX-40A")

    def command_set(self) -> int | None:
        found = self._machine.query_command_set()
        return None if found is None else int(found)

    def error_words(self) -> str:
        return str(self._machine.error_message(self._machine.read_error_status()))

    def origin_mm(self, slot: int) -> Triple | None:
        try:
            origin = self._do(lambda: self._machine.get_wcs_origin(slot))
        except ValueError:  # the library's word for "no answer in time"
            return None
        return None if origin is None else (float(origin[0]), float(origin[1]), float(origin[2]))

    def set_feed_override(self, percent: int) -> None:
        self._machine.set_cutting_feed(percent)

    def set_spindle_override(self, percent: int) -> None:
        self._machine.set_spindle_override(percent)

    def close(self) -> None:
        self._link.release()

    def _get(self, register: int, length: int) -> bytes:
        for _ in range(_READ_TRIES):
            data = self._do(lambda: self._link.vend_get(register, length))
            if len(data) >= length:
                return data
        raise PortLostError(
            self.url,
            Phrase(
                "register 0x{register:04x} answers {count} of {wanted} bytes",
                register=register,
                count=len(data),
                wanted=length,
            ),
        )

    def _do(self, transfer: Callable[[], T]) -> T:
        try:
            return transfer()
        except self._errors as error:
            raise PortLostError(self.url, f"{error}") from error

    def _wait_really(self, timeout_s: float) -> None:
        self._woken.wait(timeout_s)
        self._woken.clear()


def open_mdx40a(url: str | None = None) -> RollingmillDevice:
    """Find and open the mill on the USB bus. `url`, if given, must be "usb:mdx-40a": there is one mill per host."""
    if url not in (None, "", URL, "usb:"):
        raise PortError(
            url, Phrase("the MDX-40A is found by its USB identity: leave the port out or say {url}", url=URL)
        )
    try:
        import usb.core  # type: ignore[import-untyped]
        from rollingmill.machine import MDX40A  # type: ignore[import-untyped]
        from rollingmill.usb import MdxUSB  # type: ignore[import-untyped]
    except ImportError as error:
        raise PortError(URL, Phrase("the USB library is not installed: pip install causticmill[roland]")) from error
    try:
        link = MdxUSB.discover()
    except usb.core.NoBackendError as error:
        raise PortError(URL, Phrase("no libusb on this computer: install the system package libusb-1.0")) from error
    except usb.core.USBError as error:
        raise PortError(
            URL, Phrase("{error}: busy with another program, or no right to use it (udev rule)", error=error)
        ) from error
    except RuntimeError as error:
        raise PortError(URL, Phrase("no MDX-40A on USB: switched on, cable in? ({error})", error=error)) from error
    try:
        return RollingmillDevice(link, MDX40A(link), link_errors=(usb.core.USBError,))
    except (RuntimeError, ValueError, usb.core.USBError) as error:
        link.release()
        raise NotAControllerError(URL, Phrase("does not answer as an MDX-40A does: {error}", error=error)) from error
