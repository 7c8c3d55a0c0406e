"""The mills of a shop in the head of every screen and on one of their own: what they do, and HOLD."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.levels import mostly_thorough
from tests.page.browser import SIZES, Watched
from tests.page.canned_job import JOB_ID
from tests.page.machine_states import machine_in
from tests.page.test_orders import Way, record_orders
from tests.waiting import until

SCREENS = ("#/", "#/new", "#/machines", f"#/jobs/{JOB_ID}")
TAKEN = {"taken": True, "mill": {}}
# A browser that grants notifications, asks nobody, and keeps what it would show; a page that may be out of sight.
NOTIFYING = """
    window.asked = 0; window.told = []; window.unseen = false;
    window.Notification = class { constructor(title, {body}) { window.told.push(`${title}: ${body}`); } };
    Notification.permission = "default";
    Notification.requestPermission = async () => { window.asked += 1; return (Notification.permission = "granted"); };
    Object.defineProperty(document, "hidden", {get: () => window.unseen});
    document.hasFocus = () => !window.unseen;
"""
Mills = dict[str, tuple[str, dict[str, Any]]]  # name: state, and what is different about its run, or its "mill"


def tell(page: Page, mills: Mills) -> None:
    """From now on these are the mills that the server of this page has."""
    found = []
    for name, (state, changes) in mills.items():
        machine = machine_in(state)[0] | {"name": name}
        if "mill" in changes:
            machine["mill"] |= changes["mill"]
        elif machine["run"]:
            machine["run"] |= changes
        found.append(machine)
    page.route("**/v1/machines", lambda route: route.fulfill(json={"machines": found, "problems": []}))
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")  # who sees a page again looks at once


def opened_with(
    watched: Callable[..., Watched],
    mills: Mills,
    answer: dict[str, Any] | None = None,
    address: str = "#/",
    errors: tuple[str, ...] = (),
    script: str = "",
    **how: Any,
) -> tuple[Page, Way]:
    """A page that nobody has given a code to, and the way of its stops."""
    pages = watched(**how)
    pages.expect_errors(*errors)
    page = pages.page()
    page.add_init_script(script)
    way = Way(page, answer or TAKEN)
    tell(page, mills)
    page.goto(f"/{address}")
    expect(page.locator("#mill")).to_be_visible()
    return page, way


@pytest.mark.parametrize("size", mostly_thorough(SIZES, quick=["phone"]))
def test_a_mill_is_seen_and_held_from_every_screen(watched: Callable[..., Watched], size: str) -> None:
    page, way = opened_with(watched, {"shop": ("running", {}), "attic": ("idle", {})}, size=size)
    record_orders(page)  # what is not answered at once is said twice
    for address in SCREENS:
        page.evaluate("address => { location.hash = address }", address)
        expect(page.locator("#view h1")).to_be_visible()
        chip = page.locator("#mill")
        expect(chip.locator(".chip-state")).to_have_text("running 21 %")
        hold = chip.get_by_role("button", name="HOLD shop")
        expect(hold).to_be_in_viewport(ratio=1)
        way.heard.clear()
        hold.click()
        until(lambda: (page.wait_for_timeout(20), way.stops())[1], what=f"HOLD from {address}")
        assert way.stops() == ["shop hold"]


def test_a_hold_that_does_not_arrive_is_said_until_the_mill_stands(watched: Callable[..., Watched]) -> None:
    no = {"taken": False, "detail": "no"}
    page, _ = opened_with(watched, {"shop": ("running", {})}, no, errors=("status of 504",))
    record_orders(page, lambda route: route.fulfill(status=504, json={"detail": "no answer"}))
    hold, alarm = page.get_by_role("button", name="HOLD"), page.locator("#mill .arrived")
    before = hold.bounding_box()
    hold.click()
    expect(alarm).to_contain_text("HOLD did not arrive. Use the stop button on the mill itself.")
    assert hold.bounding_box() == before
    tell(page, {"shop": ("held", {})})
    expect(alarm).to_be_empty()


@pytest.mark.parametrize("size", mostly_thorough(SIZES, quick=["wide"]))
def test_hold_is_where_it_was_whatever_is_said_beside_it(watched: Callable[..., Watched], size: str) -> None:
    """And nothing else on the page moves by it."""
    page, _ = opened_with(watched, {"shop": ("idle", {})}, size=size)
    hold, link = page.locator("#mill .hold"), page.locator("#mill a")
    expect(hold).to_be_hidden()
    rest = page.locator("#view button, .bar > :not(#mill)")
    expect(page.get_by_role("button", name="Choose a picture")).to_be_visible()
    places = "all => all.map((one) => JSON.stringify(one.getBoundingClientRect()))"
    before = [*rest.evaluate_all(places), link.bounding_box()]
    boxes = set()
    for state, share in (("running", 0.0), ("running", 0.09), ("running", 0.994), ("held", 0.994)):
        tell(page, {"shop": (state, {"share": share}), "attic": ("idle", {})})
        words = f"{state} {share:.0%}".replace("%", " %") if share else state
        expect(page.locator(".chip-state")).to_have_text(words)
        expect(hold).to_be_visible()
        boxes.add(str(hold.bounding_box()))
        assert [*rest.evaluate_all(places), link.bounding_box()] == before
    assert len(boxes) == 1


def test_of_several_mills_the_one_that_moves_is_told_of_as_long_as_it_does(watched: Callable[..., Watched]) -> None:
    """A press of HOLD is meant for the mill that was there; the others are counted."""
    page, _ = opened_with(watched, {"attic": ("idle", {}), "barn": ("running", {}), "cellar": ("idle", {})})
    chip = page.locator("#mill")
    expect(chip).to_contain_text("barn")
    expect(chip).to_contain_text("+ 2 more")
    tell(page, {"attic": ("held", {}), "barn": ("running", {}), "cellar": ("locked", {})})
    expect(chip).to_contain_text("+ 2 need a hand")
    expect(chip.get_by_role("button", name="HOLD barn")).to_be_visible()
    tell(page, {"attic": ("idle", {}), "barn": ("idle", {"mill": {"state": "held"}}), "cellar": ("locked", {})})
    expect(chip.locator(".chip-state")).to_have_text("held")  # in a jog
    expect(chip.get_by_role("button", name="HOLD barn")).to_be_visible()
    tell(page, {"attic": ("idle", {}), "barn": ("idle", {}), "cellar": ("locked", {})})
    expect(chip).to_contain_text("cellar")
    expect(chip.locator(".chip-state")).to_have_text("locked")
    tell(page, {"attic": ("held", {}), "barn": ("idle", {}), "cellar": ("locked", {"mill": {"alarm": 0}})})
    expect(chip).to_contain_text("attic")
    expect(chip).to_contain_text("+ 2 more")  # who was only switched on needs nobody


def test_no_dialog_lies_over_hold(watched: Callable[..., Watched]) -> None:
    page, way = opened_with(watched, {"shop": ("running", {})})
    page.get_by_role("button", name="Enter code").click()
    dialog = page.get_by_role("dialog", name="Enter the code")
    expect(dialog).to_be_visible()
    page.get_by_role("button", name="HOLD").click()
    until(lambda: (page.wait_for_timeout(20), way.stops())[1], what="HOLD beside a dialog")
    rest = page.get_by_role("link", name="New job")
    assert rest.evaluate("one => one.closest('[inert]') !== null"), "all else waits for the answer"
    dialog.get_by_role("button", name="Cancel").click()
    rest.click()
    expect(page.get_by_role("heading", level=1, name="New job")).to_be_visible()


def test_on_its_own_screen_a_mill_has_one_hold(watched: Callable[..., Watched]) -> None:
    page, _ = opened_with(watched, {"shop": ("running", {})}, address="#/machines/shop")
    expect(page.locator(".chip-state")).to_have_text("running 21 %")
    expect(page.locator(".stops")).to_be_visible()
    expect(page.get_by_role("button", name="HOLD")).to_have_count(1)
    tell(page, {"shop": ("held", {}), "attic": ("idle", {})})
    expect(page.locator(".chip-state")).to_have_text("held 21 %")
    tell(page, {"shop": ("running", {}), "attic": ("running", {})})
    expect(page.get_by_role("button", name="HOLD attic")).to_be_visible()


def test_all_mills_of_the_shop_are_on_one_screen_each_with_its_hold(watched: Callable[..., Watched]) -> None:
    mills: Mills = {"attic": ("idle", {}), "barn": ("running", {}), "cellar": ("parked", {}), "desk": ("locked", {})}
    page, way = opened_with(watched, mills, address="#/machines")
    cards = page.locator(".machine-list > li")
    for k, words in enumerate(
        ("idle", "running 21 % 1 h 12 min left", "waits for your start", "Locked: hard limit hit.")
    ):
        expect(cards.nth(k)).to_contain_text(words.split(" ")[0].strip(":"))
        text = " ".join(cards.nth(k).inner_text().split())
        assert all(word in text for word in words.split()), text
    hold = cards.nth(1).get_by_role("button", name="HOLD")
    expect(cards.get_by_role("button", name="HOLD")).to_have_count(1)
    place = hold.bounding_box()
    assert place is not None
    page.mouse.move(place["x"] + 20, place["y"] + 20)
    page.mouse.down()
    changes = {"attic": ("no-agent", {}), "barn": ("running", {"share": 0.3}), "desk": ("running", {})}
    tell(page, mills | changes)
    expect(cards.nth(1)).to_contain_text("30 %")
    page.mouse.up()  # the button that was pressed is still there
    until(lambda: (page.wait_for_timeout(20), way.stops())[1], what="HOLD of one of them")
    assert way.stops() == ["barn hold"]
    assert hold.bounding_box() == place
    assert page.locator(".hold.taken:visible").count() == 0
    tell(page, mills | {"barn": ("held", {})})
    expect(cards.nth(1).locator(".hold.taken")).to_be_enabled()  # one more press of it never does harm
    expect(page.locator("#mill .hold.taken")).to_be_visible()


def test_the_only_mill_of_the_shop_opens_at_once(watched: Callable[..., Watched]) -> None:
    page, _ = opened_with(watched, {"shop": ("idle", {})}, address="#/machines")
    expect(page.get_by_role("heading", level=1, name="shop")).to_be_visible()
    assert page.evaluate("location.hash") == "#/machines/shop"


@pytest.mark.thorough
def test_who_wants_to_be_is_notified_of_what_needs_a_hand_while_looking_elsewhere(
    watched: Callable[..., Watched],
) -> None:
    """Once each, and never before a person has asked for it."""
    mills: Mills = {"shop": ("running", {}), "attic": ("idle", {})}
    page, _ = opened_with(watched, mills, address="#/machines", script=NOTIFYING)
    notify = page.get_by_role("button", name="Notify me")
    expect(notify).to_have_attribute("aria-pressed", "false")
    assert page.evaluate("asked") == 0
    notify.click()
    expect(notify).to_have_attribute("aria-pressed", "true")
    tell(page, {"shop": ("held", {})})
    expect(page.locator(".chip-state")).to_contain_text("held")
    assert page.evaluate("[asked, told]") == [1, []], "who looks at the page sees it there"
    finished = machine_in("finished")[1]
    page.route("**/v1/runs?**", lambda route: route.fulfill(json={"runs": [finished], "next": None}))
    page.evaluate("unseen = true")
    said = []
    for state, words in (
        ("running", None),
        ("interrupted", "shop: locked"),
        ("running", None),
        ("tool", "shop: waits for a tool change"),
        ("running", None),
        ("idle", "shop: pass-2-finish.nc is done. Next: pass-3-finish.nc."),
        ("jog", None),
        ("idle", None),
    ):
        changes = {"mill": {"state": "jog"}} if state == "jog" else {}
        tell(page, {"shop": ("idle" if changes else state, changes)})
        said += [words] if words else []
        page.wait_for_function("count => told.length >= count", arg=len(said))
        with page.expect_response("**/v1/machines"):
            page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")  # seen again
        page.wait_for_timeout(2500 if words is None else 0)
    assert page.evaluate("told") == said
    notify.click()
    tell(page, {"shop": ("locked", {})})
    page.evaluate("unseen = false")
    tell(page, {"shop": ("locked", {})})
    expect(page.locator(".chip-state")).to_have_text("locked")
    assert page.evaluate("told") == said
