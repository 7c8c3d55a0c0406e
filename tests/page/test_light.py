"""The light that the page finds by itself, against the server's: the same picture, the same way round."""

from __future__ import annotations

import base64
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.heightfield import Array, Heightfield
from optics.irradiance import ViewedFrom, picture_from_irradiance, target_irradiance
from optics.lens_settings import LensSettings
from optics.light import Light
from service.job.page_data.surface import light_bytes
from service.job.picture.light_png import srgb_levels
from tests.page import canned_job
from tests.page.conftest import Opened
from tests.page.jobs import canned, like, shown, unfold, with_plan
from tests.page.test_job import NO_WEBGL

PIXELS, SEEN = 64, 256
PARALLEL = Bench.centre_on(width_mm=30.0, height_mm=30.0, throw_mm=100.0, refractive_index=1.49, thickness_mm=20.0)
SUN = replace(PARALLEL, light=Light(kind="sun"))
LAMP = replace(PARALLEL, light=Light(kind="point", distance_mm=300.0, size_mm=3.0))
DRAW = """async ([data, pixels, change]) => {
    const [{ lightOf }, gl] = await Promise.all([import("/page/job/drawing_file.js"), import("/page/job/light_gl.js")]);
    const lens = await lightOf(Uint8Array.from(atob(data), (one) => one.charCodeAt(0)).buffer);
    const setting = { ...gl.settingOf(lens), ...change }, beams = gl.beamsOf(lens, setting);
    const canvas = new OffscreenCanvas(1, 1), picture = gl.lightPicture(canvas, lens, { pixels });
    picture.add(setting, beams, { whole: beams.length, first: true, stride: 2 });
    picture.turnOver();
    const ink = new OffscreenCanvas(pixels, pixels).getContext("2d");
    ink.drawImage(canvas, 0, 0);
    const shown = ink.getImageData(0, 0, pixels, pixels).data.filter((_, k) => k % 4 === 0);
    const { values } = picture.read();
    picture.free();
    return [[...values], [...shown]];
}"""


def letter() -> Array:
    """An F on a slope of grey: no mirror of it looks the same."""
    y, x = np.mgrid[:PIXELS, :PIXELS] / PIXELS
    strokes = (
        (x > 0.2)
        & (y > 0.15)
        & (y < 0.85)
        & ((x < 0.35) | ((x < 0.8) & (y < 0.28)) | ((x < 0.6) & (abs(y - 0.5) < 0.06)))
    )
    return np.where(strokes, 1.0, 0.15 + 0.2 * x)


def lens_for(bench: Bench, *, corrections: int = 1) -> tuple[Heightfield, float]:
    target = target_irradiance(letter(), viewed_from="lens")
    return design_lens(
        target, LensSettings(bench=bench, skim_mm=0.1, corrections=corrections)
    ).heightfield, target.max()


def likeness(a: Array, b: Array) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize(
    ("made_for", "lit", "change"),
    [
        pytest.param(PARALLEL, replace(PARALLEL, throw_mm=85.0), {"throwMm": 85.0}, id="wall nearer"),
        pytest.param(SUN, SUN, {}, id="sun", marks=pytest.mark.thorough),
        pytest.param(LAMP, LAMP, {}, id="lamp", marks=pytest.mark.thorough),
    ],
)
def test_the_page_sees_the_servers_caustic_and_no_mirror_of_it(
    modules: Page, made_for: Bench, lit: Bench, change: dict[str, float]
) -> None:
    """From the lens's side and from behind the wall: the same light, the other way round."""
    lens, white = lens_for(made_for)
    coarse = (PIXELS, SEEN // PIXELS, PIXELS, SEEN // PIXELS)

    def drawn(viewed_from: ViewedFrom) -> list[Array]:
        data = base64.b64encode(light_bytes(lens, made_for, white=white, viewed_from=viewed_from)).decode()
        found = modules.evaluate(DRAW, [data, SEEN, change])
        return [np.array(one).reshape(coarse).mean(axis=(1, 3)) for one in found]

    seen, shown = drawn("lens")
    wanted = simulate_caustic(lens, lit, pixels=(PIXELS, PIXELS)).irradiance
    assert likeness(seen, wanted) >= 0.99
    assert seen.mean() == pytest.approx(wanted.mean(), rel=0.01)
    assert max(likeness(seen[::-1], wanted), likeness(seen[:, ::-1], wanted), likeness(seen.T, wanted)) < 0.8
    assert likeness(shown, srgb_levels(picture_from_irradiance(wanted, viewed_from="lens"), white=white)) >= 0.98
    _, behind = drawn("behind")
    assert likeness(behind, srgb_levels(picture_from_irradiance(wanted, viewed_from="behind"), white=white)) >= 0.98


FRAMES = """() => { window.drawn = 0; const draw = WebGL2RenderingContext.prototype.drawArrays;
    WebGL2RenderingContext.prototype.drawArrays = function (...more) {
        window.drawn += 1;
        return draw.apply(this, more);
    };
}"""
AT_REST = """async () => {
    for (let before = -1, tries = 0; before !== window.drawn; tries += 1) {
        if (tries > 30) throw new Error("it draws on and on");
        before = window.drawn;
        await new Promise((done) => setTimeout(done, 1500));
    }
    return window.drawn;
}"""


@pytest.mark.thorough
def test_wall_and_block_are_moved_by_keys_and_nothing_is_drawn_while_nothing_moves(opened: Opened) -> None:
    page = opened(f"#/jobs/{canned_job.JOB_ID}", once=True)
    unfold(page)
    page.evaluate(FRAMES)
    canvas = page.locator(".light-canvas")
    canvas.scroll_into_view_if_needed()
    expect(page.locator(".light-words")).to_have_text("Wall at 100 mm, where it belongs")
    before = page.evaluate(AT_REST)
    canvas.press("ArrowUp")
    expect(page.locator(".light-words")).to_have_text("Wall at 95 mm: 5 mm too near")
    assert page.evaluate(AT_REST) > before
    page.get_by_role("slider", name="Sun, width").fill("1")
    expect(page.get_by_role("slider", name="Sun, width")).to_have_attribute("aria-valuetext", "1°")
    expect(page.locator(".light-rows output")).to_have_text(["95 mm", "0°", "0°", "0°", "1°"])
    page.get_by_role("button", name="Reset all").click()
    expect(page.locator(".light-words")).to_have_text("Wall at 100 mm, where it belongs")


@pytest.mark.thorough
def test_light_begins_with_what_the_wall_will_show_and_says_why_a_sharpened_lens_looks_broken(opened: Opened) -> None:
    """A choice of one's own stays, whatever becomes known; how exactly the wall must stand is said below."""
    job, files = canned()
    page = shown(opened, with_plan(job, 7), [one for one in files if one["name"] != "light-as-milled.bin"])
    page.locator("#light-title").scroll_into_view_if_needed()
    which, words = page.get_by_label("Surface"), page.locator(".light-live")
    expect(which.locator("option:checked")).to_have_text("As designed")
    expect(words).to_contain_text("without the tool's marks it looks broken")
    expect(words).to_contain_text("stays sharp from 0.25 mm too near to 0.24 mm too far")
    page = shown(opened, with_plan(job, 8), files)
    page.locator("#light-title").scroll_into_view_if_needed()
    expect(which.locator("option:checked")).to_have_text("As milled")
    expect(words).to_contain_text("single grooves are not drawn")
    page = shown(opened, like(job, 9), files)
    page.locator("#light-title").scroll_into_view_if_needed()
    which.select_option("As designed")
    expect(words).to_contain_text("A perfect surface.")


def test_without_webgl_a_sentence_stands_for_live_light(opened: Opened) -> None:
    page = opened(f"#/jobs/{canned_job.JOB_ID}", script=NO_WEBGL)
    unfold(page)
    page.locator("#light-title").scroll_into_view_if_needed()
    expect(page.get_by_text("no WebGL2 for live light")).to_be_visible()
    expect(page.locator(".light-canvas")).to_be_hidden()
