"""A new job on the page: what it shows is what the server makes of it, and one wish makes one job."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page, Route, expect

from service.job.spec.loading import DEFAULT_JOB, resolve_spec
from service.job.spec.model import JobSpec
from service.wording import likeness_in_words
from tests.page import canned_job
from tests.page.browser import Watched, open_blank
from tests.page.canned_job import ESTIMATE_EXAMPLE
from tests.page.conftest import Opened
from tests.page.form import (
    as_floats,
    choose,
    fill,
    make_it,
    parts,
    picture,
    pixels_of,
    pressed,
    refuse_picture,
    unfold,
    wall,
)
from tests.page.jobs import canned, shown, with_plan
from tests.page.machine_states import NAME as MILL
from tests.page.test_next_step import after

REST = {
    "optics.light.profile",
    "stock.face",
    "stock.cut_out",
    "stock.clamps",
}  # reached by the text of other values
PAGE_MODULE = "(name) => import(`/page/new/${name}.js`).then(Object.entries)"


@pytest.fixture
def new_job(opened: Opened) -> Page:
    """The view with a picture; estimates are answered by nobody, so that only what is asked for happens."""
    page = open_blank(opened, "new", errors=("status of 422",))
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    return page


@pytest.fixture
def sent(new_job: Page) -> Iterator[list[tuple[dict[str, Any], bytes, str]]]:
    """(spec, picture, Idempotency-Key) of every job that the page sends; the server itself never hears of them."""
    found: list[tuple[dict[str, Any], bytes, str]] = []

    def take(route: Route) -> None:
        found.append((*parts(route), route.request.headers["idempotency-key"]))
        route.fulfill(status=422, json={"status": 422, "detail": "enough for this test"})

    new_job.route("**/v1/jobs", take)
    yield found


def rows(page: Page, group: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = page.evaluate(f"import('/page/new/fields.js').then((all) => all.{group})")
    return found


def schema_keys(table: dict[str, Any], definitions: dict[str, Any], before: str = "") -> dict[str, dict[str, Any]]:
    found = {}
    for key, told in table["properties"].items():
        inner = definitions.get(told.get("$ref", "").rpartition("/")[2])
        found |= schema_keys(inner, definitions, f"{before}{key}.") if inner else {before + key: told}
    return found


@pytest.mark.thorough
def test_every_key_of_the_spec_has_a_field_that_knows_its_default_and_its_choices(modules: Page) -> None:
    schema = JobSpec.model_json_schema() | {"default": DEFAULT_JOB}
    told = schema_keys(schema, schema["$defs"])
    fields = [row for group in ("MAIN", "LIGHT", "MILL", "PICTURE") for row in rows(modules, group)]
    fields += [row for _, group in rows(modules, "EXPERT") for row in group]
    assert sorted(row["key"] for row in fields) == sorted(set(told) - REST - {"passes"})
    assert {row["key"] for row in rows(modules, "PASS")} == set(schema["$defs"]["PassRow"]["properties"])
    for row in fields:
        default = told[row["key"]].get("default")
        if default is not None:
            assert row["usual"] == default, row["key"]
        if "enum" in told[row["key"]]:
            assert {value for value, *_ in row["choices"]} == set(told[row["key"]]["enum"]), row["key"]


@pytest.mark.thorough
def test_a_key_that_is_new_in_the_spec_has_its_row(watched: Callable[..., Watched]) -> None:
    """Of what the schema says of it: label, hint, unit, limits, default; and what a person fills in is asked for."""
    schema = JobSpec.model_json_schema() | {"default": DEFAULT_JOB}
    words = {
        "title": "Tilt of the wall",
        "description": "Its upper edge to you.",
        "unit": "°",
    }
    new = {"type": "number", "minimum": -60, "maximum": 60, "default": 0.0, **words}
    schema["$defs"]["OpticsSpec"]["properties"]["wall_tilt_deg"] = new
    module = f"export const SCHEMA = {json.dumps(schema)};"
    page = watched().page()
    page.route("**/new/spec_schema.js", lambda route: route.fulfill(content_type="text/javascript", body=module))
    asked: list[dict[str, Any]] = []

    def estimate(route: Route) -> None:
        asked.append(parts(route)[0])
        route.fulfill(json=ESTIMATE_EXAMPLE)

    page.route("**/v1/estimates", estimate)
    page.goto("/#/new")
    choose(page, picture())
    page.get_by_label("Search all settings").fill("Tilt of the wall")
    field = page.get_by_role("group", name="All settings").get_by_label("Tilt of the wall", exact=True)
    expect(field).to_have_attribute("placeholder", "0")
    expect(field).to_have_attribute("title", "-60 to 60 °")
    expect(field).to_have_accessible_description("Its upper edge to you.")
    with page.expect_response(lambda one: b"wall_tilt_deg" in (one.request.post_data_buffer or b"")):
        field.fill("12")
    assert asked[-1]["optics"] == {"wall_tilt_deg": 12}


def test_a_picture_nobody_touched_is_sent_byte_for_byte(new_job: Page, sent: list[Any]) -> None:
    _, content, _ = pressed(new_job, sent)
    assert content == picture()
    expect(new_job.locator(".submit-bar")).to_contain_text("Enough for this test")


def test_an_estimate_that_comes_late_leaves_the_words_of_a_refusal(opened: Opened) -> None:
    page = open_blank(opened, "new", errors=("status of 422",))
    asked: list[Route] = []
    page.route("**/v1/estimates", lambda route: asked.append(route))
    page.route("**/v1/jobs", lambda route: route.fulfill(status=422, json={"status": 422, "detail": "no room for it"}))
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    after(asked, 1, page)
    make_it(page).click()
    bar = page.locator(".submit-bar")
    expect(bar).to_contain_text("No room for it")
    asked[-1].fulfill(json=ESTIMATE_EXAMPLE)
    expect(bar).to_contain_text("of milling")
    expect(bar).to_contain_text("No room for it")
    fill(page, Width="30")
    asked.clear()
    after(asked, 1, page)
    asked[-1].fulfill(json=ESTIMATE_EXAMPLE)
    expect(bar).not_to_contain_text("No room for it")


def test_the_same_request_keeps_its_key_and_another_gets_another(new_job: Page, sent: list[Any]) -> None:
    """So that pressing again after a fault makes no second job."""
    first = pressed(new_job, sent)
    assert pressed(new_job, sent) == first
    fill(new_job, Width="30")
    assert pressed(new_job, sent)[2] != first[2]


@pytest.mark.thorough
def test_turned_mirrored_and_cut_out_it_is_exactly_those_pixels(new_job: Page, sent: list[Any]) -> None:
    """Turning right is a quarter clockwise of what is seen, mirrored or not; a square wall gets the middle."""
    seen = pixels_of(picture())
    steps: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "Turn right": lambda pixels: np.rot90(pixels, -1),
        "Mirror": np.fliplr,
        "Turn left": np.rot90,
    }
    for name in ("Turn right", "Mirror", "Turn right", "Turn left", "Turn left"):
        new_job.get_by_role("button", name=name).click()
        seen = steps[name](seen)
        height, width = seen.shape[:2]
        fill(new_job, Width=str(width), Height=str(height))
        assert np.array_equal(pixels_of(pressed(new_job, sent)[1]), seen), name
    fill(new_job, Width="20", Height="20")
    side, left, top = min(width, height), max(0, width - height) // 2, max(0, height - width) // 2
    assert np.array_equal(pixels_of(pressed(new_job, sent)[1]), seen[top : top + side, left : left + side])


@pytest.mark.thorough
def test_the_part_is_chosen_by_dragging_and_by_the_keyboard_alike(new_job: Page, sent: list[Any]) -> None:
    """A square of a 60 x 40 picture can move 10 pixels to either side, and stops there."""
    seen = pixels_of(picture())
    box = wall(new_job).bounding_box()
    assert box is not None
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    new_job.mouse.move(*middle)
    new_job.mouse.down()
    new_job.mouse.move(middle[0] + box["width"], middle[1], steps=4)  # the picture goes right: its left part is seen
    new_job.mouse.up()
    assert np.array_equal(pixels_of(pressed(new_job, sent)[1]), seen[:, :40])
    wall(new_job).focus()
    for _ in range(12):
        new_job.keyboard.press("ArrowRight")
    assert np.array_equal(pixels_of(pressed(new_job, sent)[1]), seen[:, 20:])


@pytest.mark.thorough
def test_the_height_follows_the_width_until_somebody_sets_it(new_job: Page, sent: list[Any]) -> None:
    """In the proportion that it had; a width on its way to be typed leaves nothing behind."""
    width, height = (new_job.get_by_label(name, exact=True) for name in ("Width", "Height"))
    width.fill("")
    width.press_sequentially("62,5")
    expect(height).to_have_value("62.5")
    assert pressed(new_job, sent)[0]["optics"] == {"width_mm": 62.5, "height_mm": 62.5}
    height.fill("40")
    width.fill("80")
    expect(height).to_have_value("40")
    new_job.get_by_role("link", name="Machines").click()
    new_job.go_back()
    expect(height).to_have_value("40")
    width.fill("120")
    expect(height).to_have_value("60")


@pytest.mark.thorough
def test_only_what_is_not_usual_is_asked_for(new_job: Page, sent: list[Any]) -> None:
    fill(new_job, Width="30,5", Distance_to_the_wall="250")
    new_job.get_by_label("Draft").check()
    new_job.get_by_role("radio", name=re.compile("^Lamp")).check()
    new_job.get_by_label("Negative").check()
    fill(new_job, Pixels_across="64")
    new_job.get_by_label("Other values, as JSON").fill('{"optics": {"outline": [[0, 0], [30, 0], [15, 30]]}}')
    spec, _, _ = pressed(new_job, sent)
    assert spec == {
        "preset": "draft",
        "machine": {"profile": MILL},  # the one real mill there is
        "image": {"pixels": 64, "invert": True},
        "optics": {
            "width_mm": 30.5,
            "height_mm": 30.5,
            "throw_mm": 250,
            "light": {"kind": "point", "distance_mm": 1000},
            "outline": [[0, 0], [30, 0], [15, 30]],
        },
        "stock": {"margin_mm": 20},  # shown, so sent: it differs between ways to plan
    }
    del spec["machine"]  # which this process does not know
    resolve_spec(base=json.loads(json.dumps(spec), parse_int=float) | {"image": {"pixels": 64, "invert": True}})


def test_the_best_finish_is_offered_where_a_planner_can_choose_it(new_job: Page, sent: list[Any]) -> None:
    """It comes back with the planner; another choice stays. What it takes is said of no job without a finish."""
    finish, best = new_job.get_by_label("Finished by hand"), new_job.locator("option", has_text="yes, in the best way")
    chosen, hint = finish.locator("option:checked"), new_job.get_by_text("minutes and steps are on the sheet")
    how = {name: new_job.locator(f"input[value={name}]") for name in ("draft", "recommended")}
    expect(chosen).to_have_text("yes, in the best way")
    expect(hint).to_be_visible()
    how["draft"].check()
    expect(chosen).to_have_text("no: as the mill leaves it")
    expect(best).to_be_hidden()
    expect(best).to_have_js_property("hidden", True)
    expect(hint).to_be_hidden()
    assert "finish" not in pressed(new_job, sent)[0]
    how["recommended"].check()
    expect(chosen).to_have_text("yes, in the best way")
    new_job.get_by_label("Set every pass by hand").check()
    expect(chosen).to_have_text("no: as the mill leaves it")
    finish.select_option("felt and compound")
    new_job.get_by_label("Set every pass by hand").uncheck()
    expect(chosen).to_have_text("felt and compound")
    assert pressed(new_job, sent)[0]["finish"] == {"process": "felt"}


@pytest.mark.thorough
def test_how_fine_is_chosen_beside_the_size_and_only_a_plan_can_keep_a_time(new_job: Page, sent: list[Any]) -> None:
    main = new_job.get_by_role("region", name="Mill, size, time")
    names = main.get_by_role("group", name="How fine").get_by_role("radio")
    assert [one.get_attribute("value") for one in names.all()] == ["draft", "recommended", "paper"]
    time = main.get_by_label("Time at most")
    time.fill("3")
    assert pressed(new_job, sent)[0]["plan"] == {"hours": 3}
    main.get_by_label("fixed passes to try the mill; no work by hand").check()
    expect(time).to_be_disabled()
    expect(time).to_have_attribute("title", re.compile("Recommended"))
    spec = pressed(new_job, sent)[0]
    assert spec["preset"] == "draft" and "plan" not in spec
    main.get_by_label("Recommended").check()
    expect(time).to_have_value("3")
    expect(time).to_have_attribute("title", "0.01 to 10000 h")
    assert pressed(new_job, sent)[0]["plan"] == {"hours": 3}


@pytest.mark.thorough
def test_a_copy_asks_for_the_same_until_something_is_changed(opened: Opened) -> None:
    page = open_blank(opened, "new", errors=("status of 422",))
    caught: list[tuple[dict[str, Any], bytes]] = []

    def take(route: Route) -> None:
        caught.append(parts(route))
        route.fulfill(status=422, json={"status": 422, "detail": "enough for this test", "field": ""})

    page.route("**/v1/jobs", take)
    asked = canned_job.request()
    asked["spec"]["stock"] = {"thickness_mm": 25.0}
    page.route("**/request", lambda route: route.fulfill(json=asked))
    page.route(f"**{asked['image']}", lambda route: route.fulfill(body=picture()))
    page.evaluate("job => { location.hash = `#/new?from=${job}`; }", canned_job.JOB_ID)
    expect(page.get_by_label("Width", exact=True)).to_have_value("10")
    expect(wall(page)).to_be_visible()
    make_it(page).click()
    expect(page.get_by_text("enough for this test")).to_be_visible()
    assert caught[0][1] == picture()
    assert as_floats(caught[0][0]) == as_floats(asked["spec"])


@pytest.mark.thorough
def test_another_plan_is_a_click_away_from_its_own_job(opened: Opened) -> None:
    """What is posted then is that plan and nothing else that the first job had not."""
    job, files = canned()
    job = with_plan(job, 4)
    other = job["report"]["plan"]["candidates"][0]
    page = shown(opened, job, files, errors=("status of 422",))
    asked = canned_job.request()
    page.route(f"**/v1/jobs/{job['id']}/request", lambda route: route.fulfill(json=asked))
    page.route(f"**{asked['image']}", lambda route: route.fulfill(body=picture()))
    sent: list[dict[str, Any]] = []

    def take(route: Route) -> None:
        sent.append(parts(route)[0])
        route.fulfill(status=422, json={"detail": "enough for this test"})

    page.route("**/v1/jobs", take)
    page.get_by_role("slider", name="Plans, quickest first").press("Home")
    page.get_by_role("link", name="Make this job").click()
    expect(page.get_by_text("with another plan")).to_contain_text(other["words"])
    make_it(page).click()
    expect(page.get_by_text("enough for this test")).to_be_visible()
    del sent[0]["machine"]["profile"]  # which this process does not know
    resolved = resolve_spec(base=as_floats(sent[0]) | {"image": {"pixels": 64}}).model_dump(mode="json")
    assert resolved["preset"] == "recommended"
    assert len(resolved["passes"]) == len(other["spec"]["passes"])
    for ours, row in zip(resolved["passes"], other["spec"]["passes"], strict=True):
        assert {key: ours[key] for key in row} == as_floats(row) | {key: ours[key] for key in row if row[key] is None}
    for table in ("optics", "machine"):
        for key, value in other["spec"][table].items():
            assert resolved[table][key] == pytest.approx(value)
    assert (resolved["optics"]["width_mm"], resolved["image"]["pixels"]) == (10, 64)


@pytest.mark.thorough
def test_what_was_set_is_still_there_after_a_look_at_something_else(new_job: Page) -> None:
    fill(new_job, Width="33")
    new_job.get_by_role("button", name="Mirror").click()
    new_job.get_by_role("link", name="Machines").click()
    expect(new_job.get_by_role("heading", level=1, name="Machines")).to_be_visible()
    new_job.go_back()
    expect(new_job.get_by_label("Width", exact=True)).to_have_value("33")
    unfold(new_job)
    expect(new_job.get_by_role("button", name="Mirror")).to_have_attribute("aria-pressed", "true")
    new_job.get_by_role("button", name="Start over").click()
    expect(new_job.get_by_label("Width", exact=True)).to_have_value("100")
    expect(wall(new_job)).to_have_count(0)


def test_a_reload_loses_neither_picture_nor_settings(new_job: Page) -> None:
    fill(new_job, Width="33")
    new_job.get_by_role("button", name="Mirror").click()
    for elsewhere in (False, True):
        if elsewhere:
            new_job.get_by_role("link", name="Machines").click()
            expect(new_job.get_by_role("heading", level=1, name="Machines")).to_be_visible()
        new_job.reload()
        if elsewhere:
            new_job.go_back()
        expect(new_job.get_by_label("Width", exact=True)).to_have_value("33")
        unfold(new_job)
        expect(new_job.get_by_role("button", name="Mirror")).to_have_attribute("aria-pressed", "true")
        expect(wall(new_job)).to_be_visible()
    new_job.get_by_role("button", name="Start over").click()
    new_job.reload()
    expect(new_job.get_by_label("Width", exact=True)).to_have_value("100")
    expect(wall(new_job)).to_have_count(0)


@pytest.mark.thorough
def test_a_picture_this_browser_cannot_show_is_sent_as_it_is(new_job: Page, sent: list[Any]) -> None:
    file = io.BytesIO()
    Image.open(io.BytesIO(picture())).save(file, "TIFF")
    content = {"name": "scan.tif", "mimeType": "image/tiff", "buffer": file.getvalue()}
    new_job.locator("input[type=file]").first.set_input_files(content)
    expect(new_job.get_by_text("cannot show scan.tif")).to_be_visible()
    assert pressed(new_job, sent)[1] == file.getvalue()


def test_a_dozen_inputs_are_asked_for_and_all_other_keys_are_found_by_word_key_and_hint(new_job: Page) -> None:
    seen = """() => [...document.querySelectorAll(".new-job :is(input, select, textarea)")].filter((one) =>
        one.checkVisibility({contentVisibilityAuto: true, visibilityProperty: true})).length"""
    new_job.evaluate("for (const one of document.querySelectorAll('details')) one.open = false")
    assert new_job.evaluate(seen) <= 12
    new_job.get_by_text("All settings").click()
    for wanted, label in (
        ("HAZE", "Haze"),
        ("stock.skim", "Skim off the top"),
        ("scatters", "Haze"),
    ):
        new_job.get_by_label("Search all settings").fill(wanted)
        expect(new_job.get_by_label(label, exact=True)).to_be_visible()
        expect(new_job.get_by_label("Margin around", exact=True)).to_be_hidden()
    new_job.get_by_label("Search all settings").fill("")
    margin, group = new_job.get_by_label("Margin around", exact=True), new_job.locator(".expert summary")
    expect(margin).to_be_hidden()
    group.get_by_text("Stock", exact=True).click()
    margin.fill("14")
    expect(group.filter(has_text="Stock")).to_have_text("Stock1 changed")
    group.get_by_text("Optics", exact=True).click()
    expect(margin).to_be_hidden()  # one group is open at a time


def test_a_margin_is_the_one_that_is_shown(new_job: Page, sent: list[Any]) -> None:
    """A field that was left out counted 14 or 20, by the way of planning."""
    margin = new_job.get_by_label("Margin around", exact=True)
    expect(margin).to_have_value("20")
    margin.fill("14")
    assert pressed(new_job, sent)[0]["stock"] == {"margin_mm": 14}


TAKES_EVERY_JOB = """import("/page/lib/api.js").then(({ api }) => {
    const upload = api.upload;
    api.upload = async (path, ...how) => path === "/v1/jobs" ? { id: "x" } : upload(path, ...how);
})"""


def test_a_new_job_begins_with_mill_block_and_finish_of_the_last_one(opened: Opened) -> None:
    page = opened("#/new", errors=("status of 404",))  # the job that this stub has taken is nowhere
    choose(page, picture())
    finish = page.get_by_label("Finished by hand")
    expect(finish.locator("option:checked")).to_have_text("yes, in the best way")  # as a command begins
    fill(page, Thickness_of_the_block="12", Width="33", Distance_to_the_wall="200")
    finish.select_option("felt and compound")
    page.evaluate(TAKES_EVERY_JOB)
    make_it(page).click()
    expect(page.get_by_role("heading", level=1, name="New job")).to_have_count(0)
    page.goto("/#/new")
    expect(page.locator(".own > summary")).to_have_text(
        "What you have shop · block 12 mm thick · Parallel · wall at 200 mm · felt and compound"
    )
    expect(page.locator(".own")).not_to_have_attribute("open", "")
    expect(page.get_by_label("Thickness of the block")).to_have_value("12")
    expect(finish.locator("option:checked")).to_have_text("felt and compound")
    expect(page.get_by_label("Width", exact=True)).to_have_value("100")
    page.evaluate("localStorage.clear()")


def test_enter_ends_a_field_and_only_the_button_makes_the_job(new_job: Page, sent: list[Any]) -> None:
    """Without a mouse, or with a phone's keyboard, whose Go is Enter."""
    new_job.get_by_text("Your cutters").click()
    for label, value in (("Width", "25"), ("Name of the job", "mine"), ("Diameter", "4")):
        field = new_job.get_by_label(label, exact=True)
        field.fill(value)
        field.press("Enter")
        expect(field).not_to_be_focused()
        expect(field).to_have_value(value)
    assert not sent
    make_it(new_job).press("Enter")
    expect(new_job.get_by_text("enough for this test")).to_be_visible()
    assert [spec["optics"] for spec, _, _ in sent] == [{"width_mm": 25, "height_mm": 25}]


def test_mills_of_this_server_are_offered_first_by_their_own_names(new_job: Page) -> None:
    choice = new_job.get_by_role("combobox", name="Machine")
    names = choice.locator("optgroup").first.locator("option").all_inner_texts()
    assert names == ["simulated (grbl)", MILL]
    assert choice.locator("option:checked").inner_text() == names[1]


def test_a_job_begins_with_the_mill_that_is_there(modules: Page) -> None:
    """By profile, whether its mills are simulated: the only one, and a real one before a simulated one."""
    table: list[tuple[dict[str, list[bool]], str]] = [
        ({"a": [], "grbl": [], "z": []}, "grbl"),
        ({"a": [True], "grbl": []}, "a"),
        ({"a": [True], "grbl": [True]}, "grbl"),
        ({"a": [False], "grbl": [True]}, "a"),
        ({"a": [False], "grbl": [False]}, "grbl"),
    ]
    script = """(rows) => import('/page/new/machines.js').then(({firstProfile}) =>
        rows.map((all) => firstProfile(all, 'grbl')))"""
    rows = [
        [{"name": name, "mills": [{"simulated": one} for one in ones]} for name, ones in mills.items()]
        for mills, _ in table
    ]
    assert modules.evaluate(script, rows) == [first for _, first in table]


def test_without_a_picture_that_can_be_used_there_is_nothing_to_press(opened: Opened) -> None:
    """And the reason stands beside the button."""
    page = opened("#/new", errors=("status of 422",))
    why = page.locator(".submit-bar .why")
    expect(page.get_by_role("button", name="Choose a picture")).to_be_visible()
    expect(make_it(page)).to_be_hidden()
    refuse_picture(page)
    expect(why).to_have_text("This is not a picture that can be read.")
    expect(make_it(page)).to_be_disabled()
    expect(make_it(page)).to_have_accessible_description(re.compile("not a picture"))
    expect(page.get_by_role("region", name="Picture")).to_contain_text("not a picture that can be read")
    first = page.get_by_role("region", name="Picture").locator(":scope > *").first
    expect(first).to_contain_text("not a picture")  # above all that is as high as the picture
    choose(page, picture())
    expect(make_it(page)).to_be_enabled()
    expect(why).to_be_hidden()


@pytest.mark.parametrize("planned", [True, False])
def test_passes_by_hand_begin_with_those_that_would_be_milled(opened: Opened, planned: bool) -> None:
    """And go on with another like the last, by a name of its own, which has the focus."""
    page = open_blank(opened, "new")
    own = canned_job.job()["spec"]["passes"]
    answer = ESTIMATE_EXAMPLE | {"spec": {"preset": "recommended", "passes": own if planned else []}}
    page.route("**/v1/estimates", lambda route: route.fulfill(json=answer))
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    expect(page.get_by_text("Machine time")).to_be_visible()
    page.get_by_label("Set every pass by hand").check()
    expect(page.locator(".passes").get_by_label("Pitch").first).to_have_value(
        f"{own[0]['pitch_mm']:g}" if planned else "0.5"
    )
    page.get_by_role("button", name="Add a pass").click()
    names = page.locator(".passes").get_by_label("Name")
    expect(names.last).to_be_focused()
    values = names.evaluate_all("all => all.map((one) => one.value)")
    assert len(set(values)) == len(values) == 3


@pytest.mark.thorough
def test_a_fault_of_a_whole_pass_stands_at_its_head(opened: Opened) -> None:
    page = open_blank(opened, "new", errors=("status of 422",))
    told = [("spec.passes.1", "it cuts nothing"), ("spec.passes.0.pitch_mm", "more than 0 is needed")]
    problems = [{"field": field, "detail": detail} for field, detail in told]
    answer = {"status": 422, "detail": "see there", "problems": problems}
    page.route("**/v1/estimates", lambda route: route.fulfill(status=422, json=answer))
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    page.get_by_label("Set every pass by hand").check()
    rough, finish = page.locator(".passes > li").all()
    expect(rough.get_by_label("Pitch")).to_have_accessible_description("More than 0 is needed.")
    expect(finish.locator(":scope > .fault")).to_have_text("It cuts nothing.")
    expect(finish.get_by_label("Name")).to_have_accessible_description("")
    expect(rough.locator(":scope > .fault")).to_have_text("")


@pytest.mark.thorough
def test_a_refusal_stands_at_the_field_that_it_names_or_above_the_button(opened: Opened) -> None:
    """At the JSON, where the key was typed there; a table that has no row of its own is at no row of it."""
    page = open_blank(opened, "new", errors=("status of 422",))
    told = {"spec.optics.light.profile": "it is dark everywhere", "spec.plan": "two aims", "spec": "too much", "": "no"}
    problems = [{"field": field, "detail": detail} for field, detail in told.items()]
    answer = {"status": 422, "detail": "see there", "problems": problems}
    page.route("**/v1/estimates", lambda route: route.fulfill(status=422, json=answer))
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    page.get_by_label("Other values, as JSON").fill('{"optics": {"light": {"profile": [[0, 0], [0, 0]]}}}')
    expect(page.get_by_label("Other values, as JSON")).to_have_accessible_description(
        re.compile("It is dark everywhere")
    )
    expect(page.locator("[aria-invalid=true]")).to_have_count(1)
    for words in ("two aims", "Too much", "No"):
        expect(page.locator(".submit-bar")).to_contain_text(re.compile(words, re.IGNORECASE))


@pytest.mark.thorough
@pytest.mark.parametrize(("size", "words"), [("phone", "Choose or photograph a picture"), ("wide", "Drop a picture")])
def test_nobody_is_asked_to_drop_with_a_finger(opened: Opened, size: str, words: str) -> None:
    for address in ("#/new", "#/"):
        page = opened(address, size=size)
        expect(page.locator(".drop p").first).to_contain_text(words)


WEIGHT = "performance.getEntriesByType('resource').reduce((sum, one) => sum + one.transferSize, 0)"


def test_who_has_no_picture_begins_with_an_example_and_the_first_view_is_light(watched: Callable[..., Watched]) -> None:
    """The examples are there whole at once: no more than 150 kB with everything."""
    page = watched("phone").page()
    page.route("**/v1/estimates", lambda route: route.fulfill(json=ESTIMATE_EXAMPLE))
    page.goto("/#/new")
    examples = page.get_by_role("group", name="Examples")
    expect(examples.get_by_role("button")).to_have_text(["Portrait", "Camera", "Logo", "Letters"])
    for drawn in examples.locator("img").all():
        expect(drawn).not_to_have_js_property("naturalWidth", 0)
    assert 60_000 < page.evaluate(WEIGHT) <= 150_000
    examples.get_by_role("button", name="Logo").click()
    expect(wall(page)).to_be_visible()
    expect(page.get_by_label("Name of the job")).to_have_value("Logo")
    expect(page.locator(".told")).to_have_text(likeness_in_words(ESTIMATE_EXAMPLE["seen_db"]))


SLOW_TO_OPEN = """const open = createImageBitmap;
window.createImageBitmap = (...given) => new Promise((done) => { window.goOn = done; }).then(() => open(...given));"""


def test_a_picture_that_takes_its_time_is_said_to_be_opened(opened: Opened) -> None:
    page = opened("#/new", script=SLOW_TO_OPEN)
    page.route("**/v1/estimates", lambda route: route.fulfill(json=ESTIMATE_EXAMPLE))
    file = {"name": "huge.png", "mimeType": "image/png", "buffer": picture()}
    page.locator("input[type=file]").first.set_input_files(file)
    expect(page.locator(".submit-bar .why")).to_have_text("Opening huge.png…")
    expect(make_it(page)).to_be_disabled()
    page.evaluate("goOn()")
    expect(wall(page)).to_be_visible()
    expect(make_it(page)).to_be_enabled()
