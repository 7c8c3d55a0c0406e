"""Ports over real pseudo terminals and pyserial's own URLs."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Iterator

import pytest
import serial

from machines.driver import MillState, ProgramDone, ProgramLine
from machines.errors import PortError, PortLostError
from machines.grbl.driver import GrblDriver
from machines.port import SerialPort, open_port, stable_name
from machines.profile import LinkSettings
from tests.waiting import PATIENCE_S

LINK = LinkSettings()


def _raw_line(name: str) -> serial.Serial:
    return serial.Serial(name, timeout=0)


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """A pty: the far end's descriptor and the near end's name."""
    far, near = pty.openpty()
    tty.setraw(near)
    name = os.ttyname(near)
    os.close(near)
    yield far, name
    with contextlib.suppress(OSError):
        os.close(far)


def test_bytes_go_both_ways(terminal: tuple[int, str]) -> None:
    far, name = terminal
    port = open_port(name, LINK)
    assert (port.url, port.wire_bytes_per_s) == (name, 11520.0)
    os.write(far, b"ok\r\n")
    assert port.read(1.0) == b"ok\r\n"
    port.write(b"?\x85\xff")
    assert os.read(far, 10) == b"?\x85\xff"
    begin_s = port.clock()
    assert port.read(0.05) == b"" and port.clock() - begin_s >= 0.045
    port.close()


def test_a_wait_is_ended_from_another_thread(terminal: tuple[int, str]) -> None:
    port = open_port(terminal[1], LINK)
    timer = threading.Timer(0.05, port.wake)
    timer.start()
    begin_s = time.monotonic()
    assert port.read(20.0) == b"" and time.monotonic() - begin_s < 10.0
    port.wake()  # before the read
    assert port.read(20.0) == b""
    timer.join()
    port.close()


def test_a_wake_ends_the_gathering_too_and_what_has_come_is_returned(terminal: tuple[int, str]) -> None:
    """A hold must not wait for more replies to come."""
    port = SerialPort(terminal[1], _raw_line(terminal[1]), 11520.0, gather_s=20.0)
    os.write(terminal[0], b"ok")
    timer = threading.Timer(0.1, port.wake)
    timer.start()
    begin_s = time.monotonic()
    assert port.read(20.0) == b"ok"
    assert time.monotonic() - begin_s < 10.0
    timer.join()
    port.close()


def test_replies_that_come_one_by_one_are_gathered_on_a_paced_line_only(terminal: tuple[int, str]) -> None:
    """A line with a wire rate is read some 5 ms after its first byte; TCP at once: it may be faster than any wire."""
    port = open_port(terminal[1], LINK)
    assert port._gather_s == 0.005  # type: ignore[attr-defined]
    port.close()
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = open_port(f"socket://127.0.0.1:{server.getsockname()[1]}", LINK)
        assert port._gather_s == 0.0  # type: ignore[attr-defined]
        port.close()


def test_a_wait_on_a_port_that_is_closed_from_another_thread_ends_as_a_lost_port(terminal: tuple[int, str]) -> None:
    port = open_port(terminal[1], LINK)
    timers = [threading.Timer(0.05, port.close), threading.Timer(0.1, port.wake)]
    for timer in timers:
        timer.start()
    begin_s = time.monotonic()
    with pytest.raises(PortLostError):
        for _ in range(2):  # the first read may be woken before it sees that the line is gone
            port.read(20.0)
    assert time.monotonic() - begin_s < 10.0
    for timer in timers:
        timer.join()


def test_a_wake_after_the_close_rings_nobody_elses_file(terminal: tuple[int, str]) -> None:
    port = open_port(terminal[1], LINK)
    cord = port._cord  # type: ignore[attr-defined]
    port.close()
    port.close()
    begin, end = os.pipe()
    other = cord if cord in (begin, end) else os.dup2(end, cord)
    os.set_blocking(begin, False)
    port.wake()
    with pytest.raises(BlockingIOError):
        os.read(begin, 1)
    for descriptor in {begin, end, other}:
        os.close(descriptor)


def test_many_wakes_do_not_block_and_end_in_one_empty_read(terminal: tuple[int, str]) -> None:
    port = open_port(terminal[1], LINK)
    for _ in range(70_000):  # more than a pipe holds
        port.wake()
    assert port.read(20.0) == b""
    port.close()


@pytest.mark.parametrize("url", ["loop://", "pty"])
def test_what_is_unsent_is_told(terminal: tuple[int, str], url: str) -> None:
    port = open_port(terminal[1] if url == "pty" else url, LINK)
    assert port.unsent_bytes() == 0  # type: ignore[attr-defined]
    port.close()
    if url == "pty":
        with pytest.raises(PortLostError):
            port.unsent_bytes()  # type: ignore[attr-defined]


def test_a_lost_port_is_named_without_the_guesses_of_the_library(terminal: tuple[int, str]) -> None:
    far, name = terminal
    port = open_port(name, LINK)
    os.close(far)
    with pytest.raises(PortLostError) as caught:
        port.read(1.0)
    assert str(caught.value).startswith(f"port {name}: gone: cable out")
    assert "multiple access" not in str(caught.value)


@pytest.mark.parametrize("url", ["/tmp", __file__])
def test_what_is_no_serial_port_is_said_so(url: str) -> None:
    with pytest.raises(PortError, match="is not a serial port; ports here:"):
        open_port(url, LINK)


@pytest.mark.parametrize("url", ["socket://localhost", "socket://:23", "rfc2217://host", "socket://host:99999"])
def test_an_address_needs_host_and_port(url: str) -> None:
    with pytest.raises(PortError, match=r"names no host and port; allowed: [a-z0-9]+://HOST:PORT"):
        open_port(url, LINK)


def test_a_far_end_that_refuses_is_told_in_words() -> None:
    with pytest.raises(PortError, match=r"cannot be reached: connection refused$"):
        open_port("socket://127.0.0.1:1", LINK)


def test_a_port_is_opened_once(terminal: tuple[int, str]) -> None:
    port = open_port(terminal[1], LINK)
    with pytest.raises(PortError, match=r"in use by process \d+"):
        open_port(terminal[1], LINK)
    port.close()


def test_a_pulled_plug_is_a_lost_port(terminal: tuple[int, str]) -> None:
    far, name = terminal
    port = open_port(name, LINK)
    os.close(far)
    with pytest.raises(PortLostError, match=name):
        for _ in range(3):
            port.read(0.1)
    with pytest.raises(PortLostError):
        port.write(b"?")
    port.close()


@pytest.mark.parametrize("url", ["/dev/ttyNONE7", "/dev/serial/by-id/usb-nothing"])
def test_no_such_port_names_those_that_exist(url: str) -> None:
    with pytest.raises(PortError, match="does not exist; ports here:") as caught:
        open_port(url, LINK)
    assert "\n" not in str(caught.value) and url in str(caught.value)


@pytest.mark.parametrize("url", ["nonsense://x", "socket://127.0.0.1:1"])
def test_bad_urls_are_one_clear_line(url: str) -> None:
    with pytest.raises(PortError) as caught:
        open_port(url, LINK)
    assert "\n" not in str(caught.value) and url in str(caught.value)


def test_a_socket_is_a_port_and_its_end_is_noticed() -> None:
    server = socket.create_server(("127.0.0.1", 0))
    port = open_port(f"socket://127.0.0.1:{server.getsockname()[1]}", LINK)
    assert port.wire_bytes_per_s is None
    far, _ = server.accept()
    far.sendall(b"ok\r\n")
    data = b""
    while len(data) < 4:
        data += port.read(1.0)
    assert data == b"ok\r\n"
    port.write(b"?")
    assert far.recv(10) == b"?"
    far.close()
    with pytest.raises(PortLostError):
        for _ in range(5):
            port.read(0.1)
    port.close()
    server.close()


def test_loop_returns_what_is_written() -> None:
    port = open_port("loop://", LINK)
    port.write(b"abc")
    data = b""
    while len(data) < 3:
        data += port.read(0.5)
    assert data == b"abc"
    port.close()


def test_a_name_that_has_no_stable_name_stays(terminal: tuple[int, str]) -> None:
    assert stable_name(terminal[1]) == terminal[1]
    assert stable_name("socket://host:23") == "socket://host:23"


class LittleController(threading.Thread):
    """Answers over the far end of a pty as GRBL does, without moving anything; for the real port only."""

    def __init__(self, far: int) -> None:
        super().__init__(daemon=True)
        self.far, self.lines = far, []

    def run(self) -> None:
        line = b""
        answers = {
            b"$I": b"[VER:1.1h.2019:]\r\n[OPT:V,15,128]\r\n",
            b"$$": b"$13=0\r\n",
            b"$#": b"[G54:0.000,0.000,0.000]\r\n",
            b"$G": b"[GC:G0 G54 G17 G21 G90]\r\n",
        }
        with contextlib.suppress(OSError):  # the test is over
            while True:
                for byte in os.read(self.far, 256):
                    if byte == ord("?"):
                        os.write(self.far, b"<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>\r\n")
                    elif byte == ord("\n"):
                        self.lines.append(line)
                        os.write(self.far, answers.get(line, b"") + b"ok\r\n")
                        line = b""
                    else:
                        line += bytes([byte])


def test_the_driver_runs_over_a_real_terminal(terminal: tuple[int, str]) -> None:
    far, name = terminal
    driver = GrblDriver(open_port(name, LINK))  # first: a terminal that nobody has open reads as gone
    controller = LittleController(far)
    controller.start()
    driver.connect()
    until = time.monotonic() + PATIENCE_S
    while driver.status.state is not MillState.IDLE and time.monotonic() < until:
        driver.poll(0.1)
    assert driver.status.state is MillState.IDLE, (driver.failure, controller.lines)
    lines = [ProgramLine(k, k * 10, b"G4P0.%03d" % k) for k in range(1, 301)]
    driver.start(iter(lines))
    events = []
    while not any(isinstance(event, ProgramDone) for event in events) and time.monotonic() < until:
        events += driver.poll(0.1)
    assert controller.lines[-300:] == [line.text for line in lines]
    assert driver.progress.executed_line == 300
    driver.close()
