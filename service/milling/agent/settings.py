"""What an agent is started with, and where a mill's journal lives."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from machines.port import stable_name
from service.errors import FailedError, InputError, sentence_of_os_error
from service.http.event_hub import HEARTBEAT_S
from service.http.hosts import is_loopback, require_unread
from service.milling.agent.card import TOKEN_FILE, make_token, read_token
from service.processes.files import keep_private


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentSettings:
    """machine is the profile's name; port_url overrules the profile's own port (None: as the profile says).

    token_path : where the token lies, for the person to read; None when it was given by --token-file
    token_file : where the token lies in any case
    """

    machine: str
    port_url: str
    host: str
    bind_port: int
    folder: Path
    token: str
    token_path: Path | None
    token_file: Path
    max_program_bytes: int = 4 << 30
    ring_events: int = 1000
    heartbeat_s: float = HEARTBEAT_S
    subscribers: int = 32


def state_home() -> Path:
    """Return $XDG_STATE_HOME/causticmill, or ~/.local/state/causticmill."""
    home = os.environ.get("XDG_STATE_HOME")
    return Path(home if home else Path.home() / ".local" / "state") / "causticmill"


def mill_folder(machine: str, *, own_port: str | None, port_url: str) -> Path:
    """Return where journal and programs of one mill live, the same for `mill` and `stream`.

    A profile that names its port is one certain mill: its name. A general profile serves many: the port's.
    """
    if not port_url or (own_port is not None and stable_name(own_port) == port_url):
        return state_home() / machine
    return state_home() / port_slug(port_url)


def port_slug(url: str) -> str:
    """Return a file name that stays the same for the same port."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", url).strip("-.") or "port"


@contextlib.contextmanager
def report_disk_errors(folder: Path) -> Iterator[None]:
    """Raise FailedError, one line that names the folder, for what the disk refuses when it is taken into use."""
    try:
        yield
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing=f"cannot use the data folder {folder}")) from None


def _refuse_foreign_bind(host: str, token_file: Path | None, *, behind_proxy: bool) -> None:
    """Raise InputError where the agent would be reachable from elsewhere without TLS, or with a token nobody else
    knows.
    """
    if is_loopback(host):
        return
    where = f"--host {host} can be reached from other computers"
    fix = "127.0.0.1, or a proxy with TLS in front and --behind-proxy"
    require_unread(host, where, vouched=behind_proxy, allowed=fix)
    if token_file is None:
        raise InputError(f"{where}, whose callers need the token; allowed: with --token-file FILE")


def make_agent_settings(
    *,
    machine: str,
    port_url: str,
    own_port: str | None,
    host: str,
    bind_port: int,
    data: Path | None,
    token_file: Path | None,
    behind_proxy: bool = False,
) -> AgentSettings:
    """Check and complete what the command line gave. A token always guards the mill: without a file one is made."""
    _refuse_foreign_bind(host, token_file, behind_proxy=behind_proxy)
    if not 0 <= bind_port <= 65535:
        raise InputError(f"--bind-port {bind_port}; allowed: 0 (any free one) to 65535")
    folder = keep_private(data or mill_folder(machine, own_port=own_port, port_url=port_url))
    token, path = (read_token(token_file), None) if token_file is not None else make_token(folder)
    return AgentSettings(
        machine=machine,
        port_url=port_url,
        host=host,
        bind_port=bind_port,
        folder=folder,
        token=token,
        token_path=path,
        token_file=path or token_file or folder / TOKEN_FILE,
    )
