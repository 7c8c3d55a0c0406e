"""The grammar is total: every line is a reply, nothing raises, and what is nearly right is garbled."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.grbl.replies import (
    ALARMS,
    ERRORS,
    OK,
    AlarmReply,
    Banner,
    Echo,
    Empty,
    ErrorReply,
    Garbled,
    LineSplitter,
    Message,
    Push,
    Setting,
    Startup,
    Status,
    alarm_words,
    error_words,
    parse,
)


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        (b"ok", OK),
        (b"", Empty()),
        (b"error:20", ErrorReply(20)),
        (b"ALARM:2", AlarmReply(2)),
        (b"[MSG:'$H'|'$X' to unlock]", Message("'$H'|'$X' to unlock")),
        (b"[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]", Push("GC", "G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0")),
        (b"[G54:0.000,0.000,-1.500]", Push("G54", "0.000,0.000,-1.500")),
        (b"[PRB:0.000,0.000,-7.025:1]", Push("PRB", "0.000,0.000,-7.025:1")),
        (b"[OPT:V,15,128]", Push("OPT", "V,15,128")),
        (b"[echo: G1X1]", Echo(b"G1X1")),
        (b"$110=500.000", Setting(110, "500.000")),
        (b">G54G20:ok", Startup(">G54G20:ok")),
        (b"Grbl 1.1h ['$' for help]", Banner("Grbl 1.1h ['$' for help]")),
        (b"GrblHAL 1.1f ['$' or '$HELP' for help]", Banner("GrblHAL 1.1f ['$' or '$HELP' for help]")),
        (b"Grbl 3.7 [FluidNC v3.7.17 (wifi) '$' for help]", Banner("Grbl 3.7 [FluidNC v3.7.17 (wifi) '$' for help]")),
    ],
)
def test_what_controllers_say(line: bytes, reply: object) -> None:
    assert parse(line) == reply


def test_a_status_report_in_full() -> None:
    report = parse(
        b"<Hold:1|MPos:1.000,-2.500,3.000|Bf:14,120|Ln:7|FS:500,8000|Pn:XP|WCO:0.000,1.000,0.000|Ov:100,50,90|A:SF>"
    )
    assert isinstance(report, Status)
    assert (report.state, report.sub, report.machine, report.work) == ("Hold", 1, (1.0, -2.5, 3.0), None)
    assert (report.buffer, report.line, report.feed, report.spindle) == ((14, 120), 7, 500.0, 8000.0)
    assert (report.pins, report.work_offset, report.overrides) == ("XP", (0.0, 1.0, 0.0), (100, 50, 90))
    assert report.accessories == "SF"


@pytest.mark.parametrize(
    "line",
    [
        b"o*", b"okok", b"ok\rok", b"Ok", b"oK", b"o k", b"error:", b"error:x", b"errr:2", b"ALARM:2\xff", b"<Idle>",
        b"<Idel|MPos:0,0,0>", b"<Idle|MPos:0.0,0.0>", b"<Idle|MPos:0.0,0.0,nan>", b"<Idle|MPos:1e5,0,0>",
        b"<Idle|MPos:0,0,0", b"<Idle|MPos:0,0,0|MPos:0,0,0>", b"<Run|FS:0,0>", b"<Idle:|MPos:0,0,0>", b"[MSG:Pgm End",
        b"[MSG:a\x07b]", b"<Idle|MPos:30,000,0,000,4,000>", b"Grbl 1.1h ['$' for hel", b"\x00\x00",
    ],
)  # fmt: skip
def test_a_damaged_line_is_garbled(line: bytes) -> None:
    assert parse(line) == Garbled(line)


@given(st.binary(max_size=120))
def test_nothing_raises(line: bytes) -> None:
    parse(line)


@given(st.sampled_from([b"<", b"[", b"$", b"error:", b"ALARM:", b">", b"Grbl "]), st.binary(max_size=60))
def test_nothing_raises_behind_a_known_beginning(head: bytes, tail: bytes) -> None:
    parse(head + tail)
    parse(head + tail + b">")
    parse(head + tail + b"]")


@given(st.binary(max_size=300), st.lists(st.integers(0, 300), max_size=8))
def test_chunks_do_not_matter_to_lines(data: bytes, cuts: list[int]) -> None:
    whole, pieces = LineSplitter(), LineSplitter()
    expected, found, start = whole.take(data), [], 0
    for cut in [*sorted(min(cut, len(data)) for cut in cuts), len(data)]:
        found += pieces.take(data[start:cut])
        start = cut
    assert found == expected
    assert pieces.rest == whole.rest


def test_a_line_that_never_ends_is_given_up() -> None:
    assert [len(line) for line in LineSplitter().take(b"x" * 5000)] == [5000]


def test_every_documented_number_has_words_that_say_what_to_do() -> None:
    assert set(ERRORS) >= set(range(1, 39)) and set(ALARMS) >= set(range(1, 11))
    for words in (*ERRORS.values(), *ALARMS.values()):
        assert ":" in words
    assert "not supported" in error_words(20) and "soft limit" in alarm_words(2)
    assert "see the manual" in error_words(200)
