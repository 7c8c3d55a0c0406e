"""What a person does at the machine screen, step by step."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator

from playwright.sync_api import Locator, Page, expect

from tests.page.shop import MILL
from tests.waiting import until


def go_to_machine(page: Page, name: str = MILL) -> None:
    page.evaluate("name => { location.hash = `#/machines/${name}` }", name)
    expect(page.get_by_role("heading", level=1, name=name)).to_be_visible()


def machine_state(page: Page) -> Locator:
    return page.locator(".machine-state")


def readout(page: Page, axis: str, *, own: bool = False) -> Locator:
    """The figure of one axis: in work coordinates, or in the machine's own."""
    return page.locator(".readout .own" if own else ".readout .work").nth("XYZ".index(axis))


def out_of_sight(page: Page, selector: str) -> list[str]:
    """What of it is beside the window, or under a bar of the page."""
    found: list[str] = page.evaluate(
        """(selector) => [...document.querySelectorAll(selector)].filter((one) => {
            const {left, top, width, height} = one.getBoundingClientRect();
            const seen = (u, v) => one.contains(document.elementFromPoint(left + u * width, top + v * height));
            return !(seen(0.5, 0.05) && seen(0.5, 0.95));
        }).map((one) => one.outerHTML)""",
        selector,
    )
    assert page.locator(selector).count() > 0
    return found


def setup(page: Page) -> Locator:
    """The card in which a mill is homed and zeroed at any time; the next step has a button of its own."""
    return page.get_by_role("region", name="Zero and home")


def take_control(page: Page) -> None:
    """From whoever has it: a test before this one may have failed."""
    free, held = page.get_by_role("button", name="Take control"), page.get_by_role("button", name="Take over")
    expect(free.or_(held)).to_be_visible()
    if held.is_visible():
        held.click()
        page.get_by_role("group", name="Take over").get_by_role("button", name="Take over").click()
    else:
        free.click()
    expect(page.get_by_text("You have control.")).to_be_visible()


def release(page: Page) -> None:
    page.get_by_role("button", name="Give control back").click()
    expect(page.get_by_text("Nobody has control.")).to_be_visible()


def give_up(page: Page) -> None:
    """Whatever an earlier test has left on the mill is stopped, and the mill free."""
    expect(machine_state(page)).not_to_have_text("asking the server")
    if machine_state(page).inner_text() in ("running", "starting", "held"):
        page.get_by_role("button", name="STOP").click()
    loading = page.get_by_role("heading", name="Load a program")
    offers = [page.get_by_role("button", name=name, exact=True) for name in ("Give it up", "Take it off the mill")]
    expect(loading.or_(offers[0]).or_(offers[1]).first).to_be_visible()
    for offer, yes in zip(offers, ("Give it up", "Take it off"), strict=True):
        if offer.is_visible():
            offer.click()
            page.locator(".question").get_by_role("button", name=yes, exact=True).click()
    expect(loading).to_be_visible()


@contextlib.contextmanager
def logged(page: Page, words: str) -> Iterator[None]:
    """Until the page's log has an entry of this (a regular expression) made since; older ones may come late."""
    begun_s = math.floor(time.time() * 1000) / 1000
    yield
    since = """([words, begunMs]) => [...document.querySelectorAll(".log li")].some((one) =>
        new RegExp(words).test(one.innerText) && Date.parse(one.querySelector("time").dateTime) >= begunMs)"""
    page.wait_for_function(since, arg=[words, 1000 * begun_s])


def homed(page: Page) -> None:
    """Pressed again where the controller, restarting after an alarm, was still deaf to it."""
    home = setup(page).get_by_role("button", name="Home", exact=True)
    with logged(page, "Home: done"):
        home.click()
        page.wait_for_timeout(1000)
        while machine_state(page).inner_text() == "locked":
            home.click()
            page.wait_for_timeout(1000)
    expect(machine_state(page)).to_have_text("idle")


def say(page: Page, line: str) -> None:
    """And it is done: until then the link has no room for another order."""
    with logged(page, f"Line {line}: done"):
        page.get_by_label("One line to the mill").fill(line)
        page.get_by_role("button", name="Send").click()
    expect(machine_state(page)).to_have_text("idle")


def zeroed(page: Page) -> None:
    """Home, and the work zero where the lens has room."""
    homed(page)
    say(page, "G53 G0 X-150 Y-150 Z-20")
    for axis, place in zip("XYZ", ("−150.000", "−150.000", "−20.000"), strict=True):
        expect(readout(page, axis, own=True)).to_have_text(place)
    setup(page).get_by_role("button", name="X and Y = 0 here").click()
    expect(readout(page, "X")).to_have_text("0.000")
    setup(page).get_by_role("button", name="Z = 0 here", exact=True).click()
    expect(readout(page, "Z")).to_have_text("0.000")


def load(page: Page, job: str, program: str) -> None:
    page.get_by_role("combobox", name="Job").select_option(job)
    page.get_by_role("combobox", name="Program").select_option(program)
    page.get_by_role("button", name="Load onto the mill").click()
    expect(page.get_by_role("button", name=f"Start {program}")).to_be_visible()


def tick_all(within: Locator) -> None:
    """As soon as the list is there."""
    boxes = within.locator("input[type=checkbox]")
    expect(boxes.first).to_be_visible()
    for box in boxes.all():
        box.check()


def start(page: Page) -> None:
    """Every tick is needed, and a name. A plan that the mill has changed meanwhile is ticked anew, as a person does."""
    go = page.locator(".checklist:visible .go")
    expect(go).to_be_visible()
    for box in page.locator(".checklist:visible input[type=checkbox]").all():
        expect(go).to_be_disabled()
        box.check()
    page.get_by_label("Operator").fill("")
    expect(go).to_be_disabled()

    def ready() -> bool:
        for box in page.locator(".checklist:visible input[type=checkbox]").all():
            box.check()
        page.get_by_label("Operator").fill("Ada")
        page.wait_for_timeout(100)
        return go.is_enabled()

    until(ready, what="a program that can be started")
    go.click()
