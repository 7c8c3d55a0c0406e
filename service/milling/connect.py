"""Opens a Mill with its own thread from a machine's name and a port; shared by `mill` and `stream`."""

from __future__ import annotations

from machines.driver import Driver
from machines.errors import ProgramRefusedError
from machines.grbl.settings import ControllerSettings
from machines.open_driver import open_driver
from machines.port import stable_name
from machines.preflight.preflight import Preflight
from machines.profile import MachineProfile, load_profile
from phrases.phrase import Phrase
from service.errors import InputError

_FIND_THEMSELVES = ("roland-usb", "none")  # "none" reports by itself that it cannot be driven


def machine_and_port(machine: str, port: str | None) -> tuple[MachineProfile, str]:
    """Return the profile and the mill's port: the given one, else the profile's; "" if the driver finds the mill
    itself.
    """
    profile = load_profile(machine)
    url = port or profile.link.port
    if not url and profile.link.driver not in _FIND_THEMSELVES:
        raise InputError(
            f"--port: machine '{machine}' names no port of its own; allowed: --port /dev/serial/by-id/..., "
            "socket://host:port, or port = ... under [link] in a profile of yours"
        )
    return profile, stable_name(url) if url else ""


def demand_blocks(facts: Preflight, name: str) -> None:
    """Refuse an empty file or one of comments only: it would be `finished` at once, which no one intends."""
    if facts.blocks == 0:
        raise ProgramRefusedError(
            0,
            "",
            Phrase("{name}: {lines} lines and not one block in them; allowed: a program", name=name, lines=facts.lines),
        )


class Connector:
    """Opens the link each time the mill asks for it. The first time can be done beforehand, to see whether it fails."""

    def __init__(self, profile: MachineProfile, url: str) -> None:
        self._profile = profile
        self._url = url
        self._ready: Driver | None = None
        self._latest: Driver | None = None

    @property
    def settings(self) -> ControllerSettings | None:
        """The controller's settings; None if it has not reported them, or if the link has no such answers."""
        settings = getattr(self._latest, "settings", None)
        return settings if isinstance(settings, ControllerSettings) and settings.values else None

    def open_now(self) -> None:
        """Open the link and keep it for the first call; PortError if that fails."""
        if self._ready is None:
            self._ready = self()

    def close_unused(self) -> None:
        """Close a link that was not used."""
        if self._ready is not None:
            self._ready.close()
            self._ready = None

    def __call__(self) -> Driver:
        if self._ready is not None:
            driver, self._ready = self._ready, None
            return driver
        self._latest = open_driver(self._profile, self._url or None)
        return self._latest
