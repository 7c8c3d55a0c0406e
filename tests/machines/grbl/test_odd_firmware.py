"""How other firmware spells its replies: each spelling is read, or refused with a sentence that names the truth."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.driver import Faulted, MillState, ProgramDone
from machines.grbl.replies import LineSplitter, name_foreign, parse
from machines.simulated.endpoints import MemoryPort
from tests.machines.grbl.bench import Bench, Tap, numbered

Say = Callable[[bytes, int], list[bytes]]
"""A line without its end, and how many `ok` came so far -> the lines that are said instead."""

TURNS = [b"G1X%dY%dF1500" % (k % 7 + 1, k // 7) for k in range(60)]
PROGRAM = [b"G21G90G94G17", *TURNS, b"M2"]
RUNS = ""
BOOT = [
    b"ets Jun  8 2016 00:22:57",
    b"",
    b"rst:0x1 (POWERON_RESET),boot:0x13 (SPI_FAST_FLASH_BOOT)",
    b"\xff\x80\x12VMD",
]


class OddLink(Tap):
    """Says what the mill says in another way. end: of each line; first: said when the link is opened."""

    def __init__(self, port: MemoryPort, say: Say, end: bytes, first: bytes) -> None:
        super().__init__(port)
        self.say, self.end, self.first = say, end, first
        self.rest, self.oks = b"", 0

    def read(self, timeout_s: float) -> bytes:
        first, self.first = self.first, b""
        *lines, self.rest = (self.rest + self.port.read(timeout_s)).split(b"\n")
        said = []
        for line in (one.removesuffix(b"\r") for one in lines):
            self.oks += line == b"ok"
            said += self.say(line, self.oks)
        return first + b"".join(line + self.end for line in said)


def plain(line: bytes, _: int) -> list[bytes]:
    return [line]


def for_ok(*said: bytes, every: int = 1) -> Say:
    """These instead of every n-th `ok`."""
    return lambda line, oks: list(said) if line == b"ok" and oks % every == 0 else [line]


def in_reports(old: str, new: bytes) -> Say:
    """The same, but with this of every status report replaced."""
    return lambda line, _: [re.sub(old.encode(), new, line) if line[:1] == b"<" else line]


def as_grbl_09(line: bytes, _: int) -> list[bytes]:
    if line.startswith(b"Grbl"):
        return [b"Grbl 0.9j ['$' for help]"]
    return [re.sub(rb"<(\w+)[^|]*\|MPos:([-\d.,]+).*", rb"<\1,MPos:\2,WPos:\2>", line)]


def without(*heads: bytes) -> Say:
    return lambda line, _: [] if line.startswith(heads) else [line]


MODES: dict[str, tuple[Say, str]] = {
    "ok and a blank": (for_ok(b"ok "), RUNS),
    "ok and a tab": (for_ok(b"ok\t"), RUNS),
    "OK": (for_ok(b"OK"), RUNS),
    "empty lines": (for_ok(b"", b"ok", b""), RUNS),
    "a message with a letter beyond ASCII": (for_ok("[MSG:INFO: Probe µm]".encode(), b"ok", every=9), RUNS),
    "a message that is no UTF-8": (for_ok(b"[MSG:caf\xe9]", b"ok", every=9), RUNS),
    "a message without words": (for_ok(b"[MSG]", b"ok", every=9), RUNS),
    "a message in small letters": (for_ok(b"[Msg:Spindle warm]", b"ok", every=9), RUNS),
    "a message with brackets": (for_ok(b"[MSG:DBG: a]b]", b"ok", every=9), RUNS),
    "reports twice": (lambda line, _: [line, line] if line[:1] == b"<" else [line], RUNS),
    "six axes": (in_reports(r"((?:MPos|WCO):[-\d.]+,[-\d.]+,[-\d.]+)", rb"\1,0.000,0.000,0.000"), RUNS),
    "a field of a card": (in_reports(">$", b"|SD:12.50,/sd/part one.nc>"), RUNS),
    "no version": (without(b"[VER", b"[OPT"), RUNS),
    "no probe": (without(b"[PRB"), RUNS),
    "GRBL 0.9": (as_grbl_09, "this is GRBL 0.9 or older"),
    "Smoothieware": (in_reports(r"(MPos:([-\d.,]+))", rb"\1|WPos:\2"), "this is Smoothieware"),
    "decimal commas": (in_reports(r"\.", b","), "this is firmware that writes decimal commas"),
    "decimal commas in settings": (
        lambda line, _: [line.replace(b".", b",")] if line[:1] == b"$" else [line],
        "cannot be used: settings are written with decimal commas",
    ),
    "another word for ok": (for_ok(b"done"), "but 'done', which is not a reply that a controller sends"),
    "nothing for ok": (for_ok(), "neither .I nor .. is answered"),
    "not a number": (in_reports("FS:", b"FS:nan,"), "nothing answers|not a GRBL controller"),
    "a restart in a run": (for_ok(*BOOT, b"ok", every=40), "the start message of an ESP32: the board has restarted"),
}  # fmt: skip

ENDS = {"LF": b"\n", "LF CR": b"\n\r", "CR CR LF": b"\r\r\n", "NUL": b"\r\n\0", "NULs": b"\0\r\n\0\0"}


def run(say: Say, end: bytes = b"\r\n", first: bytes = b"") -> tuple[Bench, str]:
    """Connect and run; why it was refused, "" if it ran."""
    bench = Bench(baud=None, link=lambda port: OddLink(port, say, end, first))
    bench.driver.connect()
    bench.until(lambda: bench.state() in (MillState.IDLE, MillState.DISCONNECTED), 90.0)
    if bench.state() is MillState.IDLE:
        bench.start(numbered(PROGRAM))
        bench.until(lambda: bench.of(ProgramDone) or bench.of(Faulted), 200.0)
    failures = [event.words for event in bench.of(Faulted)]
    assert failures or bench.of(ProgramDone), bench.driver.status
    return bench, str(failures[0]) if failures else ""


@pytest.mark.parametrize("mode", MODES)
def test_a_spelling_is_read_or_named(mode: str) -> None:
    say, expected = MODES[mode]
    bench, words = run(say)
    assert re.search(expected, words) and bool(words) == bool(expected), words
    if not words:
        assert len(bench.mill.recording.cuts()) == len(TURNS)
    elif "restart" not in mode:
        assert not bench.mill.recording.segments, "nothing moves where the controller is not known"


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("spelling", [b"ok", b"ok ", b"OK"])
def test_every_line_end_is_read(end: str, spelling: bytes) -> None:
    bench, words = run(for_ok(spelling), ENDS[end])
    assert words == "" and len(bench.mill.recording.cuts()) == len(TURNS)


def test_what_a_board_says_when_it_starts_is_no_device_of_another_kind() -> None:
    assert run(plain, first=b"\r\n".join(BOOT) + b"\r\n")[1] == ""


@pytest.mark.parametrize(
    ("line", "name"),
    [
        (b"Grbl 0.9j ['$' for help]", "GRBL 0.9 or older"),
        (b"Grbl 0.8c ['$' for help]", "GRBL 0.9 or older"),
        (b"<Run,MPos:1.000,0.000,0.000,WPos:1.000,0.000,0.000>", "GRBL 0.9 or older"),
        (b"echo:Marlin 2.1.2", "Marlin"),
        (b"Marlin 1.1.9", "Marlin"),
        (b'echo:Unknown command: "??"', "Marlin"),
        (b"//action:notification Ready", "Marlin"),
        (b"Smoothie command shell", "Smoothieware"),
        (b"Build version: edge-94de12c, Build date: Oct 28 2014", "Smoothieware"),
        (b'{"r":{"fv":0.97},"f":[1,0,5]}', "TinyG or g2core"),
        (b"RepRapFirmware for Duet 2", "RepRapFirmware"),
        (b"// Klipper state: Ready", "Klipper"),
        (b"Grbl 1.1h ['$' for help]", None),
        (b"Grbl 3.7 [FluidNC v3.7.17 (wifi) '$' for help]", None),
        (b"<Idle|MPos:30.000,0.000,4.000,0.000|FS:0,0>", None),
        (b"[MSG:INFO: FluidNC v3.7.16]", None),
        (b"ok", None),
    ],
)
def test_firmware_is_known_by_what_it_says(line: bytes, name: str | None) -> None:
    assert name_foreign(line) == name


@given(st.binary(max_size=40), st.text("\r\0 \t", max_size=4), st.text("\r\0 \t", max_size=4))
def test_what_pads_a_line_changes_nothing(line: bytes, before: str, behind: str) -> None:
    line = line.replace(b"\n", b"")
    whole = LineSplitter().take(line + b"\n")
    padded = LineSplitter().take(before.encode() + line + behind.encode() + b"\n")
    assert [parse(one) for one in padded] == [parse(one) for one in whole]
