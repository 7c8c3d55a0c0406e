"""The image: no engine runs here, so its own install steps are carried out in a clean folder."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.docker.dockerfile import ROOT, build, ignored, read
from tests.waiting import PATIENCE_S, until

HEAD, BUILD, IMAGE = read(ROOT / "docker/Dockerfile")


def test_two_stages_of_the_same_small_base() -> None:
    assert HEAD.all("ARG") == ["PYTHON=3.11-slim-bookworm"]
    assert (BUILD.base, IMAGE.base) == ("python:${PYTHON}", "python:${PYTHON}")
    assert "--from=build /opt/causticmill /opt/causticmill" in IMAGE.all("COPY")


def test_it_does_not_run_as_root() -> None:
    kinds = [kind for kind, _ in IMAGE.steps]
    assert IMAGE.all("USER") == ["causticmill"]
    assert "RUN" not in kinds[kinds.index("USER") :]


def test_everything_from_outside_is_hashed() -> None:
    installs = [step for step in BUILD.all("RUN") if "pip install" in step]
    assert installs and all("--require-hashes" in step or "--no-index" in step for step in installs)
    lock = (ROOT / "docker/requirements.lock").read_text()
    pinned = re.findall(r"^([a-z0-9][\w.-]*)==[^\s\\;]+.*\\$", lock, flags=re.MULTILINE)
    assert {"psycopg", "obstore", "rollingmill", "setuptools", "fastapi"} <= set(pinned)


def test_all_that_runs_here_and_in_the_same_versions() -> None:
    """With the same hashes, as what is here already is not installed once more below."""

    def read_pins(path: str) -> set[tuple[str, str]]:
        entry = r"^([a-z0-9][^\\\n]*) \\\n((?: +--hash=[^\n]+\n)+)"
        return set(re.findall(entry, (ROOT / path).read_text(), flags=re.MULTILINE))

    assert read_pins("requirements.lock") < read_pins("docker/requirements.lock") < read_pins("requirements-dev.lock")


def test_it_stops_by_the_signal_that_drains() -> None:
    assert IMAGE.all("STOPSIGNAL") == ["SIGTERM"]
    assert IMAGE.json("ENTRYPOINT") == ["causticmill"], "not through a shell, which would keep the signal"


def test_nothing_private_gets_into_the_build() -> None:
    for path in ("docker/secrets/postgres_password", ".git/config", "causticmill-data/causticmill.sqlite", "out/x"):
        assert ignored(path)


def health_check() -> list[str]:
    (rest,) = IMAGE.all("HEALTHCHECK")
    return list(json.loads(rest.partition("CMD ")[2]))


@pytest.mark.thorough
def test_its_steps_make_a_server_that_serves(tmp_path: Path) -> None:
    """With the packages that run here, pip's cache, and sources not compiled ahead: the rest is what the image does."""
    environment = {key: os.environ[key] for key in os.environ if not key.startswith(("CAUSTICMILL_", "PYTHON"))}
    environment |= {"PIP_NO_COMPILE": "1", "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    venv, made = tmp_path / "opt", "-m venv /opt/causticmill"
    here, there = (sysconfig.get_path("purelib", vars={"base": base}) for base in (sys.prefix, "/opt/causticmill"))
    moved = {made: f"{made} --without-pip && echo {here} > {there}/here.pth"}
    moved |= {"/opt/causticmill": str(venv), " --no-cache-dir": ""}
    build(BUILD, tmp_path, moved=moved, environment=environment)
    inside = {
        "PATH": f"{venv}/bin:/usr/bin:/bin",
        "CAUSTICMILL_DATA": str(tmp_path / "data"),
        "CAUSTICMILL_START_AGENTS": "false",
        "CAUSTICMILL_PREPARE": "false",
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }
    server = subprocess.Popen(
        [str(venv / "bin" / IMAGE.json("ENTRYPOINT")[0]), *IMAGE.json("CMD")[:1], "--port", "0"],
        env=inside,
        cwd="/",
        stdout=subprocess.PIPE,
        text=True,
    )
    with server:
        assert server.stdout is not None
        try:
            ready = server.stdout.readline()
            port = re.findall(r"http://127\.0\.0\.1:(\d+)", ready)[0]
            command = [word.replace(":8000", f":{port}") for word in health_check()]
            assert subprocess.run([venv / "bin" / command[0], *command[1:]], env=inside).returncode == 0
            imports = "import psycopg, obstore, rollingmill"
            assert subprocess.run([venv / "bin/python", "-c", imports], env=inside).returncode == 0
            server.send_signal(signal.SIGTERM)
            assert server.wait(PATIENCE_S) == 0
            assert (
                subprocess.run(
                    [venv / "bin" / command[0], *command[1:]], env=inside, stderr=subprocess.DEVNULL
                ).returncode
                != 0
            )
        finally:
            server.kill()
    until(lambda: server.poll() is not None, what="its end")
