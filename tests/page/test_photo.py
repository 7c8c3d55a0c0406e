"""The card of a job that looks at a photograph of the wall."""

from __future__ import annotations

import re

from playwright.sync_api import FilePayload, expect

from tests.page import canned_job
from tests.page.answers import problem
from tests.page.conftest import Opened
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
    expect(page.locator(".job-progress")).to_be_visible()
    expect(page.locator(".job-photo")).to_be_hidden()
