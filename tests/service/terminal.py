"""A person at a terminal: runs the command in a process of its own behind a pty, reads the screen, presses keys."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
_CONTROL = re.compile(rb"\x1b\[[0-9;?]*[ -/]*[@-~]|\x1b.|\r")


class Terminal:
    """`with Terminal("stream", ...) as person: person.sees("Held"); person.types("r")`."""

    def __init__(self, *arguments: str, environment: dict[str, str] | None = None) -> None:
        self.master, slave = os.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
        modes = termios.tcgetattr(slave)
        modes[3] |= termios.NOFLSH  # else a Ctrl-C makes the kernel drop words that this process has not read yet
        termios.tcsetattr(slave, termios.TCSANOW, modes)

        def controlling() -> None:
            os.setsid()
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            [sys.executable, "-m", "service.cli.main", *arguments],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            preexec_fn=controlling,
            cwd=ROOT,
            env=os.environ | {"TERM": "xterm"} | (environment or {}),
        )
        os.close(slave)
        self.text = ""
        self._seen = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        os.close(self.master)

    def sees(self, words: str) -> str:
        """Wait until the words are printed after those seen last; returns the text up to them."""
        give_up = time.monotonic() + PATIENCE_S
        while (at := self.text.find(words, self._seen)) < 0:
            if time.monotonic() > give_up or not self._read():
                raise AssertionError(f"'{words}' never came; last: {self.text[-1500:]}")
        before, self._seen = self.text[self._seen : at], at + len(words)
        return before

    def is_gone_after(self, keys: str, seconds: float) -> bool:
        """Press keys and read the screen for so long at most; whether the command has ended by then."""
        with contextlib.suppress(OSError):
            self.types(keys)
        return not self._read(seconds) or self.process.poll() is not None

    def types(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    def ctrl_c(self) -> None:
        self.types("\x03")

    def signals(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def hangs_up(self) -> None:
        """Close the terminal's window."""
        os.close(self.master)
        self.master = os.open(os.devnull, os.O_RDWR)

    def ends(self) -> int:
        """Wait for the end; its exit code."""
        give_up = time.monotonic() + PATIENCE_S
        while self._read():
            assert time.monotonic() < give_up, self.text[-1500:]
        return self.process.wait(PATIENCE_S)

    def _read(self, wait_s: float = 0.2) -> bool:
        if not select.select([self.master], [], [], wait_s)[0]:
            return True
        try:
            data = os.read(self.master, 65536)
        except OSError:  # the other side is closed
            return False
        self.text += _CONTROL.sub(b"", data).decode(errors="replace")
        return bool(data)
