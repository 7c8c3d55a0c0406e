"""What a person sees in the terminal of `serve`, and what stands in a log instead."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from service.server.pairing_code import frame_rows
from service.settings import ServerSettings
from tests.service.server.supervisor.processes import CODE, HERE, STAND_INS
from tests.waiting import PATIENCE_S, until

LOG = """
from service.logs import configure_logs
import structlog
configure_logs("info", form={form!r}, process="api")
structlog.get_logger().warning("disk low", free_mb=3)
"""


def logged(form: str, *, terminal: bool) -> str:
    """What one warning looks like."""
    command = [sys.executable, "-c", LOG.format(form=form)]
    if not terminal:
        return subprocess.run(command, capture_output=True, text=True, check=True).stderr
    ours, its = os.openpty()
    subprocess.run(command, stderr=its, check=True)
    os.close(its)
    shown = os.read(ours, 4096).decode()
    os.close(ours)
    return shown


@pytest.mark.thorough
@pytest.mark.parametrize(("form", "terminal"), [("auto", False), ("json", True), ("json", False)])
def test_a_log_that_is_stored_is_json(form: str, terminal: bool) -> None:
    line = json.loads(logged(form, terminal=terminal))
    assert (line["event"], line["free_mb"], line["process"]) == ("disk low", 3, "api")


@pytest.mark.parametrize(("form", "terminal"), [("auto", True), ("text", False)])
def test_a_log_that_a_person_reads_is_a_short_line(form: str, terminal: bool) -> None:
    line = logged(form, terminal=terminal)
    assert re.match(r"\d\d:\d\d:\d\d \[warning *\] disk low +free_mb=3 process=api\s*$", line), line


def test_on_a_terminal_address_and_code_stand_in_a_frame(tmp_path: Path) -> None:
    """The supervisor with stand-ins for API and worker, which never answer with words of their own."""
    ours, its = os.openpty()
    settings = ServerSettings(data=tmp_path, port=0, start_agents=False)
    command = [sys.executable, "-m", "service.server.supervisor.supervisor", *STAND_INS]
    environment = settings.environment() | {"PYTHONPATH": str(HERE), "PYTHONUTF8": "1"}
    serving = subprocess.Popen(command, stdout=its, stderr=subprocess.PIPE, env=environment)
    os.close(its)
    os.set_blocking(ours, False)
    seen = bytearray()

    def framed_code() -> bool:
        with contextlib.suppress(BlockingIOError):
            seen.extend(os.read(ours, 4096))
        return "└" in seen.decode(errors="ignore")

    try:
        until(framed_code, what="the frame")
    finally:
        serving.terminate()
        serving.communicate(timeout=PATIENCE_S)
        os.close(ours)
    rows = [line.strip() for line in seen.decode().splitlines() if line.startswith("│")]
    assert re.search(r"http://127\.0\.0\.1:\d+ ", rows[0]) and re.search(rf"Code +{CODE} ", rows[1])
    assert len({len(row) for row in rows}) == 1


@pytest.mark.parametrize("fine", [True, False])
def test_a_frame_is_a_frame(fine: bool) -> None:
    before, *box, after, end = frame_rows(("short", "a longer row"), fine=fine).split("\n")
    assert (before, after, end) == ("", "", "") and len({len(row) for row in box}) == 1
    assert fine or all(row.isascii() for row in box)
