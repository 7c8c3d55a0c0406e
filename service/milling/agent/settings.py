"""The settings of an agent, and the folder of a mill's journal."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from machines.port import stable_name
from service.errors import FailedError, InputError, sentence_of_os_error
from service.http.hosts import is_loopback, require_unread
from service.milling.agent.card import TOKEN_FILE, make_token, read_token
from service.processes.files import keep_private


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentSettings:
    """machine is the profile's name; port_url overrules the profile's own port (None: as the profile says).

    token_path : file of the token, shown to the person; None if it was given by --token-file
    token_file : file of the token in either case
    """

    machine: str
    port_url: str
    host: str
    bind_port: int
    folder: Path
    token: str
    token_path: Path | None
    token_file: Path


def state_home() -> Path:
    """Return $XDG_STATE_HOME/causticmill, or ~/.local/state/causticmill."""
    home = os.environ.get("XDG_STATE_HOME")
    return Path(home if home else Path.home() / ".local" / "state") / "causticmill"


def mill_folder(machine: str, *, own_port: str | None, port_url: str) -> Path:
    """Return the folder of one mill's journal and programs, the same for `mill` and `stream`.

    It is named after the profile if that names a port, because it then stands for one mill; otherwise after the port.
    """
    if not port_url or (own_port is not None and stable_name(own_port) == port_url):
        return state_home() / machine
    return state_home() / port_slug(port_url)


def port_slug(url: str) -> str:
    """Return a file name that stays the same for the same port."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", url).strip("-.") or "port"


@contextlib.contextmanager
def report_disk_errors(folder: Path) -> Iterator[None]:
    """Turn errors of the disk, when the folder is first used, into FailedError: one line that names the folder."""
    try:
        yield
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing=f"cannot use the data folder {folder}")) from None


def _refuse_foreign_bind(host: str, token_file: Path | None, *, behind_proxy: bool) -> None:
    """Raise InputError if the agent would be reachable from elsewhere without TLS, or with a token that no one else
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
    """Check and complete the values of the command line. A token always protects the mill: if no file is given, a token
    is made.
    """
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
