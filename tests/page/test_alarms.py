"""What a person is told and offered after each alarm in the middle of a program."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import pytest
from playwright.sync_api import Page, Route, expect

from machines.grbl.replies import SPINDLE_ON_ALARMS
from tests.levels import mostly_thorough
from tests.page.conftest import Opened
from tests.page.driving import machine_state, tick_all
from tests.page.machine_states import PLAN, locked, told, with_control
from tests.page.test_next_step import RAISED, after, orders_of

SAID = {
    1: "hard limit hit",
    2: "move would leave the travel",
    3: "reset while moving",
    4: "probe was already touching",
    5: "probe did not touch within its travel",
    6: "homing stopped by a reset",
    7: "homing stopped by the safety door",
    8: "homing could not leave the switch",
    9: "homing did not find the switch",
    10: "homing of a second motor failed",
}
LOST = {"position_trusted": False, "zeroed": ""}
EITHER = {min(SAID.keys() & SPINDLE_ON_ALARMS), min(SAID.keys() - SPINDLE_ON_ALARMS)}  # the spindle turns, or not


def way_on(number: int) -> Callable[[Route], None]:
    """Answers whoever asks how to go on."""
    plan = PLAN | {"ready": True, "needs": [], "words": [f"the way on after alarm {number}"]}
    return lambda route: route.fulfill(json=plan)


def lock_by_alarm(page: Page, number: int) -> None:
    """This alarm in the middle of a program: its words are on the page, and whether the spindle turns."""
    on, line = number in SPINDLE_ON_ALARMS, page.locator(".next")
    turns = {"spindle_on": on, "spindle_rpm": 18000 if on else 0}
    told(page, "interrupted", operator="Ada", mill=LOST | turns | locked(number))
    expect(line).to_contain_text(f"Locked: {SAID[number]}.")
    assert "(" not in line.text_content().split(SAID[number])[0], number
    expect(machine_state(page)).to_have_text("locked")
    expect(page.locator(".running .mark")).to_have_text("interrupted")
    spindle = page.locator(".pace div", has_text="Spindle").locator("dd")
    expect(spindle).to_have_text("on, 18,000 rpm" if on else "off")


@pytest.mark.thorough
def test_after_every_alarm_its_words_and_the_spindle_are_on_the_page(opened: Opened) -> None:
    page = with_control(opened, "interrupted")
    for number in SAID:
        lock_by_alarm(page, number)


@pytest.mark.parametrize("numbers", mostly_thorough((EITHER, sorted(SAID.keys() - EITHER)), quick=(EITHER,)), ids=str)
def test_after_an_alarm_home_and_the_way_on_are_offered(opened: Opened, numbers: Iterable[int]) -> None:
    page = with_control(opened, "interrupted")
    line, go = page.locator(".next"), page.get_by_role("button", name="Go on from line 8,640")
    for number in numbers:
        lock_by_alarm(page, number)
        expect(go).to_be_hidden()
        sent = orders_of(page)
        line.get_by_role("button", name="Home", exact=True).click()
        after(sent, 1, page)
        assert sent == [("home", {})]
        homed = RAISED | {"state": "idle", "detail": "", "code": "", "alarm": 0, "spindle_on": False, "needs": []}
        told(page, "interrupted", operator="Ada", mill=homed, plan=way_on(number))
        expect(line).to_contain_text("go on with it")
        expect(page.locator(".recover")).to_contain_text(f"the way on after alarm {number}")
        tick_all(page.locator(".recover"))
        page.get_by_label("Operator").fill("Ada")
        sent = orders_of(page)
        go.click()
        after(sent, 1, page)
        assert [(name.partition(":")[2], body["plan"]) for name, body in sent] == [("recover", PLAN["plan"])]
