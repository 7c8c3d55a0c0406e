"""Moving the mill by hand: a press that is held, by finger and key, and the probe. What ends a hold stops the mill."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, CDPSession, Page, Route, expect

from tests.page.browser import Watched, new_context
from tests.page.conftest import sign_in
from tests.page.driving import go_to_machine, homed, logged, machine_state, readout, release, say, take_control
from tests.page.shop import Shop

FEED = 6
HELD_MM = 0.3  # three seconds at this feed
FARTHER = 400  # a jog goes so much farther than it was ordered, so that one can see where it is stopped
FAR_MM = FARTHER * HELD_MM
STOPPED_MS = 30_000  # all of it takes twice as long
SIX_PRESSES = """async (one) => {
    for (let k = 0; k < 6; k += 1) {
        one.click();
        await new Promise((go) => setTimeout(go, 60));
    }
}"""
PLATE_MM, RETRACT_MM = 1.5, 2.0


class Finger:
    """On one button of a page, wherever that is by then."""

    def __init__(self, page: Page, button: str) -> None:
        self._session: CDPSession = page.context.new_cdp_session(page)
        self._button = page.get_by_role("button", name=button, exact=True)
        self._is_down = False

    def down(self) -> None:
        self._button.evaluate("one => one.scrollIntoView({block: 'center'})")
        box = self._button.bounding_box()
        assert box is not None
        point = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
        self._session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [point]})
        self._is_down = True

    def gone(self, how: str = "touchEnd") -> None:
        if self._is_down:
            self._session.send("Input.dispatchTouchEvent", {"type": how, "touchPoints": []})
        self._is_down = False


@pytest.fixture(scope="module")
def phone(browser: Browser, shop: Shop) -> Iterator[Page]:
    """A phone with control of a homed mill; jogs are held."""
    watched = Watched(new_context(browser, shop.url, size="phone"))
    watched.expect_errors("status of 409")
    page = watched.page()
    page.goto("/")
    sign_in(page, shop.key("Ada"))
    go_to_machine(page)
    take_control(page)
    homed(page)
    page.get_by_label("while pressed").check()
    page.get_by_role("region", name="Jog").get_by_label("Feed").fill(str(FEED))
    yield page
    release(page)
    watched.close()


@pytest.fixture
def at_mill(phone: Page) -> Iterator[Page]:
    yield phone
    phone.unroute_all()


def farther(route: Route) -> None:
    asked = route.request.post_data_json
    route.continue_(post_data=json.dumps(asked | {"by_mm": [FARTHER * mm for mm in asked["by_mm"]]}))


def place_mm(page: Page, axis: str) -> float:
    return float(readout(page, axis, own=True).inner_text().replace("−", "-"))


def hidden(page: Page, now: bool) -> None:
    page.evaluate("""now => {
        Object.defineProperty(document, "hidden", {get: () => now, configurable: true});
        document.dispatchEvent(new Event("visibilitychange"));
    }""", now)  # fmt: skip


def unfold_probe(page: Page) -> None:
    if not page.get_by_label("Plate thickness").is_visible():
        page.get_by_text("Probe Z with a plate").click()


def unfocused(page: Page) -> None:
    page.evaluate("window.dispatchEvent(new Event('blur'))")


@pytest.mark.thorough
def test_whatever_ends_the_hold_stops_the_mill(at_mill: Page) -> None:
    at_mill.route("**/control/jog", farther)
    finger = Finger(at_mill, "X minus")

    def key_down() -> None:
        at_mill.get_by_role("button", name="Use keyboard or gamepad").click()
        at_mill.keyboard.down("ArrowLeft")

    ends: dict[str, tuple[Callable[[], None], Callable[[], None]]] = {
        "key up": (key_down, lambda: at_mill.keyboard.up("ArrowLeft")),
        "lifted": (finger.down, finger.gone),
        "cancelled": (finger.down, lambda: finger.gone("touchCancel")),
        "window without focus": (finger.down, lambda: unfocused(at_mill)),
        "tab out of sight": (finger.down, lambda: hidden(at_mill, now=True)),
    }
    for how, (begin, end) in ends.items():
        before = place_mm(at_mill, "X")
        with logged(at_mill, "^[^ ]+ Jog X"):
            begin()
            expect(machine_state(at_mill)).to_have_text("jogging")
            end()
            hidden(at_mill, now=False)
            expect(machine_state(at_mill)).to_have_text("idle", timeout=STOPPED_MS)
            assert 0 < before - place_mm(at_mill, "X") < FAR_MM - 20, how
            finger.gone()
        homed(at_mill)


def test_a_word_to_go_that_a_word_to_stop_has_overtaken_moves_nothing(at_mill: Page) -> None:
    waiting: list[Route] = []
    at_mill.route("**/control/jog", lambda route: waiting.append(route))
    place = place_mm(at_mill, "X")
    finger = Finger(at_mill, "X minus")
    with logged(at_mill, "End of a jog"):
        with at_mill.expect_request("**/control/jog"):
            finger.down()
        finger.gone()
    with at_mill.expect_response("**/control/jog") as answer:
        farther(waiting[0])
    assert answer.value.status == 409
    expect(at_mill.locator(".jog .said")).to_contain_text("the mill was stopped after you pressed")
    expect(machine_state(at_mill)).to_have_text("idle")
    assert place_mm(at_mill, "X") == place
    at_mill.wait_for_timeout(1500)  # the word to stop is said until it is certain


def test_a_hold_that_nothing_ends_is_short(at_mill: Page) -> None:
    """The order itself goes no farther than some seconds of feed, and a second finger changes nothing."""
    sent: list[str] = []
    at_mill.on("request", lambda asked: sent.append(asked.post_data or "") if asked.url.endswith("/jog") else None)
    before = place_mm(at_mill, "X")
    finger = Finger(at_mill, "X minus")
    finger.down()
    expect(readout(at_mill, "X", own=True)).to_have_text(f"−{HELD_MM - before:.3f}")
    expect(machine_state(at_mill)).to_have_text("idle")
    with logged(at_mill, "End of a jog"):
        finger.gone()
    assert len(sent) == 1
    at_mill.wait_for_timeout(1500)  # as above: nothing may be ordered that this word would stop


def test_quick_presses_add_up(at_mill: Page) -> None:
    """At 60 mm/min each takes a second; the log has the first one, and the rest as one."""
    before = place_mm(at_mill, "X")
    at_mill.get_by_label("1", exact=True).check()
    feed = at_mill.get_by_role("region", name="Jog").get_by_label("Feed")
    feed.fill("60")
    with logged(at_mill, "Jog X -5 mm: done"):
        at_mill.get_by_role("button", name="X minus").evaluate(SIX_PRESSES)
        expect(at_mill.locator(".jog .waits")).to_have_text("Waiting: X −5 mm")
    expect(readout(at_mill, "X", own=True)).to_have_text(f"−{6 - before:.3f}")
    expect(at_mill.locator(".jog .waits")).to_be_empty()
    feed.fill(str(FEED))
    at_mill.get_by_label("while pressed").check()


@pytest.mark.thorough
def test_a_probe_sets_the_zero_by_the_plate(at_mill: Page) -> None:
    """The plate is felt at machine Z -25; from there the tool rises, and its height over the block is known."""
    say(at_mill, "G53 G0 Z-20")
    expect(readout(at_mill, "Z", own=True)).to_have_text("−20.000")
    unfold_probe(at_mill)
    at_mill.get_by_label("Plate thickness").fill(str(PLATE_MM))
    at_mill.get_by_role("button", name="Probe Z", exact=True).click()
    question = at_mill.get_by_role("group", name="Probe Z")
    expect(question).to_contain_text("goes down by up to 10 mm")
    question.get_by_role("button", name="Probe", exact=True).click()
    expect(readout(at_mill, "Z")).to_have_text(f"{PLATE_MM + RETRACT_MM:.3f}")
    expect(readout(at_mill, "Z", own=True)).to_have_text("−23.000")
    expect(machine_state(at_mill)).to_have_text("idle")


@pytest.mark.thorough
def test_a_probe_that_touches_nothing_is_said_with_what_to_do(at_mill: Page) -> None:
    unfold_probe(at_mill)
    at_mill.get_by_label("Down at most").fill("1")
    at_mill.get_by_role("button", name="Probe Z", exact=True).click()
    at_mill.get_by_role("group", name="Probe Z").get_by_role("button", name="Probe", exact=True).click()
    expect(at_mill.locator(".trouble")).to_contain_text(re.compile("probe", re.IGNORECASE))
    expect(at_mill.locator(".next")).to_contain_text("Next: check that the tool is free to rise, then home the mill.")
    homed(at_mill)
