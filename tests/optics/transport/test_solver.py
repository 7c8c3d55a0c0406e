"""The transport map and its lens: each pixel gets its share, nothing folds, and symmetry is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.errors import TotalReflectionError
from optics.irradiance import picture_from_irradiance, target_irradiance
from optics.lens_settings import LensSettings
from optics.metrics import CausticScore, score_caustic
from optics.refraction import tangent_per_slope
from optics.transport.even_light import rim_slopes
from optics.transport.grid_levels import average_boxes, level_shapes
from optics.transport.solver import solve_transport
from tests.optics.areas import areas_mm2


def on_screen(settings: LensSettings, screen_mm: tuple[float, float], **changes: float) -> LensSettings:
    """The same lens, or one of another height or throw, before a centred screen of that size."""
    of = settings.bench
    sizes = {"width_mm": of.width_mm, "height_mm": of.height_mm, "throw_mm": of.throw_mm} | changes
    return replace(settings, bench=Bench.centre_on(refractive_index=of.refractive_index, screen_mm=screen_mm, **sizes))


def scored(target: np.ndarray, settings: LensSettings) -> CausticScore:
    lens = design_lens(target, settings).heightfield
    caustic = simulate_caustic(lens, settings.bench, pixels=target.shape)
    return score_caustic(caustic.irradiance, target)


def test_even_light_needs_a_flat_lens(settings: LensSettings) -> None:
    lens = design_lens(np.ones((32, 32)), settings)
    np.testing.assert_allclose(lens.heightfield.z_mm, -settings.skim_mm, atol=1e-9)
    np.testing.assert_allclose(lens.transport_map.lens_mm, lens.transport_map.screen_mm, atol=1e-9)


def test_each_pixel_collects_its_share(settings: LensSettings, soft_picture: np.ndarray) -> None:
    target = target_irradiance(soft_picture, viewed_from="lens")
    solution = solve_transport(target, settings.bench, skim_mm=0.1, tolerance=1e-4)
    assert solution.converged
    areas = areas_mm2(solution.transport_map().lens_mm) / (400 / target.size)
    assert areas.min() > 0  # no quad turned over
    assert areas.mean() == pytest.approx(1.0, abs=1e-12)  # the frame stays on the frame
    # corner quads see a wider stencil than the solver's midpoint quads: second-order difference on 48 pixels
    np.testing.assert_allclose(areas, target, rtol=0.08)


def test_picture_appears(settings: LensSettings, soft_picture: np.ndarray) -> None:
    """The light through the exact surface is the target, and corrections bring it closer."""
    soft = scored(target_irradiance(soft_picture, viewed_from="lens"), replace(settings, corrections=0))
    assert soft.psnr_db > 55
    edged = soft_picture.copy()
    edged[20:40, 5:20] *= 2.5
    target = target_irradiance(edged, viewed_from="lens")
    once = scored(target, replace(settings, corrections=0))
    corrected = scored(target, replace(settings, corrections=2))
    assert once.psnr_db > 30
    assert corrected.psnr_db > once.psnr_db + 2
    assert corrected.misplaced_light < 0.005


@pytest.mark.parametrize("viewed_from", ["lens", "behind"])
def test_viewer_sees_the_picture_the_right_way_round(
    settings: LensSettings, soft_picture: np.ndarray, viewed_from: str
) -> None:
    """The bright blob is upper left in the picture; by hand: +Y is up, and from the lens's side +X is to the left."""
    target = target_irradiance(soft_picture, viewed_from=viewed_from)  # type: ignore[arg-type]
    lens = design_lens(target, settings).heightfield
    light = simulate_caustic(lens, settings.bench, pixels=target.shape).irradiance
    row, column = np.unravel_index(light.argmax(), light.shape)
    assert row > 30  # high Y
    assert (column > 30) if viewed_from == "lens" else (column < 18)
    seen = picture_from_irradiance(light, viewed_from=viewed_from)  # type: ignore[arg-type]
    assert np.corrcoef(seen.ravel(), soft_picture.ravel())[0, 1] > 0.999


def test_light_converges_where_the_picture_is_bright(settings: LensSettings, soft_picture: np.ndarray) -> None:
    """Under the bright blob the lens bulges toward the screen (positive lens), it is not its negative."""
    target = target_irradiance(soft_picture, viewed_from="behind")
    lens = design_lens(target, settings).heightfield
    spline = lens.spline()
    bright = spline.jets(5.0, 16.0)
    assert bright[3] + bright[5] < 0


def test_turning_the_picture_turns_the_lens(settings: LensSettings, soft_picture: np.ndarray) -> None:
    target = target_irradiance(soft_picture, viewed_from="lens")
    lens = design_lens(target, settings).heightfield.z_mm
    turned = design_lens(np.rot90(target).copy(), settings).heightfield.z_mm
    np.testing.assert_allclose(turned, np.rot90(lens), atol=5e-4 * np.ptp(lens))


def test_black_areas_converge_without_a_floor(settings: LensSettings) -> None:
    picture = np.zeros((64, 64))
    picture[10:30, 12:50] = 1.0
    picture[40:56, 20:36] = 0.7
    target = target_irradiance(picture, viewed_from="lens")
    design = design_lens(target, settings)
    assert design.converged, design.message
    assert scored(target, settings).misplaced_light < 0.06  # 64 pixels: edges are a good part of it


def test_other_screen_sizes_and_shapes(settings: LensSettings, soft_picture: np.ndarray) -> None:
    """A 20 x 10 mm lens onto a 30 x 15 mm screen: the frame lands on the frame."""
    target = target_irradiance(soft_picture[:24], viewed_from="lens")
    wide = on_screen(settings, (30.0, 15.0), height_mm=10.0)
    score = scored(target, wide)
    assert score.psnr_db > 38
    assert score.misplaced_light < 0.005


@pytest.mark.parametrize("screen_mm", [(30.0, 15.0), (12.0, 6.0), (24.0, 24.0), (60.0, 30.0)])
def test_another_screen_takes_hardly_more_steps(
    settings: LensSettings, soft_picture: np.ndarray, screen_mm: tuple[float, float]
) -> None:
    """Rim slopes and piston come to rest with the map: 5 steps for the same screen as the aperture, here under 20."""
    target = target_irradiance(soft_picture[:24], viewed_from="lens")
    task = on_screen(settings, screen_mm, height_mm=10.0)
    solution = solve_transport(target, task.bench, skim_mm=0.1)
    assert solution.converged
    assert sum(level.iterations for level in solution.levels) < 20
    corners = solution.transport_map()
    assert corners.screen_mm[0, 0] == pytest.approx([10 - screen_mm[0] / 2, 5 - screen_mm[1] / 2])
    assert corners.lens_mm[-1, -1] == pytest.approx([20, 10])


@pytest.mark.parametrize("screen_mm", [(20.0, 20.0), (30.0, 15.0)])
def test_light_from_p_lands_on_q(
    settings: LensSettings, soft_picture: np.ndarray, screen_mm: tuple[float, float]
) -> None:
    """The map read off the optical path is the one that Snell's law finds on the surface, to 2 % of a pixel."""
    task = replace(on_screen(settings, screen_mm), corrections=0, vertices_per_pixel=4)
    design = design_lens(target_irradiance(soft_picture, viewed_from="lens"), task)
    p, q = design.transport_map.lens_mm[1:-1, 1:-1], design.transport_map.screen_mm[1:-1, 1:-1]
    z, zx, zy, *_ = design.heightfield.spline().jets(p[..., 0], p[..., 1])
    way_mm = (task.bench.throw_mm - z) * np.vectorize(tangent_per_slope)(zx**2 + zy**2, task.bench.refractive_index)
    landed = p + np.stack([way_mm * zx, way_mm * zy], axis=-1)
    assert np.linalg.norm(q - p, axis=-1).max() > 2
    np.testing.assert_allclose(landed, q, atol=0.02 * min(screen_mm) / 48)


def test_rim_slopes_send_light_from_frame_to_frame(settings: LensSettings) -> None:
    """s = shift / R on the frame, with R = (n H - c) / (n s_z - 1): the equation whose root is taken in closed form."""
    bench = on_screen(settings, (33.0, 14.0)).bench
    rng = np.random.default_rng(3)
    c = 38 + np.cumsum(rng.uniform(-0.05, 0.05, (9, 12)), axis=0)
    rim_x, rim_y = rim_slopes(c, bench)
    for side in (0, -1):
        for slope, edge, shift, step in (
            (rim_x[side], c[:, side], 6.5, 14 / 9),
            (rim_y[side], c[side], -3.0, 33 / 12),
        ):
            s_z = np.sqrt(1 - slope**2 - np.gradient(edge, step) ** 2)
            ray = (1.49 * 40 - edge) / (1.49 * s_z - 1)
            np.testing.assert_allclose(ray * slope, -shift if side == 0 else shift, atol=1e-9)


def test_even_light_on_a_larger_screen_starts_close_to_its_solution(settings: LensSettings) -> None:
    """The base path alone spreads the aperture over the screen, up to the lens's relief."""
    bench = on_screen(settings, (45.0, 45.0)).bench
    solution = solve_transport(np.ones((24, 24)), bench, skim_mm=0.1)
    qx, qy = bench.pixel_centres_mm(24, 24)
    base = bench.base_path_mm(qx[None, :], qy[:, None])
    np.testing.assert_allclose(np.ptp(solution.path_mm), np.ptp(base), rtol=0.15)
    assert sum(level.iterations for level in solution.levels) < 20


@hypothesis_settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), contrast=st.floats(1.0, 300.0), shape=st.sampled_from([(24, 24), (16, 37)]))
def test_random_pictures_never_fold_or_fail(seed: int, contrast: float, shape: tuple[int, int]) -> None:
    """Whatever the picture, the lens is finite, at or under the skim, and its light is all accounted for."""
    rng = np.random.default_rng(seed)
    target = target_irradiance(contrast ** rng.random(shape), viewed_from="lens")
    task = LensSettings(
        bench=Bench.centre_on(
            width_mm=20.0, height_mm=20.0 * shape[0] / shape[1], throw_mm=60.0, refractive_index=1.49
        ),
        skim_mm=0.2,
        corrections=1,
    )
    design = design_lens(target, task)
    z = design.heightfield.z_mm
    assert np.isfinite(z).all()
    assert z.max() == pytest.approx(-0.2, abs=1e-12)
    assert design.message


def test_throw_too_short_names_the_shortest(settings: LensSettings) -> None:
    picture = np.full((32, 32), 0.01)
    picture[4:12, 4:12] = 1.0
    with pytest.raises(TotalReflectionError, match="throw of 3 mm") as caught:
        design_lens(
            target_irradiance(picture, viewed_from="lens"),
            replace(settings, bench=replace(settings.bench, throw_mm=3.0)),
        )
    longer = replace(settings, bench=replace(settings.bench, throw_mm=1.2 * caught.value.shortest_throw_mm))
    assert design_lens(target_irradiance(picture, viewed_from="lens"), longer).converged


def test_the_throw_that_is_named_is_enough_for_a_large_screen(settings: LensSettings, soft_picture: np.ndarray) -> None:
    target = target_irradiance(soft_picture, viewed_from="lens")
    hall = on_screen(settings, (50.0, 50.0), throw_mm=10.0)
    with pytest.raises(TotalReflectionError) as caught:
        design_lens(target, hall)
    assert design_lens(
        target, replace(hall, bench=replace(hall.bench, throw_mm=caught.value.shortest_throw_mm))
    ).converged
    facade = on_screen(settings, (4000.0, 4000.0), throw_mm=50.0)
    with pytest.raises(TotalReflectionError, match="throw of 50 mm is too short"):
        design_lens(target, facade)


def test_a_picture_with_one_dot_says_how_far_it_got(settings: LensSettings) -> None:
    picture = np.zeros((64, 64))
    picture[20, 30] = picture[50, 40] = 1.0
    design = design_lens(target_irradiance(picture, viewed_from="lens"), settings)
    assert np.isfinite(design.heightfield.z_mm).all()
    assert "rms" in design.message


def test_a_lens_that_loses_its_light_has_not_converged(settings: LensSettings) -> None:
    """All light in one corner pixel: the map exists, but the vertices are too few and some light misses the screen."""
    picture = np.zeros((64, 64))
    picture[0, 0] = 1.0
    design = design_lens(
        target_irradiance(picture, viewed_from="lens"), replace(settings, bench=replace(settings.bench, throw_mm=34.0))
    )
    assert design.history[-1]["lost_light"] > 0.05
    assert not design.converged
    assert "misses the screen" in design.message


def test_the_best_pass_is_kept(settings: LensSettings) -> None:
    """Corrections make stripes of two pixels worse, so the lens is that of the first pass; each pass has its scores."""
    target = target_irradiance(np.tile([1.0, 1.0, 0.0, 0.0], (64, 16)), viewed_from="lens")
    design = design_lens(target, settings)
    scores = [record["psnr_db"] for record in design.history]
    assert len(scores) == 3
    assert max(scores) > scores[-1] + 0.5
    kept = simulate_caustic(design.heightfield, settings.bench, pixels=target.shape, tubes_per_cell=2)
    assert score_caustic(kept.irradiance, target).psnr_db == pytest.approx(max(scores))


def test_light_is_kept_between_levels() -> None:
    values = np.random.default_rng(0).random((48, 37))
    for shape in level_shapes((300, 37)):
        assert shape[0] >= 8
    coarse = average_boxes(values, (24, 10))
    assert coarse.mean() == pytest.approx(values.mean(), abs=1e-14)
    np.testing.assert_allclose(coarse[:, 0], values[:, :3].reshape(24, 2, 3).mean(1) @ [1, 1, 1] / 3.7
                               + values[:, 3].reshape(24, 2).mean(1) * 0.7 / 3.7)  # fmt: skip


@pytest.mark.parametrize("radius_mm", [1.0, 2.0])
def test_the_asked_ball_fits_into_the_valleys(settings: LensSettings, radius_mm: float) -> None:
    """No second derivative of the vertices above 1 / r, though the closing lets some more than its own through."""
    picture = np.zeros((64, 64))
    picture[20:44, 14:50] = 1.0
    task = replace(settings, min_radius_mm=radius_mm, corrections=1)
    lens = design_lens(target_irradiance(picture, viewed_from="lens"), task).heightfield
    for axis, spacing in ((0, lens.dy_mm), (1, lens.dx_mm)):
        assert (np.diff(lens.z_mm, 2, axis=axis) / spacing**2).max() < 1.0 / radius_mm
