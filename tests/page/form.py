"""The form of a new job: what a person fills in, and what the page sends then."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Locator, Page, Route, expect

from tests.page.answers import problem


def picture(width: int = 60, height: int = 40) -> bytes:
    """Unlike itself in any mirror, turned any way, and in any part."""
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([4 * columns, 6 * rows, (7 * rows * columns) % 251], axis=-1).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def pixels_of(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def choose(page: Page, content: bytes, name: str = "portrait.png") -> None:
    expect(page.get_by_role("heading", level=1, name="New job")).to_be_visible()
    file = {"name": name, "mimeType": "image/png", "buffer": content}
    page.locator("input[type=file]").first.set_input_files(file)
    expect(wall(page)).to_be_visible()
    unfold(page)


def unfold(page: Page) -> None:
    """Whatever is folded for who does not need it, except the part for experts."""
    page.evaluate("""() => document.querySelectorAll(".fold, .expert > details").forEach(
        (one) => Object.assign(one, { name: "", open: true }))""")


def refuse_picture(page: Page) -> None:
    """Choose what is none: it is answered as the server answers."""
    words = "this is not a picture that can be read"
    page.route("**/v1/estimates", lambda route: route.fulfill(**problem(422, detail=words, field="image")), times=1)
    broken = {"name": "broken.png", "mimeType": "image/png", "buffer": b"no picture"}
    page.locator("input[type=file]").first.set_input_files(broken)


def wall(page: Page) -> Locator:
    return page.locator("canvas.wall")


def fill(page: Page, **values: str) -> None:
    for label, value in values.items():
        page.get_by_label(label.replace("_", " "), exact=True).fill(value)


def make_it(page: Page) -> Locator:
    return page.get_by_role("button", name="Make the lens")


def parts(route: Route) -> tuple[dict[str, Any], bytes]:
    body = route.request.post_data_buffer or b""
    boundary = b"--" + route.request.headers["content-type"].partition("boundary=")[2].encode()
    found = {}
    for part in body.split(boundary)[1:-1]:
        head, _, content = part[2:-2].partition(b"\r\n\r\n")
        found[b"image" if b'name="image"' in head else b"spec"] = content
    return json.loads(found[b"spec"]), found[b"image"]


def pressed(page: Page, sent: list[tuple[dict[str, Any], bytes, str]]) -> tuple[dict[str, Any], bytes, str]:
    """What the page sends when the button is pressed."""
    with page.expect_response("**/v1/jobs"):
        make_it(page).click()
    expect(make_it(page)).to_have_attribute("aria-disabled", "false")
    return sent[-1]


def as_floats(spec: Any) -> Any:
    return json.loads(json.dumps(spec), parse_int=float)
