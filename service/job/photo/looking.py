"""Evaluates a photograph of the wall: registers, fits, judges and draws it. It is compared with a job's lens, its
set-up, and the best picture of the light in its folder.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.heightfield import Heightfield
from optics.irradiance import ViewedFrom, flip_between_picture_and_work_frame, picture_from_irradiance
from optics.photograph import Registration, register
from optics.photograph.rays import ORDERS
from optics.photograph.views import area_average
from optics.photograph.wall import Estimate, WallFit, fit_wall, surface_error_um
from optics.spline import Array
from phrases.phrase import Phrase
from service.errors import InputError, printable
from service.job import arrays
from service.job.files import HEIGHTFIELD, MAP, plain
from service.job.photo.findings import PhotoFinding, UselessPhotoError
from service.job.picture.linear_light import srgb_to_linear
from service.job.picture.reading import WallPhoto, read_wall_photo
from service.job.report.pictures import PREDICTED, PredictedKind
from service.job.spec.lens_task import bench_of
from service.job.spec.loading import load_stored_spec
from service.progress import QuietReporter, Reporter, Stopwatch

LOOK_PICTURE, LOOK_FIGURES = "look.png", "look.json"
LEAST_ALIKE = 0.62  # other pictures reach 0.56, the right one behind a coarse mill 0.68
_LEAST_PEAK, _DARK_PEAK = 0.004, 0.05  # of white, in linear light
_MOST_CLIPPED, _SOME_CLIPPED = 0.75, 0.05
_LEAST_SEEN = 0.85
_LEAST_ACROSS_PX = 64.0
_ODD_TONE = 0.15
_TURNED_DEG, _LEANT_DEG = 0.3, 0.5
_SURE, _SURER, _SUREST = 2.0, 3.0, 4.0  # deviations from zero: of a distance, a tilt, one of many surface errors
_CAMERA_PX = 1.2  # pixels of the photograph: the camera's own blur


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictedLight:
    """irradiance (ny, nx): work frame, mean about 1; NaN where its file is clipped at white."""

    kind: PredictedKind
    lens: Heightfield
    bench: Bench
    irradiance: Array
    viewed_from: ViewedFrom

    @property
    def bounded(self) -> Array:
        """The irradiance, with the brightest known value in place of brighter ones."""
        return np.nan_to_num(self.irradiance, nan=float(np.nanmax(self.irradiance)))


def load_predicted_light(folder: Path) -> PredictedLight:
    """Load the predicted light of a job that has a lens; InputError if it has none, or another program's files."""
    if not folder.is_dir():
        raise InputError(f"--job: {folder} is no folder; allowed: the folder of an earlier design or make")
    spec = load_stored_spec(folder)
    lens = arrays.load_heightfield(folder / HEIGHTFIELD)
    target = arrays.load_target(folder / MAP)
    bench, viewed_from = bench_of(spec), spec.optics.viewed_from
    for kind, name in PREDICTED.items():
        seen = _picture(folder / name, target)
        if seen is not None:
            irradiance = flip_between_picture_and_work_frame(seen, viewed_from)
            return PredictedLight(kind=kind, lens=lens, bench=bench, irradiance=irradiance, viewed_from=viewed_from)
    light = simulate_caustic(lens, bench, pixels=(target.shape[0], target.shape[1])).irradiance
    return PredictedLight(kind="designed", lens=lens, bench=bench, irradiance=light, viewed_from=viewed_from)


def _picture(path: Path, target: Array) -> Array | None:
    """Return the irradiance of one of our pictures, whose white is the target's brightest pixel, or None."""
    try:
        with Image.open(path, formats=("PNG",)) as image:
            levels = np.asarray(image.convert("L"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, SyntaxError):
        words = Phrase("{path}: not a picture of this program; `causticmill make` writes a new one", path=path)
        raise InputError(words) from None
    if levels.shape != target.shape:
        return None
    linear = srgb_to_linear(levels / 255.0) * float(target.max())
    return np.where(levels == 255, np.nan, linear)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """findings in the order in which a person acts; figures: what look.json holds; pictures as the viewer sees them.

    rectified, predicted (ny, nx) : irradiance, row 0 on top; NaN where the photograph shows nothing or is clipped
    """

    findings: tuple[PhotoFinding, ...]
    figures: dict[str, Any]
    rectified: Array
    predicted: Array

    def png(self, *, with_words: bool = True) -> bytes:
        """Draw photograph, prediction, difference, and the findings in words."""
        from service.job.report.figures.photographs import look_png  # its dependencies are slow to import

        sentences = [one.sentence() for one in self.findings] if with_words else []
        return look_png(self.rectified, self.predicted, sentences)


def look_at(
    photo: WallPhoto,
    predicted: PredictedLight,
    *,
    name: str,
    picture_width_mm: float | None = None,
    reporter: Reporter | None = None,
) -> Look:
    """Compare a photograph with the prediction. UselessPhotoError, with the photograph's `name`, if it is of no use.

    picture_width_mm : width of the lit rectangle on the wall, if it was measured
    """
    watch = Stopwatch(reporter or QuietReporter())
    with watch.stage("finding the picture"):
        place = _register(photo, predicted, name)
    with watch.stage("fitting the wall") as on_progress:
        fit = fit_wall(
            photo.light,
            place,
            predicted.lens,
            predicted.bench,
            predicted.irradiance,
            viewed_from=predicted.viewed_from,
            picture_width_mm=picture_width_mm,
            on_progress=on_progress,
        )
    findings = tuple(_findings(photo, predicted, place, fit))

    def show(light: Array) -> Array:
        return picture_from_irradiance(light, viewed_from=predicted.viewed_from)

    return Look(
        findings=findings,
        figures=_figures(photo, predicted, place, fit, findings, name),
        rectified=show(np.where(place.usable, place.rectified, np.nan)),
        predicted=show(predicted.bounded),
    )


def _register(photo: WallPhoto, predicted: PredictedLight, name: str) -> Registration:
    peak = _peak(photo)
    if 0.0 < peak < _LEAST_PEAK:
        raise _refusal(name, "too_dark", peak_percent=100 * peak, least_percent=100 * _LEAST_PEAK)
    if peak == 0.0 or min(photo.light.shape) < 8:
        raise _refusal(name, "no_light")
    place = register(photo.light, predicted.bounded, viewed_from=predicted.viewed_from, fit_tone=True)
    if place.clipped_share > _MOST_CLIPPED:
        clipped, most = 100 * place.clipped_share, 100 * _MOST_CLIPPED
        raise _refusal(name, "too_bright", clipped_percent=clipped, most_percent=most)
    if place.likeness < LEAST_ALIKE:
        raise _refusal(name, "not_this_lens", likeness=place.likeness, least=LEAST_ALIKE)
    if place.overlap < _LEAST_SEEN:
        raise _refusal(name, "cut_off", seen_percent=100 * place.overlap, least_percent=100 * _LEAST_SEEN)
    across = place.pixels_per_pixel * max(predicted.irradiance.shape)
    if across < _LEAST_ACROSS_PX:
        raise _refusal(name, "too_small", across_px=across, least_px=_LEAST_ACROSS_PX)
    return place


def _refusal(name: str, code: str, **values: float) -> UselessPhotoError:
    return UselessPhotoError(name, PhotoFinding(code, values))


def _peak(photo: WallPhoto) -> float:
    """Return the excess brightness of the brightest thousandth over the dark, without its noise."""
    share = min(1.0, 200 / max(photo.light.shape))
    shape = max(1, round(photo.light.shape[0] * share)), max(1, round(photo.light.shape[1] * share))
    dark, bright = np.quantile(area_average(photo.light, shape), (0.05, 0.999))
    return float(bright - dark)


def _findings(photo: WallPhoto, predicted: PredictedLight, place: Registration, fit: WallFit) -> list[PhotoFinding]:
    found = []
    if place.mirrored:
        found.append(PhotoFinding("mirrored", {"viewed_from": predicted.viewed_from}))
    found.append(_distance(predicted, fit.throw_mm))
    found += _find_tilt("wall_tilted", fit.wall_tilt_rad, predicted)
    found += _find_tilt("light_aslant", fit.light_tilt_rad, predicted)
    deg = _turn_deg(place)
    if abs(deg) > _TURNED_DEG:
        found.append(PhotoFinding("turned", {"deg": deg}))
    found.append(_softness(predicted, place, fit))
    found.append(_surface(predicted, fit))
    if place.clipped_share > _SOME_CLIPPED:
        found.append(PhotoFinding("partly_clipped", {"clipped_percent": 100 * place.clipped_share}))
    if _peak(photo) < _DARK_PEAK:
        found.append(PhotoFinding("rather_dark"))
    if abs(place.tone - 1.0) > _ODD_TONE:
        found.append(PhotoFinding("odd_tones", {"tone": place.tone}))
    return found


def _distance(predicted: PredictedLight, throw: Estimate) -> PhotoFinding:
    within = 2 * throw.deviation
    if throw.exceeds(_SURE):
        code = "wall_too_far" if throw.value > 0 else "wall_too_near"
        return PhotoFinding(code, {"mm": abs(throw.value), "deviation_mm": throw.deviation})
    if throw.is_determined:
        return PhotoFinding("wall_in_place", {"within_mm": max(within, abs(throw.value))})
    return PhotoFinding("wall_unknown", {"within_mm": within, "throw_mm": predicted.bench.throw_mm})


def _find_tilt(code: str, angles: tuple[Estimate, Estimate], predicted: PredictedLight) -> list[PhotoFinding]:
    """Return one finding for both directions if one of them is certain and large enough to act on."""
    sure = [one.exceeds(_SURER) and abs(math.degrees(one.value)) > _LEANT_DEG for one in angles]
    if not any(sure):
        return []
    left = predicted.viewed_from == "lens"  # a viewer who looks along the light has +X on the left
    words = (("left", "right") if left else ("right", "left")), ("top", "bottom")
    sides = [pair[0 if one.value > 0 else 1] for pair, one, counts in zip(words, angles, sure, strict=True) if counts]
    total = math.degrees(math.hypot(*(one.value for one, counts in zip(angles, sure, strict=True) if counts)))
    deviation = math.degrees(math.hypot(*(one.deviation for one, counts in zip(angles, sure, strict=True) if counts)))
    return [PhotoFinding(code, {"deg": total, "deviation_deg": deviation, "sides": sides})]


def _turn_deg(place: Registration) -> float:
    """Return the turn beyond the nearest quarter turn, by which the camera was held."""
    deg = math.degrees(place.rotation_rad)
    return deg - 90.0 * round(deg / 90.0)


def _softness(predicted: PredictedLight, place: Registration, fit: WallFit) -> PhotoFinding:
    pixel_mm = predicted.bench.screen.width_mm / predicted.irradiance.shape[1]
    unsure_mm = max(0.5 * pixel_mm, _CAMERA_PX / place.pixels_per_pixel * pixel_mm, 0.3 * fit.predicted_blur_mm)
    values = {"foretold": predicted.kind, "mm": abs(fit.blur_mm), "foretold_mm": fit.predicted_blur_mm}
    if fit.blur_mm > unsure_mm:
        source_deg = math.degrees(4.0 * fit.blur_mm / predicted.bench.throw_mm)  # a disc is four deviations wide
        return PhotoFinding("softer", {**values, "source_deg": source_deg})
    if fit.blur_mm < -unsure_mm:
        return PhotoFinding("sharper", values)
    return PhotoFinding("as_soft_as_foretold", {"foretold": predicted.kind})


def _surface(predicted: PredictedLight, fit: WallFit) -> PhotoFinding:
    determined = [one for one in fit.surface_um if one.is_determined]
    if not determined:
        return PhotoFinding("surface_unknown")
    sure = [(order, one) for order, one in zip(ORDERS, fit.surface_um, strict=True) if one.exceeds(_SUREST)]
    if not sure:
        return PhotoFinding("surface_right", {"within_um": max(2 * one.deviation for one in determined)})
    sign = -1 if predicted.viewed_from == "lens" else 1  # left and right as the viewer sees them
    rows = [
        {"order_x": a, "order_y": b, "um": one.value * sign**a, "deviation_um": one.deviation}
        for (a, b), one in sorted(sure, key=lambda row: -abs(row[1].value))
    ]
    return PhotoFinding(
        code="surface_off", values={"peak_to_valley_um": _peak_to_valley(predicted, fit, _SUREST), "terms": rows}
    )


def _peak_to_valley(predicted: PredictedLight, fit: WallFit, deviations: float) -> float:
    shape = predicted.lens.height_mm / predicted.lens.width_mm
    x, y = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41))
    return float(np.ptp(surface_error_um(fit.surface_um, x, y, shape, deviations=deviations)))


def _figures(
    photo: WallPhoto,
    predicted: PredictedLight,
    place: Registration,
    fit: WallFit,
    findings: tuple[PhotoFinding, ...],
    name: str,
) -> dict[str, Any]:
    def degrees_of(one: Estimate) -> dict[str, Any]:
        return {"deg": math.degrees(one.value), "deviation_deg": math.degrees(one.deviation), "told": one.is_determined}

    throw = fit.throw_mm
    return plain(
        {
            "photo": {"name": name, "width": photo.width, "height": photo.height},
            "foretold": predicted.kind,
            "place": {
                "homography": place.homography.tolist(),
                "photo_width": photo.light.shape[1],
                "photo_height": photo.light.shape[0],
                "turned_deg": _turn_deg(place),
                "quarter_turns": round(math.degrees(place.rotation_rad) / 90.0) % 4,
                "mirrored": place.mirrored,
                "correlation": place.correlation,
                "likeness": place.likeness,
                "confidence": place.confidence,
                "overlap": place.overlap,
                "clipped_share": place.clipped_share,
                "tone": place.tone,
            },
            "wall": {
                "throw_off_mm": throw.value,
                "throw_deviation_mm": throw.deviation,
                "throw_told": throw.is_determined,
                "tilt_x": degrees_of(fit.wall_tilt_rad[0]),
                "tilt_y": degrees_of(fit.wall_tilt_rad[1]),
            },
            "light": {"aslant_x": degrees_of(fit.light_tilt_rad[0]), "aslant_y": degrees_of(fit.light_tilt_rad[1])},
            "blur": {"beyond_foretold_mm": fit.blur_mm, "foretold_mm": fit.predicted_blur_mm},
            "surface": {
                "peak_to_valley_um": _peak_to_valley(predicted, fit, 0.0),
                "terms": [
                    {
                        "order_x": a,
                        "order_y": b,
                        "um": one.value,
                        "deviation_um": one.deviation,
                        "told": one.is_determined,
                    }
                    for (a, b), one in zip(ORDERS, fit.surface_um, strict=True)
                ],
            },
            "likeness": {"as_foretold": fit.before, "as_fitted": fit.correlation},
            "findings": [one.plain() for one in findings],
        }
    )


def look_at_photo(
    path: Path, job: Path, *, picture_width_mm: float | None = None, reporter: Reporter | None = None
) -> Look:
    """Evaluate the photograph in a file, of the lens of the job in a folder."""
    watch = Stopwatch(reporter or QuietReporter())
    with watch.stage("reading"):
        photo, predicted = read_wall_photo(path), load_predicted_light(job)
    return look_at(photo, predicted, name=printable(str(path)), picture_width_mm=picture_width_mm, reporter=reporter)
