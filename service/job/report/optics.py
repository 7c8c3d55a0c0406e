"""The setup sheet's part on the lens as an optical part: scores, figures of the surface, light and screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from phrases.phrase import Phrase, join
from service.job.files import table
from service.job.spec.light import describe_light, name_spectrum
from service.wording import ball, describe_misplaced, likeness_in_words, number

_SEEN_GAIN_DB = 0.5  # less is not mentioned
_STRAIGHT_MM = 0.005
_BLACK_WORTH_A_WORD = 0.002

_CURVATURES = {"half": "p50", "p90": "p90", "p999": "p99.9", "most": "p100"}  # as in report.json
_PERCENT = 0.01
_TILT_DEG = 0.5
_NOTHING_DB = 0.1


def score_rows(report: Mapping[str, Any]) -> list[tuple[Phrase, str, Phrase]]:
    """Return rows (what, figure, words), first for the perfect surface, then as milled and as finished."""
    rows: list[tuple[Phrase, str, Phrase]] = []
    parts = {
        "optics": Phrase("Lens itself"),
        "as_milled": Phrase("As milled"),
        "as_finished": Phrase("As finished"),
    }
    for key, part in parts.items():
        scores = table(report.get(key))
        if (psnr_db := scores.get("psnr_db")) is not None:
            what = Phrase("{part}: likeness (PSNR)", part=part)
            rows.append((what, f"{psnr_db:.1f} dB", likeness_in_words(scores.get("seen_db"))))
        if scores.get("ssim") is not None:
            words = Phrase("how alike small parts are; 1 is identical")
            rows.append((Phrase("{part}: structure (SSIM)", part=part), f"{scores['ssim']:.3f}", words))
        if (share := scores.get("misplaced_light")) is not None:
            what = Phrase("{part}: light in wrong places", part=part)
            rows.append((what, f"{100 * share:.2f} %", describe_misplaced(share)))
        if leak := scores.get("dark_leak"):
            what = Phrase("{part}: light where it should be dark", part=part)
            rows.append((what, f"{100 * leak:.2f} %", _leak_in_words(scores)))
    sharp = table(table(report.get("optics")).get("from_a_point_source")).get("psnr_db")
    if sharp is not None:
        words = Phrase("the lens is made for a source of this size, and best with it")
        rows.append((Phrase("Likeness (PSNR) without the size of the source"), f"{sharp:.1f} dB", words))
    return [*rows, *_rows_of_colours(table(report.get("optics")))]


def _rows_of_colours(optics: Mapping[str, Any]) -> list[tuple[Phrase, str, Phrase]]:
    """Return the light for which the scores hold; nothing for an old report that does not state it."""
    light = table(optics.get("light"))
    if not light:
        return []
    words = Phrase("the colours that all these figures hold under; others need another distance to the wall")
    if light.get("dispersion") is None:
        words = Phrase("the dispersion of the block is unknown: all colours are treated alike")
    elif light["dispersion"] == 0.0:
        words = Phrase("a mirror sends all colours the same way")
    elif (best_db := optics.get("psnr_db_one_wavelength")) is not None:
        words = Phrase(
            "the colours that all these figures hold under; at one wavelength the lens itself shows {psnr_db:.1f} dB",
            psnr_db=best_db,
        )
    return [(Phrase("Light"), name_spectrum(light.get("spectrum")), words)]


def _leak_in_words(scores: Mapping[str, Any]) -> Phrase:
    if (estimate := scores.get("dark_leak_estimate")) is None:
        return Phrase("of all light falls where the picture is black")
    if radius_mm := scores.get("min_radius_mm"):
        return Phrase(
            "of all light falls where the picture is black; valleys that a ball {size} cuts let about "
            "{share_percent:.2f} % through",
            size=ball(radius_mm),
            share_percent=100 * estimate,
        )
    return Phrase(
        "of all light falls where the picture is black; valleys as narrow as the grid allows let about "
        "{share_percent:.2f} % through",
        share_percent=100 * estimate,
    )


def lens_rows(report: Mapping[str, Any], spec: Mapping[str, Any]) -> list[tuple[Phrase, str]]:
    """Return (what, figure) rows on the surface and its design."""
    optics, wanted = table(report.get("optics")), table(spec.get("optics"))
    rows = [*_surface_rows(optics), *_rows_of_closing(table(optics.get("closing"))), *_polish_rows(optics)]
    if wanted.get("surface") == "mirror":
        words = Phrase("mirror: light comes from the wall's side and is reflected by the milled face")
        rows.append((Phrase("Kind"), words))
    elif wanted.get("refractive_index") is not None:
        rows.append((Phrase("Refractive index"), f"{wanted['refractive_index']:g}"))
    if (outline := wanted.get("outline", "rectangle")) != "rectangle":
        corners = outline if isinstance(outline, str) else Phrase("{count} corners", count=len(outline))
        rows.append((Phrase("Outline"), Phrase("ellipse") if outline == "ellipse" else corners))
    if wanted.get("method"):
        parts = [str(wanted["method"])]
        if optics.get("branch") == "inverted":
            parts.append(Phrase("rays cross before the screen"))
        ends = {"True": Phrase("converged"), "False": Phrase("NOT converged")}
        parts += filter(None, [ends.get(str(optics.get("converged")))])
        rows.append((Phrase("Method"), join(", ", parts)))
    return rows


def _surface_rows(optics: Mapping[str, Any]) -> list[tuple[Phrase, str]]:
    rows: list[tuple[Phrase, str]] = []
    if optics.get("relief_mm") is not None:
        rows.append((Phrase("Relief, highest to lowest point"), f"{optics['relief_mm']:.2f} mm"))
    if optics.get("max_slope_deg") is not None:
        rows.append((Phrase("Steepest slope"), f"{optics['max_slope_deg']:.1f}°"))
    if optics.get("min_concave_radius_mm") is not None:
        rows.append((Phrase("Largest ball that fits everywhere"), ball(round(optics["min_concave_radius_mm"], 2))))
    for share, key in (("99.9 %", "concave_radius_999_mm"), ("99 %", "concave_radius_99_mm")):
        if optics.get(key) is not None:
            fits = Phrase("{size} fits", size=ball(round(optics[key], 2)))
            rows.append((Phrase("{share} of the lens: a ball up to", share=share), fits))
    if curvature := table(optics.get("concave_curvature_per_mm")):
        figures = {name: number(curvature.get(key), 3) for name, key in _CURVATURES.items()}
        words = Phrase("half of the area up to {half}, 90 % up to {p90}, 99.9 % up to {p999}, most {most}", **figures)
        rows.append((Phrase("Hollow curvature, 1/mm"), words))
    return rows


def _rows_of_closing(closing: Mapping[str, Any]) -> list[tuple[Phrase, str]]:
    if not closing:
        return []
    lost_db = closing["psnr_db_without"] - closing["psnr_db_with"]
    parts = [Phrase("costs {lost_db:.1f} dB", lost_db=lost_db) if lost_db >= 0.05 else Phrase("costs nothing")]
    if closing["dark_leak_with"] > 0:
        leaks = " → ".join(f"{100 * closing[key]:.2f}" for key in ("dark_leak_without", "dark_leak_with"))
        parts.append(Phrase("light where it should be dark {shares} %", shares=leaks))
    return [(Phrase("Valleys filled for a ball {size}", size=ball(closing["radius_mm"])), join(", ", parts))]


def _polish_rows(optics: Mapping[str, Any]) -> list[tuple[Phrase, str]]:
    polish = table(optics.get("polish"))
    if not polish:
        return []
    gain_db = polish["psnr_db_after"] - polish["psnr_db_before"]
    words = Phrase(
        "{count} steps, +{gain_db:.1f} dB, moves the surface by {change_um} µm rms",
        count=polish["steps"],
        gain_db=gain_db,
        change_um=number(polish["change_um_rms"], 2),
    )
    if gain_db >= _SEEN_GAIN_DB:
        words = Phrase(
            "{steps}; it shows only on a surface smoothed after milling: straight from a ball R 0.5 (Ø 1 mm) at "
            "0.02 mm pitch nothing of it is left, and with scallops smoothed to a tenth about half of it",
            steps=words,
        )
    return [(Phrase("Polish"), words)]


def sentences_of_preparation(report: Mapping[str, Any]) -> list[Phrase]:
    """Return sentences on the picture's preparation for the setup sheet; empty if it was left as it is."""
    image = table(report.get("image"))
    if image.get("prepare") != "detail":
        return []
    if not image["prepared"]:
        return [
            Phrase(
                "The picture was to be prepared for what will show, but was left as it is: it has only two tones, "
                "and no contrast to bring out."
            )
        ]
    raised = Phrase(
        "The lens aims at a prepared picture: contrast is raised in what is a little larger than {detail_mm:.2g} mm, "
        "the smallest detail that is expected to show on the wall, and tones are spread where there is something to "
        "see",
        detail_mm=image["prepare_detail_mm"],
    )
    if (share := image["black_share"]) >= _BLACK_WORTH_A_WORD:
        raised = Phrase(
            "{raised}; black is kept at {share_percent:.1f} % of the mean, which valleys under the ball let through",
            raised=raised,
            share_percent=100 * share,
        )
    return [
        Phrase(
            "{raised}. The scores compare with the prepared picture, whose stronger contrast is harder to reach, "
            "so they do not measure what the preparation is worth; compared with the picture as it was given they "
            "are: {scores}. Judge the preparation by eye, side by side.",
            raised=raised,
            scores=join(", ", _scores_in_words(report)),
        )
    ]


def _scores_in_words(report: Mapping[str, Any]) -> list[Phrase]:
    parts = {
        "image": Phrase("the prepared picture itself"),
        "optics": Phrase("the lens"),
        "as_milled": Phrase("as milled"),
        "as_finished": Phrase("as finished"),
    }
    found = ((part, table(table(report.get(key)).get("against_original"))) for key, part in parts.items())
    return [
        Phrase("{part} {psnr_db:.1f} dB, SSIM {ssim:.3f}", part=part, psnr_db=score["psnr_db"], ssim=score["ssim"])
        for part, score in found
        if score
    ]


def light_sentences(spec: Mapping[str, Any]) -> list[Phrase]:
    """Return sentences on the required light, for the person who sets up the lamp."""
    optics = table(spec.get("optics"))
    light = table(optics.get("light"))
    is_mirror = optics.get("surface") == "mirror"
    sentences = [describe_light(light, is_mirror=is_mirror)]
    if (spectrum := light.get("spectrum")) is not None and not is_mirror:
        sentences.append(Phrase("The lens is made for {colours}.", colours=name_spectrum(spectrum)))
    if light.get("gaussian_mm") is not None:
        width_mm = number(light["gaussian_mm"])
        sentences.append(
            Phrase("The beam is brightest in the middle and {width_mm} mm wide (1/e²).", width_mm=width_mm)
        )
    elif light.get("profile"):
        sentences.append(
            Phrase("The light is uneven as measured (optics.light.profile); its middle is the lens's middle.")
        )
    if optics.get("outline", "rectangle") != "rectangle":
        sentences.append(
            Phrase("No light may pass beyond the outline of the lens: cut the block along it, or mask it.")
        )
    return sentences


def screen_sentence(spec: Mapping[str, Any]) -> Phrase | None:
    """Return where the picture is, if not straight before the lens."""
    optics = table(spec.get("optics"))
    aside, up = (float(optics.get(f"screen_shift_{axis}_mm") or 0.0) for axis in "xy")
    aside_mm, up_mm = number(abs(aside)), number(abs(up))
    ways = []
    if abs(aside) > _STRAIGHT_MM:
        left, right = Phrase("{mm} mm to the left", mm=aside_mm), Phrase("{mm} mm to the right", mm=aside_mm)
        ways.append(left if aside > 0 else right)
    if abs(up) > _STRAIGHT_MM:
        ways.append(Phrase("{mm} mm above", mm=up_mm) if up > 0 else Phrase("{mm} mm below", mm=up_mm))
    if not ways:
        return None
    return Phrase(
        "The middle of the picture lies {where} of the middle of the lens, for a person who looks from it to the wall.",
        where=ways[0] if len(ways) == 1 else Phrase("{first} and {second}", first=ways[0], second=ways[1]),
    )


def tolerance_sentences(tolerances: Mapping[str, Any], *, throw_mm: float) -> list[Phrase]:
    """Return sentences on distance, tilt and size of the source; empty if nothing was simulated."""
    if not tolerances:
        return []
    return [_distance(tolerances, throw_mm), *_index(tolerances), _tilt(tolerances), *_source(tolerances)]


def _distance(found: Mapping[str, Any], throw_mm: float) -> Phrase:
    near, far = found["focus_range_mm"]
    off_mm = _PERCENT * throw_mm
    worst = min(point["psnr_db"] for point in found["focus"] if abs(abs(point["offset_mm"]) - off_mm) < 1e-3 * off_mm)
    return Phrase(
        "A distance wrong by 1 % ({off_mm} mm) {costs}; 3 dB are lost when the wall is {near_mm} mm too near or "
        "{far_mm} mm too far.",
        off_mm=number(off_mm, 2),
        costs=_costs(found["psnr_db"] - worst),
        near_mm=number(-near, 2),
        far_mm=number(far, 2),
    )


def _index(found: Mapping[str, Any]) -> list[Phrase]:
    """Return how far the wall must move for a block of another index; nothing if that has no effect."""
    point = table(found.get("index"))
    if not point or (gain_db := point["psnr_db_moved"] - point["psnr_db"]) < _NOTHING_DB:
        return []
    return [
        Phrase(
            "The refractive index of a block is known to ±{spread:g} only: if the picture is unsharp, move the wall by "
            "up to {wall_mm} mm nearer or farther, which brings back up to {gain_db:.1f} dB.",
            spread=point["more_index"],
            wall_mm=number(abs(point["wall_mm"]), 2),
            gain_db=gain_db,
        )
    ]


def _tilt(found: Mapping[str, Any]) -> Phrase:
    point = min(found["tilts"], key=lambda tilt: abs(tilt["tilt_deg"] - _TILT_DEG))
    moved = (point["shift_mm"][0] ** 2 + point["shift_mm"][1] ** 2) ** 0.5
    return Phrase(
        "Light tilted by {tilt_deg}° moves the picture by {shift_mm} mm and also {costs}.",
        tilt_deg=number(point["tilt_deg"]),
        shift_mm=number(moved, 2),
        costs=_costs(found["psnr_db"] - point["psnr_db"]),
    )


def _source(found: Mapping[str, Any]) -> Sequence[Phrase]:
    sentences = []
    if found["blur_mm"] > 0:
        sentences.append(
            Phrase(
                "The source that the lens is made for spreads each point over {spread_mm} mm on the wall, {spread_px} "
                "pixels.",
                spread_mm=number(found["blur_mm"], 2),
                spread_px=number(found["blur_px"], 1),
            )
        )
    for point in found["sources"]:
        if found["blur_mm"] == 0 and abs(point["size_deg"] - 0.53) < 1e-9:
            sentences.append(
                Phrase(
                    "The sun's disc (0.53°) would spread each point over {spread_mm} mm, {spread_px} pixels, and leave "
                    "{psnr_db:.0f} dB; a small lamp far away is sharper.",
                    spread_mm=number(point["diameter_mm"], 2),
                    spread_px=number(point["diameter_px"], 1),
                    psnr_db=point["psnr_db"],
                )
            )
    return sentences


def _costs(lost_db: float) -> Phrase:
    if lost_db < _NOTHING_DB:
        return Phrase("costs next to nothing")
    return Phrase("costs {lost_db:.1f} dB", lost_db=lost_db)
