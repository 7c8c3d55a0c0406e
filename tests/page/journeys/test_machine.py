"""The machine screen at a mill: who may move it and how, and what stops it."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Page, Route, expect

from tests.page.conftest import Opened
from tests.page.driving import homed, logged, machine_state, readout, release, setup, take_control
from tests.page.machine_states import taken
from tests.page.shop import MILL, Shop

SCREEN = f"#/machines/{MILL}"


@pytest.fixture
def at_mill(opened: Opened, shop: Shop) -> Iterator[Page]:
    """A page with control of a homed mill."""
    page = opened(SCREEN, key="Ada")
    take_control(page)
    homed(page)
    yield page
    release(page)


def places(page: Page) -> list[str]:
    return [readout(page, axis).inner_text() for axis in "XYZ"]


def jogs_sent(page: Page) -> list[str]:
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.post_data or "") if request.url.endswith("/jog") else None)
    return sent


def press_stop(page: Page, name: str) -> None:
    """Until the mill's own log says that it has come."""
    with logged(page, rf"\b{name}\b"):
        page.get_by_role("button", name=name).click()


@pytest.mark.thorough
def test_one_press_is_one_step(at_mill: Page) -> None:
    sent = jogs_sent(at_mill)
    at_mill.get_by_label("0.1", exact=True).check()
    expect(readout(at_mill, "X", own=True)).to_have_text("−1.000")  # where homing ends
    at_mill.get_by_role("button", name="X minus").click()
    expect(readout(at_mill, "X", own=True)).to_have_text("−1.100")
    assert len(sent) == 1


@pytest.mark.thorough
def test_a_key_moves_the_mill_only_while_the_pad_is_armed_and_only_once(at_mill: Page) -> None:
    sent = jogs_sent(at_mill)
    at_mill.get_by_role("button", name="X minus").focus()
    at_mill.keyboard.press("ArrowLeft")
    assert sent == [], "not armed"
    at_mill.get_by_role("button", name="Use keyboard or gamepad").click()
    with logged(at_mill, "Jog X.*: done"):
        for _ in range(5):  # held down: the browser repeats it
            at_mill.keyboard.down("ArrowLeft")
        at_mill.keyboard.up("ArrowLeft")
    expect(machine_state(at_mill)).to_have_text("idle")
    assert len(sent) == 1
    at_mill.get_by_label("One line to the mill").focus()
    at_mill.keyboard.press("ArrowLeft")
    at_mill.get_by_role("button", name="X minus").focus()
    at_mill.keyboard.press("ArrowLeft")
    assert len(sent) == 1, "armed only as long as the focus stays in the pad"


@pytest.mark.thorough
def test_without_control_nothing_that_moves_can_be_pressed_but_what_stops_can(opened: Opened, shop: Shop) -> None:
    page = opened(SCREEN, key="Ada")
    take_control(page)
    homed(page)
    release(page)
    for name in ("X minus", "Home", "Unlock", "X = 0 here", "Send"):
        expect(page.get_by_role("button", name=name, exact=True)).to_be_disabled()
    for name in ("HOLD", "STOP"):
        press_stop(page, name)
    expect(machine_state(page)).to_have_text("idle")


@pytest.mark.thorough
def test_one_has_control_the_others_see_who_and_may_take_it_over(opened: Opened, shop: Shop) -> None:
    ada, grace = opened(SCREEN, key="Ada"), opened(SCREEN, key="Grace")
    take_control(ada)
    expect(grace.locator(".control .who")).to_contain_text("Ada has control")
    expect(setup(grace).get_by_role("button", name="Home", exact=True)).to_be_disabled()
    grace.get_by_role("button", name="Take over").click()
    grace.get_by_role("group", name="Take over").get_by_role("button", name="Take over").click()
    expect(grace.get_by_text("You have control.")).to_be_visible()
    expect(ada.get_by_text(re.compile(r"^Grace.* has taken control\.$"))).to_be_visible()
    expect(setup(ada).get_by_role("button", name="Home", exact=True)).to_be_disabled()
    release(grace)
    expect(ada.get_by_text("Nobody has control.")).to_be_visible()


@pytest.mark.thorough
def test_a_stop_does_not_wait_for_anything(at_mill: Page) -> None:
    """An order that gets no answer does not hold it up."""
    hanging: list[Route] = []
    at_mill.route("**/control/jog", lambda route: hanging.append(route))
    with at_mill.expect_request("**/control/jog"):
        at_mill.get_by_role("button", name="X minus").click()
    press_stop(at_mill, "HOLD")
    for route in hanging:
        route.fulfill(status=202, json=taken(route))
    at_mill.get_by_role("button", name="STOP").click()  # held, the mill would be of no use to the next test
    expect(machine_state(at_mill)).to_have_text("idle")


@pytest.mark.thorough
def test_a_moving_mill_is_held_from_the_list_of_jobs_by_who_has_no_control(at_mill: Page, opened: Opened) -> None:
    watching = opened("#/", key="Grace")
    chip = watching.locator("#mill")
    expect(chip.get_by_role("button", name=f"HOLD {MILL}")).to_be_hidden()
    at_mill.get_by_label("One line to the mill").fill("G91 G1 X-60 F20")
    at_mill.get_by_role("button", name="Send").click()
    chip.get_by_role("button", name=f"HOLD {MILL}").click()
    expect(machine_state(at_mill)).to_have_text("held")
    expect(chip.locator(".chip-state")).to_have_text("held")
    at_mill.get_by_role("button", name="STOP").click()
    expect(machine_state(at_mill)).to_have_text("idle")
