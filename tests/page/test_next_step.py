"""The line that says the next step: what is due, one blue button, and nothing that is not safe before its time."""

from __future__ import annotations

import copy
import json
import re
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect

from tests.page.browser import SIZES, open_blank
from tests.page.conftest import Opened
from tests.page.driving import machine_state, out_of_sight, tick_all
from tests.page.machine_states import MACHINE, PLAN, RUN, taken, told, with_control
from tests.page.machine_states import NAME as MILL
from tests.waiting import until

SCREEN = f"#/machines/{MILL}"
LOST = {"position_trusted": False, "zeroed": ""}
# What one finds in the morning: homed, nobody has set a zero, the tool in the corner that it was homed into.
FRESH = {"zeroed": "", "needs": [], "work_mm": [-1.0, -1.0, -1.0], "machine_mm": [-1.0, -1.0, -1.0]}
OVER_IT = FRESH | {"work_mm": [-150.0, -150.0, -1.0], "machine_mm": [-150.0, -150.0, -1.0]}
XY_SET = FRESH | {"zeroed": "XY", "work_mm": [0.0, 0.0, -1.0], "machine_mm": [-150.0, -150.0, -1.0]}
ON_TOP = XY_SET | {"work_mm": [0.0, 0.0, -21.0], "machine_mm": [-150.0, -150.0, -21.0]}
ALL_SET = ON_TOP | {"zeroed": "XYZ", "work_mm": [0.0, 0.0, 0.0]}
UP = {"work_mm": [0.0, 0.0, 5.0], "machine_mm": [-150.0, -150.0, -16.0]}
RAISED = {"work_mm": [12.4, 7.02, 5.0], "machine_mm": [-137.6, -142.98, -15.0]}
DUE = """async ([machine, run, mine, ticked, load]) => {
    const { findNextStep } = await import("/page/machine/next_step.js");
    const due = findNextStep({machine, run, mine, away: "", gone: ""}, {load: {ready: true, ...load}, ticked});
    return [due.step, due.act?.label ?? "", due.words];
}"""
READY = PLAN | {"ready": True, "needs": []}
STATES_SAID = [("state", "run"), ("state", "idle"), ("state", "jog"), ("state", "alarm"), ("command", "Home: done")]
NAMED = {"name": "pass-1.nc"}
JARGON = re.compile(r"\b(preset|parked|vouch\w*|agent|latched)\b", re.IGNORECASE)


def ready(route: Route) -> None:
    """Answers who asks how to go on."""
    route.fulfill(json=READY)


def after(sent: list[Any], count: int, page: Page) -> None:
    """Until so many orders are given; a moment longer, for one too many."""
    for _ in range(400):
        if len(sent) >= count:
            break
        page.wait_for_timeout(50)
    page.wait_for_timeout(100)
    assert len(sent) == count, sent


def orders_of(page: Page) -> list[tuple[str, dict[str, Any]]]:
    """Every order that this page gives from now on: (its name, its body). None of them reaches a mill."""
    sent: list[tuple[str, dict[str, Any]]] = []

    def take(route: Any) -> None:
        sent.append((route.request.url.rpartition("/")[2], json.loads(route.request.post_data or "{}")))
        route.fulfill(status=202, json=taken(route))

    page.route(re.compile(r"/control/\w|/v1/runs/[^/]+:\w"), take)
    return sent


def test_every_step_comes_after_the_one_before(modules: Page) -> None:
    """Connect, control, home, load, tool over the zero, zero, tick, start: only the one that is due."""

    def due(
        mill: dict[str, Any],
        *,
        mine: bool = True,
        run: Any = None,
        ticked: bool = False,
        jobs: int = 1,
        at: bool = False,
    ) -> list[str]:
        machine = copy.deepcopy(MACHINE)
        machine["mill"] |= mill
        if run and run["state"] == "running":
            machine["run"] = run
        found: list[str] = modules.evaluate(DUE, [machine, run, mine, ticked, {"jobs": jobs, "atWork": at}])
        return [text.replace("\xa0", " ") for text in found]

    assert due({"state": "disconnected", "connected": False}, mine=False)[0] == "trouble"
    assert due(FRESH | LOST, mine=False)[0] == "control"
    assert due(FRESH | LOST)[:2] == ["home", "Home"]
    assert due({"state": "alarm"} | LOST)[:2] == ["home", "Home"]
    assert due(FRESH, jobs=0)[0] == "make"
    assert due(FRESH, jobs=0, at=True)[0] == "wait"
    assert due(FRESH, at=True)[0] == "wait", "the job that is meant is still worked on: no other's program in its place"
    assert due(FRESH)[0] == "load", "the program says which tool and which block the zero is for"
    corner = due(FRESH, run=RUN)
    assert corner[:2] == ["corner", ""], "nothing sets a zero where homing has left the tool"
    assert "R 0.5 (Ø 1 mm)" in corner[2]
    over_it = due(OVER_IT, run=RUN)
    assert over_it[:2] == ["zero", "X and Y = 0 here"]
    assert "8 mm inside the block" in over_it[2]
    assert due(XY_SET, run=RUN)[:2] == ["top", ""]
    assert due(ON_TOP, run=RUN)[:2] == ["zero", "Z = 0 here"]
    assert due(ALL_SET)[0] == "load"
    assert due(ALL_SET, run=RUN)[:2] == ["off", "Raise Z"], "it stands on the block where Z = 0 was set"
    assert due(ALL_SET | UP, run=RUN)[0] == "tick"
    assert due(ALL_SET, run=RUN, ticked=True)[0] == "start"
    for ticked in (False, True):
        words = due(ALL_SET | UP, run=RUN | {"travel_in_doubt": True}, ticked=ticked)[2]
        assert "may not fit the travel" in words
        assert "may not" not in due(ALL_SET | UP, run=RUN | {"travel_in_doubt": False}, ticked=ticked)[2]
        dry = due(ALL_SET | UP, run=RUN | {"travel_in_doubt": True, "lift_mm": 20}, ticked=ticked)
        assert "load it lower, or start the dry pass" in dry[2], "what its button does is said beside it"
    running = RUN | {"state": "running"}
    assert due(ALL_SET | {"state": "run"}, run=running)[2] == "The program runs."
    assert due(ALL_SET | {"state": "run"}, run=running | {"lift_mm": 20})[2] == "The dry pass runs: nothing is cut."
    after_another = ALL_SET | UP | {"needs": ["a program has ended"]}
    new_tool = due(after_another, run=RUN)
    assert new_tool[:2] == ["zero", "Z = 0 here"]
    assert "R 0.5 (Ø 1 mm)" in new_tool[2]
    change = {"from_radius_mm": 0.5, "to_radius_mm": 0.5, "words": "the same tool as before"}
    same_tool = RUN | {"setup": RUN["setup"] | {"change": change}}
    assert due(after_another, run=same_tool)[0] == "tick", "a tool that stays in keeps its zero"
    new_block = RUN | {"setup": RUN["setup"] | {"change": None}}
    assert due(after_another, run=new_block)[:2] == ["zero", "Z = 0 here"]
    finished = RUN | {"state": "finished", "open": False}
    assert due(ALL_SET, run=finished)[::2] == ["load", "load a program."], "none is named before the card has it"


@pytest.mark.thorough
@pytest.mark.parametrize("state", ["parked", "stopped", "locked", "held", "finished"])
def test_only_what_is_due_is_blue_and_every_word_is_plain(opened: Opened, state: str) -> None:
    def without_jobs(*place: str, **how: Any) -> Page:
        page = opened(*place, **how)
        page.route(
            "**/v1/jobs?*", lambda route: route.fulfill(json={"jobs": [], "next": None})
        )  # whatever other tests have made
        return page

    page = with_control(without_jobs, state)
    expect(page.locator(".running .mark").or_(page.locator(".loading")).first).to_be_visible()
    expect(page.locator(".primary:visible")).to_have_count(0 if state == "finished" else 1)
    assert not (found := JARGON.search(page.locator("main").inner_text())), found


def test_a_tool_in_the_block_is_said_and_goes_up_before_it_goes_sideways(opened: Opened) -> None:
    page = with_control(opened, "stopped")
    expect(machine_state(page)).to_have_text("idle, tool in the block")
    line = page.locator(".next")
    expect(line).to_contain_text("The tool stands 2.3 mm in the block: raise Z first.")
    for name in ("X minus", "X plus", "Y minus", "Y plus", "Z down"):
        expect(page.get_by_role("button", name=name)).to_be_disabled()
    expect(page.get_by_role("button", name="Z up")).to_be_enabled()
    sent = orders_of(page)
    line.get_by_role("button", name="Raise Z").click()
    after(sent, 1, page)
    assert sent == [("jog", {"by_mm": [0, 0, pytest.approx(7.3)], "feed_mm_per_min": 500})]
    page.get_by_role("button", name="Jog in the block").click()
    expect(page.get_by_role("button", name="Z down")).to_be_enabled()
    page.get_by_role("button", name="X minus").click()
    after(sent, 2, page)
    assert sent[1:] == [("jog", {"by_mm": [-1, 0, 0], "feed_mm_per_min": 1000})], "out by hand is never impossible"
    told(page, "stopped", operator="Ada", mill=RAISED)
    expect(machine_state(page)).to_have_text("idle")
    expect(line).to_contain_text("go on with it, step by step")


@pytest.mark.thorough
def test_nothing_is_said_to_be_left_while_the_tool_stands_in_the_block(opened: Opened) -> None:
    page = with_control(opened, "stopped")
    page.route("**/v1/runs/*/recovery", ready)
    page.get_by_role("button", name="Look again").click()
    tick = page.locator(".recover input[type=checkbox]").first
    tick.check()
    first = page.locator(".wizard > li").nth(1)
    expect(first).to_contain_text("The tool stands 2.3 mm in the block: raise Z first.")
    expect(first).not_to_contain_text("done")
    told(page, "stopped", operator="Ada", mill=RAISED, plan=ready)
    expect(first).to_contain_text("Nothing: the mill stands")
    expect(first).to_contain_text("done")
    expect(tick).to_be_checked()


@pytest.mark.parametrize(
    ("state", "button"),
    [
        ("stopped", "Go on from line 8,640"),
        pytest.param("parked", "Start pass-2-finish.nc", marks=pytest.mark.thorough),
    ],
)
def test_no_program_goes_while_the_line_says_to_raise_the_tool(opened: Opened, state: str, button: str) -> None:
    """Every tick is given, and a name: what is in the way is the tool, and the button says so until it is up."""
    low = {"work_mm": [12.4, 7.02, -2.3], "machine_mm": [-137.6, -142.98, -22.3], "needs": []}
    page = with_control(opened, state, mill=low)
    page.route("**/v1/runs/*/recovery", ready)
    if state == "stopped":
        page.get_by_role("button", name="Look again").click()
    expect(page.locator(".next")).to_contain_text("raise Z first.")
    listed = page.locator(".checklist:visible")
    tick_all(listed)
    page.get_by_label("Operator").fill("Ada")
    go = page.get_by_role("button", name=button)
    expect(go).to_be_disabled()
    expect(listed.locator(".missing")).to_have_text("Raise Z first.")
    told(page, state, operator="Ada", mill=RAISED | {"needs": []}, plan=ready)
    expect(listed.locator(".missing")).to_have_text("")
    expect(go).to_be_enabled()


def test_a_tick_is_for_the_plan_of_the_mill_as_it_stands(opened: Opened) -> None:
    """It has moved, and moved again: no tick is taken before the newest plan is there, none is lost with an old one."""
    page = with_control(opened, "stopped", mill=RAISED)
    tick, go = page.locator(".recover input[type=checkbox]").first, page.locator(".recover .go")
    asked: list[Route] = []

    def at(z_mm: float) -> None:
        higher = {"work_mm": [12.4, 7.02, z_mm], "machine_mm": [-137.6, -142.98, z_mm - 20]}
        count = len(asked) + 1
        told(page, "stopped", operator="Ada", mill=higher, plan=lambda route: asked.append(route))
        after(asked, count, page)

    def answer(route: Route, line: int) -> None:
        route.fulfill(json=READY | {"overlap_line": line})

    at(6.0)
    answer(asked[0], 6000)
    tick.check()
    at(7.0)
    expect(tick).to_be_disabled()
    at(8.0)
    answer(asked[2], 8000)
    expect(go).to_have_text("Go on from line 8,000")
    tick.check()
    answer(asked[1], 7000)
    page.wait_for_timeout(200)
    expect(go).to_have_text("Go on from line 8,000")
    expect(tick).to_be_checked()
    told(page, "stopped", operator="Ada", mill=RAISED | {"state": "jog"})
    expect(page.locator(".next")).to_contain_text("wait until it stands")


def test_off_the_block_by_the_line(opened: Opened) -> None:
    page = with_control(opened, "parked", mill=ALL_SET)
    sent = orders_of(page)
    line = page.locator(".next")
    expect(line).to_contain_text("raise the tool a little, then tick the list.")
    line.get_by_role("button", name="Raise Z").click()
    after(sent, 1, page)
    assert sent == [("jog", {"by_mm": [0, 0, 5], "feed_mm_per_min": 500})]


@pytest.mark.parametrize("said", [{}, {"warnings": [], "travel_in_doubt": False}])
def test_travel_is_in_doubt_only_once_every_zero_is_set(opened: Opened, said: dict[str, Any]) -> None:
    """Before that it is bound to be: the program is placed by a zero that nobody has set for it. With the first axis
    that is set the agent withdraws its warning, and travel is as little known.
    """
    page = with_control(opened, "parked", mill=XY_SET, run=said)
    card = page.locator(".running")
    expect(card).to_contain_text("Whether it fits the travel is known once X, Y and Z are set.")
    expect(card.get_by_text("It may not fit the travel")).to_have_count(0)
    told(page, "parked", operator="Ada", mill=ALL_SET | UP, run=said)
    expect(card.get_by_text("No warnings" if said else "It may not fit the travel")).to_be_visible()


def test_the_head_of_the_page_knows_of_a_start_as_soon_as_the_screen_below_it(opened: Opened) -> None:
    page = with_control(opened, "parked")
    expect(page.locator(".chip-state")).to_contain_text("waits for your start")
    page.evaluate(
        "import('/page/machine/mills.js').then(({ mills }) => { mills.look = async () => {}; })"
    )  # asks no more
    told(page, "running", operator="Ada")
    expect(page.locator(".chip-state")).to_contain_text("running")


def test_the_list_says_who_switches_the_spindle_on(opened: Opened) -> None:
    page = with_control(opened, "parked")
    expect(page.locator(".checklist")).to_contain_text("the program switches the spindle on, at 18,000 rpm")


@pytest.mark.parametrize("size", [pytest.param("wide", marks=pytest.mark.thorough), "phone"])
def test_what_is_to_be_ticked_is_shown_and_then_the_line_starts(opened: Opened, size: str) -> None:
    """By the very button of the card: once all is ticked, and by whom."""
    page = with_control(opened, "parked", size=size, mill={"needs": []}, run={"travel_in_doubt": False})
    line, listed = page.locator(".next"), page.locator(".checklist:visible")
    line.get_by_role("button", name="Show").click()
    assert out_of_sight(page, ".checklist .tick") == []
    expect(listed.locator("input").first).to_be_focused()
    tick_all(listed)
    page.get_by_label("Operator").fill("")
    expect(line).to_contain_text("give your name, then start.")
    page.get_by_label("Operator").fill("Ada")
    sent = orders_of(page)
    line.get_by_role("button", name="Start", exact=True).click()
    after(sent, 1, page)
    [(order, body)] = sent
    assert (order.rpartition(":")[2], body["operator"], body["checks"]) == ("start", "Ada", RUN["required_checks"])


@pytest.mark.thorough
@pytest.mark.parametrize("size", ["wide", "phone"])
def test_who_is_shown_where_to_jog_sees_where_the_tool_is(opened: Opened, size: str) -> None:
    page = with_control(opened, "parked", size=size, mill=FRESH)
    page.locator(".next").get_by_role("button", name="Show").click()
    assert out_of_sight(page, ".readout .work, .pad button") == []
    expect(page.get_by_role("button", name="Y plus")).to_be_focused()


@pytest.mark.thorough
@pytest.mark.parametrize("size", ["wide", "phone"])
def test_who_jogs_sees_where_the_tool_is_however_far_the_page_is_scrolled(opened: Opened, size: str) -> None:
    page = with_control(opened, "parked", size=size, mill=FRESH)
    page.evaluate("scrollTo(0, document.documentElement.scrollHeight)")
    position = page.locator(".readout").bounding_box()
    assert page.locator(".jog").bounding_box()["y"] < position["y"] + position["height"], "scrolled under it"
    assert out_of_sight(page, ".readout .work") == []
    for name in ("Y plus", "Y minus"):
        page.get_by_role("button", name=name).focus()
        assert out_of_sight(page, f".readout .work, .pad [aria-label='{name}']") == []


@pytest.mark.thorough
def test_keys_to_jog_by_and_their_steps_are_in_sight_together(opened: Opened) -> None:
    """Scrolled to the steps, with the position still above."""
    page = with_control(opened, "parked", mill=FRESH)
    for width, height in ((1440, 900), (1024, 768), (768, 1024), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        page.locator(".steps").evaluate("one => one.scrollIntoView({block: 'end'})")
        assert out_of_sight(page, ".readout .work, .pad button, .steps label") == [], (width, height)


@pytest.mark.parametrize(
    ("state", "mill"),
    [
        ("unplugged", {}),
        *(pytest.param(*one, marks=pytest.mark.thorough) for one in (("locked", {}), ("parked", OVER_IT))),
    ],
)
def test_on_a_phone_the_next_step_leaves_room_for_the_mill(opened: Opened, state: str, mill: dict[str, Any]) -> None:
    """Its words are within it; with all of them unfolded it takes a third of the height, and what stops is in reach."""
    page = with_control(opened, state, mill=mill, size="phone")
    line = page.locator(".next")
    high, words = (one.evaluate("one => one.offsetHeight") for one in (line, line.locator(".next-words")))
    assert words <= high
    if state != "parked":
        line.get_by_text("More").click()
        expect(line.locator(".next-more")).to_be_visible()
        for width, height in ((1440, 900), (1024, 768), SIZES["phone"]):
            page.set_viewport_size({"width": width, "height": height})
            assert out_of_sight(page, ".readout .work") == [], "what is unfolded pushes it down"
        high = line.evaluate("one => one.offsetHeight")
    assert high <= 0.35 * SIZES["phone"][1]
    for name in ("HOLD", "STOP"):
        page.get_by_role("button", name=name).click(trial=True)


@pytest.mark.thorough
def test_a_drawing_says_which_corner_is_zero_before_a_program_is_loaded(opened: Opened) -> None:
    page = with_control(opened, "idle")
    drawing = page.get_by_role("img", name="X0 Y0 is the front left corner of the lens, inside the block, not to scale")
    expect(drawing).to_contain_text("not to scale")
    expect(page.locator(".zero-place")).to_contain_text("is known once a program is loaded")
    block, lens, corner = (drawing.locator(one).bounding_box() for one in (".block", ".lens", ".corner"))
    middle = [corner["x"] + corner["width"] / 2, corner["y"] + corner["height"] / 2]
    assert middle == pytest.approx([lens["x"], lens["y"] + lens["height"]], abs=1)
    assert block["x"] + 5 < lens["x"] and lens["x"] + lens["width"] + 5 < block["x"] + block["width"]
    told(page, "parked", operator="Ada")
    drawing = page.get_by_role("img", name="8 mm inside the block 116 × 116 mm")
    expect(drawing).to_be_visible()
    block, lens = (drawing.locator(one).bounding_box() for one in (".block", ".lens"))
    assert lens["width"] / block["width"] == pytest.approx(100 / 116, abs=0.03)
    expect(drawing).not_to_contain_text("scale")
    expect(page.locator(".zero-place")).to_contain_text("8 mm inside the block's left and front edges")


@pytest.mark.thorough
def test_a_long_step_ends_before_the_travel_does_and_z_takes_none(opened: Opened) -> None:
    at = {"work_mm": [0.0, 0.0, 5.0], "machine_mm": [-60.0, -5.0, -40.0], "needs": []}
    page = with_control(opened, "idle", mill=at)
    sent = orders_of(page)
    page.get_by_label("100", exact=True).check()
    for count, name in enumerate(("X plus", "X minus", "Z up"), 1):
        page.get_by_role("button", name=name).click()
        after(sent, count, page)
        page.wait_for_timeout(4000)  # an order of which the log says nothing is given up
    assert [body["by_mm"] for _, body in sent] == [[58, 0, 0], [-100, 0, 0], [0, 0, 10]]
    told(page, "idle", operator="Ada", mill=at | {"machine_mm": [-1.0, -5.0, -40.0]})
    expect(page.locator(".readout .own").first).to_have_text("−1.000")
    page.get_by_role("button", name="X plus").click()
    expect(page.locator(".jog .said")).to_contain_text("The travel ends here")
    assert len(sent) == 3


def test_what_is_held_goes_on_by_key_only_where_that_is_meant(opened: Opened) -> None:
    """Space on Resume, and Shift with R anywhere; Space anywhere else still holds."""
    page = with_control(opened, "held")
    sent = orders_of(page)
    resume = page.get_by_role("button", name="Resume")
    expect(resume).to_contain_text("Shift+R")
    presses = (lambda: resume.press(" "), lambda: page.keyboard.press("Shift+R"))
    for count, press in enumerate(presses, 1):
        press()
        after(sent, count, page)
    assert [name.partition(":")[2] for name, _ in sent] == ["resume", "resume"]
    page.get_by_role("button", name="Give control back").press(" ")
    after(sent, 3, page)
    page.keyboard.press("Escape")
    after(sent, 4, page)
    assert [name for name, _ in sent[2:]] == ["hold", "abort"]


@pytest.mark.thorough
def test_control_is_not_given_back_without_a_word(opened: Opened) -> None:
    page = with_control(opened, "running")
    page.route("**/v1/machines/shop/control", lambda route: route.fulfill(status=204))
    page.evaluate("location.hash = '#/'")
    toast = page.locator(".toast")
    expect(toast).to_contain_text("You keep control of shop for 10 minutes. pass-2-finish.nc goes on")
    toast.get_by_role("button", name="Back to it").click()
    expect(page.get_by_role("heading", level=1, name=MILL)).to_be_visible()


TEN_MINUTES = """
    window.waits = [];
    const later = setTimeout;
    window.setTimeout = (act, ms) => (ms === 600000 ? (window.waits.push(act), 0) : later(act, ms));
"""


def test_who_leaves_the_view_to_read_keeps_control_for_a_while(opened: Opened) -> None:
    """And gives no order from there: what is released is released once."""
    page = with_control(opened, "idle", script=TEN_MINUTES)
    released: list[str] = []
    page.on("request", lambda asked: released.append(asked.url) if asked.method == "DELETE" else None)
    page.route("**/v1/machines/shop/control", lambda route: route.fulfill(status=204))
    page.evaluate("location.hash = '#/'")
    expect(page.locator(".toast")).to_contain_text("You keep control of shop for 10 minutes.")
    page.evaluate("location.hash = '#/machines/shop'")
    expect(page.get_by_text("You have control.")).to_be_visible()
    expect(page.locator(".toast")).to_have_count(0)  # it would lie over the next step of a phone
    assert released == []
    page.evaluate("location.hash = '#/'")
    expect(page.get_by_role("heading", level=1, name="Jobs")).to_be_visible()
    page.evaluate("window.waits.at(-1)()")
    page.evaluate("location.hash = '#/machines/shop'")
    expect(page.get_by_role("button", name="Take over")).to_be_visible()
    until(lambda: (page.wait_for_timeout(20), released)[1], what="control is given back")
    assert len(released) == 1


@pytest.mark.thorough
def test_the_zero_of_the_cut_is_put_back_by_one_press(opened: Opened) -> None:
    page = with_control(opened, "stopped", mill=RAISED)
    plan = {
        "needs": [{"code": "zero", "values": {}, "words": "G54 differs"}],
        "zero_back": "G10 L2 P1 X-150.000 Y-150.000 Z-20.000",
    }
    again = page.get_by_role("button", name="Look again")
    expect(again).to_be_visible()
    page.route("**/v1/runs/*/recovery", lambda route: route.fulfill(json=PLAN | plan))
    again.click()
    sent = orders_of(page)
    page.get_by_role("button", name="Put the zero back").click()
    after(sent, 1, page)
    assert sent == [("block", {"text": plan["zero_back"], "confirm": True})]
    page.route("**/v1/runs/*/recovery", lambda route: route.fulfill(json=PLAN | plan | {"zero_back": ""}))
    again.click()
    expect(page.locator(".recover .needs")).to_contain_text("Touch off and set X, Y and Z again")


@pytest.mark.thorough
def test_the_console_tells_what_matters(opened: Opened) -> None:
    page = open_blank(opened, "machine", key="Ada")
    told(page, "idle")
    entries: list[tuple[str, str, str]] = [(kind, words, "") for kind, words in STATES_SAID]
    entries += [("run", "pass-1.nc: parked", "run_parked"), ("state", "idle", "")]
    entries += [("command", "Read settings: done", "settings_read"), ("command", "Jog X +10 mm: done", "")]
    entries += [("command", "X and Y = 0 here: done, at machine X 1.000, Y 2.000 mm", "")]
    logged = [
        {"number": k, "at_s": 1.0, "kind": kind, "words": words} | ({"code": code, "values": NAMED} if code else {})
        for k, (kind, words, code) in enumerate(entries)
    ]
    body = "".join(f"event: log\ndata: {json.dumps(entry)}\n\n" for entry in logged)
    page.route("**/v1/machines/shop/events", lambda route: route.fulfill(body=body, content_type="text/event-stream"))
    page.evaluate(f"location.hash = '{SCREEN}'")
    lines = page.locator(".log li span")
    told_of = ["locked", "Home: done", "pass-1.nc: waits for your start", *(words for _, words, _ in entries[-2:])]
    expect(lines).to_have_text(told_of)


def test_an_alarm_is_red_for_who_only_watches_and_a_mill_just_switched_on_is_not(opened: Opened) -> None:
    page = open_blank(opened, "machine")
    told(page, "interrupted")
    page.evaluate(f"location.hash = '{SCREEN}'")
    expect(page.locator(".next.bad")).to_contain_text("take control")
    expect(page.locator(".recover")).to_contain_text("Take control first.")
    page = open_blank(opened, "machine")
    told(page, "locked", mill={"alarm": 0, "code": "", "detail": ""})
    page.evaluate(f"location.hash = '{SCREEN}'")
    expect(page.locator(".next:not(.bad)")).to_contain_text("take control")
