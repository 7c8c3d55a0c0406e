"""Finds the mills: the person's own profiles that name a port, agents on other computers, a simulated one.

The files are read again each time, so a corrected or new profile works at once, and a broken one only affects itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from machines.profile import (
    MachineProfile,
    ProfileError,
    UnknownProfileError,
    find_own_profiles,
    load_profile,
)
from machines.profile_values import UnreadableFileError, read_data
from phrases.phrase import Phrase
from service.errors import InputError, printable
from service.http.hosts import require_unread
from service.milling.agent.settings import state_home
from service.settings import ServerSettings

SIMULATED = "simulated"
_FINDS_ITSELF = "roland-usb"
_TEXTS = {"machine", "url", "token_file"}


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownMachine:
    """A mill that may have an agent.

    folders    : where a local agent's agent.json may lie, the one `serve` starts first; empty for a remote one
    url, token_file : of a remote agent
    problem    : why it cannot be used, in words
    simulated  : there is no mill, only a model of one
    camera     : address of the camera beside it
    """

    name: str
    profile: MachineProfile | None = None
    folders: tuple[Path, ...] = ()
    url: str = ""
    token_file: Path | None = None
    problem: str = ""
    simulated: bool = False
    camera: str = ""

    @property
    def remote(self) -> bool:
        return bool(self.url)


def read_machines(settings: ServerSettings) -> tuple[dict[str, KnownMachine], list[str]]:
    """Return the machines by name, sorted, and the fault of the list of remote ones."""
    found = {machine.name: machine for machine in _local_machines(settings)}
    problems: list[str] = []
    if settings.simulated_mill:
        if SIMULATED in found:
            problems.append(
                Phrase("there is a mill of the name '{name}', so no simulated one is offered", name=SIMULATED)
            )
        else:
            found[SIMULATED] = _describe_simulated(settings)
    try:
        remote = remote_machines(settings.agents_file) if settings.agents_file is not None else []
    except InputError as error:
        remote, problems = [], [str(error)]
    for machine in remote:
        if machine.name in found:
            problems.append(
                Phrase(
                    "machine '{machine}' of the agents file is a machine of this computer, too", machine=machine.name
                )
            )
        else:
            found[machine.name] = machine
    found |= {name: replace(found[name], camera=url) for name, url in settings.cameras.items() if name in found}
    return dict(sorted(found.items())), problems


def local_folder(settings: ServerSettings, machine: str) -> Path:
    """Return the folder of the agent that `serve` starts."""
    return (settings.agents_folder / machine).absolute()


def folder_of_simulated(settings: ServerSettings) -> Path:
    """Return the folder of the simulated mill's profile and port, and its agent's folder `agent`."""
    return (settings.data / "simulated").absolute()


def _describe_simulated(settings: ServerSettings) -> KnownMachine:
    """Return the mill that `serve --with-simulated-mill` keeps."""
    folders = (folder_of_simulated(settings) / "agent",)
    try:
        profile = load_profile(SIMULATED, (folder_of_simulated(settings),))
    except (ProfileError, UnknownProfileError) as error:
        return KnownMachine(name=SIMULATED, folders=folders, simulated=True, problem=printable(str(error)))
    return KnownMachine(name=SIMULATED, profile=profile, folders=folders, simulated=True)


def _local_machines(settings: ServerSettings) -> Iterator[KnownMachine]:
    for name in find_own_profiles():
        folders = (local_folder(settings, name), state_home() / name)
        try:
            profile = load_profile(name)
        except (ProfileError, UnknownProfileError) as error:
            yield KnownMachine(name=name, folders=folders, problem=printable(str(error)))
            continue
        if profile.link.driver == "none" or not (profile.link.port or profile.link.driver == _FINDS_ITSELF):
            continue  # a profile to make programs for, not a mill at the end of a wire
        yield KnownMachine(name=name, profile=profile, folders=folders)


def remote_machines(path: Path) -> list[KnownMachine]:
    """Return the agents file: [[agents]] tables with machine, url, token_file, and private_network = true if no one
    else is on the network between here and the agent. InputError names its fault.
    """
    try:
        rows = read_data(path).get("agents", [])
    except UnreadableFileError as error:
        raise InputError(Phrase("agents file {path}: {cause}", path=path, cause=error.words)) from None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(
            Phrase("agents file {path}: allowed: [[agents]] tables with machine, url and token_file", path=path)
        )
    machines = [_remote(path, number, row) for number, row in enumerate(rows, start=1)]
    names = [machine.name for machine in machines]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(Phrase("agents file {path}: machine '{twice}' is named twice", path=path, twice=twice))
    return machines


def _remote(path: Path, number: int, row: dict[str, Any]) -> KnownMachine:
    where = Phrase("agents file {path}, agent {number}", path=path, number=number)
    texts = {key: value for key, value in row.items() if key != "private_network"}
    private = row.get("private_network", False)
    if set(texts) != _TEXTS or not all(isinstance(value, str) for value in texts.values()):
        raise InputError(
            Phrase("{where}: allowed: machine, url and token_file, each a text, and private_network", where=where)
        )
    if not isinstance(private, bool):
        raise InputError(
            Phrase(
                "{where}: private_network = {value}; allowed: true or false", where=where, value=repr(str(private)[:40])
            )
        )
    try:
        parts = urlsplit(row["url"])
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and not parts.query and parts.port != 0
    except ValueError:
        good = False
    if not good:
        raise InputError(
            Phrase(
                "{where}: url = '{url}'; allowed: https://..., or http://127.0.0.1:port",
                where=where,
                url=row["url"][:200],
            )
        )
    if parts.scheme == "http":
        require_unread(
            str(parts.hostname),
            Phrase("{where}: url = '{url}' is on another computer", where=where, url=row["url"][:200]),
            vouched=private,
            allowed=Phrase(
                "https://... of a proxy with TLS in front of the agent, http://127.0.0.1:port, or "
                "private_network = true where nobody else is on the network between them"
            ),
        )
    if not row["machine"] or "/" in row["machine"]:
        raise InputError(
            Phrase(
                "{where}: machine = '{machine}'; allowed: a name without /", where=where, machine=row["machine"][:80]
            )
        )
    token_file = path.parent / Path(row["token_file"]).expanduser()
    return KnownMachine(name=row["machine"], url=row["url"].rstrip("/"), token_file=token_file)
