"""The farm of docker/compose.yaml: its parts fit together, and every command in it is one of ours."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from service.cli.app import app
from service.settings import ServerSettings
from tests.docker.dockerfile import ROOT

FILE = ROOT / "docker/compose.yaml"
FARM: dict[str, Any] = yaml.safe_load(FILE.read_text())
SERVICES: dict[str, dict[str, Any]] = FARM["services"]
OURS = {name: service for name, service in SERVICES.items() if service["image"] == "causticmill"}
KEYS = {
    "image", "build", "init", "restart", "read_only", "tmpfs", "cap_drop", "security_opt", "environment", "secrets",
    "depends_on", "volumes", "shm_size", "stop_grace_period", "healthcheck", "command", "entrypoint", "ports", "deploy",
    "profiles", "devices", "group_add", "networks",
}  # fmt: skip


def substituted(text: str) -> str:
    """${NAME:-default} as its default."""
    return re.sub(r"\$\{[A-Z_]+:-([^}]*)\}", r"\1", text)


def test_every_key_is_one_of_composes() -> None:
    assert {key for key in FARM if not key.startswith("x-")} == {"name", "services", "networks", "volumes", "secrets"}
    assert {key for service in SERVICES.values() for key in service} <= KEYS


def test_volumes_secrets_and_services_that_are_named_are_there() -> None:
    for service in SERVICES.values():
        sources = {volume.split(":")[0] for volume in service.get("volumes", [])}
        assert {source for source in sources if source[0] != "."} <= set(FARM["volumes"])
        assert all((FILE.parent / source).exists() for source in sources if source[0] == ".")
        assert set(service.get("secrets", [])) <= set(FARM["secrets"])
        for name, condition in service.get("depends_on", {}).items():
            assert name in SERVICES
            if condition["condition"] == "service_healthy":
                assert "test" in SERVICES[name]["healthcheck"]
    used = {volume.split(":")[0] for service in SERVICES.values() for volume in service.get("volumes", [])}
    assert set(FARM["volumes"]) <= used


@pytest.mark.parametrize("name", [name for name, service in OURS.items() if "entrypoint" not in service])
def test_every_command_is_accepted_by_our_command_line(name: str) -> None:
    """Parsed in full by the real parser, which refuses unknown options and values; nothing is run."""
    command, *arguments = [substituted(word) for word in OURS[name]["command"]]
    group = typer.main.get_command(app)
    subcommand = group.commands[command]  # type: ignore[attr-defined]
    with subcommand.make_context(command, arguments) as context:
        assert context.params


def test_one_variable_names_the_mill_for_api_and_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What runs before the agent writes the token and the list of agents that the API reads."""
    from service.server.fleet.registry import remote_machines

    files = SERVICES["mill-files"]
    assert files["entrypoint"] == ["python", "-c"]
    assert files["environment"] == {"MILL_MACHINE": "${MILL_MACHINE:-grbl}"}
    monkeypatch.setenv("MILL_MACHINE", "router")
    for _ in range(2):  # it runs at every start
        exec(files["command"][0].replace("/mill", str(tmp_path)).replace(f"http:/{tmp_path}", "http://mill"))
    (machine,) = remote_machines(tmp_path / "agents.toml")
    assert (machine.name, machine.url, machine.token_file) == ("router", "http://mill-agent:8765", tmp_path / "token")
    assert (tmp_path / "token").stat().st_mode & 0o777 == 0o600
    assert SERVICES["api"]["environment"]["CAUSTICMILL_AGENTS_FILE"] == "/mill/agents.toml"
    for name in ("agent", "sim-agent"):
        command, after = SERVICES[name]["command"], SERVICES[name]["depends_on"]
        assert (
            command[command.index("--machine") + 1] == files["environment"]["MILL_MACHINE"] == "${MILL_MACHINE:-grbl}"
        )
        assert command[command.index("--bind-port") + 1] == "8765"
        assert after["mill-files"]["condition"] == "service_completed_successfully"
        assert SERVICES[name]["networks"] == {"mill": {"aliases": ["mill-agent"]}}


def test_every_setting_is_one_of_ours() -> None:
    known = {f"CAUSTICMILL_{name.upper()}" for name in ServerSettings.model_fields}
    known |= {"CAUSTICMILL_SECRETS", "MILL_MACHINE"}
    for service in OURS.values():
        assert {key for key in service.get("environment", {}) if not key.startswith("AWS_")} <= known


def test_a_farm_of_it_is_safe_by_our_own_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its settings, with its secrets as files, make a store that all workers share."""
    script = tmp_path / "docker/make-secrets.sh"
    script.parent.mkdir()
    shutil.copy(ROOT / "docker/make-secrets.sh", script)
    subprocess.run([script], check=True, capture_output=True)
    assert subprocess.run([script], capture_output=True).returncode == 2, "an old password is not lost"
    for key, value in SERVICES["worker"]["environment"].items():
        monkeypatch.setenv(key, substituted(value))
    monkeypatch.setenv("CAUSTICMILL_SECRETS", str(script.parent / "secrets"))
    settings = ServerSettings.load()
    password = (script.parent / "secrets/postgres_password").read_text()
    assert settings.database_url == f"postgresql://causticmill:{password}@postgres/causticmill"
    assert not settings.embedded and settings.store_is_shared and settings.store_url == "file:///objects"
    for name, secret in FARM["secrets"].items():
        assert (script.parent / secret["file"]).name == name


def test_nobody_is_root_or_gains_rights() -> None:
    for service in OURS.values():
        assert service["cap_drop"] == ["ALL"] and service["read_only"] is True and service["init"] is True
        assert "user" not in service and "privileged" not in service


def test_the_api_is_published_on_this_computer_only() -> None:
    assert [service["ports"] for service in SERVICES.values() if "ports" in service] == [SERVICES["api"]["ports"]]
    assert all(port.startswith("127.0.0.1:") for port in SERVICES["api"]["ports"])


def test_an_agent_is_on_a_network_that_leaves_this_computer_nowhere() -> None:
    """What it and the API say to each other is not encrypted: --behind-proxy must be true in another way."""
    assert FARM["networks"] == {"mill": {"internal": True}}
    on_it = {name for name, service in SERVICES.items() if "mill" in service.get("networks", [])}
    assert on_it == {"api", "agent", "sim-agent", "sim-mill"}
    for name in ("agent", "sim-agent"):
        assert list(SERVICES[name]["networks"]) == ["mill"] and "ports" not in SERVICES[name]
        assert "--behind-proxy" in SERVICES[name]["command"]


@pytest.mark.skipif(
    shutil.which("docker") is None
    or subprocess.run(["docker", "compose", "version"], capture_output=True).returncode != 0,
    reason="no docker compose here",
)
@pytest.mark.parametrize("profile", ["mill", "simulated"])
def test_compose_itself_reads_it(profile: str) -> None:
    subprocess.run(["docker", "compose", "-f", FILE, "--profile", profile, "config", "--quiet"], check=True)
