"""systemd units of the server and of the agents of mills.

The server's unit starts no agents, because everything it starts ends with it and an agent must outlive it. Each agent
has its own unit.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from service.errors import FailedError, InputError, sentence_of_os_error
from service.processes.files import write_whole

_OURS = "# Written by `causticmill service install`."
_SYSTEM = Path("/etc/systemd/system")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,60}")

_HARDENED = """\
NoNewPrivileges=yes
RestrictSUIDSGID=yes
LockPersonality=yes
UMask=0077
"""
# Needs mount namespaces, which a user's own manager cannot make everywhere.
_WALLED = """\
ProtectSystem=strict
ProtectHome=read-only
ReadWritePaths={data}
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectControlGroups=yes
"""

_SERVER = """\
[Unit]
Description=causticmill job server
Documentation=man:systemd.service(5)
After=network.target
# a database or a store that comes later than we do is waited for
StartLimitIntervalSec=0

[Service]
Type=exec
ExecStart={command} serve --data {data} --no-agents
Environment=PYTHONUNBUFFERED=1 "XDG_CACHE_HOME={cache}"
EnvironmentFile=-{settings}
{account}Restart=on-failure
RestartSec=5
# 2: its configuration was refused, which another start does not change
RestartPreventExitStatus=2
# the supervisor ends its children well; what it leaves after that is killed
KillMode=mixed
TimeoutStopSec=40
{hardened}
[Install]
WantedBy={target}
"""

_AGENT = """\
[Unit]
Description=causticmill agent of the mill {machine}
After=network.target
StartLimitIntervalSec=300
StartLimitBurst=10

[Service]
Type=exec
ExecStart={command} mill --machine {machine} --data {data}/agents/{machine} --bind-port 0{port}
Environment=PYTHONUNBUFFERED=1 "XDG_CACHE_HOME={cache}"
EnvironmentFile=-{settings}
{account}Restart=on-failure
RestartSec=2
RestartPreventExitStatus=2
# a stop holds the mill first and waits until it stands
KillMode=mixed
TimeoutStopSec=30
{hardened}
[Install]
WantedBy={target}
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnitOrder:
    """machine: the unit of its agent, else of the server; account: who runs a system's unit."""

    data: Path
    system: bool
    account: str
    machine: str | None = None
    mill_port: str | None = None

    @property
    def name(self) -> str:
        return "causticmill.service" if self.machine is None else f"causticmill-mill-{self.machine}.service"

    @property
    def path(self) -> Path:
        if self.system:
            return _SYSTEM / self.name
        home = os.environ.get("XDG_CONFIG_HOME")
        return (Path(home) if home else Path.home() / ".config") / "systemd" / "user" / self.name


def unit_text(order: UnitOrder) -> str:
    """Return the unit. InputError if a name cannot be written into a unit."""
    if order.machine is not None and not _NAME.fullmatch(order.machine):
        raise InputError(f"--machine {order.machine!r}; allowed: letters, digits, . _ -")
    if not _NAME.fullmatch(order.account):
        raise InputError(f"--account {order.account!r}; allowed: the name of an account of this computer")
    data = _word(str(order.data), "--data")
    settings = order.data / "settings.env"
    return f"{_OURS}\n" + (_SERVER if order.machine is None else _AGENT).format(
        command=_command(),
        data=data,
        cache=_text(str(order.data / "cache"), "--data").replace("$$", "$"),
        settings=_text(str(settings), "--data").replace("$$", "$"),  # a lone path: taken unchanged except for %
        machine=order.machine,
        port="" if order.mill_port is None else f" --port {_word(order.mill_port, '--mill-port')}",
        account=_account(order),
        hardened=_harden(order, data),
        target="multi-user.target" if order.system else "default.target",
    )


def install(order: UnitOrder, *, force: bool) -> list[str]:
    """Write the unit and make the data folder; return lines with the person's next steps."""
    text = unit_text(order)
    try:
        if order.path.exists() and not force and _OURS not in order.path.read_text(encoding="utf-8"):
            raise InputError(f"{order.path} is not ours; allowed: with --force")
        order.data.mkdir(parents=True, exist_ok=True, mode=0o700)
        order.path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(order.path, text)
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot write the unit")) from None
    return [f"written: {order.path}", *_next_steps(order)]


def _next_steps(order: UnitOrder) -> list[str]:
    user = "" if order.system else "--user "
    steps = [f"systemctl {user}daemon-reload", f"systemctl {user}enable --now {order.name}"]
    if order.system:
        made = f"useradd --system --home-dir {order.data} {order.account}"
        groups = f"usermod --append --groups dialout {order.account}" if order.machine is not None else None
        owned = f"chown -R {order.account}: {order.data}"
        steps = [made, *([groups] if groups else []), owned, *steps]
    else:
        steps.append("loginctl enable-linger    # so that it runs when you are not logged in")
    settings = f"settings (CAUSTICMILL_...=..., one a line) go into {order.data / 'settings.env'}"
    return ["then:", *(f"    {step}" for step in steps), settings]


def _account(order: UnitOrder) -> str:
    if not order.system:
        return ""
    groups = "SupplementaryGroups=dialout\n" if order.machine is not None else ""
    return f"User={order.account}\n{groups}"


def _harden(order: UnitOrder, data: str) -> str:
    if not order.system:
        return _HARDENED
    devices = "PrivateDevices=yes\n" if order.machine is None else ""  # an agent needs its port
    private = "" if order.data.parts[1:2] == ("tmp",) else "PrivateTmp=yes\n"
    return _HARDENED + _WALLED.format(data=data) + devices + private


def _command() -> str:
    """Return the command of this installation."""
    beside = Path(sys.executable).with_name("causticmill")
    found = str(beside) if beside.is_file() else shutil.which("causticmill")
    if found is None:
        return f"{_word(sys.executable, 'python')} -m service.cli.main"
    return _word(found, "causticmill")


def _word(text: str, name: str) -> str:
    """Return one word of a unit's line."""
    text = _text(text, name)
    return f'"{text}"' if " " in text else text


def _text(text: str, name: str) -> str:
    """Escape the text so that systemd does not expand specifiers or variables in it."""
    if not text.isprintable() or any(c in text for c in "\"'\\"):
        raise InputError(f"{name} {text!r} cannot stand in a unit file; allowed: a name without quotes and backslashes")
    return text.replace("%", "%%").replace("$", "$$")
