"""The systemd units: what they hold, what is refused, and that systemd itself reads them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from service.cli.main import run
from service.errors import InputError
from service.server.supervisor.systemd import UnitOrder, unit_text


def order(data: Path, **given: object) -> UnitOrder:
    return UnitOrder(**({"data": data, "system": True, "account": "causticmill"} | given))  # type: ignore[arg-type]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
@pytest.mark.parametrize("machine", [None, "grbl"])
@pytest.mark.parametrize("folder", ["plain", "with space", "100% $HOME"])
def test_systemd_has_nothing_to_say_against_it(tmp_path: Path, machine: str | None, folder: str) -> None:
    unit = tmp_path / "causticmill-trial.service"
    unit.write_text(unit_text(order(tmp_path / folder, machine=machine)))
    said = subprocess.run(["systemd-analyze", "verify", "--man=no", unit], capture_output=True, text=True)
    about_us = [line for line in said.stderr.splitlines() if "causticmill-trial" in line]
    assert said.returncode == 0 and about_us == [], said.stderr


def test_what_a_server_may_and_what_happens_to_it(tmp_path: Path) -> None:
    lines = unit_text(order(tmp_path)).splitlines()
    for line in (
        "NoNewPrivileges=yes",
        "ProtectSystem=strict",
        f"ReadWritePaths={tmp_path}",
        "Restart=on-failure",
        "RestartPreventExitStatus=2",
        "KillMode=mixed",
        "User=causticmill",
    ):
        assert line in lines
    (command,) = [line for line in lines if line.startswith("ExecStart=")]
    assert command.endswith(f"serve --data {tmp_path} --no-agents"), "agents outlive it: in units of their own"


def test_the_agents_unit_keeps_the_mill_where_serve_looks_for_it(tmp_path: Path) -> None:
    text = unit_text(order(tmp_path, machine="grbl", mill_port="/dev/serial/by-id/x"))
    assert f"mill --machine grbl --data {tmp_path}/agents/grbl --bind-port 0 --port /dev/serial/by-id/x\n" in text
    assert "SupplementaryGroups=dialout\n" in text and "PrivateDevices" not in text


@pytest.mark.parametrize(
    "given", [{"machine": "../x"}, {"machine": "a b"}, {"account": "a;b"}, {"data": Path("/a\nb")}]
)
def test_names_that_would_mean_something_else_are_refused(tmp_path: Path, given: dict[str, object]) -> None:
    with pytest.raises(InputError):
        unit_text(order(**({"data": tmp_path} | given)))  # type: ignore[arg-type]


def test_installing_for_a_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    unit = tmp_path / "config/systemd/user/causticmill.service"
    install = ["service", "install", "--data", str(tmp_path / "data")]
    assert run([*install, "--print"]) == 0
    assert not unit.exists()
    shown = capsys.readouterr().out
    assert run(install) == 0
    assert unit.read_text() == shown
    assert "systemctl --user enable --now causticmill.service" in capsys.readouterr().out
    assert (tmp_path / "data").stat().st_mode & 0o777 == 0o700
    assert run(install) == 0, "our own is replaced"


def test_a_unit_that_is_not_ours_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    unit = tmp_path / "systemd/user/causticmill.service"
    unit.parent.mkdir(parents=True)
    unit.write_text("[Service]\nExecStart=/bin/true\n")
    install = ["service", "install", "--data", str(tmp_path / "data")]
    assert run(install) == 2
    assert capsys.readouterr().err.startswith(f"error: {unit} is not ours")
    assert "/bin/true" in unit.read_text()
    assert run([*install, "--force"]) == 0
    assert "causticmill" in unit.read_text()
