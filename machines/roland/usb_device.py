"""The MDX-40A through the `rollingmill` library (extra [roland]), as the device that usb_driver works with.

State, ping, counter, job bracket and program bytes go straight to the library's transfers: its machine class swallows
errors of the link there and logs every block. What is asked once (command set, origins, error text) goes through it.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from machines.clock import make_running_clock
from machines.driver import Triple
from machines.errors import NotAControllerError, PortError, PortLostError
from machines.roland.mdx40a import STATE_BYTES, DeviceState, decode_state
from phrases.phrase import Phrase

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
    """machines.roland.mdx40a.Mdx40aDevice. `machine` is rollingmill's MDX40A on the same link."""

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
