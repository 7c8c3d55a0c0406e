"""Whole ways through the page, as a person goes them, on a real server and simulated mills."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.page.conftest import Opened
from tests.page.driving import give_up, homed, load, machine_state, release, start, take_control, zeroed
from tests.page.shop import JOB_MS, LONG_PROGRAM, MILL, PICTURE, Shop
from tests.waiting import until

AWAY = (r"net::ERR_", r"status of 50[234]")
OVERTAKEN = r"status of 409 .*/recovery"  # a plan to go on, asked for in the moment in which the mill's state changes


@pytest.fixture
def at_mill(opened: Opened, shop: Shop) -> Iterator[Page]:
    """A page with control of a mill that is homed and has its zero; servers may go away under it."""
    shop.long_job()  # before the page looks which there are
    page = opened(f"#/machines/{MILL}", key="Ada", errors=(*AWAY, OVERTAKEN))
    take_control(page)
    give_up(page)
    zeroed(page)
    yield page
    release(page)


def running(page: Page, shop: Shop) -> None:
    """A long program runs on the mill."""
    load(page, shop.long_job(), LONG_PROGRAM)
    start(page)
    expect(machine_state(page)).to_have_text("running")


def cut_lines(page: Page) -> int:
    found = re.search(r"line ([\d,]+) of", page.locator(".meter").inner_text())
    assert found is not None
    return int(found[1].replace(",", ""))


def goes_on(page: Page) -> None:
    """The figures on the page rise: it hears of the mill."""
    before = cut_lines(page)
    until(lambda: (page.wait_for_timeout(50), cut_lines(page) > before)[1], what="more lines cut, as the page says")


def drop(page: Page, picture: Path) -> None:
    """As from the desktop: the file comes with the event."""
    content = base64.b64encode(picture.read_bytes()).decode()
    transfer = page.evaluate_handle(
        """([name, content]) => {
            const found = new DataTransfer();
            const bytes = Uint8Array.from(atob(content), (c) => c.charCodeAt(0));
            found.items.add(new File([bytes], name, {type: "image/png"}));
            return found;
        }""",
        [picture.name, content],
    )
    page.dispatch_event(".drop", "drop", {"dataTransfer": transfer})


def test_from_a_dropped_picture_to_a_finished_run(opened: Opened, shop: Shop) -> None:
    """Nothing but the page and the code that the server has printed."""
    page = opened()
    drop(page, PICTURE)
    page.get_by_label("Width", exact=True).fill("10")
    page.get_by_label("Height", exact=True).fill("10")
    page.get_by_role("radio", name="Draft").check()
    page.locator("summary", has_text=re.compile("^Picture$")).click()
    page.get_by_label("Pixels across").fill("64")
    page.get_by_text("All settings").click()
    page.get_by_text("Milling", exact=True).click()
    page.get_by_label("Set every pass by hand").check()
    page.get_by_label("Pitch").last.fill("0.25")
    page.get_by_label("Step down").last.fill("0.4")
    page.get_by_role("button", name="Make the lens").click()
    page.locator("summary", has_text="Programs").click(timeout=JOB_MS)
    page.get_by_role("link", name="Send to simulated: pass-1-rough.nc").click(timeout=JOB_MS)
    page.get_by_role("button", name="Take control").click()
    page.get_by_role("textbox", name="Code", exact=True).fill(shop.code)
    page.get_by_label("Your name").fill("Ada Lovelace")
    page.get_by_role("button", name="Enter", exact=True).click()
    expect(page.get_by_text("You have control.")).to_be_visible()
    expect(page.locator(".primary:visible")).to_have_text("Home")  # and not to load, before the mill knows where it is
    zeroed(page)
    page.get_by_role("button", name="Load onto the mill").click(timeout=JOB_MS)
    expect(page.get_by_role("button", name="Start pass-1-rough.nc")).to_be_visible()
    start(page)
    expect(page.locator(".running .mark")).to_have_text("finished")
    expect(page.locator(".meter")).to_contain_text("100 %")
    expect(page.locator(".next")).to_contain_text("load the next program of logo, pass-2-finish.nc")
    expect(page.get_by_role("combobox", name="Program")).to_have_value("pass-2-finish.nc")
    page.get_by_role("button", name="Load onto the mill").click()
    expect(page.get_by_role("button", name="Start pass-2-finish.nc")).to_be_visible()
    give_up(page)
    release(page)


def raised(page: Page) -> None:
    """The tool goes up first, and the plan to go on is made anew from there; it may have stood high already."""
    line = page.locator(".next")
    expect(line).to_contain_text(re.compile("raise Z first|go on with it"))
    if "raise Z first" in line.inner_text():
        with page.expect_response("**/recovery"):
            line.get_by_role("button", name="Raise Z").click()
    expect(line).to_contain_text("go on with it")


@pytest.mark.thorough
def test_a_run_is_held_resumed_stopped_and_gone_on_with(at_mill: Page, shop: Shop) -> None:
    running(at_mill, shop)
    at_mill.keyboard.press("Space")
    expect(machine_state(at_mill)).to_have_text("held")
    at_mill.get_by_role("button", name="Resume").click()
    expect(machine_state(at_mill)).to_have_text("running")
    goes_on(at_mill)
    at_mill.keyboard.press("Escape")
    expect(at_mill.locator(".running .mark")).to_have_text("stopped")
    stopped_at = cut_lines(at_mill)
    expect(machine_state(at_mill)).to_have_text(re.compile("^idle"))
    expect(at_mill.get_by_text(re.compile("Lines up to .* are cut for certain"))).to_be_visible()
    raised(at_mill)
    start(at_mill)
    expect(at_mill.locator(".running .mark")).to_have_text("running")
    goes_on(at_mill)
    assert cut_lines(at_mill) > stopped_at


@pytest.mark.thorough
def test_a_mill_that_an_alarm_locks_in_the_cut_is_homed_and_gone_on_with(
    at_mill: Page, shop: Shop, picture: Callable[[Page, str], Path | None]
) -> None:
    spindle = at_mill.locator(".pace div", has_text="Spindle").locator("dd")
    running(at_mill, shop)
    goes_on(at_mill)
    expect(spindle).to_have_text(re.compile("^on"))
    with shop.mill.lock:
        shop.mill.mill.firmware.settings[21] = 1.0
        shop.mill.mill.press("limit")
    expect(machine_state(at_mill)).to_have_text("locked")
    expect(spindle).to_have_text("off")
    expect(at_mill.locator(".running .mark")).to_have_text("interrupted")
    picture(at_mill, "locked")
    line = at_mill.locator(".next")
    expect(line).to_contain_text("Locked: hard limit hit.")
    homed(at_mill)
    raised(at_mill)
    stopped_at = cut_lines(at_mill)
    picture(at_mill, "homed")
    start(at_mill)
    expect(at_mill.locator(".running .mark")).to_have_text("running")
    expect(spindle).to_have_text(re.compile("^on"))
    goes_on(at_mill)
    assert cut_lines(at_mill) > stopped_at
    at_mill.keyboard.press("Escape")
    expect(at_mill.locator(".running .mark")).to_have_text("stopped")
    expect(spindle).to_have_text("off")


@pytest.mark.thorough
def test_the_page_recovers_by_itself_from_restarts_while_the_mill_runs(at_mill: Page, shop: Shop) -> None:
    """First the API dies and is started anew by its supervisor, then the whole server goes and comes back."""
    running(at_mill, shop)
    at_mill.evaluate("window.neverReloaded = true")
    shop.kill_api()
    expect(at_mill.locator(".next")).to_contain_text("use the button on the mill")
    expect(at_mill.locator(".trouble")).to_be_empty()
    goes_on(at_mill)
    shop.stop()
    expect(at_mill.locator(".next")).to_contain_text("use the button on the mill")
    expect(at_mill.locator(".stops")).to_contain_text("use the button on the mill itself")
    for control in at_mill.locator(".overrides button").all():
        expect(control).to_be_disabled()
    shop.start()
    expect(at_mill.locator(".trouble")).to_be_empty()
    goes_on(at_mill)
    expect(at_mill.get_by_text("You have control.")).to_be_visible()
    at_mill.get_by_role("button", name="HOLD").click()
    expect(machine_state(at_mill)).to_have_text("held")
    assert at_mill.evaluate("window.neverReloaded"), "nobody had to load the page again"


@pytest.mark.thorough
def test_a_pulled_cable_is_said_and_the_run_gone_on_with(at_mill: Page, shop: Shop) -> None:
    running(at_mill, shop)
    shop.pull_cable()
    trouble = at_mill.locator(".trouble")
    expect(trouble).to_contain_text("The mill is not connected.")
    expect(at_mill.locator(".next")).to_contain_text("the spindle may turn")
    expect(machine_state(at_mill)).to_have_text("not connected")
    expect(at_mill.get_by_role("button", name=re.compile("^Go on from"))).to_be_hidden()
    shop.plug_in()
    expect(at_mill.get_by_role("heading", name="Go on with this program")).to_be_visible()
