"""A job on the page, from the wish to its files."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import pytest
from playwright.sync_api import Route, expect

from tests.page.conftest import Opened
from tests.page.form import choose, fill, make_it, picture
from tests.page.jobs import unfold
from tests.page.shop import JOB_MS, Shop

AWAY = (r"net::ERR_", r"status of 50[234]")


@pytest.mark.thorough
def test_what_cannot_be_used_is_said_beside_its_field_and_the_first_has_the_focus(opened: Opened, shop: Shop) -> None:
    page = opened("#/new", errors=("status of 4[0-9][0-9]",))
    choose(page, picture())
    fill(page, Width="abc", Height="-3")
    make_it(page).click()
    width, height = (page.get_by_label(name, exact=True) for name in ("Width", "Height"))
    expect(width).to_be_focused()
    expect(width).to_have_accessible_description("'abc' is not a number.")
    bar = page.locator(".submit-bar")
    fill(page, Width="30")
    expect(width).to_have_attribute("aria-invalid", "false")
    bar.get_by_role("button", name="Height").click()
    expect(height).to_be_focused()
    expect(height).to_have_accessible_description(
        "-3 is not allowed; allowed: a number from 0.5 to 2000 mm. Use 0.5 mm"
    )
    page.get_by_label("Set every pass by hand").check()
    page.get_by_label("Pitch").first.fill("9")
    page.get_by_text("All settings").click()
    fill(page, Height="30")
    expect(bar.locator(".why")).to_have_text("Such a lens cannot be made. Look at:Pitch")
    bar.get_by_role("button", name="Pitch").click()
    pitch = page.get_by_label("Pitch").first
    expect(pitch).to_be_focused()  # its fold has opened
    expect(pitch).to_have_accessible_description("9 is wider than the ball's radius; allowed: 0.002 to radius_mm = 3.")


@pytest.mark.thorough
def test_pressed_twice_and_with_the_answer_lost_it_makes_one_job(opened: Opened, shop: Shop) -> None:
    page = opened("#/new", errors=("net::ERR", "status of 404"))
    choose(page, picture(), name="once-only.png")
    lost = []

    def lose_the_first(route: Route) -> None:
        if route.request.method != "POST" or lost:
            route.fallback()
        else:
            lost.append(route.fetch().status)
            route.abort("connectionreset")

    page.route("**/v1/jobs", lose_the_first)
    fill(page, Width="10", Height="10")
    page.get_by_label("Draft").check()
    fill(page, Pixels_across="16")
    make_it(page).dblclick()
    expect(page).to_have_url(re.compile("#/jobs/"))
    assert lost == [202]
    with shop.client() as client:
        made = [job for job in client.get("/v1/jobs").json()["jobs"] if job["name"] == "once-only.png"]
        assert [page.url.rpartition("/")[2]] == [job["id"] for job in made]
        client.post(f"/v1/jobs/{made[0]['id']}:cancel")


@pytest.mark.thorough
def test_a_job_is_followed_to_its_end_though_the_server_dies_meanwhile(opened: Opened, shop: Shop) -> None:
    """Progress, pictures, figures and programs come without a reload, across a crash of the API."""
    job = shop.begin()
    page = opened(f"#/jobs/{job}", errors=AWAY)
    unfold(page)
    words = page.locator(".progress-words")
    expect(words).to_have_text(re.compile(r"\d+ %: (?!Read)"), timeout=JOB_MS)
    shop.kill_api()
    expect(words).to_contain_text("Worked out", timeout=JOB_MS)
    expect(page.locator(".job-state")).to_have_text("done")
    page.locator("#pictures-title").scroll_into_view_if_needed()
    expect(page.get_by_role("img", name="As milled: with all marks of the tool").last).to_be_visible()
    expect(page.locator(".facts")).to_contain_text("will blur")
    expect(page.locator(".programs li")).to_have_count(2)


@pytest.mark.thorough
def test_files_are_whole_with_a_token_and_without(opened: Opened, shop: Shop) -> None:
    """By a plain link; by a stream onto the disk; by way of memory: the same bytes."""
    job, _ = shop.told()
    program = job["programs"][0]

    def sha256(path: Path) -> str:
        return hashlib.sha256(path.read_bytes()).hexdigest()

    for key in ("", "Ada"):
        page = opened(f"#/jobs/{job['id']}", key=key)
        unfold(page)
        page.evaluate("delete window.showSaveFilePicker")
        with page.expect_download() as download:
            page.locator(".programs").get_by_role("link", name="Save").first.click()
        assert download.value.suggested_filename == program["name"]
        assert sha256(download.value.path()) == program["sha256"]
    page = opened(f"#/jobs/{job['id']}", key="Ada")
    unfold(page)
    page.evaluate("""() => {
        window.pieces = [];
        window.showSaveFilePicker = async () => ({createWritable: async () => new WritableStream({
            write(piece) { window.pieces.push(piece.byteLength); }, close() { window.whole = true; }})});
    }""")
    save = page.locator(".programs").get_by_role("link", name="Save").first
    save.click()
    expect(save).not_to_have_attribute("data-busy", "yes")
    assert page.evaluate("window.whole")
    assert page.evaluate("window.pieces.reduce((sum, piece) => sum + piece, 0)") == program["bytes"]
