"""The machine screen: who may move the mill and how, what stops it, and what a person is told."""

from __future__ import annotations

import csv
import io
import re
from itertools import product
from typing import Any

import pytest
from PIL import Image
from playwright.sync_api import Page, Route, expect

from service.job.spec.finish_library import built_in_processes, instruct_finishing
from tests.levels import mostly_thorough
from tests.page import canned_job
from tests.page.browser import SIZES, Scheme, layout_faults, open_blank, serious_faults
from tests.page.conftest import Opened
from tests.page.driving import machine_state, out_of_sight
from tests.page.machine_states import RUN, STATES, USED, machine_in, told, with_control
from tests.page.shop import MILL

SCREEN = f"#/machines/{MILL}"


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
    """A simulated one may be many times as fast; what it has left is then no scale of what it has taken so far."""
    page = open_blank(opened, "machine")
    for state, words in (("running", "1 h 12 min left"), ("simulated", "1 h 11 min left on a real mill")):
        told(page, state)
        page.evaluate(f"location.hash = '{SCREEN}'")
        left = page.locator(".meter .row span").first
        expect(left).to_have_text(words)
        assert left.evaluate("one => parseFloat(getComputedStyle(one).fontSize)") >= 24, "read from across the room"
        expect(page.locator(".step")).to_have_text("The program runs.")
        page.evaluate("location.hash = '#/'")


def test_the_readout_is_over_no_jog_key(opened: Opened) -> None:
    """All that one jogs with is in sight with it, at once."""
    page = with_control(opened, "idle")
    assert out_of_sight(page, ".readout .work, .pad button, .steps label") == []
    page.locator(".jog .field input").focus()
    page.get_by_role("button", name="Y plus").focus()
    assert out_of_sight(page, ".readout .work, .pad button") == []


def test_feed_and_buffer_are_plotted_while_a_program_runs(opened: Opened) -> None:
    page = open_blank(opened, "machine")
    plots = page.locator(".spark")
    for buffer in (0.9, 0.4):
        told(page, "running", mill={"buffer_share": buffer, "feed_mm_per_min": 1000 * buffer})
        page.evaluate(f"location.hash = '{SCREEN}'")
        expect(page.locator(".pace")).to_contain_text(f"{buffer:.0%}".replace("%", " %"))
    expect(plots).to_have_count(2)
    for plot in plots.all():
        expect(plot).to_be_visible()
        heights = [float(one.partition(",")[2]) for one in plot.locator("polyline").get_attribute("points").split()]
        assert heights[-1] > heights[0], "less is lower"
    told(page, "running", mill={"feed_mm_per_min": 0})
    expect(page.locator(".pace")).to_contain_text("433 mm/min")  # it stands for a moment between two lines
    told(page, "held", mill={"feed_mm_per_min": 0})
    expect(page.locator(".pace")).to_contain_text("Feed0 mm/min")
    told(page, "finished", mill={"buffer_share": 0.0})
    expect(page.locator(".running .mark")).to_have_text("finished")
    expect(plots.first).to_be_hidden()
    expect(page.locator(".pace")).not_to_contain_text("Buffer", use_inner_text=True)


def test_mill_and_program_are_one_state_in_words(modules: Page) -> None:
    """The controller says idle until the first move has come to it, and now and then between two of them."""
    script = """(rows) => import("/page/machine/words.js").then((words) => rows.map(([mill, run, cut]) => {
        const found = {id: "1", state: run, executed_line: cut};
        const machine = {agent: {reachable: true}, mill: {state: mill, connected: true}, run: found};
        return [words.standing(machine).word, words.runStanding(found, machine)[1]];
    }))"""
    mills = ("idle", "run", "holding", "held", "door", "alarm", "tool")
    under_way = list(product(mills, ("running", "holding", "held", "stopping", "recovering"), (0, 7)))
    for row, (head, card) in zip(under_way, modules.evaluate(script, under_way), strict=True):
        assert head == card != "idle", row
    told_of = {
        ("idle", "running", 0): ["starting", "starting"],
        ("run", "parked", 0): ["moving", "waits for your start"],
        ("idle", "finished", 9): ["idle", "finished"],
    }
    assert modules.evaluate(script, list(told_of)) == list(told_of.values())


@pytest.mark.parametrize("size", mostly_thorough(["wide", "phone"], quick=["phone"]))
def test_hold_and_stop_never_move_and_nothing_comes_into_their_place(opened: Opened, size: str) -> None:
    """A second press of a frightened hand must not resume."""
    page = open_blank(opened, "machine", size=size)
    found = []
    for state in ("running", "held"):
        told(page, state)
        page.evaluate(f"location.hash = '{SCREEN}'")
        expect(page.locator(".running .mark")).to_be_visible()
        found.append([page.get_by_role("button", name=name).bounding_box() for name in ("HOLD", "STOP")])
        expect(page.get_by_role("button", name="Resume")).to_be_visible(visible=state == "held")
        if state == "running":
            page.evaluate("location.hash = '#/'")
            expect(page.get_by_role("heading", level=1, name="Jobs")).to_be_visible()
    assert found[0] == found[1]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("size", "scheme"),
    [
        ("wide", "light"),
        ("tablet", "light"),
        ("phone", "dark"),
    ],
)
def test_every_state_can_be_read_and_used_by_everybody(opened: Opened, size: str, scheme: Scheme) -> None:
    """And the line of the next step is as high whatever it says. For mills in use, test_screens has axe-core's word."""
    page = open_blank(opened, "machine", size=size, scheme=scheme)
    heights = {}
    for state in STATES:
        told(page, state)
        page.evaluate(f"location.hash = '{SCREEN}'")
        _, run = machine_in(state)
        expect(machine_state(page)).not_to_have_text("asking the server")
        if run is not None:
            expect(page.locator(".running .mark")).to_be_visible()
        heights[state] = page.locator(".next").evaluate(
            "one => `${one.offsetHeight} px, ${one.scrollHeight - one.clientHeight} more`"
        )
        assert layout_faults(page) == [], state
        if size != "tablet" and state not in USED:
            assert serious_faults(page) == [], state
        for name in ("HOLD", "STOP"):
            expect(page.get_by_role("button", name=name)).to_be_in_viewport(ratio=1)
        page.evaluate("location.hash = '#/'")
        expect(page.get_by_role("heading", level=1, name="Jobs")).to_be_visible()
    assert serious_faults(page) == []
    assert len(set(heights.values())) == 1 and heights["idle"].endswith(" 0 more"), heights


def test_what_a_mill_has_cut_is_told_with_the_hours_of_each_ball_and_kept_as_a_table(opened: Opened) -> None:
    """All pages of it; a program that was never started has cut nothing, and no cell is a formula."""
    page = open_blank(opened, "machine", once=True)
    told(page, "idle")
    done = machine_in("finished")[1] | {
        "started_at": "2026-11-21T08:00:00.000Z",
        "ended_at": "2026-11-21T10:00:00.000Z",
    }
    half = done | {"state": "aborted", "share": 0.5, "operator": "=HYPERLINK(1)"}
    large = done | {"setup": done["setup"] | {"tool": done["setup"]["tool"] | {"radius_mm": 3.0}}}
    parked = machine_in("parked")[1]
    more = f"/v1/runs?machine={MILL}&limit=100&cursor={done['id']}"
    pages = {False: {"runs": [done, parked, half], "next": more}, True: {"runs": [large], "next": None}}
    page.route("**/v1/runs?**", lambda route: route.fulfill(json=pages["cursor" in route.request.url]))
    page.evaluate(f"location.hash = '{SCREEN}'")
    page.get_by_role("heading", name="History").click()
    card = page.locator(".history")
    expect(card).to_contain_text("3 h 45 min cut. R 3 (Ø 6 mm): 1 h 30 min, R 0.5 (Ø 1 mm): 2 h 15 min")
    expect(card.get_by_role("listitem")).to_have_count(3)
    with page.expect_download() as saved:
        card.get_by_role("button", name="Save as CSV").click()
    assert saved.value.suggested_filename == f"{MILL}-history.csv"
    rows = list(csv.DictReader(saved.value.path().read_text(encoding="utf-8").splitlines()))
    assert [(row["ball_radius_mm"], row["state"], row["hours_cut"]) for row in rows] == [
        ("0.5", "finished", "1.5000"),
        ("0.5", "aborted", "0.7500"),
        ("3", "finished", "1.5000"),
    ]
    assert rows[1]["operator"] == "'=HYPERLINK(1)"


SKETCH = """async (done) => {
    const { PathSketch } = await import("/page/machine/path_sketch.js");
    const lens = new OffscreenCanvas(10, 10), pen = lens.getContext("2d");
    [["red", 0, 0], ["lime", 5, 0], ["blue", 0, 5], ["yellow", 5, 5]].forEach(([colour, x, y]) => {
        pen.fillStyle = colour;
        pen.fillRect(x, y, 5, 5);
    });
    const corners = [[0, 7], [9, 7], [9, 2], [0, 2]]; // along the upper half, then back along the lower one
    const data = new Uint16Array(corners.flatMap(([x, y]) => [(x / 9) * 65535, (y / 9) * 65535, 0, 0]));
    const rows = [{ count: 4, low: [0, 0], high: [9, 9], line0: 0, line1: 30 }];
    const path = { head: { programs: [{ file: "p", lines: 30 }] }, levels: [{ rows, data: { get: () => data } }] };
    const sketch = new PathSketch(), canvas = new OffscreenCanvas(100, 100);
    globalThis.getComputedStyle = () => ({ getPropertyValue: () => "gray" });
    sketch.take(path, "p", { picture: lens, x0: 0, y0: 0, dx: 1, dy: 1 });
    const scale = { k: 10, dense: 1, x: (mm) => 5 + 10 * mm, y: (mm) => 95 - 10 * mm };
    const scene = { lens: { x0: 0, y0: 0, x1: 9, y1: 9 }, block: { x0: -1, y0: -1, x1: 10, y1: 10 }, radius: 1 };
    sketch.draw(canvas, scale, scene, done);
    const ink = canvas.getContext("2d");
    const at = (x, y) => [...ink.getImageData(scale.x(x), scale.y(y), 1, 1).data].slice(0, 3).join();
    return [[2, 7.3], [7, 7.3], [2, 2.3], [7, 2.3]].map(([x, y]) => at(x, y));
}"""


def test_the_lens_appears_where_it_is_cut(modules: Page) -> None:
    """As wide as the ball, each place in the colours of its height."""
    red, lime, blue, yellow, bare = "255,0,0", "0,255,0", "0,0,255", "255,255,0", "128,128,128"
    assert modules.evaluate(SKETCH, {"line": 0, "whole": False}) == [bare] * 4
    assert modules.evaluate(SKETCH, {"line": 12, "whole": False}) == [red, lime, bare, bare]
    assert modules.evaluate(SKETCH, {"line": 30, "whole": True}) == [red, lime, blue, yellow]


@pytest.mark.thorough
def test_the_camera_beside_the_mill_shows_what_is_there_now_or_nothing(opened: Opened) -> None:
    page = open_blank(opened, "machine", errors=("status of 502",))
    asked, answers = [], [True]
    file = io.BytesIO()
    Image.new("RGB", (8, 6), "red").save(file, "JPEG")

    def answer(route: Route) -> None:
        asked.append(1)
        if answers[0]:
            route.fulfill(body=file.getvalue(), content_type="image/jpeg")
        else:
            route.fulfill(status=502, json={"detail": "the camera does not answer"})

    page.route("**/camera.jpg", answer)
    told(page, "running", camera=True)
    page.evaluate(f"location.hash = '{SCREEN}'")
    seen = page.get_by_role("img", name="The mill, as its camera sees it")
    expect(seen).to_have_js_property("naturalWidth", 8)
    answers[0] = False
    expect(page.get_by_text("The camera does not answer with a picture.")).to_be_visible()
    expect(page.locator(".camera img")).to_be_hidden()
    answers[0] = True
    expect(seen).to_be_visible()
    page.locator(".camera summary").click()
    count = len(asked)
    page.wait_for_timeout(2500)
    assert len(asked) <= count + 1  # that was on its way
    told(page, "running")
    expect(page.locator(".camera")).to_be_hidden()


def test_the_pictures_kept_of_a_run_are_played(opened: Opened) -> None:
    page = open_blank(opened, "machine")
    file = io.BytesIO()
    Image.new("RGB", (8, 6), "red").save(file, "JPEG")
    path = f"/v1/runs/{RUN['id']}/timelapse"
    times = [f"2026-11-21T08:0{minute}:00.000Z" for minute in range(4)]
    pictures = [{"at": at, "url": f"{path}/{number}.jpg"} for number, at in enumerate(times)]
    page.route("**/camera.jpg", lambda route: route.fulfill(body=file.getvalue(), content_type="image/jpeg"))
    own = {"started_at": times[0], "links": {"timelapse": path}}
    told(page, "finished", camera=True, run=own)
    asked: list[str] = []
    page.route(f"**{path}", lambda route: route.fulfill(json={"pictures": pictures}))
    page.route(
        f"**{path}/*.jpg",
        lambda route: (
            asked.append(route.request.url[-5]),
            route.fulfill(body=file.getvalue(), content_type="image/jpeg"),
        ),
    )
    page.evaluate(f"location.hash = '{SCREEN}'")
    card = page.locator(".timelapse")
    card.locator("summary").click()
    expect(card.get_by_role("img")).to_have_js_property("naturalWidth", 8)
    card.get_by_role("button", name="Play").click()
    expect(card.get_by_role("slider")).to_have_value("3")
    expect(card.get_by_role("button", name="Play")).to_be_visible()
    assert asked == ["3", "0", "1", "2", "3"]
    told(page, "finished", run=own)
    expect(card).to_be_hidden()


def test_on_a_phone_the_camera_comes_next_after_the_program_that_runs(opened: Opened) -> None:
    """And after what there is to do, where nothing runs."""
    page = open_blank(opened, "machine", size="phone")
    file = io.BytesIO()
    Image.new("RGB", (8, 6), "red").save(file, "JPEG")
    page.route("**/camera.jpg", lambda route: route.fulfill(body=file.getvalue(), content_type="image/jpeg"))
    page.evaluate(f"location.hash = '{SCREEN}'")
    for state, cards in (("running", [".running", ".camera", ".part", ".overrides"]), ("parked", [".part", ".camera"])):
        told(page, state, camera=True)
        expect(page.locator(cards[-1])).to_be_visible()
        tops = [box["y"] for card in cards if (box := page.locator(card).bounding_box())]
        assert tops == sorted(tops) and len(tops) == len(cards), (state, tops)


TIMES = """async ({ passes, runs, now }) => {
    const { findWholeJob, runTimeWords, wholeJobWords } = await import("/page/machine/running.js");
    return runs.map((run) => [runTimeWords(run, now, false), wholeJobWords(findWholeJob(passes, run, run.simulated))]);
}"""


def test_a_run_says_since_when_until_what_time_and_how_much_of_its_whole_job_is_cut(modules: Page) -> None:
    passes = [{"file": f"pass-{n}.nc", "time_s": time_s} for n, time_s in ((1, 3600), (2, 7200), (3, 3600))]
    now = "new Date(2026, 10, 29, 22, 30).getTime()"
    run = {"state": "running", "share": 0.1, "time_s": 7200, "time_left_s": 3600, "left_out": []}
    run |= {"program": {"name": "pass-2.nc"}, "started_at": "2026-11-21T08:00:00.000Z"}
    late = run | {"time_left_s": 86400}
    skipped = run | {"left_out": [{"name": "pass-1.nc"}], "time_left_s": None, "started_at": None}
    done = run | {"state": "finished", "program": {"name": "pass-3.nc"}, "time_left_s": None}
    other = run | {"program": {"name": "witness-marks.nc"}}
    dry = run | {"lift_mm": 20}
    fast = run | {"simulated": True, "time_left_s": 400, "share": 0.5}  # by its own pace, which is no real mill's
    given = {"passes": passes, "runs": [run, late, skipped, done, other, dry, fast], "now": modules.evaluate(now)}
    (here, late_, left_out, over, unknown, in_air, fast_) = modules.evaluate(TIMES, given)
    assert re.fullmatch(r".+ since its start, ends about 23:30", here[0])
    assert here[1] == "Program 2 of 3. The whole job: 50 % cut, 2 h of milling left"
    assert re.search(r"ends about \w+.* 22:30", late_[0])
    assert left_out == ["", "Program 2 of 3. The whole job: 5 % cut, 3 h 48 min of milling left"]
    assert over[1] == "Program 3 of 3. The whole job is cut."
    assert fast_[1] == here[1]
    assert unknown[1] == in_air[1] == ""  # a dry pass cuts nothing of its job


CUT = """(runs) => import("/page/machine/part.js").then(({ findCut }) => runs.map(findCut))"""


def test_a_dry_pass_cuts_nothing_of_the_part_that_is_drawn(modules: Page) -> None:
    run = {"executed_line": 7, "lift_mm": None}
    runs = [run | {"state": state, "lift_mm": lift} for state, lift in (("held", None), ("held", 20), ("finished", 20))]
    assert modules.evaluate(CUT, runs) == [{"line": 7, "whole": False}] + [{"line": 0, "whole": False}] * 2


def test_a_dry_pass_says_that_nothing_is_cut(opened: Opened) -> None:
    page = with_control(opened, "parked", run={"lift_mm": 20.0})
    card = page.locator(".running")
    expect(card.locator(".dry")).to_have_text(
        "Dry pass: the program runs 20 mm higher, with spindle and coolant off. Nothing is cut."
    )
    expect(card.locator(".checklist .go")).to_have_text("Start the dry pass of pass-2-finish.nc")
    expect(card.locator(".checklist")).to_contain_text("a dry pass: the spindle stays off")
    expect(card).not_to_contain_text("A first run?")
    told(page, "running", operator="Ada", run={"lift_mm": 20.0})
    expect(page.locator(".part")).to_contain_text("; nothing is cut")
    expect(page.locator(".override:visible span")).to_have_text(["Feed", "Rapids"])
    told(page, "finished", operator="Ada", run={"lift_mm": 20.0, "next": None})
    expect(card.locator(".dry")).to_have_text(
        "That was a dry pass, 20 mm higher: nothing was cut. Load the program again to cut it."
    )
    expect(card).not_to_contain_text("the lens is milled")
    expect(page.locator(".step")).not_to_contain_text("milled")


def test_a_dry_pass_is_offered_before_the_first_run_of_a_program(opened: Opened) -> None:
    page = with_control(opened, "parked")
    offer = page.locator(".running").get_by_text("A first run?")
    expect(offer).to_be_visible()
    in_the_air = {"id": "an earlier one", "state": "finished", "open": False, "started_at": RUN["created_at"]}
    told(page, "parked", operator="Ada", run={"id": "another"}, before=RUN | in_the_air | {"lift_mm": 20.0})
    expect(page.locator(".running .go")).to_be_visible()
    expect(offer).to_have_count(0)


def test_a_program_is_loaded_as_it_is_or_as_a_dry_pass(opened: Opened) -> None:
    page = with_control(opened, "idle", errors=("ERR_FAILED",))
    sent: list[Any] = []
    page.route("**/v1/machines/shop/runs", lambda route: (sent.append(route.request.post_data_json), route.abort()))
    page.get_by_role("button", name="Load onto the mill").click()
    page.get_by_text("Dry pass", exact=True).click()
    page.get_by_role("button", name="Load as a dry pass").click()
    page.wait_for_timeout(200)
    assert [one.get("lift_mm") for one in sent] == [None, 15], "the mill has no room for the usual 20"


CLOCKS = """async ({ clocks, now }) => {
    const { workedSeconds } = await import("/page/job/work_clock.js");
    return clocks.map((clock) => workedSeconds(clock, now));
}"""


def test_the_clock_of_the_work_by_hand_counts_while_it_runs_and_never_backwards(modules: Page) -> None:
    paused, runs, set_back = (
        {"worked_ms": 90_000, "since_ms": since_ms} for since_ms in (None, 1_000_000.0, 2_000_000.0)
    )
    given = {"clocks": [paused, runs, set_back], "now": 1_030_000.0}
    assert modules.evaluate(CLOCKS, given) == [90, 120, 90]


def test_after_the_last_pass_the_work_by_hand_has_a_clock_that_a_reload_keeps(opened: Opened) -> None:
    page = open_blank(opened, "machine", key="Ada")
    told(page, "finished", operator="Ada", run={"next": None})
    job = canned_job.job()
    by_hand = instruct_finishing({"process": "felt"}, built_in_processes(), area_mm2=2500.0)
    job |= {"id": RUN["job"], "report": job["report"] | {"finishing": by_hand}}
    page.route(f"**/v1/jobs/{RUN['job']}", lambda route: route.fulfill(json=job))
    page.evaluate(f"location.hash = '{SCREEN}'")
    clock = page.locator(".running .work-clock")
    expect(clock.get_by_role("timer")).to_have_text("10 min left")
    for width, height in SIZES.values():
        page.set_viewport_size({"width": width, "height": height})
        assert out_of_sight(page, ".work-clock button:not([hidden])") == [], f"under a bar at {width}"
    clock.get_by_role("button", name="Start the clock").click()
    expect(clock).to_contain_text("until ")
    page.evaluate(
        """() => {
            const [kept] = Object.keys(localStorage).filter((key) => key.endsWith("work-by-hand"));
            const all = JSON.parse(localStorage.getItem(kept));
            for (const one of Object.values(all)) one.since_ms -= 4 * 60 * 1000;
            localStorage.setItem(kept, JSON.stringify(all));
        }"""
    )
    page.reload()
    expect(clock.get_by_role("timer")).to_have_text("6 min left")
    clock.get_by_role("button", name="Pause").click()
    expect(clock).to_contain_text("paused after 4 min")
    clock.get_by_role("button", name="From the beginning").click()
    expect(clock.get_by_role("timer")).to_have_text("10 min left")
    page.get_by_role("link", name="How it is done").click()
    expect(page.locator(".finishing-part > details")).to_have_attribute("open", "")


ROOM = """(mills) => import("/page/machine/place.js").then(({roomToLift}) => mills.map((mill) =>
    String(roomToLift({mill, profile: {homing: true, safe_z_mm: 5}}))))"""


def test_a_dry_pass_has_the_room_between_its_rapids_and_the_top_of_z(modules: Page) -> None:
    """Zero at machine -20, rapids 5 mm above it: 15 mm are left, wherever the tool is; an unknown zero says nothing."""
    at = [{"machine_mm": [-150, -150, z], "work_mm": [0, 0, z + 20], "position_trusted": True} for z in (-20, -3)]
    lost = at[0] | {"position_trusted": False}
    assert modules.evaluate(ROOM, [*at, lost]) == ["15", "15", "Infinity"]
