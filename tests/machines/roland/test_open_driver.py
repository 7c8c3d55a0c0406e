"""Which driver a profile gets, and what is refused before a port is touched."""

from __future__ import annotations

from dataclasses import replace

import pytest

from machines.drip.driver import DripDriver
from machines.driver import Driver
from machines.errors import MachineError, NotAllowedError, PortError
from machines.open_driver import open_driver
from machines.profile import LinkSettings, MachineProfile, load_profile
from machines.roland.serial_driver import RolandSerialDriver

GRBL = load_profile("grbl", ())


def linked(**link: object) -> MachineProfile:
    return replace(GRBL, link=LinkSettings(**link))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("profile", "url", "words"),
    [
        (linked(driver="none"), None, "copy the program to the machine's own computer"),
        (load_profile("linuxcnc", ()), "loop://", "copy the program to the machine's own computer"),
        (linked(driver="grbl"), None, "names no port"),
        (linked(driver="drip", flow="xonxoff"), "loop://", "it obeys DC1 and DC3 itself"),
        (linked(driver="roland-serial"), "loop://", "'rtscts'"),
        (linked(driver="lpt"), "loop://", "not a driver that exists"),
    ],
)
def test_a_link_that_cannot_work_is_refused_in_words(profile: MachineProfile, url: str | None, words: str) -> None:
    with pytest.raises(MachineError, match=words):
        open_driver(profile, url)


def test_the_roland_profile_asks_for_its_mill_on_usb_and_for_no_serial_port() -> None:
    profile = load_profile("roland-mdx-40a", ())
    assert profile.link.port == "usb:mdx-40a"
    with pytest.raises(PortError, match="usb:mdx-40a"):
        open_driver(profile, None)  # no such mill here, or no libusb
    with pytest.raises(PortError, match="found by its USB identity"):
        open_driver(profile, "/dev/ttyUSB0")


def test_the_okuma_profile_gets_a_drip_feed_on_a_port_without_handshake_of_its_own() -> None:
    driver: Driver = open_driver(load_profile("okuma-osp", ()), "loop://")
    assert isinstance(driver, DripDriver)
    assert "never a real Okuma" in driver.facts.tried_on
    driver.close()


@pytest.mark.parametrize("url", ["socket://127.0.0.1:1", "rfc2217://127.0.0.1:1"])
def test_a_roland_on_a_port_that_hides_its_queue_is_refused_before_it_is_opened(url: str) -> None:
    with pytest.raises(NotAllowedError, match="cannot tell how many bytes it still holds"):
        open_driver(linked(driver="roland-serial", flow="rtscts"), url)


def test_a_roland_profile_of_ones_own_gets_the_serial_driver_with_its_dialect() -> None:
    driver = open_driver(replace(linked(driver="roland-serial", flow="rtscts"), dialect="rml-1"), "loop://")
    assert isinstance(driver, RolandSerialDriver)
    driver.close()
