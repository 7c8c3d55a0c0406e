"""The list of jobs, the way to a new one, and the key."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page, Route, expect

from service.job.picture.light_png import thumbnail_png
from service.job.picture.linear_light import srgb_to_linear
from service.page.files import FOLDER
from tests.page import form
from tests.page.browser import NOWHERE, Watched
from tests.page.conftest import Opened
from tests.page.listed import answer_with, summary
from tests.page.shop import PICTURE
from tests.page.stub import Stub

STATES = {"queued": "waiting", "running": "working", "succeeded": "done", "failed": "failed", "cancelled": "cancelled"}
FIRST_VIEW_BYTES, WITH_PICTURES_BYTES = 150_000, 300_000
EXAMPLES = PICTURE.parent
DROP = """([place, name, bytes]) => {
    const data = new DataTransfer();
    data.items.add(new File([new Uint8Array(bytes)], name, {type: name.endsWith("png") ? "image/png" : "text/plain"}));
    const event = new DragEvent("drop", {dataTransfer: data, bubbles: true, cancelable: true});
    document.querySelector(place).dispatchEvent(event);
}"""


def shown(opened: Opened, jobs: list[dict[str, Any]], **how: Any) -> Page:
    page = opened(NOWHERE, **how)
    answer_with(page, jobs)
    page.evaluate("location.hash = '#/'")
    expect(page.get_by_role("heading", level=1, name="Jobs")).to_be_visible()
    return page


@pytest.mark.thorough
def test_every_state_is_a_word_and_a_shape(opened: Opened) -> None:
    error = {"stage": "map", "detail": "the lens is " + "very " * 60 + "thin", "field": None}
    jobs = [summary(number, state, error=error if state == "failed" else None) for number, state in enumerate(STATES)]
    jobs.append(summary(9, "queued", name="a-name-without-any-place-to-break-it" * 3 + ".png"))
    page = shown(opened, jobs)
    for number, word in enumerate(STATES.values()):
        card = page.get_by_role("link", name=f"picture-{number}")
        expect(card).to_contain_text(word)
        assert card.locator(".mark svg").count() == 1
    drawn = page.locator(".mark svg").evaluate_all("all => all.map(one => one.innerHTML)")
    assert len(set(drawn)) == len(STATES)


@pytest.mark.thorough
def test_who_has_no_job_is_told_in_one_sentence_what_to_do(opened: Opened) -> None:
    page = shown(opened, [])
    place = page.locator(".drop")
    words = page.locator(".drop > p")
    expect(words).to_contain_text("Drop a picture here")
    assert words.inner_text().count(".") == 1
    light = page.get_by_role("img", name="The light of a milled lens")  # the tests' browser asks for no motion
    expect(light).to_have_js_property("complete", True)
    assert light.evaluate("one => one.currentSrc").endswith("focus-still.avif")
    expect(page.get_by_role("navigation", name="Which jobs")).to_be_hidden()
    expect(place.get_by_role("button", name="Choose a picture")).to_be_visible()
    page.get_by_role("group", name="Examples").get_by_role("button", name="Logo").click()
    expect(page.get_by_label("Name of the job")).to_have_value("Logo")  # as it is called there


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_colours_are_those_chosen_at_the_foot_and_stay(opened: Opened, theme: str) -> None:
    page = shown(opened, [summary(1, "succeeded")], scheme="dark" if theme == "light" else "light")
    page.get_by_label("Colours").select_option(theme)
    paper = "getComputedStyle(document.documentElement).backgroundColor"
    chosen = page.evaluate(paper)
    assert (chosen == "rgb(251, 250, 248)") == (theme == "light")
    page.reload()
    expect(page.get_by_label("Colours")).to_have_value(theme)
    assert page.evaluate(paper) == chosen
    page.get_by_label("Colours").select_option("as the computer")


def test_a_dropped_picture_begins_a_job_and_anything_else_is_refused_in_words(opened: Opened) -> None:
    page = shown(opened, [])
    expect(page.locator(".drop")).to_be_visible()
    page.evaluate(DROP, [".drop", "notes.txt", list(b"no picture")])
    expect(page.get_by_text("This is not a picture.")).to_be_visible()
    page.evaluate(DROP, [".drop", "portrait.png", list(form.picture())])
    expect(page.get_by_role("heading", name="New job")).to_be_visible()
    expect(page.get_by_label("Name of the job")).to_have_value("portrait")


@pytest.mark.thorough
def test_the_list_goes_on_by_itself_and_leaves_the_focus_where_it_is(opened: Opened) -> None:
    jobs = [summary(1, "running", progress=0.10), summary(2, "succeeded")]
    page = shown(opened, jobs)
    page.get_by_role("link", name="picture-2").focus()
    jobs[0] |= {"progress": 0.57, "etag": '"later"'}
    jobs.insert(0, summary(0, "queued", queue_position=1))
    expect(page.get_by_role("link", name="picture-1")).to_contain_text("57 %")
    expect(page.get_by_role("link", name="picture-0")).to_be_visible()
    jobs.pop()
    jobs[1] |= {"state": "succeeded", "etag": '"last"'}
    expect(page.get_by_role("link", name="picture-1")).to_contain_text("done")
    expect(page.get_by_role("link", name="picture-2")).to_have_count(0)


def test_what_works_stands_first_and_a_failure_does_not_look_perfect(opened: Opened) -> None:
    waits = [summary(number, "queued") for number in range(18)]
    page = shown(opened, [*waits, summary(18, "running"), summary(19, "failed")])
    expect(page.locator(".job .name").first).to_have_text("picture-18")
    failed = page.get_by_role("link", name="picture-19").locator(".thumb")
    assert "grayscale" in failed.evaluate("one => getComputedStyle(one).filter")


@pytest.mark.thorough
def test_a_filter_shows_the_jobs_of_its_states(opened: Opened) -> None:
    page = shown(opened, [summary(number, state) for number, state in enumerate(STATES)])
    for words, states in (("Working", ("queued", "running")), ("Failed", ("failed", "cancelled")), ("All", STATES)):
        page.get_by_role("link", name=words, exact=True).click()
        expect(page.get_by_role("link", name=words, exact=True)).to_have_attribute("aria-current", "true")
        expect(page.locator(".job .name")).to_have_count(len(states))
    answer_with(page, [])
    page.get_by_role("link", name="Failed", exact=True).click()
    expect(page.get_by_text("No job failed or was cancelled.")).to_be_visible()


def test_the_first_view_is_small_and_comes_from_this_server_only(watched: Callable[..., Watched], stub: Stub) -> None:
    page = watched().page()
    sizes: dict[str, int] = {}
    page.on("requestfinished", lambda request: sizes.update({request.url: request.sizes()["responseBodySize"]}))
    page.goto("/")
    expect(page.get_by_role("heading", level=1, name="Jobs")).to_be_visible()
    page.wait_for_load_state("networkidle")
    assert all(url.startswith((stub.url, "blob:")) for url in sizes)
    asked_early = page.locator("link[rel=modulepreload]").evaluate_all("all => all.map(one => one.href)")
    assert {url for url in sizes if url.endswith(".js")} == set(asked_early)  # none waits for another to be read
    room = sum(one.stat().st_size for one in (FOLDER / "jobs").glob("*.avif"))  # for who has no job yet
    assert 10_000 < sum(sizes.values()) + room < FIRST_VIEW_BYTES, json.dumps(sizes, indent=1)


@pytest.mark.thorough
def test_a_dozen_jobs_of_the_usual_size_are_a_small_first_view_too(
    watched: Callable[..., Watched], stub: Stub, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = [thumbnail_png(light, white=1.0) for light in photographs()]
    for number, content in enumerate(pictures):
        monkeypatch.setitem(stub.pictures, summary(number, "succeeded")["id"], content)
    page = watched().page()
    sizes: dict[str, int] = {}
    page.on("requestfinished", lambda request: sizes.update({request.url: request.sizes()["responseBodySize"]}))
    page.goto("/")
    expect(page.locator(".job img.there")).to_have_count(1 + len(pictures))
    page.wait_for_load_state("networkidle")
    assert sum("/thumbnail" in url and url.endswith(".png") for url in sizes) == 1 + len(pictures)
    assert sum(map(len, pictures)) < sum(sizes.values()) < WITH_PICTURES_BYTES, json.dumps(sizes, indent=1)


def photographs() -> Iterator[np.ndarray]:
    """Twelve pictures of 512 pixels that pack as badly as photographs do."""
    for name in ("camera", "astronaut"):
        with Image.open(EXAMPLES / f"{name}.png") as picture:
            light = srgb_to_linear(np.asarray(picture.convert("L").resize((512, 512)), dtype=float) / 255)
        yield from (np.rot90(turned, k) for turned in (light, np.fliplr(light), 1 - light) for k in (0, 1))


def test_an_address_of_no_view_is_said_so_whoever_is_here(opened: Opened) -> None:
    """Who listens anew when it hears who is here does not hear it again for ever."""
    page = opened("#/nowhere", key="Ada")
    expect(page.get_by_role("alert")).to_contain_text("no such page")


def test_a_view_that_comes_too_late_is_not_shown(opened: Opened) -> None:
    """A person went on while it loaded: neither its content nor its title takes the place of what they look at."""
    page = opened("#/new")
    waiting: list[Route] = []
    page.route("**/v1/jobs?*", lambda route: waiting.append(route))
    with page.expect_request("**/v1/jobs?*"):
        page.evaluate("location.hash = '#/'")
    page.evaluate("location.hash = '#/new'")
    expect(page.get_by_role("heading", level=1, name="New job")).to_be_visible()
    waiting[0].fulfill(json={"jobs": [], "next": None})
    page.evaluate("() => new Promise((done) => setTimeout(done, 200))")
    expect(page.get_by_role("heading", level=1)).to_have_text("New job")
    assert page.title().startswith("New job")


def test_who_declines_to_give_a_key_is_not_asked_again_and_who_gives_it_later_sees_the_list(
    opened: Opened, stub: Stub
) -> None:
    page = opened(NOWHERE, errors=("status of 401",))

    def ask_for_a_key(route: Route) -> None:
        known = "authorization" in route.request.headers
        body = {"status": 401, "detail": "a token is needed", "field": "Authorization"}
        route.fallback() if known else route.fulfill(status=401, json=body)

    page.route("**/v1/jobs?*", ask_for_a_key)
    page.evaluate("location.hash = '#/'")
    dialog = page.get_by_role("dialog", name="Enter the code")
    dialog.get_by_role("button", name="Cancel").click()
    expect(page.get_by_text("This server asks for its code before it shows this.")).to_be_visible()
    expect(page.get_by_text("token")).to_have_count(0)
    page.get_by_role("button", name="Try again").click()
    expect(page.get_by_role("heading", level=1, name="Not shown")).to_be_visible()
    expect(dialog).to_have_count(0)
    page.get_by_role("button", name="Enter code").click()
    dialog.get_by_role("textbox", name="Code", exact=True).fill(stub.key("Joan"))
    dialog.get_by_label("Your name").fill("Joan")
    dialog.get_by_role("button", name="Enter", exact=True).click()
    expect(page.get_by_role("heading", level=1, name="Jobs")).to_be_visible()


@pytest.mark.thorough
def test_the_list_can_be_walked_with_the_keyboard_alone(opened: Opened) -> None:
    page = shown(opened, [summary(1, "succeeded")])
    page.reload()
    expect(page.get_by_role("link", name="picture-1")).to_be_visible()
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to content")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#view")).to_be_focused()
    page.keyboard.press("Tab")
    expect(page.get_by_role("button", name="Choose a picture")).to_be_focused()
    for _ in range(9):
        page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="picture-1")).to_be_focused()
    outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    assert outline != "none"


def names(page: Page) -> list[str]:
    found: list[str] = page.locator(".job .name:visible").all_inner_texts()
    return found


def test_jobs_are_found_by_name_and_sorted_however_many_there_are(opened: Opened) -> None:
    """Those that the list has not asked for so far count, too; what was asked is there again after Back."""
    page = opened(NOWHERE)
    jobs = [summary(number, "succeeded", name=f"Lens {number}.png") for number in range(12)]
    pages = {
        None: (jobs[:4], "?limit=48&cursor=1"),
        "cursor=1": (jobs[4:8], "?limit=48&cursor=2"),
        "cursor=2": (jobs[8:], ""),
    }

    def answer(route: Route) -> None:
        asked = next((key for key in pages if key and key in route.request.url), None)
        found, more = pages[asked]
        route.fulfill(json={"jobs": found, "next": f"/v1/jobs{more}" if more else None})

    page.route("**/v1/jobs?*", answer)
    page.evaluate("location.hash = '#/'")
    expect(page.locator(".job")).to_have_count(4)
    order = page.get_by_role("combobox", name="Order")
    order.select_option(label="By name")
    expect(page.locator(".job")).to_have_count(12)
    assert names(page) == [f"Lens {number}" for number in range(12)]
    order.select_option(label="Oldest first")
    expect(page.locator(".job .name").first).to_have_text("Lens 11")
    page.get_by_role("searchbox").fill("lens 1")
    expect(page.locator(".job:visible")).to_have_count(3)
    assert names(page) == ["Lens 11", "Lens 10", "Lens 1"]
    page.evaluate("location.hash = '#/machines'")
    expect(page.get_by_role("heading", level=1, name="Machines")).to_be_visible()
    page.go_back()
    expect(page.locator(".job:visible")).to_have_count(3)
    expect(page.get_by_role("searchbox")).to_have_value("lens 1")
    for words, found in (("11.PNG", 1), ("lens grbl done", 12), ("60 × 40 lens 3", 1), ("failed", 0)):
        page.get_by_role("searchbox").fill(words)
        expect(page.locator(".job:visible")).to_have_count(found)
    page.get_by_role("searchbox").fill("no such lens")
    expect(page.get_by_text("No job has all of these words.")).to_be_visible()


@pytest.mark.thorough
def test_many_jobs_are_deleted_at_once_after_one_question(opened: Opened) -> None:
    """Only those that are ticked and shown; one that is refused stays and says why."""
    jobs = [summary(number, "succeeded", name=f"Lens {number}.png") for number in range(4)]
    page = shown(opened, jobs, key="Ada", errors=("status of 409",))
    deleted: list[str] = []

    def delete(route: Route) -> None:
        if route.request.method != "DELETE":
            return route.fallback()
        job = next(job for job in jobs if job["id"] in route.request.url)
        if job["name"] == "Lens 3.png":
            return route.fulfill(status=409, json={"detail": "a program of it is on a mill"})
        jobs.remove(job)
        deleted.append(job["name"])
        return route.fulfill(status=204)

    page.route("**/v1/jobs/*", delete)
    expect(page.get_by_role("checkbox")).to_have_count(0)
    page.get_by_role("button", name="Select").click()
    page.get_by_role("checkbox", name="Select Lens 0").check()
    page.get_by_role("searchbox").fill("lens 3")
    page.get_by_role("button", name="All shown").click()
    expect(page.get_by_role("button", name="Delete 1")).to_be_enabled()  # nobody deletes what they do not see
    page.get_by_role("searchbox").fill("lens")
    page.get_by_role("button", name="Delete 2").click()
    assert deleted == []
    page.get_by_role("dialog", name="Delete 2 jobs?").get_by_role("button", name="Delete").click()
    expect(page.get_by_text("Lens 3: A program of it is on a mill.")).to_be_visible()
    assert deleted == ["Lens 0.png"]
    assert names(page) == ["Lens 1", "Lens 2", "Lens 3"]


def test_the_picture_of_a_job_becomes_that_of_the_wall(opened: Opened, stub: Stub) -> None:
    """As soon as there is one: a target looks perfect, whatever becomes of it."""
    job = summary(1, "running")
    at = f"/v1/jobs/{job['id']}/artifacts"
    page = opened(NOWHERE)
    page.route(
        f"**{at}/*",
        lambda route: route.fulfill(body=thumbnail_png(np.ones((4, 4)), white=1.0), content_type="image/png"),
    )
    jobs = [job | {"links": job["links"] | {"picture": f"{at}/thumbnail.png"}}]
    answer_with(page, jobs)
    page.evaluate("location.hash = '#/'")
    picture = page.locator(".job img.there")
    expect(picture).to_be_visible()
    before = picture.get_attribute("src")
    with page.expect_request(f"**{at}/thumbnail-as-milled.png"):
        jobs[0] = jobs[0] | {"links": job["links"] | {"picture": f"{at}/thumbnail-as-milled.png"}}
    expect(picture).not_to_have_attribute("src", before or "")
