"""Pictures: one exposure, the right way up, and a path sample that keeps what matters in bounded memory; thumbnails:
small in pixels and in bytes, in light as bright as the large ones.
"""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from optics.irradiance import picture_from_irradiance, target_irradiance
from optics.paper.flow import FlowSnapshot
from service.job.picture.light_png import THUMBNAIL_BYTES, THUMBNAIL_SIDES, picture_png, srgb_levels, thumbnail_png
from service.job.picture.linear_light import srgb_to_linear
from service.job.report.figures.base import round_up
from service.job.report.figures.lens import flow_png, heightfield_png, shade_by_raking_light
from service.job.report.figures.path_sample import ContourSample
from service.job.report.figures.paths import PathSample, toolpath_png
from service.job.report.figures.wall import comparison_png, through_focus_png


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)))


def test_every_srgb_level_survives_the_way_through_linear_light():
    levels = np.arange(256) / 255
    linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    assert np.array_equal(srgb_levels(7.0 * linear, white=7.0), np.arange(256))


def test_target_and_caustic_share_one_exposure_and_brighter_light_is_clipped():
    target = np.array([[0.0, 1.0], [2.0, 4.0]])
    shown = pixels(picture_png(target, white=4.0))
    caustic = pixels(picture_png(np.array([[0.0, 1.0], [2.0, 40.0]]), white=4.0))
    assert np.array_equal(shown, caustic)
    assert shown[1, 1] == 255
    assert shown[0, 0] == 0
    assert pixels(picture_png(target / 2, white=4.0))[1, 1] < 255


@pytest.mark.parametrize("white", [0.0, -1.0, np.nan, np.inf])
def test_an_exposure_without_light_is_refused(white):
    with pytest.raises(ValueError, match="white"):
        srgb_levels(np.ones((2, 2)), white=white)


@pytest.mark.parametrize("viewed_from", ["lens", "behind"])
def test_the_saved_picture_is_what_the_viewer_sees(viewed_from):
    picture = np.arange(12.0).reshape(3, 4)  # no symmetry: any flip shows
    irradiance = target_irradiance(picture, viewed_from=viewed_from)
    seen = picture_from_irradiance(irradiance, viewed_from=viewed_from)
    expected = srgb_levels(picture, white=picture.max())
    assert np.array_equal(pixels(picture_png(seen, white=irradiance.max())), expected)


def test_a_small_picture_has_the_means_of_light_and_a_smaller_one_stays_as_it_is():
    light = np.random.default_rng(7).random((6, 8))
    means = light.reshape(3, 2, 4, 2).mean((1, 3))
    assert np.array_equal(pixels(picture_png(light, white=1.0, side=4)), srgb_levels(means, white=1.0))
    assert picture_png(light, white=1.0, side=8) == picture_png(light, white=1.0)


@given(st.floats(1e-6, 1e6))
def test_a_rounded_scale_is_the_next_one_two_or_five(value):
    limit = round_up(value)
    assert value <= limit * (1 + 1e-9)
    assert limit <= 2.5 * value * (1 + 1e-6)
    assert f"{limit:e}"[0] in "125"


def test_figures_are_pngs_even_for_flat_and_equal_input():
    picture = np.ones((20, 30))
    axis = np.linspace(0, 10, 12)
    for png in (
        comparison_png(picture, picture),
        through_focus_png([(0.5, picture), (1.0, picture)], throw_mm=100, white=1.0),
        heightfield_png(axis, axis, np.full((12, 12), -0.1)),
        toolpath_png([], width_mm=10, height_mm=10, margin_mm=0),
    ):
        assert pixels(png).ndim == 3


def test_a_figure_of_a_wide_picture_is_no_taller_than_it_needs_to_be():
    """Two thirds of it and more are picture, whatever the lens's proportion."""
    for ny, nx in ((30, 60), (60, 60), (60, 40)):
        black = np.zeros((ny, nx))
        black[-1, -1] = 1.0
        shown = pixels(comparison_png(black, black))
        rows = (shown[:, : shown.shape[1] // 4, :3] < 250).any(axis=2).mean(axis=1) > 0.5
        assert rows.mean() > 0.66


def test_the_rounding_errors_of_a_flat_lens_have_no_colour():
    axis = np.linspace(0, 10, 40)
    noise = 1e-13 * np.random.default_rng(0).standard_normal((40, 40))
    flat, noisy = (pixels(heightfield_png(axis, axis, z - 0.1)) for z in (np.zeros((40, 40)), noise))
    inner = np.s_[100:700, 100:700]  # of the left panel
    assert np.abs(flat[inner].astype(int) - noisy[inner]).max() <= 2


def test_light_from_the_upper_left_brightens_the_upper_left_flank_of_a_hill():
    axis = np.linspace(-5, 5, 41)
    hill = np.exp(-(axis[None, :] ** 2 + axis[:, None] ** 2) / 6)  # row 0 at the lowest y
    shade = shade_by_raking_light(axis, axis, hill)
    assert shade[26, 14] > shade[20, 20] > shade[14, 26]


def test_the_flow_is_mirrored_for_a_viewer_on_the_lens_side():
    u, v = np.meshgrid(np.linspace(0, 10, 33), np.linspace(0, 10, 33))
    left_only = np.where(u < 3, 1.0, 0.0)
    step = FlowSnapshot(step=1, lens_mm=np.stack([u, v], axis=-1), difference=left_only)
    behind, lens = (pixels(flow_png([step], viewed_from=side)).astype(int) for side in ("behind", "lens"))
    lower = slice(behind.shape[0] // 2, None)

    def red_column(shown):
        redness = (shown[lower, :330, 0] - shown[lower, :330, 2]).sum(axis=0)
        return np.average(np.arange(330), weights=np.maximum(redness, 0))

    assert red_column(behind) + 50 < red_column(lens)


def serpentine(rows: int, per_row: int, *, pitch_mm: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(n + 1, 3) points and (n,) rapid flags: in from above, rows along x, out again."""
    rng = np.random.default_rng(seed)
    x = np.tile(np.linspace(0, 20, per_row), (rows, 1))
    x[1::2] = x[1::2, ::-1].copy()
    y = np.repeat(np.arange(rows) * pitch_mm, per_row)
    cut = np.column_stack([x.ravel(), y, rng.uniform(-3, 0, y.size)])
    points = np.concatenate([[[0, 0, 5]], cut, cut[-1:] + np.array([0, 0, 9])])
    rapid = np.zeros(len(points) - 1, dtype=bool)
    rapid[-1] = True
    return points, rapid


def sampled(points: np.ndarray, rapid: np.ndarray, *, batch: int, pitch_mm: float, limit: int) -> PathSample:
    sample = PathSample(label="p", pitch_mm=pitch_mm, radius_mm=0.5, width_mm=20, height_mm=20, limit=limit)
    for k in range(0, len(rapid), batch):
        last = min(k + batch, len(rapid))
        sample.add(points[k:last], points[k + 1 : last + 1], rapid[k:last])
    return sample


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 120), st.integers(2, 60), st.integers(1, 500), st.integers(10, 3000), st.integers(0, 99))
def test_thinning_keeps_the_extremes_and_the_limit(rows, per_row, batch, limit, seed):
    points, rapid = serpentine(rows, per_row, pitch_mm=0.2, seed=seed)
    sample = sampled(points, rapid, batch=batch, pitch_mm=0.2, limit=limit)
    cutting = points[:-1]  # the last point belongs to the rapid alone
    kept = sample.cuts_mm()
    for corner, extreme in ((sample.bounds_mm()[0], np.min), (sample.bounds_mm()[1], np.max)):
        assert np.array_equal(corner, extreme(cutting, axis=0))
        assert np.array_equal(corner, extreme(kept, axis=(0, 1)))
    assert len(kept) <= limit + 6
    assert (sample.moves, sample.rapids, sample.entries) == (len(rapid), 1, 1)


def test_the_sample_does_not_depend_on_the_size_of_the_batches():
    points, rapid = serpentine(100, 50, pitch_mm=0.2)
    one, many = (sampled(points, rapid, batch=batch, pitch_mm=0.2, limit=100_000) for batch in (10**6, 7))
    assert np.array_equal(one.zoom_mm()[0], many.zoom_mm()[0])
    assert np.array_equal(one.bounds_mm(), many.bounds_mm())
    assert np.array_equal(one.entry_points_mm(), many.entry_points_mm())
    assert set(one.cuts_mm()[:-6, 0, 1]) == set(many.cuts_mm()[:-6, 0, 1])


def test_the_window_holds_every_move_that_meets_it_and_no_other():
    points, rapid = serpentine(100, 400, pitch_mm=0.2)
    sample = sampled(points, rapid, batch=1000, pitch_mm=0.2, limit=100_000)
    window, cuts = sample.window, sample.zoom_mm()[0]
    low = np.minimum(points[:-2], points[1:-1])[:, :2]
    high = np.maximum(points[:-2], points[1:-1])[:, :2]
    inside = (low <= [window.x1_mm, window.y1_mm]).all(axis=1) & (high >= [window.x0_mm, window.y0_mm]).all(axis=1)
    assert 0 < inside.sum() == len(cuts) < len(points) / 4


def test_entries_are_where_a_rapid_ends_and_cutting_begins_and_pauses_are_none():
    points = np.array([[0, 0, 5], [0, 0, -1], [9, 0, -1], [9, 0, 5], [9, 3, 5], [9, 3, 5], [9, 3, -1], [0, 3, -1.0]])
    rapid = np.array([False, False, True, True, False, False, False])  # the fifth is a pause
    sample = sampled(points, rapid, batch=3, pitch_mm=1, limit=100)
    assert sample.entries == 2
    assert np.array_equal(sample.entry_points_mm(), [[0, 0, 5], [9, 3, 5]])
    assert sample.moves == 6


def test_many_entries_are_thinned_but_counted():
    n = 9001
    start = np.column_stack([np.linspace(0, 20, n), np.zeros(n), np.zeros(n)])
    sample = PathSample(label="p", pitch_mm=1, radius_mm=1, width_mm=20, height_mm=20)
    for point in np.array_split(start, 50):
        pairs = np.repeat(point, 2, axis=0)
        sample.add(pairs, pairs + np.array([0.1, 0, -1]), np.tile([True, False], len(point)))
    assert sample.entries == n
    assert len(sample.entry_points_mm()) <= 2000


@pytest.mark.thorough
def test_a_toolpath_picture_shows_rapids_and_only_rapids_in_red():
    points, rapid = serpentine(40, 30, pitch_mm=0.5)

    def red(sample):
        shown = pixels(toolpath_png([sample], width_mm=20, height_mm=20, margin_mm=2)).astype(int)
        above = shown[: int(0.9 * len(shown))]  # the legend has its own red
        return int(((above[..., 0] > 180) & (above[..., 1] < 80)).sum())

    hops = np.concatenate([points, [[0, 20, 9], [20, 0, 9]]])
    without = red(sampled(points, rapid, batch=99, pitch_mm=0.5, limit=10**5))
    assert red(sampled(hops, np.append(rapid, [True, True]), batch=99, pitch_mm=0.5, limit=10**5)) > without + 50


def spiral(pitch_mm: float, side_mm: float = 20.0, step_mm: float = 0.2) -> np.ndarray:
    turns = np.arange(0, side_mm / 2 / pitch_mm, step_mm / 40)
    angle = 2 * np.pi * turns
    radius = pitch_mm * turns
    middle = np.array([side_mm / 2, side_mm / 2, 0])
    return middle + np.column_stack([radius * np.cos(angle), radius * np.sin(angle), -radius / 9])


@pytest.mark.parametrize("batch", [10**6, 999])
def test_of_a_contour_path_evenly_strewn_pieces_are_drawn(batch):
    """Drawn pieces lie on the path, keep half their distance, leave no large hole, and their number is bounded."""
    path, layer = spiral(0.1), np.column_stack([np.linspace(0, 20, 300), np.full(300, 7.0), np.full(300, -0.5)])
    up = np.array([0, 0, 9])
    points = np.concatenate([layer, layer[-1:] + up, path[:1] + up, path, path[-1:] + up])
    rapid = np.zeros(len(points) - 1, dtype=bool)
    rapid[[299, 300, len(points) - 2]] = True
    sample = ContourSample(label="p", pitch_mm=0.1, radius_mm=0.5, width_mm=20, height_mm=20)
    for k in range(0, len(rapid), batch):
        last = min(k + batch, len(rapid))
        sample.add(points[k:last], points[k + 1 : last + 1], rapid[k:last])
    drawn, apart = sample.tracks_mm()[:, 1, :2], sample.row_distance_mm
    radius = np.hypot(*(drawn - 10).T)
    assert len(drawn) < 20_000
    assert np.diff(np.unique(np.round(radius / 0.1))).max() * 0.1 < 2 * apart
    near = np.hypot(*(drawn[:, None, :] - drawn[None, ::7, :]).transpose(2, 0, 1))
    other = (abs(radius[:, None] - radius[None, ::7]) > 0.2 * apart) & (radius > 1)[:, None]  # long turns
    assert near[other].min() > 0.25 * apart  # cells are a quarter of the distance
    assert sample.ends_mm()[1] == pytest.approx(path[-1]) and sample.ends_mm()[0][:2] == pytest.approx(path[0, :2])
    assert sample.length_mm == pytest.approx(np.hypot(*np.diff(path[:, :2], axis=0).T).sum(), rel=1e-6)
    moves, along = sample.window_tracks()
    inside = sample.window.meets(path[:-1], path[1:])
    assert (
        len(moves) == inside.sum() == len(along) and (np.diff(along) >= 0).all() and 0 <= along.min() < along.max() <= 1
    )


@pytest.mark.thorough
def test_a_contour_pass_is_drawn_beside_the_others():
    points = np.concatenate([[[10, 10, 5]], spiral(0.5)])
    sample = ContourSample(label="p", pitch_mm=0.5, radius_mm=0.5, width_mm=20, height_mm=20)
    sample.add(points[:-1], points[1:], np.zeros(len(points) - 1, dtype=bool))
    rows = sampled(*serpentine(40, 30, pitch_mm=0.5), batch=99, pitch_mm=0.5, limit=10**5)
    assert pixels(toolpath_png([rows, sample], width_mm=20, height_mm=20, margin_mm=2)).std() > 10


@pytest.mark.thorough
def test_a_toolpath_picture_shows_a_lens_that_does_not_fill_its_aperture():
    """Its rim is drawn where it runs, and nothing else changes but the line of the aperture."""

    def dark(outline_mm):
        sample = PathSample(label="p", pitch_mm=1, radius_mm=1, width_mm=20, height_mm=20)
        sample.add(np.zeros((1, 3)), np.array([[20.0, 0, 0]]), np.array([True]))
        picture = toolpath_png([sample], width_mm=20, height_mm=20, margin_mm=2, outline_mm=outline_mm)
        return pixels(picture).astype(int)[..., :3].max(axis=-1) < 90

    square = [(5.0, 5.0), (15.0, 5.0), (15.0, 15.0), (5.0, 15.0)]
    with_rim, without = dark(square), dark(None)
    assert with_rim.shape == without.shape
    assert (with_rim & ~without).sum() > 300  # pixels of the rim's sides


def opened(content: bytes) -> Image.Image:
    image = Image.open(io.BytesIO(content))
    assert image.mode == "L"
    return image


@settings(max_examples=30, deadline=None)
@given(ny=st.integers(1, 700), nx=st.integers(1, 700), seed=st.integers(0, 99))
def test_whatever_the_picture_it_is_small_and_keeps_its_shape(ny: int, nx: int, seed: int) -> None:
    """Noise is what packs worst."""
    content = thumbnail_png(np.random.default_rng(seed).random((ny, nx)), white=1.0)
    width, height = opened(content).size
    assert len(content) <= THUMBNAIL_BYTES
    assert max(width, height) == min(max(ny, nx), max(width, height)) and max(width, height) <= THUMBNAIL_SIDES[0]
    assert abs(width * ny - height * nx) <= 0.5 * max(nx, ny) + max(width, height)


@pytest.mark.parametrize("shape", [(64, 64), (192, 120)])
def test_a_small_picture_is_the_large_one_itself(shape: tuple[int, int]) -> None:
    light = np.linspace(0.0, 2.0, shape[0] * shape[1]).reshape(shape)
    assert thumbnail_png(light, white=1.5) == picture_png(light, white=1.5)


def test_a_pixel_is_the_mean_of_its_light() -> None:
    """Not of its grey levels: black and white stripes are half of the light, which is no mid grey."""
    light = np.tile([0.0, 1.0], (512, 256))
    grey = np.asarray(opened(thumbnail_png(light, white=1.0)), dtype=float)
    assert srgb_to_linear(grey / 255).mean() == pytest.approx(0.5, abs=0.01)
    ramp = np.add.outer(np.linspace(0, 1, 384), np.linspace(0, 3, 384))
    small = np.asarray(opened(thumbnail_png(ramp, white=4.0)), dtype=int)
    assert np.abs(small - srgb_levels(ramp.reshape(192, 2, 192, 2).mean((1, 3)), white=4.0).astype(int)).max() <= 1
