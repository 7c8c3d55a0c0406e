"""The live panel: readable at 80 columns, the same rows whatever happens, so that nothing jumps."""

from __future__ import annotations

import dataclasses

import pytest
from rich.console import Console

from machines.driver import MillStatus
from service.milling.terminal.keys import Question
from service.milling.terminal.screen import StreamView, mill_lines, one_line, panel

CALM = StreamView(state="run", run_state="running", line=134, executed_line=105, total_lines=923, time_left_s=43.0)
FULL = dataclasses.replace(
    CALM,
    state="disconnected",
    detail="port /dev/serial/by-id/usb-1a86_USB2.0-Serial-if00-port0: gone: cable out, power off or the far end closed",
    line=123_456_789,
    executed_line=123_456_700,
    total_lines=250_000_000,
    position_mm=(-1234.567, 1234.567, -123.456),
    buffer="1023 of 1024 bytes, 128 lines",
    feed_mm_per_min=12345.0,
    spindle="24000 rpm",
    overrides=(200, 100, 200),
    protections=("corridor: positions are compared with the path " * 3, "echo: every line is compared"),
)


def rows(view: StreamView, columns: int = 80) -> list[str]:
    console = Console(width=columns, force_terminal=False, color_system=None)
    with console.capture() as captured:
        console.print(panel("pass-1-rough.nc", view))
    return captured.get().splitlines()


def test_the_panel_keeps_its_rows() -> None:
    views = [CALM, FULL, dataclasses.replace(CALM, run_state="finished", state="idle", time_left_s=None)]
    views += [dataclasses.replace(CALM, question=question.value) for question in Question]
    assert {len(rows(view)) for view in views} == {12}
    assert all(len(row) == 80 for view in views for row in rows(view))


@pytest.mark.parametrize("question", list(Question))
def test_the_keys_are_shown_whole_at_80_columns(question: Question) -> None:
    assert any(question.value in row for row in rows(dataclasses.replace(CALM, question=question.value)))


@pytest.mark.parametrize(
    "label", ["mill", "line", "time left", "position", "feed", "overrides", "buffer", "protection"]
)
def test_each_row_says_what_it_is(label: str) -> None:
    assert sum(row.startswith(f"\u2502 {label} ") for row in rows(FULL)) == 1


def test_a_moment_without_motion_in_a_run_is_not_shown_as_idle() -> None:
    """GRBL says Idle in a dwell and when its buffer runs dry for a moment."""
    dwell = dataclasses.replace(CALM, state="idle")
    assert one_line(dwell).startswith("run,")
    assert one_line(dataclasses.replace(dwell, run_state="finished")).startswith("idle,")
    assert one_line(dataclasses.replace(CALM, state="alarm")).startswith("alarm,")


def test_nothing_is_left_of_a_run_that_is_over() -> None:
    over = dataclasses.replace(CALM, run_state="finished", state="idle", time_left_s=None)
    assert "time left" not in one_line(over)
    assert "unknown" not in next(row for row in rows(over) if "time left" in row)


@pytest.mark.parametrize(
    ("sure", "words"), [(True, ", sure"), (False, ", not sure: not homed, and nobody has said that it is right")]
)
def test_whether_the_position_is_right_is_said_in_plain_words(sure: bool, words: str) -> None:
    (line,) = [one for one in mill_lines("mill", MillStatus(position_trusted=sure), (), None) if "position" in one]
    assert line.endswith(words)
