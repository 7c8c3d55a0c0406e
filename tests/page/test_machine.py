"""The machine screen: who may move the mill and how, what stops it, and what a person is told."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Page, Route, expect

from tests.page.browser import Scheme, layout_faults, serious_faults
from tests.page.conftest import Opened
from tests.page.driving import homed, logged, machine_state, readout, release, setup, take_control
from tests.page.machine_states import STATES, machine_in, told, with_control
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


def test_one_press_is_one_step(at_mill: Page) -> None:
    sent = jogs_sent(at_mill)
    at_mill.get_by_label("0.1", exact=True).check()
    expect(readout(at_mill, "X", own=True)).to_have_text("−1.000")  # where homing ends
    at_mill.get_by_role("button", name="X minus").click()
    expect(readout(at_mill, "X", own=True)).to_have_text("−1.100")
    assert len(sent) == 1


def test_a_key_moves_the_mill_only_while_the_pad_is_armed_and_only_once(at_mill: Page) -> None:
    sent = jogs_sent(at_mill)
    at_mill.get_by_role("button", name="X minus").focus()
    at_mill.keyboard.press("ArrowLeft")
    assert sent == [], "not armed"
    at_mill.get_by_role("button", name="Use the keyboard").click()
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


def test_without_control_nothing_that_moves_can_be_pressed_but_what_stops_can(opened: Opened, shop: Shop) -> None:
    page = opened(SCREEN, key="Ada")
    expect(page.get_by_text("Nobody has control.")).to_be_visible()
    for name in ("X minus", "Home", "Unlock", "X = 0 here", "Send"):
        expect(page.get_by_role("button", name=name, exact=True)).to_be_disabled()
    for name in ("HOLD", "STOP"):
        press_stop(page, name)
    expect(machine_state(page)).to_have_text("idle")


def test_without_a_server_nothing_is_offered_and_nobody_is_said_to_have_control(opened: Opened) -> None:
    page = with_control(opened, "stopped", errors=("ERR_FAILED",))
    inside = page.get_by_role("button", name="Jog in the block")
    expect(inside).to_be_enabled()
    page.route(re.compile(".*"), lambda route: route.abort())
    page.evaluate("window.dispatchEvent(new Event('online'))")
    expect(page.locator(".trouble")).to_have_text("The server does not answer.")
    expect(inside).to_be_disabled()
    for choice in page.locator(".steps input").all():
        expect(choice).to_be_disabled()
    expect(page.locator(".control .who")).to_have_text("Control is unknown.")
    expect(page.locator(".running .mark")).to_have_text("last seen stopped")


def test_a_server_that_has_lost_the_mill_does_not_know_who_has_control(opened: Opened) -> None:
    page = with_control(opened, "idle")
    page.wait_for_timeout(3200)  # what is said sooner may have been on its way
    told(page, "no-agent")
    who = page.locator(".control .who")
    expect(who).to_have_text("Control is unknown.")
    told(page, "idle", operator="Ada")
    expect(who).to_have_text("You have control.")


@pytest.mark.thorough
def test_hours_of_a_simulated_mill_are_not_taken_for_those_of_a_real_one(opened: Opened) -> None:
    page = opened("#/machines")
    for state, words in (("running", "1 h 12 min left"), ("simulated", "1 h 12 min left, simulated")):
        told(page, state)
        page.evaluate(f"location.hash = '{SCREEN}'")
        expect(page.locator(".meter .row span")).to_have_text(words)
        page.evaluate("location.hash = '#/machines'")


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
        route.fulfill(status=202, json={})
    at_mill.get_by_role("button", name="STOP").click()  # held, the mill would be of no use to the next test
    expect(machine_state(at_mill)).to_have_text("idle")


def test_mill_and_program_are_one_state_in_words(opened: Opened) -> None:
    """The controller says idle until the first move has come to it, and now and then between two of them."""
    script = """async ([mill, run, cut]) => {
        const words = await import("/page/machine/words.js");
        const found = {id: "1", state: run, executed_line: cut};
        const machine = {agent: {reachable: true}, mill: {state: mill, connected: true}, run: found};
        return [words.standing(machine).word, words.runStanding(found, machine)[1]];
    }"""
    page = opened("#/machines")
    for mill in ("idle", "run", "holding", "held", "door", "alarm", "tool"):
        for run in ("running", "holding", "held", "stopping", "recovering"):
            for cut in (0, 7):
                head, card = page.evaluate(script, [mill, run, cut])
                assert head == card != "idle", (mill, run, cut)
    assert page.evaluate(script, ["idle", "running", 0]) == ["starting", "starting"]
    assert page.evaluate(script, ["run", "parked", 0]) == ["moving", "waits for your start"]
    assert page.evaluate(script, ["idle", "finished", 9]) == ["idle", "finished"]


@pytest.mark.parametrize("size", ["wide", "phone"])
def test_hold_and_stop_never_move_and_nothing_comes_into_their_place(opened: Opened, size: str) -> None:
    """A second press of a frightened hand must not resume."""
    page = opened("#/machines", size=size)
    found = []
    for state in ("running", "held"):
        told(page, state)
        page.evaluate(f"location.hash = '{SCREEN}'")
        expect(page.locator(".running .mark")).to_be_visible()
        found.append([page.get_by_role("button", name=name).bounding_box() for name in ("HOLD", "STOP")])
        expect(page.get_by_role("button", name="Resume")).to_be_visible(visible=state == "held")
        if state == "running":
            page.evaluate("location.hash = '#/machines'")
            expect(page.get_by_role("heading", level=1, name="Machines")).to_be_visible()
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("size", "scheme"),
    [
        ("wide", "light"),
        *(pytest.param(*one, marks=pytest.mark.thorough) for one in (("tablet", "light"), ("phone", "dark"))),
    ],
)
def test_every_state_can_be_read_and_used_by_everybody(opened: Opened, size: str, scheme: Scheme) -> None:
    page = opened("#/machines", size=size, scheme=scheme)
    for state in STATES:
        told(page, state)
        page.evaluate(f"location.hash = '{SCREEN}'")
        _, run = machine_in(state)
        expect(machine_state(page)).not_to_have_text("asking the server")
        if run is not None:
            expect(page.locator(".running .mark")).to_be_visible()
        assert layout_faults(page) == [], state
        if size != "tablet":
            assert serious_faults(page) == [], state
        for name in ("HOLD", "STOP"):
            expect(page.get_by_role("button", name=name)).to_be_in_viewport(ratio=1)
        page.evaluate("location.hash = '#/machines'")
        expect(page.get_by_role("heading", level=1, name="Machines")).to_be_visible()
    assert serious_faults(page) == []
