"""Opens the driver for a machine's profile and a port."""

from __future__ import annotations

from machines.driver import Driver
from machines.errors import MachineError, NotAllowedError
from machines.profile import MachineProfile
from phrases.phrase import Phrase


def open_driver(profile: MachineProfile, port_url: str | None) -> Driver:
    """Open the link of this machine; the caller calls `connect`. MachineError: one line with the reason."""
    kind = profile.link.driver
    url = port_url or profile.link.port
    if kind == "none":
        raise NotAllowedError(
            Phrase(
                "this server has no link to machine '{machine}': copy the program to the machine's own computer "
                "and start it there",
                machine=profile.name,
            )
        )
    if kind == "roland-usb":
        from machines.roland.usb_device import open_mdx40a
        from machines.roland.usb_driver import RolandUsbDriver

        return RolandUsbDriver(open_mdx40a(url), dialect=profile.dialect)
    if not url:
        raise NotAllowedError(
            Phrase(
                "machine '{machine}' names no port: give one (/dev/serial/by-id/..., socket://host:port), or "
                "write port = ... under [link] in a profile of your own",
                machine=profile.name,
            )
        )
    if kind == "grbl":
        return _open_grbl(profile, url)
    if kind == "drip":
        return _open_drip(profile, url)
    if kind == "roland-serial":
        return _open_roland_serial(profile, url)
    raise MachineError(
        Phrase(
            "machine '{machine}': link.driver = '{driver}' is not a driver that exists",
            machine=profile.name,
            driver=kind,
        )
    )


def _open_grbl(profile: MachineProfile, url: str) -> Driver:
    from machines.grbl.driver import GrblDriver
    from machines.grbl.link import GrblOptions
    from machines.port import open_port

    options = GrblOptions(rx_bytes=profile.link.rx_bytes, dialect=profile.dialect)
    return GrblDriver(open_port(url, profile.link), options=options)


def _open_drip(profile: MachineProfile, url: str) -> Driver:
    from machines.drip.driver import DripDriver
    from machines.port import open_port

    if profile.link.flow != "none":
        raise NotAllowedError(
            Phrase(
                "machine '{machine}': link.flow = '{flow}': allowed with the drip driver: 'none' (it obeys DC1 "
                "and DC3 itself; a port that does would hide them)",
                machine=profile.name,
                flow=profile.link.flow,
            )
        )
    return DripDriver(open_port(url, profile.link), profile.link, planner_blocks=profile.planner_blocks)


def _open_roland_serial(profile: MachineProfile, url: str) -> Driver:
    from machines.port import open_port
    from machines.roland.serial_driver import RolandSerialDriver

    if profile.link.flow != "rtscts":
        raise NotAllowedError(
            Phrase(
                "machine '{machine}': link.flow = '{flow}': allowed with the Roland serial driver: 'rtscts' "
                "(the mill stops the sender by its handshake line)",
                machine=profile.name,
                flow=profile.link.flow,
            )
        )
    if "://" in url and not url.startswith("loop://"):
        raise NotAllowedError(
            Phrase(
                "port {url} cannot tell how many bytes it still holds: a busy mill would look like a lost one and "
                "a hold would come late; allowed: a serial port of this computer",
                url=url,
            )
        )
    port = open_port(url, profile.link)
    return RolandSerialDriver(port, profile.link, dialect=profile.dialect, planner_blocks=profile.planner_blocks)
