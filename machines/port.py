"""Byte streams to a mill: serial ports by device or stable id, and pyserial's URLs (socket://, rfc2217://, loop://).

The only module that imports pyserial. Opening must not move or reset anything: DTR and RTS are set to their resting
level before the port is opened and never touched again, and HUPCL is taken off so that closing does not drop them. Most
Arduinos still reset on the first opening after plugging in; the banner shows it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import select
import threading
import time
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from machines.clock import make_running_clock
from machines.errors import PortError, PortLostError
from machines.profile import LinkSettings
from phrases.phrase import Phrase

BY_ID = Path("/dev/serial/by-id")
READ_BYTES = 4096
_SLICE_S = 0.02  # polling interval of a line that select() does not support
_GATHER_S = 0.005  # of the 11 ms of wire that a full receive buffer covers


class Port(Protocol):
    """The interface for drivers. `read` returns received bytes at once, b"" after the timeout; PortLostError if the
    port is gone.
    """

    url: str
    wire_bytes_per_s: float | None

    def read(self, timeout_s: float) -> bytes: ...
    def write(self, data: bytes) -> None: ...
    def write_realtime(self, data: bytes) -> bool:
        """Write a byte now, from any thread and without waiting; False if the line does not take it."""
        ...

    def wake(self) -> None: ...
    def close(self) -> None: ...
    def clock(self) -> float: ...


def stable_name(device: str) -> str:
    """Convert /dev/ttyUSB0 to /dev/serial/by-id/usb-...: that name is still the same mill after a replug."""
    if not device.startswith("/") or not BY_ID.is_dir():
        return device
    try:
        real = Path(device).resolve(strict=True)
        return next((str(link) for link in sorted(BY_ID.iterdir()) if link.resolve() == real), device)
    except OSError:
        return device


def port_names() -> tuple[str, ...]:
    """List the serial ports of this computer by stable names, with the devices' own descriptions."""
    return tuple(sorted(stable_name(str(port.device)) for port in list_ports.comports()))


def open_port(url: str, link: LinkSettings) -> SerialPort:
    """Open a link exclusively. PortError says what is wrong and what to do."""
    name = url if "://" in url else stable_name(url)
    if name.startswith(("socket://", "rfc2217://")):
        _require_address(name)
    try:
        line = serial.serial_for_url(
            name,
            do_not_open=True,
            baudrate=link.baud,
            bytesize=link.bytesize,
            parity=link.parity,
            stopbits=link.stopbits,
            rtscts=link.flow == "rtscts",
            xonxoff=link.flow == "xonxoff",
            timeout=0,
            write_timeout=2.0,
        )
    except ValueError as error:
        raise PortError(name, Phrase("not a known port or URL: {reason}", reason=error)) from error
    if "://" not in name:
        line.exclusive = True
        line.dtr = True  # as the kernel sets it on open: no edge is made that would reset the controller
        line.rts = True
    try:
        line.open()
    except (serial.SerialException, OSError, ValueError) as error:
        raise _make_open_error(name, error) from error
    _take_off_hupcl(line)
    with contextlib.suppress(Exception):
        line.set_low_latency_mode(True)  # FTDI: 1 ms instead of 16; not offered by every driver
    wire = None if "://" in name else link.wire_bytes_per_s
    return SerialPort(name, line, wire, gather_s=_GATHER_S if wire and link.driver == "grbl" else 0.0)


def _require_address(url: str) -> None:
    try:
        parts = urlsplit(url)
        good = bool(parts.hostname and parts.port)
    except ValueError:
        good = False
    if not good:
        raise PortError(
            url, Phrase("names no host and port; allowed: {scheme}://HOST:PORT", scheme=url.partition("://")[0])
        )


def _descriptor(line: Any) -> int:
    """Return the descriptor to wait on; -1 where there is none (loop://, rfc2217://, Windows)."""
    if os.name != "posix":
        return -1
    try:
        return int(line.fileno())
    except (AttributeError, OSError, ValueError, serial.SerialException):
        return -1


def _take_off_hupcl(line: Any) -> None:
    """Take HUPCL off: a close must not drop DTR, which would reset the controller at the next opening."""
    if os.name != "posix" or not isinstance(getattr(line, "fd", None), int):
        return
    import termios

    with contextlib.suppress(termios.error, OSError):
        attributes = termios.tcgetattr(line.fd)
        attributes[2] &= ~termios.HUPCL
        termios.tcsetattr(line.fd, termios.TCSANOW, attributes)


def _make_open_error(name: str, error: Exception) -> PortError:
    number = getattr(error, "errno", None)
    text = str(error)
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "exclusively lock" in text:
        holder = _holder(name)
        if holder:
            return PortError(name, Phrase("in use by process {process}; close that first", process=holder))
        return PortError(name, Phrase("in use by another program; close that first"))
    if number in (errno.EACCES, errno.EPERM):
        return PortError(
            name,
            Phrase("permission denied: add your user to the group that owns it (mostly 'dialout'), then log in again"),
        )
    if "://" in name:
        return PortError(name, Phrase("cannot be reached: {reason}", reason=_reason(text)))
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or ("could not open port" in text and number is None):
        return PortError(name, Phrase("does not exist; ports here: {ports}", ports=_list_ports()))
    if number in (errno.EISDIR, errno.ENOTTY) or "not configure port" in text:
        return PortError(name, Phrase("is not a serial port; ports here: {ports}", ports=_list_ports()))
    return PortError(name, Phrase("cannot be opened: {reason}", reason=_reason(text)))


def _list_ports() -> str:
    return ", ".join(port_names()) or Phrase("none")


def _reason(text: str) -> str:
    """Return the system's message without pyserial's additions."""
    said = re.search(r"\[Errno -?\d+\] ([^:]+)", text)
    return said.group(1).strip().lower() if said else text


def _holder(name: str) -> str:
    """Return `1234 (screen)`: the process that has the device open, as far as /proc shows it."""
    try:
        real = os.path.realpath(name)
        for folder in Path("/proc").iterdir():
            if not folder.name.isdecimal() or folder.name == str(os.getpid()):
                continue
            with contextlib.suppress(OSError):
                if any(os.path.realpath(link) == real for link in (folder / "fd").iterdir()):
                    return f"{folder.name} ({(folder / 'comm').read_text().strip()})"
    except OSError:
        pass
    return f"{os.getpid()} (this one)" if _open_here(name) else ""


def _open_here(name: str) -> bool:
    with contextlib.suppress(OSError):
        return any(os.path.realpath(link) == os.path.realpath(name) for link in Path("/proc/self/fd").iterdir())
    return False


class SerialPort:
    """A Port over pyserial. One thread reads and writes; `wake` and `write_realtime` may come from any.

    gather_s : once something has come, wait this long for more. A controller's replies come one by one, and handling
               several in one round halves the processor time; `wake` ends this wait, too
    """

    def __init__(self, url: str, line: Any, wire_bytes_per_s: float | None, *, gather_s: float = 0.0) -> None:
        self.url = url
        self.wire_bytes_per_s = wire_bytes_per_s
        self._line = line
        self._gather_s = gather_s
        self._clock = make_running_clock()
        self._woken = threading.Event()  # for a line that select() does not support
        self._file = _descriptor(line)
        self._bell, self._cord = os.pipe() if self._file >= 0 else (-1, -1)
        self._ringing = threading.Lock()  # a closed descriptor may be another file by now: do not write to it
        if self._file >= 0:
            os.set_blocking(self._cord, False)

    def clock(self) -> float:
        """Return seconds of running time (`machines.clock`): a pause of this process counts against nobody."""
        return self._clock()

    def read(self, timeout_s: float) -> bytes:
        """Return the received bytes; wait at most `timeout_s` for the first one."""
        try:
            return self._await_bytes(timeout_s) if self._file >= 0 else self._in_slices(timeout_s)
        except (serial.SerialException, OSError, TypeError, ValueError) as error:
            # pyserial raises TypeError from a port that was closed under it
            raise self._make_lost_error(error) from error

    def _await_bytes(self, timeout_s: float) -> bytes:
        ready, _, _ = select.select([self._file, self._bell], [], [], max(timeout_s, 0.0))
        if self._bell in ready:
            os.read(self._bell, 64)
        if self._file not in ready:
            return b""
        if self._gather_s and len(ready) == 1:
            select.select([self._bell], [], [], self._gather_s)
        return bytes(self._line.read(READ_BYTES))

    def _in_slices(self, timeout_s: float) -> bytes:
        end_s = time.monotonic() + timeout_s
        while not (waiting := self._line.in_waiting) and not self._woken.is_set():
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                break
            self._woken.wait(min(left_s, _SLICE_S))
        self._woken.clear()
        return bytes(self._line.read(min(waiting, READ_BYTES))) if waiting else b""

    def write(self, data: bytes) -> None:
        try:
            self._line.write(data)
        except (serial.SerialException, OSError, TypeError, ValueError) as error:
            raise self._make_lost_error(error) from error

    def write_realtime(self, data: bytes) -> bool:
        with self._ringing:
            if self._file < 0 or self._cord < 0:  # not a file, or closed
                return False
            try:
                return os.write(self._file, data) == len(data)
            except OSError:  # full, or gone: the owner's own write finds out
                return False

    def wake(self) -> None:
        """End a read that waits, or the next one."""
        self._woken.set()
        with self._ringing:
            if self._cord >= 0:
                with contextlib.suppress(BlockingIOError):  # full: it rings already
                    os.write(self._cord, b"!")

    def unsent_bytes(self) -> int:
        """Return the number of bytes waiting in the operating system; 0 if it does not report that."""
        try:
            return int(getattr(self._line, "out_waiting", 0))
        except (serial.SerialException, OSError, TypeError) as error:
            raise self._make_lost_error(error) from error

    def close(self) -> None:
        with self._ringing:
            if self._cord >= 0:
                os.close(self._bell)
                os.close(self._cord)
                self._bell = self._cord = -1
            self._file = -1
        with contextlib.suppress(serial.SerialException, OSError):
            self._line.close()

    def _make_lost_error(self, error: Exception) -> PortLostError:
        self.close()
        if isinstance(error, serial.SerialTimeoutException):
            return PortLostError(self.url, Phrase("has accepted no bytes for 2 s: unplugged, or switched off"))
        gone = Phrase("gone: cable out, power off or the far end closed")
        if isinstance(error, OSError) and error.errno:  # pyserial's own message only guesses
            gone = Phrase("{what} ({reason})", what=gone, reason=error)
        return PortLostError(self.url, gone)
