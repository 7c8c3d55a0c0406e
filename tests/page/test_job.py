"""The view of a job: what it shows is what the server has, live, and everything can be had by mouse, finger and key."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from service.job.spec.loading import resolve_spec
from service.job.stages.table import usual_seconds
from service.wording import duration, likeness_in_words
from tests.levels import mostly_thorough
from tests.page import canned_job
from tests.page.browser import SIZES, open_blank
from tests.page.canned_job import RUN_EXAMPLE
from tests.page.conftest import Kept, Opened, visit
from tests.page.jobs import PLAN_HOURS, alike, answer, canned, like, shown, stopped_at, unfold, with_plan
from tests.page.machine_states import NAME as MILL
from tests.service.job.page_data.paths import split_header

AWAY = (r"net::ERR_", r"status of 50[234]")
NO_WEBGL = """const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
    return kind === "webgl2" ? null : get.call(this, kind, ...more);
};"""


@pytest.fixture(scope="module")
def at_job(browser: Browser, kept: Kept) -> Iterator[Page]:
    """One look at the finished job, for all who change nothing of it."""
    watched = kept.pages(browser, "wide", once=True)
    page = watched.page()
    visit(page, f"#/jobs/{canned_job.JOB_ID}")
    unfold(page)
    yield page
    watched.close()


def share_of(slider: Locator) -> float:
    return float(slider.input_value())


def test_a_wipe_goes_where_mouse_and_keys_say(at_job: Page) -> None:
    frame, slider = (
        at_job.locator(".wipe-frame"),
        at_job.get_by_role("slider", name="Wipe between Target and As milled"),
    )
    at_job.locator("#pictures-title").scroll_into_view_if_needed()
    expect(slider).to_be_visible()
    frame.scroll_into_view_if_needed()
    box = frame.bounding_box()
    assert box
    middle = box["y"] + box["height"] / 2
    at_job.mouse.move(box["x"] + box["width"] / 2, middle)
    at_job.mouse.down()
    for share in (0.6, 0.25):
        at_job.mouse.move(box["x"] + share * box["width"], middle)
        assert share_of(slider) == pytest.approx(100 * share, abs=0.6)
    at_job.mouse.up()
    at_job.mouse.move(box["x"] + box["width"], middle)
    assert share_of(slider) == pytest.approx(25, abs=0.6)  # let go is let go
    slider.press("ArrowRight")
    assert share_of(slider) == pytest.approx(25.5, abs=0.6)
    slider.press("End")
    clip = at_job.locator(".wipe-over").evaluate("one => getComputedStyle(one).clipPath")
    assert clip == "inset(0px 0px 0px 100%)"  # all of the left picture
    at_job.get_by_role("combobox", name="Right").select_option("Ideal caustic")
    expect(at_job.get_by_role("slider", name="Wipe between Target and Ideal caustic")).to_be_visible()


def test_figures_in_words_are_those_of_the_report(at_job: Page) -> None:
    job, _ = canned()
    milled, optics = job["report"]["as_milled"], job["report"]["optics"]
    pixel_mm = job["spec"]["optics"]["width_mm"] / job["spec"]["image"]["pixels"]
    marks_mm = math.hypot(milled["blur_x_px"], milled["blur_y_px"]) * pixel_mm
    detail_mm = max(pixel_mm, math.hypot(2 * marks_mm, optics["tolerances"]["blur_mm"]))
    facts = at_job.locator(".facts")
    expect(facts).to_contain_text(alike(milled["seen_db"]))
    assert not re.search(r"dB|PSNR|SSIM|rms", facts.inner_text()), "words for an eye; figures are folded away"
    at_job.get_by_text("Figures for experts").click()
    likeness = at_job.get_by_role("row", name="Likeness (PSNR)").get_by_role("cell")
    assert likeness.all_inner_texts() == [f"{one['psnr_db']:.1f} dB" for one in (milled, optics)]
    told = re.search(r"details under ([\d.]+) (mm|µm) will blur", facts.inner_text())
    assert told
    assert float(told[1]) * (1e-3 if told[2] == "µm" else 1) == pytest.approx(detail_mm, rel=0.06)
    for warning in job["report"]["warnings"]:
        expect(at_job.locator(".warnings-part")).to_contain_text(warning[1:].replace("`", ""))
    expect(at_job.locator("#view")).not_to_contain_text(re.compile("causticmill [a-z]"))  # here nobody has a terminal


def test_page_and_setup_sheet_say_the_same_of_likeness_and_time(modules: Page) -> None:
    """One scale of words, one way of saying times."""
    script = """([levels, times]) => Promise.all([import("/page/job/eye_words.js"), import("/page/lib/words.js")]).then(
        ([{eyeWords, alikeWords}, {hours}]) => [levels.map(eyeWords), levels.map(alikeWords), times.map(hours)])"""
    levels = [step / 4 for step in range(20, 220)]
    times = [0, 59.4, 59.5, 89, 90, 3569, 3570, 9900, 86_369, 86_370, 90_000, 183_600]
    assert modules.evaluate(script, [levels, times]) == [
        [likeness_in_words(level) for level in levels],
        [alike(level) for level in levels],
        [duration(seconds) for seconds in times],
    ]


HEADLINES = """([optics, milled, foretold, finishing]) => import("/page/job/figures.js").then(({headlines}) =>
    headlines({optics: {width_mm: 30, height_mm: 30}, image: {pixels: 64}}, {optics, as_milled: milled, finishing},
    foretold).filter(([what]) => what.startsWith("On the wall")))"""


def test_what_was_foretold_stands_first_until_the_milled_lens_is_simulated(modules: Page) -> None:
    """So that nobody who was told of a poor picture reads for a while only of a good one."""
    designed, hard = {"seen_db": 22.0}, alike(8.0)
    first, second = modules.evaluate(HEADLINES, [designed, None, 8.0, {}])
    assert first == ["On the wall", hard, "as predicted; the last steps simulate it"]
    assert second[0] == "On the wall, if polished"
    (only,) = modules.evaluate(HEADLINES, [designed, None, None, {}])
    assert only[0] == "On the wall, if polished" and "as milled it may be less" in only[2]
    assert modules.evaluate(HEADLINES, [designed, None, 8.0, None]) == [first], "nobody is to polish this lens"
    assert modules.evaluate(HEADLINES, [designed, {"seen_db": 8.0}, 20.0, {}])[0] == [
        "On the wall, as milled",
        hard,
        "",
    ]


def test_a_pass_in_words_says_nothing_that_is_not_known(modules: Page) -> None:
    """The program of witness marks has no rows, and says what it is for."""
    witness = {"name": "witness", "tool": "ball", "radius_mm": 3.0, "step_down_mm": 0.5, "feed_mm_per_min": 1000.0}
    script = "(row) => import('/page/job/figures.js').then(({passWords}) => passWords(row))"
    told = modules.evaluate(script, witness).replace("\u00a0", " ")
    assert told.startswith("ball R 3 (Ø 6 mm), mills ripples beside the lens") and "every" not in told
    assert "every 0.1 mm at 1000 mm/min" in modules.evaluate(script, witness | {"pitch_mm": 0.1})


LEFT = """(rows) => import("/page/job/progress.js").then(({secondsLeft, leftWords}) => rows.map(([job, live, now]) => {
    const left = secondsLeft(job, live, now);
    return [left.low, left.high, leftWords(left)];
}))"""


@pytest.mark.parametrize("reused", [0, 3])
def test_time_left_goes_down_to_the_end_and_never_to_nothing_while_minutes_remain(modules: Page, reused: int) -> None:
    """On a computer so much slower than that of the usual seconds, a quarter either way from stage to stage; where the
    first stages were done before, too."""
    usual = list(usual_seconds(resolve_spec(preset="paper")).items())
    rows, places = [], []
    for slower in (0.7, 2.5, 8.0):
        seed = np.random.default_rng(7)
        takes = [0.0 if k < reused else own * slower * seed.uniform(0.75, 1.25) for k, (_, own) in enumerate(usual)]
        for share in np.arange(0.02, 1.0, 0.07):
            rows.append(under_way(usual, takes, share, reused))
            places.append((share, (1 - share) * sum(takes)))
    for (share, left), (low, high, words) in zip(places, modules.evaluate(LEFT, rows), strict=True):
        assert high >= low > 0
        if share > 0.1:
            assert 0.5 * left < high and low < 2.0 * left, (share, left, low, high)
        assert not (left > 120 and words.startswith("less")), (share, left, words)


FIRST = (3.1, 1.0, 4.3, 3.3, 12.3, 0.8, 20.8, 11.5, 20.1, 37.5, 0.1)  # s: each stage compiles its kernels


def test_the_first_job_on_a_computer_is_never_all_but_done_while_minutes_remain(modules: Page) -> None:
    size = ["optics.width_mm=30", "optics.height_mm=30"]
    usual = list(usual_seconds(resolve_spec(preset="draft", overrides=size)).items())
    shares = list(np.arange(0.0, 0.45, 0.04))
    found = modules.evaluate(LEFT, [under_way(usual, list(FIRST), share) for share in shares])
    for share, (_, high, words) in zip(shares, found, strict=True):
        is_open = words == "a few minutes left"  # until the passes are planned and the pace is known
        assert is_open or (high > 0.8 * (1 - share) * sum(FIRST) and not words.startswith("less")), (share, words)
        assert is_open or share > 0.05


def test_a_plan_that_an_estimate_has_made_says_nothing_of_the_pace(modules: Page) -> None:
    """It is only read, in a fraction of the usual time."""
    usual = [("image", 0.2), ("passes", 12.0), ("map", 22.7), ("as-milled", 22.3)]
    takes, at = [0.6, 0.5, 68.0, 67.0], 2
    ((low, high, words),) = modules.evaluate(LEFT, [under_way(usual, takes, (sum(takes[:at]) + 0.01) / sum(takes))])
    assert words == "a few minutes left" or high > 0.8 * sum(takes[at:]), (low, high, words)


def under_way(usual: list[tuple[str, float]], takes: list[float], share: float, reused: int = 0) -> list[Any]:
    """What LEFT is asked after this share of the time that all stages take: [job, live, now in ms]."""
    ends = np.cumsum(takes)
    now = share * ends[-1]
    at = int(np.searchsorted(ends, now, side="right"))
    stages = [
        {"name": name, "usual_s": own, "state": "reused" if k < reused else "committed" if k < at else "waiting",
         "seconds": takes[k] if k < at else None, "started_at": _iso(ends[k] - takes[k])}
        for k, (name, own) in enumerate(usual)
    ]  # fmt: skip
    stages[at] |= {"state": "running"}
    done = (now - (ends[at] - takes[at])) / takes[at]
    return [{"stages": stages}, {"stage": usual[at][0], "share": float(done)}, float(now * 1000)]


def _iso(seconds: float) -> str:
    return f"{np.datetime64(round(seconds * 1000), 'ms')}Z"


def test_a_job_that_goes_on_is_never_all_done_and_offers_no_archive_yet(opened: Opened) -> None:
    job, files = canned()
    begun = job["created_at"][:17] + "00.000Z"
    running = like(job, 41, state="running", progress=1.0, programs=[], started_at=begun, ended_at=None)
    running["stages"] = stopped_at(running, "as-milled", "running")
    page = shown(opened, running, files)
    expect(page.get_by_role("region", name="Progress")).to_contain_text(re.compile("^99 %: .* left", re.S))
    expect(page.get_by_role("region", name="Files")).to_contain_text("when the job is done")
    expect(page.get_by_role("link", name="All files")).to_have_count(0)
    expect(page.locator(".job-about")).to_contain_text("begun ")
    expect(page.get_by_role("heading", level=1)).to_have_text("logo")


def test_each_program_goes_to_the_mill_by_its_number(at_job: Page) -> None:
    job, _ = canned()
    rows = at_job.locator(".programs li")
    expect(rows).to_have_count(len(job["programs"]))
    for row, program in zip(rows.all(), job["programs"], strict=True):
        expect(row).to_contain_text(program["name"])
        send = row.locator("a.button").filter(has_text=re.compile(f"Send to (mill|{MILL})")).first
        expect(send).to_have_attribute("href", f"#/machines/{MILL}?job={job['id']}&program={program['number']}")
        assert ("primary" in send.get_attribute("class")) == (program["number"] == 1), "the first pass is cut first"


def test_programs_can_be_sent_once_checked_though_their_pictures_are_still_to_come(opened: Opened) -> None:
    job, files = canned()
    running = like(job, 7, state="running", stages=stopped_at(job, "as-milled", "running"))
    page = shown(opened, running, files)
    programs = page.get_by_role("region", name="Programs")
    expect(programs).to_contain_text("still being worked out")
    expect(programs.get_by_role("link", name=f"Send to {MILL}")).to_have_count(len(job["programs"]))


@pytest.mark.thorough
@pytest.mark.parametrize("given_up", [False, True])
def test_programs_of_a_job_that_failed_or_is_given_up_can_be_saved_but_not_sent(opened: Opened, given_up: bool) -> None:
    """A mill would refuse them; they are checked, so a person may look at them."""
    job, files = canned()
    state = "running" if given_up else "failed"
    error = None if given_up else {"stage": "as-milled", "detail": "the disk is full", "field": None}
    stages = stopped_at(job, "as-milled", state)
    page = shown(opened, like(job, 7, state=state, stages=stages, error=error, cancel_requested=given_up), files)
    programs = page.get_by_role("region", name="Programs")
    expect(programs).to_contain_text("try again")
    expect(programs.get_by_role("link", name="Save")).to_have_count(len(job["programs"]))
    expect(programs.get_by_role("link", name="Send")).to_have_count(0)
    answer(page, like(job, 7), files)
    page.reload()
    answer(page, like(job, 7), files)
    unfold(page)
    expect(programs.get_by_role("link", name=f"Send to {MILL}")).to_have_count(len(job["programs"]))
    expect(programs).not_to_contain_text("again")


@pytest.mark.thorough
def test_the_map_of_heights_reads_off_the_surface(at_job: Page) -> None:
    data = canned_job.files()["surface.bin"]
    head, start = split_header(data)
    steps = np.frombuffer(data, "<u2", offset=start).reshape(head["ny"], head["nx"])
    chart = at_job.locator(".height-map")
    chart.scroll_into_view_if_needed()
    expect(chart).to_have_attribute("width", str(head["nx"]))
    box = chart.bounding_box()
    assert box
    chart.hover(position={"x": 0.25 * box["width"], "y": 0.25 * box["height"]})  # upper left: low X, high Y
    told = re.fullmatch(r"X ([\d.]+)\s+Y ([\d.]+)\s+Z (-[\d.]+) mm", at_job.locator(".height-reading").inner_text())
    assert told
    x_mm, y_mm, z_mm = map(float, told.groups())
    assert x_mm < 5 < y_mm  # of a lens of 10 mm
    column, row = (x_mm - head["x0_mm"]) / head["dx_mm"], (y_mm - head["y0_mm"]) / head["dy_mm"]
    near = steps[int(row) : int(row) + 2, int(column) : int(column) + 2] * head["dz_mm"] + head["z0_mm"]
    assert near.min() - 2e-3 <= z_mm <= near.max() + 2e-3


@pytest.mark.thorough
def test_the_lens_turns_by_hand_and_rests_for_who_wants_no_motion(at_job: Page) -> None:
    body = at_job.locator(".lens-canvas")
    at_job.locator("#lens-title").scroll_into_view_if_needed()
    body.scroll_into_view_if_needed()
    expect(at_job.get_by_role("button", name="Turn", exact=True)).to_be_visible()
    at_job.wait_for_timeout(300)
    first = body.screenshot()
    at_job.wait_for_timeout(400)
    assert body.screenshot() == first
    body.focus()
    body.press("ArrowLeft")
    at_job.wait_for_timeout(200)
    turned = body.screenshot()
    assert turned != first
    body.press("+")
    at_job.wait_for_timeout(200)
    assert body.screenshot() != turned


WALL = """async (viewedFrom) => {
    const { lensPicture } = await import("/page/job/lens_gl.js");
    const canvas = new OffscreenCanvas(200, 200);
    const shown = new OffscreenCanvas(64, 64), pen = shown.getContext("2d");
    pen.fillRect(0, 0, 64, 64);
    pen.fillStyle = "red";
    pen.fillRect(4, 4, 24, 24); // above on the left
    const grid = { nx: 2, ny: 2, x0: 0, y0: 0, dx: 10, dy: 10, z0: -1, dz: 1, steps: [0, 0, 0, 0] };
    const picture = lensPicture(canvas, grid);
    picture.showWall(shown, { screen: { width: 40, height: 40 }, shift: [0, 0], throw_mm: 30, viewedFrom });
    picture.draw({ yaw: viewedFrom === "lens" ? 0 : Math.PI, pitch: 0, distance: 1.9, wall: true });
    const flat = new OffscreenCanvas(200, 200).getContext("2d");
    flat.drawImage(canvas, 0, 0);
    const { data } = flat.getImageData(0, 0, 200, 200), sums = [0, 0, 0];
    for (let at = 0; at < data.length; at += 4) {
        if (data[at] < 150 || data[at + 1] > 100) continue;
        const pixel = at / 4;
        [1, pixel % 200, Math.floor(pixel / 200)].forEach((value, k) => (sums[k] += value));
    }
    picture.free();
    return [sums[1] / sums[0], sums[2] / sums[0], sums[0]];
}"""


@pytest.mark.parametrize("viewed_from", ["lens", "behind"])
def test_the_wall_beyond_the_lens_shows_the_picture_the_right_way_round(modules: Page, viewed_from: str) -> None:
    """From the side that it is for: what is above on the left in the picture is so on the wall."""
    x, y, count = modules.evaluate(WALL, viewed_from)
    assert count > 100 and x < 95 and y < 95


def test_the_lens_is_shown_with_its_wall_or_alone(at_job: Page) -> None:
    body, wall = at_job.locator(".lens-canvas"), at_job.get_by_role("button", name="With the wall")
    at_job.locator("#lens-title").scroll_into_view_if_needed()
    expect(wall).to_have_attribute("aria-pressed", "true")
    both = body.screenshot()
    wall.click()
    expect(wall).to_have_attribute("aria-pressed", "false")
    at_job.wait_for_timeout(200)
    assert body.screenshot() != both


@pytest.mark.thorough
def test_without_webgl_there_is_the_map_of_heights(opened: Opened) -> None:
    page = opened(f"#/jobs/{canned_job.JOB_ID}", script=NO_WEBGL)
    unfold(page)
    chart = page.locator(".height-map")
    chart.scroll_into_view_if_needed()
    expect(page.locator(".height-bar")).to_be_visible()
    expect(page.locator(".lens-canvas")).to_have_count(0)


@pytest.mark.thorough
def test_a_failed_job_says_what_to_change(opened: Opened) -> None:
    job, files = canned()
    error = {"stage": "pass-2", "detail": "the ball of 3 mm does not fit", "field": "spec.passes.1.radius_mm"}
    stages = stopped_at(job, "pass-2", "failed")
    failed = like(job, 1, state="failed", error=error, stages=stages, programs=[], progress=0.6)
    page = shown(opened, failed, files[:4])
    told = page.locator(".notice.bad")
    expect(told).to_contain_text("The ball of 3 mm does not fit.")
    expect(told).to_contain_text("Change ball radius of pass 2 (finish)")
    expect(told.get_by_role("link")).to_have_attribute("href", f"#/new?from={failed['id']}")
    expect(page.locator(".stages [data-state=failed]")).to_have_text(re.compile("pass 2.*failed"))
    asked: list[str] = []
    page.route("**:retry", lambda route: (asked.append(route.request.method), route.fulfill(status=202, json=job)))
    page.get_by_role("button", name="Try again").click()
    expect(page.locator(".job-state")).to_have_text("done")
    assert asked == ["POST"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("state", "words"),
    [
        ("queued", "Waits: 2 jobs before this one."),
        ("cancelled", "Try again goes on with the steps that were finished."),
    ],
)
def test_a_job_without_results_explains_itself(opened: Opened, state: str, words: str) -> None:
    job, _ = canned()
    stages = stopped_at(job, "image", "cancelled" if state == "cancelled" else "waiting")
    empty: dict[str, Any] = {"report": None, "programs": [], "stages": stages, "progress": 0.0, "queue_position": 3}
    page = shown(opened, like(job, 2, state=state, **empty), [])
    expect(page.get_by_text(words)).to_be_visible()


def test_a_deleted_job_is_gone_after_a_question(opened: Opened) -> None:
    job, files = canned()
    page = shown(opened, like(job, 3), files)
    asked: list[str] = []

    def delete(route: Any) -> None:
        asked.append(route.request.method)
        route.fulfill(status=204)

    page.route(
        f"**/v1/jobs/{like(job, 3)['id']}",
        lambda route: delete(route) if route.request.method == "DELETE" else route.fallback(),
    )
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Keep").click()
    assert not asked
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.get_by_role("heading", level=1, name="Jobs")).to_be_visible()
    assert asked == ["DELETE"]


@pytest.mark.thorough
def test_a_slider_goes_through_the_plans(opened: Opened) -> None:
    job, files = canned()
    planned = with_plan(job, 4)
    page = shown(opened, planned, files)
    slider, chosen = page.get_by_role("slider", name="Plans, quickest first"), page.locator(".plan-chosen")
    expect(chosen).to_contain_text("This is the plan of this job,")
    expect(slider).to_have_value("2")
    expect(slider).to_have_attribute("max", str(len(PLAN_HOURS) - 1))
    slider.press("Home")
    expect(chosen).to_contain_text("12 min")
    expect(slider).to_have_attribute("aria-valuetext", re.compile("^12 min, .* % alike$"))
    expect(chosen).to_contain_text("Fine hair is lost.")
    link = chosen.get_by_role("link", name="Make this job")
    expect(link).to_have_attribute("href", f"#/new?from={planned['id']}&plan=0")
    slider.press("ArrowRight")
    expect(slider).to_be_focused()
    expect(link).to_have_attribute("href", f"#/new?from={planned['id']}&plan=1")
    slider.press("End")
    expect(chosen).to_contain_text("every 0.1 mm")


@pytest.mark.thorough
def test_two_jobs_are_compared_by_all_in_which_they_differ(opened: Opened) -> None:
    job, files = canned()
    finish = job["spec"]["finish"] | {"process": "felt", "minutes": 1.8, "order": 1}
    spec = job["spec"] | {"optics": job["spec"]["optics"] | {"throw_mm": 123.0}, "finish": finish}
    report = job["report"] | {"as_milled": job["report"]["as_milled"] | {"psnr_db": 31.5, "seen_db": 22.0}}
    report |= {"finishing": {"minutes": 1.8, "steps": []}}
    other = like(job, 5, name="other.png", spec=spec, report=report)
    page = open_blank(opened, "job")
    answer(page, other, files)
    page.evaluate("([a, b]) => { location.hash = `#/compare/${a}/${b}` }", [job["id"], other["id"]])
    card = page.get_by_role("region", name="What differs")
    rows = card.locator(":scope > table").get_by_role("row")
    names = ["", "Work by hand", "On the wall", "Distance to the wall", "Finished by hand"]
    expect(rows.locator(":first-child:is(th, td)")).to_have_text(names)  # each thing once
    card.get_by_text("Every setting that differs").click()
    expect(card.locator("details tbody th")).to_have_text(["Order"])  # no everyday word
    better = page.get_by_role("row", name="On the wall").get_by_role("cell", name="better")
    expect(better).to_have_text(re.compile(alike(22.0)))
    expect(rows.nth(3)).to_have_text(re.compile(r"Distance to the wall.*123 mm"))
    for name in ("logo", "other"):
        expect(page.get_by_role("img", name=f"{name}, As milled")).to_be_visible()
        expect(page.get_by_role("link", name=name, exact=True)).to_be_visible()


@pytest.mark.thorough
def test_a_job_that_is_not_there_is_said_so(opened: Opened) -> None:
    page = opened("#/jobs/00000000-0000-4000-8000-00000000dead", errors=("status of 404",))
    expect(page.get_by_role("alert")).to_contain_text("no job")


@pytest.mark.parametrize("size", mostly_thorough(["wide", "tablet"], quick=["wide"]))
def test_a_finished_job_is_its_light_and_two_screens_long_with_no_phrase_twice(opened: Opened, size: str) -> None:
    """The light and the next steps fill the first screen; everything else is folded, but what to look out for."""
    job, files = canned()
    told = ["The picture will be flatter: a smaller ball or a wall farther away keeps more of it. " * 2]
    page = shown(opened, like(job, 1, report=job["report"] | {"warnings": told}), files, size=size)
    page.evaluate(
        "for (const one of document.querySelectorAll('.folded:not(.warnings-part) > details')) one.open = false"
    )
    expect(page.get_by_role("img", name="On the wall, as milled")).to_be_in_viewport(ratio=1)
    expect(page.get_by_role("link", name=re.compile("^Send to "))).to_be_in_viewport(ratio=1)
    assert page.evaluate("document.documentElement.scrollHeight") <= 2 * SIZES[size][1]
    unfold(page)
    expect(
        page.get_by_text(likeness_in_words(job["report"]["as_milled"]["seen_db"])).filter(visible=True)
    ).to_have_count(1)


def test_a_made_lens_shows_the_wall_big_and_what_to_do_next_until_it_is_milled(opened: Opened) -> None:
    """The picture is what will really be seen; a mill's finished runs tick the first step off."""
    job, files = canned()
    page = shown(opened, job, files)
    ending = page.get_by_role("region", name="Your lens is ready to mill")
    expect(ending.get_by_role("img", name="On the wall, as milled")).to_be_visible()
    expect(ending.get_by_role("listitem")).to_have_text([re.compile("Mill it"), re.compile("Shine light through it")])
    expect(ending.get_by_role("link", name="What would show more?")).to_have_attribute(
        "href", f"#/new?from={job['id']}&show=more"
    )
    mill = ending.get_by_role("link", name=re.compile("^Send to "))
    expect(mill).to_have_attribute("href", f"#/machines/shop?job={job['id']}&program=1")
    ending.get_by_role("button", name="Programs").click()
    expect(page.get_by_role("heading", name="Programs")).to_be_in_viewport()
    page = open_blank(opened, "job")
    ending = page.get_by_role("region", name="Your lens is ready to mill")
    runs = [RUN_EXAMPLE | {"job": job["id"], "state": "finished", "program": one} for one in job["programs"]]
    programs = [{key: run["program"][key] for key in ("number", "name", "sha256")} for run in runs]
    told = [run | {"program": program} for run, program in zip(runs, programs, strict=True)]
    page.route("**/v1/runs?job=*", lambda route: route.fulfill(json={"runs": told[:1], "next": None}))
    page.evaluate("id => { location.hash = `#/jobs/${id}` }", job["id"])
    expect(ending.get_by_role("link", name=re.compile("^Send to "))).to_have_attribute("href", re.compile("program=2$"))
    page.locator(".programs-part > details").evaluate("one => (one.open = true)")
    expect(page.locator(".programs li").filter(has_text="milled")).to_contain_text(["pass-1-rough.nc"])
    expect(page.locator(".programs .primary").first).to_have_attribute("href", re.compile("program=2$"))
    page.route("**/v1/runs?job=*", lambda route: route.fulfill(json={"runs": told, "next": None}))
    page.evaluate("location.hash = '#/-'")
    page.evaluate("id => { location.hash = `#/jobs/${id}` }", job["id"])
    milled = page.get_by_role("region", name="Your lens is milled")
    expect(milled.get_by_role("listitem").first).to_contain_text("done")
    expect(milled.get_by_role("button", name="Programs")).to_have_count(0)
    page.locator(".programs-part > details").evaluate("one => (one.open = true)")
    expect(page.locator(".programs li").filter(has_text="milled")).to_have_count(len(job["programs"]))
    expect(page.locator(".primary:visible")).to_have_count(0)  # no pass is the next thing to do


def test_a_job_being_made_shows_what_is_there_of_its_light(opened: Opened) -> None:
    job, files = canned()
    running = like(job, 41, state="running", programs=[], ended_at=None)
    running["stages"] = stopped_at(running, "as-milled", "running")
    page = shown(opened, running, files)
    making = page.get_by_role("region", name="Your lens is being made")
    expect(making.get_by_role("img", name=re.compile("^On the wall, "))).to_have_attribute("src", re.compile("^blob:"))
    expect(page.get_by_role("region", name="Progress").get_by_role("list")).to_be_hidden()


def test_a_job_that_failed_has_no_ending(opened: Opened) -> None:
    job, files = canned()
    page = shown(opened, like(job, 5, state="failed"), files)
    expect(page.get_by_role("heading", name="Programs")).to_be_visible()
    expect(page.locator(".ending")).to_be_hidden()
