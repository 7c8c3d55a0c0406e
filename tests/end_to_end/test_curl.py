"""The working day with curl of docs/rest.md: server, simulated mill, picture, programs, a whole run."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import uuid
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.trials.server.deployment import free_port
from tests.trials.server.processes import MARK, kill, processes, wait_until

TOP = Path(__file__).parents[2]
REST = TOP / "docs" / "rest.md"
# What the test changes in its text: sizes and addresses, no command.
SMALL = '{"preset": "draft", "image": {"pixels": 48}, "optics": {"width_mm": 8, "height_mm": 8}}'
_TIME_FACTOR = 5
_PATIENCE_S = 240.0


def working_day() -> str:
    """The block of docs/rest.md that works with the job server from its start to the end of a run."""
    blocks = re.findall(r"^```sh\n(.*?)^```", REST.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return next(block for block in blocks if ":start" in block)


def replaced(text: str, old: str, new: str) -> str:
    assert old in text, f"docs/rest.md no longer says {old}"
    return text.replace(old, new)


@contextlib.contextmanager
def shell(script: str, folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """bash -e on the script, its output in `output`; at the end all that it has started is gone, agents included."""
    mark = uuid.uuid4().hex
    (folder / "examples").symlink_to(TOP / "examples")
    (folder / ".venv").symlink_to(sys.prefix)
    own = {name: value for name, value in os.environ.items() if not name.startswith("CAUSTICMILL_")}
    environment = {**own, "HOME": str(folder), "XDG_STATE_HOME": str(folder / "state"), MARK: mark}
    environment["CAUSTICMILL_PREPARE"] = "false"
    with (folder / "output").open("wb") as output:
        words = ["bash", "-e", "-o", "pipefail", "-c", script]
        process = subprocess.Popen(words, cwd=folder, env=environment, stdout=output, stderr=output)
    try:
        yield process, mark
    finally:
        for number in (signal.SIGTERM, signal.SIGKILL):
            kill((one.pid for one in processes(mark)), number)
            if wait_until(lambda: not processes(mark), 20.0):
                break
        process.wait()


@pytest.mark.thorough
def test_a_working_day_with_curl(tmp_path: Path) -> None:
    """Every command succeeds; passes are what the job's report names; the run is held, resumed and finished."""
    port = free_port()
    script = replaced(working_day(), ":8000", f":{port}")
    script = replaced(script, "serve --data", f"serve --port {port} --data")
    script = replaced(script, ":8620", f":{free_port()}")
    script = replaced(script, "--time-factor 100", f"--time-factor {_TIME_FACTOR}")
    script = replaced(script, '{"preset": "draft"}', SMALL)
    assert not re.search(r"causticmill (?!sim-mill|serve|token create)", script), "only curl, after the start"
    with shell(script, tmp_path) as (process, mark):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)
        output = (tmp_path / "output").read_text(encoding="utf-8")
        assert process.returncode == 0, output[-4000:]
        assert [one for one in processes(mark) if one.kind == "api"], "the server was gone before the script"
    report = json.loads(zipfile.ZipFile(tmp_path / "everything.zip").read("report.json"))
    assert len(report["passes"]) == 2
    for row in report["passes"]:
        assert hashlib.sha256((tmp_path / row["file"]).read_bytes()).hexdigest() == row["sha256"]
    assert "<html" in (tmp_path / "setup.html").read_text(encoding="utf-8")
    lens = zipfile.ZipFile(tmp_path / "everything.zip").read("heightfield.npz")
    assert (tmp_path / "heightfield.npz").read_bytes() == lens
    assert "event: ended" in output
    assert json.loads((tmp_path / "run.json").read_text())["state"] in ("parked", "preparing")
    assert '"state":"finished"' in output[output.index('"state":"held"') :]
