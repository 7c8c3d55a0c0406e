"""Orders and stops on their way to the mill: an order that is late is not sent, a stop takes every way there is."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Page, Route, WebSocketRoute, expect

from service.milling.api import ProbeCornerBody
from tests.levels import mostly_thorough
from tests.page.answers import problem
from tests.page.browser import open_blank
from tests.page.conftest import Opened
from tests.page.driving import setup, tick_all
from tests.page.machine_states import GRANT, PLAN, STOPS, machine_in, taken, told, with_control
from tests.page.machine_states import NAME as MILL
from tests.page.test_words import JARGON
from tests.waiting import until

SCREEN = f"#/machines/{MILL}"
READY = PLAN | {"ready": True, "needs": []}
CODES = ("grant_expired", "grant_stopped", "grant_lease", "grant_unknown", "plan_changed", "setup_changed")
ORDERS = re.compile(r"/control/\w|/v1/runs/[^/]+:\w")
CLOCK = "() => { const now = Date.now; window.skipped = 0; Date.now = () => now() + window.skipped; }"
Sent = list[tuple[str, dict[str, Any], dict[str, str]]]


def refusal(code: str, detail: str = "the server's own words", **more: Any) -> dict[str, Any]:
    """What a route is fulfilled with where an order is refused."""
    return problem(409, detail=detail, code=code, values={}, **more)


def record_orders(page: Page, answer: Callable[[Route], Any] | None = None) -> Sent:
    """Every order or stop that leaves this page from now on: (name, body, headers)."""
    sent: Sent = []

    def take(route: Route) -> None:
        asked = route.request
        name = re.split("[/:]", asked.url)[-1]
        sent.append((name, json.loads(asked.post_data or "{}"), asked.headers))
        if answer is None:
            route.fulfill(status=202, json=taken(route))
        else:
            answer(route)

    page.route(ORDERS, take)
    return sent


def await_orders(page: Page, sent: Sent, count: int = 1) -> None:
    until(lambda: (page.wait_for_timeout(20), len(sent) >= count)[1], what=f"{count} orders sent")
    page.wait_for_timeout(100)  # one too many would be seen
    assert len(sent) == count, sent


def press_start(page: Page) -> None:
    tick_all(page.locator(".checklist:visible"))
    page.locator(".checklist:visible .go").click()


def press_send(page: Page) -> None:
    page.get_by_label("One line to the mill").fill("G0 X0")
    page.get_by_role("button", name="Send", exact=True).click()


def press_guarded(page: Page, label: str, sure: str) -> None:
    page.get_by_role("button", name=label, exact=True).click()
    page.get_by_role("group", name=label, exact=True).get_by_role("button", name=sure, exact=True).click()


def press_spindle(page: Page) -> None:
    page.get_by_text("Spindle by hand").click()
    page.get_by_label("Speed").fill("9000")
    press_guarded(page, "Spindle on", "Start the spindle")


PRESSES: dict[str, tuple[str, Callable[[Page], None]]] = {
    "home": ("idle", lambda page: setup(page).get_by_role("button", name="Home", exact=True).click()),
    "jog": ("idle", lambda page: page.get_by_role("button", name="X minus").click()),
    "block": ("idle", press_send),
    "go-to-zero": ("idle", lambda page: press_guarded(page, "Go to X0 Y0 Z0", "Go down there")),
    "spindle": ("idle", press_spindle),
    "frame": ("parked", lambda page: press_guarded(page, "Frame the job", "Go around it")),
    "start": ("parked", press_start),
    "resume": ("held", lambda page: page.get_by_role("button", name="Resume").click()),
    "override": ("running", lambda page: page.get_by_role("button", name="Feed slower").click()),
    "recover": ("stopped", press_start),
}
RAISED = {"work_mm": [12.4, 7.02, 5.0], "machine_mm": [-137.6, -142.98, -15.0]}


def at_mill(opened: Opened, state: str, **how: Any) -> Page:
    mill = RAISED if state == "stopped" else None
    page = with_control(opened, state, mill=mill, **how)
    if state == "stopped":
        page.route("**/v1/runs/*/recovery", lambda route: route.fulfill(json=READY))
        page.get_by_role("button", name="Look again").click()
        expect(page.get_by_role("button", name="Go on from line 8,640")).to_be_visible()
    return page


@pytest.mark.parametrize("what", mostly_thorough(PRESSES, quick=["jog", "start", "frame", "go-to-zero", "spindle"]))
def test_every_order_goes_under_a_grant_that_is_asked_for_at_the_press(opened: Opened, what: str) -> None:
    state, press = PRESSES[what]
    page = at_mill(opened, state)
    sent, asked = record_orders(page), []

    def grant(route: Route) -> None:
        assert not sent
        asked.append((route.request.headers["causticmill-control"], route.request.post_data_json))
        route.fulfill(status=201, json=GRANT)

    page.route("**/grants", grant)
    press(page)
    await_orders(page, sent)
    assert asked == [("a secret", {"stops": 7})]
    name, _, headers = sent[0]
    assert (name, headers["causticmill-grant"], headers["causticmill-control"]) == (what, "a word", "a secret")


def test_an_order_whose_grant_comes_too_late_is_not_sent(opened: Opened) -> None:
    page = at_mill(opened, "idle")
    sent, waiting = record_orders(page), []
    page.route("**/grants", lambda route: waiting.append(route))
    PRESSES["home"][1](page)
    expect(page.locator(".setup .said")).to_contain_text("Not sent")
    expect(page.locator(".setup .said")).to_contain_text("press again")
    assert len(waiting) == 1
    assert sent == []


def test_a_computer_that_slept_after_the_press_sends_no_order(opened: Opened) -> None:
    """The clock of the page may stand still then; the other one says how long it was."""
    page = at_mill(opened, "idle")
    sent, waiting = record_orders(page), []
    page.evaluate(CLOCK)
    page.route("**/grants", lambda route: waiting.append(route))
    with page.expect_request("**/grants"):
        PRESSES["home"][1](page)
    page.evaluate("window.skipped = 60_000")
    waiting[0].fulfill(status=201, json=GRANT)
    expect(page.locator(".setup .said")).to_contain_text("Not sent")
    assert sent == []


def test_a_press_that_a_busy_page_hears_too_late_sends_no_order(opened: Opened) -> None:
    page = at_mill(opened, "idle")
    sent = record_orders(page)
    home = setup(page).get_by_role("button", name="Home", exact=True)
    home.evaluate("""(one) => {
        const press = new MouseEvent("click", {bubbles: true});
        const until = performance.now() + 2500;
        while (performance.now() < until);
        one.dispatchEvent(press);
    }""")
    expect(page.locator(".setup .said")).to_contain_text("Not sent")
    assert sent == []


def test_every_refusal_of_an_order_is_one_plain_sentence(modules: Page) -> None:
    script = """async (codes) => {
        const { refusal } = await import("/page/machine/words.js");
        return codes.map((code) => refusal({code, detail: code}));
    }"""
    found = modules.evaluate(script, list(CODES))
    assert len(set(found)) == len(CODES)
    for code, words in zip(CODES, found, strict=True):
        assert code not in words
        assert not JARGON.search(words)
        assert words.startswith("Not ")
        assert words.endswith(".")


@pytest.mark.thorough
def test_a_plan_that_has_changed_is_shown_and_ticked_anew(opened: Opened) -> None:
    plans = [READY]
    page = at_mill(opened, "stopped", errors=("status of 409",))
    page.route("**/v1/runs/*/recovery", lambda route: route.fulfill(json=plans[-1]))
    sent = record_orders(page, lambda route: route.fulfill(**refusal("plan_changed")))
    tick_all(page.locator(".checklist:visible"))
    plans.append(READY | {"plan": "b2" * 32, "overlap_line": 8600})
    page.get_by_role("button", name="Go on from line 8,640").click()
    expect(page.get_by_role("button", name="Go on from line 8,600")).to_be_disabled()
    expect(page.locator(".recover .said")).to_contain_text("Read it again")
    assert page.locator(".checklist input:checked").count() == 0
    assert sent[0][1]["plan"] == READY["plan"]
    press_start(page)
    await_orders(page, sent, 2)
    assert sent[1][1]["plan"] == "b2" * 32


def test_a_start_rests_on_what_was_looked_at(opened: Opened) -> None:
    """Zero or position that change after a tick take it off; the server may know it sooner than the page."""
    page = at_mill(opened, "parked", errors=("status of 409",))
    ticked = page.locator(".checklist input:checked")
    tick_all(page.locator(".checklist:visible"))
    told(page, "parked", operator="Ada", mill={"setup": "77" * 32})
    expect(ticked).to_have_count(0)
    expect(page.locator(".checklist .missing")).to_contain_text("look again")
    sent = record_orders(page, lambda route: route.fulfill(**refusal("setup_changed")))
    press_start(page)
    await_orders(page, sent)
    assert sent[0][1]["setup"] == "77" * 32
    expect(page.locator(".running .said")).to_contain_text("Compare the readout with the block")
    expect(ticked).to_have_count(0)


class Way:
    """The WebSocket for stops, as a server would have it. answers: to each stop; None: it says nothing."""

    def __init__(self, page: Page, answer: dict[str, Any] | None) -> None:
        self.heard: list[dict[str, Any]] = []
        self.answer = answer
        page.route_web_socket(STOPS, self._open)

    def _open(self, way: WebSocketRoute) -> None:
        def hear(text: str | bytes) -> None:
            message = json.loads(text)
            self.heard.append(message)
            if "token" in message:
                way.send(json.dumps({"ready": True}))
            elif self.answer is not None:
                way.send(json.dumps({"id": message["id"]} | self.answer))

        way.on_message(hear)

    def stops(self) -> list[str]:
        return [f"{one['machine']} {one['what']}" for one in self.heard if "what" in one]


def watching(opened: Opened, answer: dict[str, Any] | None, **how: Any) -> tuple[Page, Way]:
    """A page without control of a mill that runs, its way for stops open."""
    page = open_blank(opened, "machine", once=True, **how)  # no route of a socket ends
    told(page, "running")
    way = Way(page, answer)
    page.evaluate(f"location.hash = '{SCREEN}'")
    expect(page.locator(".running .mark")).to_be_visible()
    until(lambda: (page.wait_for_timeout(20), way.heard)[1], what="the way for stops open")
    return page, way


def test_a_stop_goes_by_a_way_of_its_own(opened: Opened) -> None:
    page, way = watching(opened, {"taken": True, "mill": {}})
    sent = record_orders(page)
    page.get_by_role("button", name="HOLD").click()
    page.get_by_role("button", name="STOP").click()
    until(lambda: (page.wait_for_timeout(500), len(way.stops()) == 2)[1], what="two stops")
    assert way.stops() == [f"{MILL} hold", f"{MILL} abort"]
    assert sent == [], "what is answered at once need not be said twice"
    expect(page.locator(".stops .arrived")).to_be_empty()


@pytest.mark.parametrize(
    "answer", [None, pytest.param({"taken": False, "detail": "no answer in time"}, marks=pytest.mark.thorough)]
)
def test_a_stop_without_an_answer_goes_the_other_way_too(opened: Opened, answer: dict[str, Any] | None) -> None:
    page, way = watching(opened, answer)
    sent = record_orders(page)
    page.get_by_role("button", name="HOLD").click()
    await_orders(page, sent)
    assert (way.stops(), sent[0][0]) == ([f"{MILL} hold"], "hold")
    page.wait_for_timeout(300)
    expect(page.locator(".stops .arrived")).to_be_empty()


@pytest.mark.thorough
def test_a_hold_is_not_said_again_after_a_stop(opened: Opened) -> None:
    """It would come when the mill has been cleared, and hold it."""
    page, way = watching(opened, None)
    sent = record_orders(page)
    both = page.get_by_role("button", name=re.compile("^(HOLD|STOP)"))
    expect(both).to_have_count(2)
    both.evaluate_all("(buttons) => buttons.forEach((one) => one.click())")  # at once, however slow the browser
    until(lambda: (page.wait_for_timeout(500), sent)[1], what="the stop by the other way")
    assert (way.stops(), [name for name, *_ in sent]) == ([f"{MILL} hold", f"{MILL} abort"], ["abort"])


@pytest.mark.thorough
def test_an_order_after_our_own_stop_is_no_order_before_it(opened: Opened) -> None:
    """The answer to the stop counts, where what the mill says comes later."""
    page = at_mill(opened, "held")

    def stopped(route: Route) -> dict[str, Any]:
        answer = taken(route)
        return answer | {"mill": answer["mill"] | {"stops": 8}}

    page.route("**/control/hold", lambda route: route.fulfill(status=202, json=stopped(route)))
    asked: list[dict[str, Any]] = []

    def grant(route: Route) -> None:
        asked.append(route.request.post_data_json)
        route.fulfill(status=201, json=GRANT)

    page.route("**/grants", grant)
    with page.expect_response("**/control/hold"):
        page.get_by_role("button", name="HOLD").click()
    with page.expect_response("**/grants"):
        page.get_by_role("button", name="Resume").click()
    assert asked == [{"stops": 8}]


def test_a_stop_that_no_way_takes_is_said_until_the_mill_stands(opened: Opened) -> None:
    """And not over the next run, which is another one and well."""
    page, _ = watching(opened, {"taken": False, "detail": "no"}, errors=("status of 504",))
    record_orders(page, lambda route: route.fulfill(status=504, json={"detail": "no answer"}))
    alarm = page.locator(".stops .arrived")
    page.get_by_role("button", name="HOLD").click()
    expect(alarm).to_contain_text("HOLD did not arrive")
    told(page, "running", mill={"spindle_rpm": 17000})
    expect(page.locator(".readout")).to_contain_text("17")
    expect(alarm).to_contain_text("HOLD did not arrive")
    told(page, "held")
    expect(alarm).to_be_empty()
    told(page, "running")
    expect(page.locator(".machine-state")).to_have_text("running")
    expect(alarm).to_be_empty()


def test_a_program_that_leaves_the_travel_is_told_in_a_sentence_and_where_in_a_fold(opened: Opened) -> None:
    page = at_mill(opened, "parked", errors=("status of 409",))
    values = {"detail": "\n".join(f"{axis} would go from 1 to 2 mm" for axis in "XYZ" * 3)}
    told = problem(409, detail="start: no", code="travel", values=values)
    record_orders(page, lambda route: route.fulfill(**told))
    press_start(page)
    said = page.locator(".running .said")
    expect(said).to_contain_text("Set the zero where it fits")
    expect(said.get_by_text("Z would").first).to_be_hidden()
    said.get_by_text("Where", exact=True).click()
    expect(said.get_by_text("Z would go from 1 to 2 mm.")).to_have_count(3)


def test_a_zero_that_is_set_anew_asks_for_the_warnings_of_the_program_anew(opened: Opened) -> None:
    page = with_control(opened, "parked", mill={"needs": []})
    expect(page.locator(".next")).to_contain_text("may not fit the travel")
    fits = machine_in("parked")[1] | {"travel_in_doubt": False, "warnings": []}
    page.route("**/v1/runs/*", lambda route: route.fulfill(json=fits))
    entry = {"number": 9, "at_s": 1795284539.5, "kind": "command", "words": "Zero: done", "by": "Ada"}
    body = f"event: log\ndata: {json.dumps(entry)}\n\n"
    page.route("**/events", lambda route: route.fulfill(body=body, content_type="text/event-stream"))
    page.evaluate("window.dispatchEvent(new Event('online'))")
    expect(page.locator(".next")).not_to_contain_text("may not fit")


def test_a_stop_while_the_server_is_away_is_no_alarm_over_a_run_that_is_back_and_well(opened: Opened) -> None:
    page, _ = watching(opened, {"taken": False, "detail": "no"}, errors=("ERR_FAILED",))
    for path in ("**/events", "**/control/**", "**/v1/runs**"):
        page.route(path, lambda route: route.abort())
    with page.expect_response(lambda answer: answer.url.endswith("/")):  # elsewhere it does
        page.evaluate("window.dispatchEvent(new Event('online'))")
    page.wait_for_timeout(100)
    assert "The server does not answer." in page.locator(".next").inner_text()
    page.get_by_role("button", name="HOLD").click()
    alarm = page.locator(".stops .arrived")
    expect(alarm).to_contain_text("HOLD did not arrive")
    told(page, "running")
    expect(page.locator(".machine-state")).to_have_text("running")
    expect(alarm).to_be_empty()


@pytest.mark.thorough
def test_nothing_can_be_loaded_while_an_order_is_on_its_way(opened: Opened) -> None:
    """Taken is not carried out: between the two the button said that it could, and then that it could not."""
    page = open_blank(opened, "machine", key="Ada")
    told(page, "idle", operator="Ada")
    page.evaluate(f"location.hash = '{SCREEN}'")
    page.get_by_role("button", name="Take over").click()
    page.get_by_role("group", name="Take over").get_by_role("button", name="Take over").click()
    load = page.get_by_role("button", name="Load onto the mill")
    expect(load).to_be_enabled()
    # Whether it is on, at every turn of the page from the answer to the order on.
    page.evaluate("""() => {
        const load = [...document.querySelectorAll("button")].find((one) => one.textContent === "Load onto the mill");
        window.seen = [];
        setInterval(() => window.seen.push(load.disabled), 5);
    }""")
    sent = record_orders(page)
    setup(page).get_by_role("button", name="Z = 0 here", exact=True).click()
    await_orders(page, sent)
    page.wait_for_timeout(300)
    expect(load).to_be_disabled(timeout=200)
    expect(load).to_be_enabled()  # of an order that the log says nothing of
    seen: list[bool] = page.evaluate("window.seen")
    off = seen.index(True)
    assert all(seen[off : len(seen) - 1 - seen[::-1].index(True)])


def test_a_line_that_changes_the_mill_itself_is_asked_for_once_more(opened: Opened) -> None:
    page = at_mill(opened, "idle", errors=("status of 409",))
    words = "$20=0 switches the soft limits off: nothing stops the tool at the end of travel"

    def answer(route: Route) -> None:
        if json.loads(route.request.post_data or "{}").get("confirm"):
            route.fulfill(status=202, json=taken(route))
        else:
            route.fulfill(**refusal("confirm", words, effect=words))

    sent = record_orders(page, answer)
    page.get_by_label("One line to the mill").fill("$20=0")
    page.get_by_role("button", name="Send", exact=True).click()
    question = page.get_by_role("group", name="Send $20=0")
    expect(question).to_contain_text("switches the soft limits off")
    expect(question.get_by_role("button", name="Cancel")).to_be_focused()
    question.get_by_role("button", name="Send $20=0 anyway").click()
    await_orders(page, sent, 2)
    assert [body for _, body, _ in sent] == [{"text": "$20=0"}, {"text": "$20=0", "confirm": True}]
    expect(question).to_be_hidden()
    expect(page.get_by_label("One line to the mill")).to_have_value("")


@pytest.mark.thorough
def test_who_gave_which_order_can_be_read(opened: Opened) -> None:
    def given(number: int, **more: Any) -> dict[str, Any]:
        base = {"number": number, "at_s": 1795284531.5 + number, "kind": "command", "by": "Ada", "from": "192.168.1.20"}
        return base | {"words": "Jog X 1.000: done"} | more

    why = {"order": "jog", "code": "", "values": {}, "words": "the mill was told to stop after this order"}
    refused = {"words": f"jog: refused: {why['words']}", "code": "order_refused", "values": why}
    pages = {
        "": {
            "orders": [given(60, kind="order", words="hold", code="hold", values={}, by="Grace"), given(59)],
            "next": 59,
        },
        "59": {"orders": [given(58, kind="order", **refused)], "next": None},
    }

    def answer(route: Route) -> None:
        before = re.search(r"before=(\d+)", route.request.url)
        route.fulfill(json=pages[before[1] if before else ""])

    page = open_blank(opened, "machine")
    told(page, "idle")
    page.route("**/v1/machines/shop/orders**", answer)
    page.evaluate(f"location.hash = '{SCREEN}'")
    page.get_by_role("heading", name="Orders").click()
    rows = page.locator(".given li")
    expect(rows).to_have_count(2)
    expect(rows.first).to_contain_text("HOLD")
    expect(rows.first).to_contain_text("Grace from 192.168.1.20")
    page.get_by_role("button", name="Show older ones").click()
    expect(rows).to_have_count(3)
    expect(rows.last).to_contain_text("told to stop after this order")
    expect(page.get_by_role("button", name="Show older ones")).to_be_hidden()
    expect(page.locator(".log")).to_contain_text("port lost: the device is gone Ada")


def test_a_corner_is_probed_by_what_is_known_of_plate_tool_and_block(opened: Opened) -> None:
    """Tool and block are those of the program; the plate is given once, and not asked for again."""
    page = with_control(opened, "parked")
    sent = record_orders(page)
    page.get_by_text("Probe the corner with a plate").click()
    probe = page.get_by_role("button", name="Probe the corner", exact=True)
    expect(probe).to_be_disabled()
    for side, mm in (("on", "10"), ("left of", "6.1"), ("in front of", "5.9")):
        page.get_by_label(f"Plate {side} the block").fill(mm)
    expect(page.get_by_label("X0 Y0 inside the edges")).to_have_value("8")
    probe.click()
    question = page.get_by_role("group", name="Probe the corner")
    expect(question).to_contain_text("20 mm and its radius to the left")
    question.get_by_role("button", name="Probe", exact=True).click()
    until(lambda: sent or page.wait_for_timeout(50))
    [(order, body, _)] = sent
    assert order == "probe-corner" and ProbeCornerBody.model_validate(body).model_dump(exclude_unset=True) == {
        "plate_mm": 10, "wall_x_mm": 6.1, "wall_y_mm": 5.9, "depth_mm": 10, "cutter_radius_mm": 0.5, "margin_mm": 8,
        "aside_mm": 20.5, "below_mm": 1.5,
    }  # fmt: skip
    page.reload()
    expect(page.get_by_label("Plate left of the block")).to_have_value("6.1")
