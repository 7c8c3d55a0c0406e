"""What moves or starts the mill keeps its place when words come and go, and nothing else comes to where it was."""

from __future__ import annotations

from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.page.browser import SIZES
from tests.page.conftest import Opened
from tests.page.driving import machine_state, out_of_sight, setup, tick_all
from tests.page.machine_states import told, with_control

REFUSAL = "Start: X would go from -152.000 to -36.000 mm in machine coordinates; the machine reaches -300 to 0. " * 3
BOXES = """(names) => Object.fromEntries([...document.querySelectorAll("main button")]
    .filter((one) => one.checkVisibility() && names.includes(one.getAttribute("aria-label") ?? one.textContent))
    .filter((one) => !one.closest(".next"))
    .map((one) => [one.getAttribute("aria-label") ?? one.textContent, one.getBoundingClientRect().toJSON()])
    .map(([name, {x, y, width, height}]) => [name, [x, y, width, height]]))"""
MOVING = ["X minus", "X plus", "Y minus", "Y plus", "Z up", "Z down", "End jog"]
SETTING = ["Home", "Unlock", "Reset", "X = 0 here", "Y = 0 here", "X and Y = 0 here", "Z = 0 here"]
START = "Start pass-2-finish.nc"
# What a mill without a program may say, one after the other: notices come and go.
SAID: list[tuple[str, dict[str, Any], str]] = [
    ("idle", {"needs": []}, "idle"),
    ("locked", {}, "locked"),
    ("idle", {}, "idle"),
    ("idle", {"position_trusted": False, "zeroed": "", "needs": []}, "idle"),
    ("idle", {"work_mm": [0, 0, -2.3], "needs": []}, "idle, tool in the block"),
    ("idle", {"state": "sleep"}, "asleep"),
    ("idle", {"state": "door"}, "door open"),
    ("unplugged-idle", {}, "not connected"),
    ("no-agent", {}, "out of reach"),
    ("idle", {"needs": []}, "idle"),
]


# The buttons that a press in their middle reaches at the moment at which a run has begun.
PRESSABLE = """() => { window.pressable = new Promise((done) => {
    const reached = (one) => {
        const {x, y, width, height} = one.getBoundingClientRect();
        return document.elementFromPoint(x + width / 2, y + height / 2)?.closest("button") === one;
    };
    const overrides = document.querySelector(".overrides");
    new MutationObserver(() => {
        if (overrides.hidden) return;
        const buttons = [...document.querySelectorAll("main button:enabled")].filter((one) => one.checkVisibility());
        done(buttons.filter(reached).map((one) => one.firstChild.textContent));
    }).observe(overrides, {attributes: true, attributeFilter: ["hidden"]});
}); }"""
# The largest empty height between a card and what stands above it, and under the last one; in heights of the window.
EMPTY = """() => {
    const {top} = document.querySelector(".machine-columns").getBoundingClientRect();
    const cards = [...document.querySelectorAll(".machine-columns .card")]
        .filter((one) => one.checkVisibility()).map((one) => one.getBoundingClientRect());
    const over = (a, b) => a.bottom <= b.top && a.left < b.right && a.right > b.left;
    const gaps = cards.map((b) => b.top - Math.max(top, ...cards.filter((a) => over(a, b)).map((a) => a.bottom)));
    const {scrollHeight} = document.documentElement;
    const last = scrollY + Math.max(...cards.map((one) => one.bottom));
    const rest = scrollHeight - document.querySelector(".stops").offsetHeight - last;
    return Math.max(scrollHeight > innerHeight ? rest : 0, ...gaps) / innerHeight;
}"""


def boxes(page: Page, names: list[str]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = page.evaluate(BOXES, names)
    assert set(found) == set(names)
    return found


def say(page: Page, state: str, mill: dict[str, Any]) -> None:
    if state == "unplugged-idle":
        state, mill = "idle", {"state": "disconnected", "connected": False, "problem": "port lost: the device is gone"}
    told(page, state, operator="Ada", mill=mill)


@pytest.mark.thorough
@pytest.mark.parametrize("size", SIZES)
def test_words_that_come_and_go_move_no_button_that_moves_the_mill(opened: Opened, size: str) -> None:
    page = with_control(opened, "idle", size=size, mill={"needs": []}, errors=("status of 409",))
    expect(machine_state(page)).to_have_text("idle")
    before, high = boxes(page, MOVING + SETTING), page.locator(".next").bounding_box()
    for state, mill, word in SAID:
        say(page, state, mill)
        expect(machine_state(page)).to_have_text(word)
        assert boxes(page, MOVING + SETTING) == before, word
        assert page.locator(".next").bounding_box() == high, word
        assert setup(page).get_by_role("button", name="Unlock").is_enabled() == (word == "locked"), word
    page.route("**/control/jog", lambda route: route.fulfill(status=409, json={"detail": "Jog: it leaves the travel"}))
    page.get_by_role("button", name="Z up").click()
    expect(page.locator(".jog .said")).to_have_text("Jog: it leaves the travel.")
    page.evaluate("scrollTo(0, 0)")
    assert boxes(page, MOVING + SETTING) == before, "a refusal has its place, too"


@pytest.mark.thorough
@pytest.mark.parametrize("size", ["wide", "phone"])
def test_start_keeps_its_place_and_nothing_comes_to_it_when_the_run_begins(opened: Opened, size: str) -> None:
    page = with_control(opened, "parked", size=size)
    start = page.get_by_role("button", name=START)
    expect(page.locator("canvas")).to_be_visible()
    page.wait_for_timeout(300)
    before = boxes(page, [START])
    for mill in ({"needs": []}, {"position_trusted": False}, {"state": "alarm"}):
        told(page, "parked", operator="Ada", mill=mill)
        page.wait_for_timeout(300)
        assert boxes(page, [START]) == before, mill
    told(page, "parked", operator="Ada")
    start.evaluate("one => one.scrollIntoView({block: 'center'})")
    box = start.bounding_box()
    assert box is not None
    tick_all(page.locator(".checklist:visible"))
    told(page, "running", operator="Ada")
    expect(page.get_by_role("heading", name="Overrides, %")).to_be_visible()
    found = page.evaluate(
        """({x, y, width, height}) => [0.1, 0.3, 0.5, 0.7, 0.9].flatMap((u) => [0.1, 0.5, 0.9].map((v) =>
            document.elementFromPoint(x + u * width, y + v * height)))
            .map((one) => one?.closest("button, input, select")?.textContent ?? "")""",
        box,
    )
    assert set(found) == {""}, found


def test_what_comes_with_a_run_rests_for_a_moment_but_for_hold_and_stop(opened: Opened) -> None:
    page = with_control(opened, "parked")
    expect(page.get_by_role("button", name=START)).to_be_visible()
    page.evaluate(PRESSABLE)
    told(page, "running", operator="Ada")
    assert page.evaluate("window.pressable") == ["HOLD", "STOP"]
    page.get_by_role("button", name="Feed slower").click(trial=True)


@pytest.mark.thorough
@pytest.mark.parametrize("size", ["wide", "phone"])
def test_a_run_that_begins_or_ends_is_shown_from_the_top_without_empty_space(opened: Opened, size: str) -> None:
    page = with_control(opened, "parked", size=size)
    expect(page.locator("canvas")).to_be_visible()
    turns = [("running", "Overrides, %"), ("stopped", "Go on with this program"), ("running", "Overrides, %")]
    for state, title in [*turns, ("finished", "Load a program")]:
        page.evaluate("scrollTo(0, document.documentElement.scrollHeight)")
        told(page, state, operator="Ada")
        expect(page.get_by_role("heading", name=title)).to_be_visible()
        expect(page.locator(".recover button").first).to_be_visible(visible=state == "stopped")
        assert page.evaluate("scrollY") == 0, state
        assert page.evaluate(EMPTY) < 0.25, state
        if state == "stopped":
            assert out_of_sight(page, ".next .trouble, .recover h2") == []


@pytest.mark.thorough
def test_while_a_program_runs_all_that_tells_of_it_is_in_sight(opened: Opened) -> None:
    page = with_control(opened, "parked")
    page.evaluate("scrollTo(0, document.documentElement.scrollHeight)")
    told(page, "running", operator="Ada")
    expect(page.get_by_role("heading", name="Overrides, %")).to_be_visible()
    expect(page.locator(".meter")).to_contain_text("left")
    assert out_of_sight(page, ".readout .work, .meter strong, .meter progress, .meter span, .part canvas") == []


@pytest.mark.thorough
@pytest.mark.parametrize("size", ["wide", "phone"])
def test_what_a_start_was_refused_for_is_in_sight(opened: Opened, size: str) -> None:
    page = with_control(opened, "parked", size=size, errors=("status of 409",))
    page.route("**/v1/runs/*:start", lambda route: route.fulfill(status=409, json={"detail": REFUSAL}))
    tick_all(page.locator(".checklist:visible"))
    page.get_by_role("button", name=START).click()
    words = page.locator(".running .said")
    expect(words).to_have_text(REFUSAL.strip())
    on_top = words.evaluate("""(one) => {
        const {left, top, width, height} = one.getBoundingClientRect();
        const at = (v) => one.contains(document.elementFromPoint(left + width / 2, top + v * height));
        return [0.02, 0.5, 0.98].every(at);
    }""")
    assert on_top


@pytest.mark.thorough
def test_on_a_phone_what_is_on_the_mill_comes_first(opened: Opened) -> None:
    page = with_control(opened, "parked", size="phone")
    tops = "(names) => names.map((one) => document.querySelector(one).getBoundingClientRect().top)"
    program, jog = page.evaluate(tops, [".running", ".jog"])
    assert program < jog
    page = with_control(opened, "idle", size="phone")
    expect(page.locator(".loading")).to_be_visible()
    jog, load = page.evaluate(tops, [".jog", ".loading"])
    assert jog < load
