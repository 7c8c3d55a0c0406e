"""A picture by the camera: Chromium's own, which sees a test picture, stands in for it."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Page, expect

from tests.page.browser import layout_faults, open_blank, serious_faults
from tests.page.conftest import Opened

TRACKS = "window.streams.flatMap((one) => one.getTracks()).map((one) => one.readyState)"
NOTE_STREAMS = """window.streams = [];
const get = navigator.mediaDevices.getUserMedia.bind(navigator.mediaDevices);
navigator.mediaDevices.getUserMedia = async (wanted) => {
    const found = await get(wanted);
    window.streams.push(found);
    return found;
};
null"""
REFUSE = """navigator.mediaDevices.getUserMedia = async () => {
    throw new DOMException("no", "NotAllowedError");
};
null"""


@pytest.fixture
def page(opened: Opened) -> Page:
    found = open_blank(opened, "new")
    found.context.grant_permissions(["camera"])
    found.evaluate("location.hash = '#/new'")
    expect(found.get_by_role("heading", level=1, name="New job")).to_be_visible()
    return found


@pytest.mark.thorough
def test_a_photograph_becomes_the_picture_of_the_job(page: Page) -> None:
    """What the camera saw, at its full size; afterwards the camera is off."""
    page.evaluate(NOTE_STREAMS)
    page.get_by_role("button", name="Take a photo").click()
    dialog = page.get_by_role("dialog", name="Take a photo")
    shutter = dialog.get_by_role("button", name="Take it")
    expect(shutter).to_be_enabled()
    assert serious_faults(page) == []
    for width, height in ((390, 844), (1440, 900)):
        page.set_viewport_size({"width": width, "height": height})
        assert layout_faults(page) == []
        expect(shutter).to_be_in_viewport(ratio=1)
    size = dialog.locator("video").evaluate("one => [one.videoWidth, one.videoHeight]")
    shutter.click()
    expect(dialog).to_have_count(0)
    expect(page.locator("canvas.wall")).to_be_visible()
    expect(page.get_by_label("Name of the job")).to_have_value(re.compile(r"^photo \d{4}-\d\d-\d\d"))
    assert page.evaluate(TRACKS) == ["ended"]
    assert min(size) >= 240
    page.wait_for_function("""() => {
        const wall = document.querySelector("canvas.wall");
        return new Set(wall.getContext("2d").getImageData(0, 0, wall.width, wall.height).data).size > 10;
    }""")


@pytest.mark.thorough
def test_who_thinks_better_of_it_has_no_picture_and_the_camera_is_off(page: Page) -> None:
    page.evaluate(NOTE_STREAMS)
    page.get_by_role("button", name="Take a photo").click()
    page.get_by_role("dialog", name="Take a photo").get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("dialog")).to_have_count(0)
    assert page.evaluate(TRACKS) == ["ended"]
    expect(page.locator("canvas.wall")).to_have_count(0)


def test_a_camera_that_may_not_be_used_is_said_so(page: Page) -> None:
    page.evaluate(REFUSE)
    page.get_by_role("button", name="Take a photo").click()
    expect(page.get_by_text("may not use the camera")).to_be_visible()
    expect(page.get_by_role("dialog")).to_have_count(0)


@pytest.mark.thorough
def test_a_phone_takes_it_with_its_own_program(opened: Opened) -> None:
    page = opened("#/new", size="phone")
    with page.expect_file_chooser() as asked:
        page.get_by_role("button", name="Take a photo").click()
    assert asked.value.element.get_attribute("capture") == "environment"


@pytest.mark.thorough
def test_where_no_camera_can_be_used_none_is_offered(page: Page) -> None:
    """As without TLS: the browser does not even say whether there is one."""
    page.evaluate("delete Navigator.prototype.mediaDevices")
    page.evaluate("location.hash = '#/machines'")
    expect(page.get_by_role("heading", level=1, name="Machines")).to_be_visible()
    page.evaluate("location.hash = '#/new'")
    expect(page.get_by_role("button", name="Choose a picture")).to_be_visible()
    expect(page.get_by_role("button", name="Take a photo")).to_be_hidden()
