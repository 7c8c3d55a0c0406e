"""Photographs that the page takes: of the wall, and of a test piece."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import FilePayload, Route, expect

from tests.page import canned_job
from tests.page.answers import problem
from tests.page.canned_job import COUPON_EXAMPLE, ESTIMATE_EXAMPLE
from tests.page.conftest import Opened
from tests.page.form import choose, parts, picture
from tests.page.jobs import unfold
from tests.page.machine_states import NAME
from tests.page.stub import GOING

NOTE_PARTS = """() => {
  const sent = window.fetch;
  window.fetch = (address, options) => {
    if (options?.body instanceof FormData) window.parts = [...options.body].map(([name, file]) => [name, file.name]);
    return sent(address, options);
  };
}"""


def test_a_photograph_of_the_wall_is_sent_and_what_it_tells_is_shown(opened: Opened) -> None:
    """Findings as sentences and the picture beside them; a refusal says what to do, and another one can be taken."""
    page = opened(f"#/jobs/{canned_job.JOB_ID}", errors=("status of 422",))
    unfold(page)
    card = page.get_by_role("region", name="Photograph of the wall")
    chosen = card.locator("input[type=file]")
    assert (chosen.get_attribute("accept"), chosen.get_attribute("capture")) == ("image/*", "environment")
    photo: FilePayload = {"name": "wall.png", "mimeType": "image/png", "buffer": canned_job.files()["target.png"]}
    refusal = problem(422, detail="wall.png: too dark; expose longer", field="photo")
    page.route("**/photos", lambda route: route.fulfill(**refusal), times=1)
    chosen.set_input_files(photo)
    expect(card.get_by_text("Wall.png: too dark; expose longer.")).to_be_visible()
    expect(card.locator("img")).to_be_hidden()
    page.evaluate(NOTE_PARTS)
    chosen.set_input_files(photo)
    expect(card.get_by_role("listitem")).to_have_text([re.compile("^The wall stands 1.9 mm .* too far")])
    expect(card.locator("img")).to_have_attribute("src", re.compile("^data:image/png;base64,"))
    expect(card.get_by_text("too dark")).to_have_count(0)
    assert page.evaluate("window.parts") == [["photo", "wall.png"]]


def test_without_a_lens_no_photograph_is_asked_for(opened: Opened) -> None:
    page = opened(f"#/jobs/{GOING}")
    unfold(page)
    expect(page.locator(".job-progress")).to_be_visible()
    expect(page.locator(".job-photo")).to_be_hidden()


@pytest.mark.thorough
def test_the_test_piece_is_that_of_the_chosen_machine_and_its_figures_go_into_the_job(opened: Opened) -> None:
    """Of another machine the archive is another, and what was measured of the first is not said, even if it is late."""
    page = opened("#/new")
    estimated: list[dict[str, Any]] = []

    def note(route: Route) -> None:
        estimated.append(parts(route)[0])
        route.fulfill(json=ESTIMATE_EXAMPLE)

    page.route("**/v1/estimates", note)
    choose(page, picture())
    piece = page.locator("details", has_text="Measure your mill and your finish").last
    piece.locator("summary").click()
    archive = piece.get_by_role("link", name="Programs and sheet")
    expect(archive).to_have_attribute("href", f"/v1/profiles/{NAME}/coupon.zip")
    photo: FilePayload = {"name": "piece.png", "mimeType": "image/png", "buffer": canned_job.files()["target.png"]}
    piece.locator("input[type=file]").set_input_files(photo)
    expect(piece.locator("ul > li").filter(has_text="1.1 mm").first).to_be_visible()
    with page.expect_response(lambda one: b"k0_rad_per_mm" in (one.request.post_data_buffer or b"")):
        piece.get_by_role("button", name="Use these figures for this job").click()
    values = COUPON_EXAMPLE["values"]
    assert estimated[-1]["finish"]["k0_rad_per_mm"] == values["finish.k0_rad_per_mm"]
    assert estimated[-1]["machine"]["z_noise_mm"] == values["machine.z_noise_mm"]
    page.get_by_label("Machine", exact=True).select_option(label="grbl-3018: engraver")
    expect(archive).to_have_attribute("href", "/v1/profiles/grbl-3018/coupon.zip")
    expect(piece.locator("ul > li")).to_have_count(0)
    late: list[Route] = []
    page.route("**/coupon/photos", lambda route: late.append(route))
    with page.expect_request("**/coupon/photos"):
        piece.locator("input[type=file]").set_input_files(photo)
    page.get_by_label("Machine", exact=True).select_option(label="simulated (grbl)")
    expect(piece.get_by_text("Looking at the photograph")).to_have_count(0)
    with page.expect_response("**/coupon/photos"):
        late[0].fulfill(json=COUPON_EXAMPLE)
    page.evaluate("new Promise((done) => setTimeout(done))")
    expect(piece.locator("ul > li")).to_have_count(0)
