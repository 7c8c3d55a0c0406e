"""What the setup sheet says of the lens as an optical part: scores, figures of the surface, light and screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from service.job.finite_json import table
from service.job.spec.light import describe_light
from service.wording import ball, number, psnr_in_words, word_misplaced

_SEEN_GAIN_DB = 0.5  # less is not worth a word
_STRAIGHT_MM = 0.005
_BLACK_WORTH_A_WORD = 0.002
_MILLED_AWAY = (
    "it shows only on a surface smoothed after milling: straight from a ball R 0.5 (Ø 1 mm) at 0.02 mm pitch nothing "
    "of it is left, with scallops smoothed to a tenth about half"
)

_PERCENT = 0.01
_TILT_DEG = 0.5
_NOTHING_DB = 0.1


def score_rows(report: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return (what, figure, in words), first for the perfect surface, then as milled and as finished."""
    rows = []
    for key, prefix in (("optics", "Lens itself"), ("as_milled", "As milled"), ("as_finished", "As finished")):
        scores = table(report.get(key))
        if (psnr_db := scores.get("psnr_db")) is not None:
            rows.append((f"{prefix}: likeness (PSNR)", f"{psnr_db:.1f} dB", psnr_in_words(psnr_db)))
        if scores.get("ssim") is not None:
            words = "how alike small parts are; 1 is identical"
            rows.append((f"{prefix}: structure (SSIM)", f"{scores['ssim']:.3f}", words))
        if (share := scores.get("misplaced_light")) is not None:
            rows.append((f"{prefix}: light in wrong places", f"{100 * share:.2f} %", word_misplaced(share)))
        if leak := scores.get("dark_leak"):
            rows.append((f"{prefix}: light where it is to be dark", f"{100 * leak:.2f} %", _leak_in_words(scores)))
    sharp = table(table(report.get("optics")).get("from_a_point_source")).get("psnr_db")
    if sharp is not None:
        rows.append(
            (
                "Likeness (PSNR) without the size of the source",
                f"{sharp:.1f} dB",
                "the lens is made for a source of this size, and best with it",
            )
        )
    return rows


def _leak_in_words(scores: Mapping[str, Any]) -> str:
    words = "of all light falls where the picture is black"
    if (estimate := scores.get("dark_leak_estimate")) is None:
        return words
    radius = scores.get("min_radius_mm") or 0.0
    valleys = f"valleys that a ball {ball(radius)} cuts" if radius else "valleys as narrow as the grid allows"
    return f"{words}; {valleys} let about {100 * estimate:.2f} % through"


def lens_rows(report: Mapping[str, Any], spec: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return (what, figure) of the surface and how it came about."""
    optics, wanted = table(report.get("optics")), table(spec.get("optics"))
    rows = [*_surface_rows(optics), *_rows_of_closing(table(optics.get("closing"))), *_polish_rows(optics)]
    if wanted.get("surface") == "mirror":
        rows.append(("Kind", "mirror: light comes from the wall's side and is reflected by the milled face"))
    elif wanted.get("refractive_index") is not None:
        rows.append(("Refractive index", f"{wanted['refractive_index']:g}"))
    if wanted.get("outline", "rectangle") != "rectangle":
        outline = wanted["outline"]
        rows.append(("Outline", outline if isinstance(outline, str) else f"{len(outline)} corners"))
    if wanted.get("method"):
        converged = {"True": ", converged", "False": ", NOT converged"}.get(str(optics.get("converged")), "")
        crossing = ", rays cross before the screen" if optics.get("branch") == "inverted" else ""
        rows.append(("Method", f"{wanted['method']}{crossing}{converged}"))
    return rows


def _surface_rows(optics: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = []
    if optics.get("relief_mm") is not None:
        rows.append(("Relief, highest to lowest point", f"{optics['relief_mm']:.2f} mm"))
    if optics.get("max_slope_deg") is not None:
        rows.append(("Steepest slope", f"{optics['max_slope_deg']:.1f}°"))
    if optics.get("min_concave_radius_mm") is not None:
        rows.append(("Largest ball that fits everywhere", ball(round(optics["min_concave_radius_mm"], 2))))
    for share, key in (("99.9 %", "concave_radius_999_mm"), ("99 %", "concave_radius_99_mm")):
        if optics.get(key) is not None:
            rows.append((f"{share} of the lens: a ball up to", f"{ball(round(optics[key], 2))} fits"))
    curvature = table(optics.get("concave_curvature_per_mm"))
    if curvature:
        told = (("half of the area", "p50"), ("90 %", "p90"), ("99.9 %", "p99.9"))
        words = ", ".join(f"{name} up to {number(curvature.get(key), 3)}" for name, key in told)
        rows.append(("Hollow curvature, 1/mm", f"{words}, most {number(curvature.get('p100'), 3)}"))
    return rows


def _rows_of_closing(closing: Mapping[str, Any]) -> list[tuple[str, str]]:
    if not closing:
        return []
    lost = closing["psnr_db_without"] - closing["psnr_db_with"]
    words = f"costs {lost:.1f} dB" if lost >= 0.05 else "costs nothing"
    if closing["dark_leak_with"] > 0:
        leaks = " → ".join(f"{100 * closing[key]:.2f}" for key in ("dark_leak_without", "dark_leak_with"))
        words += f", light where it is to be dark {leaks} %"
    return [(f"Valleys filled for a ball {ball(closing['radius_mm'])}", words)]


def _polish_rows(optics: Mapping[str, Any]) -> list[tuple[str, str]]:
    polish = table(optics.get("polish"))
    if not polish:
        return []
    gain = polish["psnr_db_after"] - polish["psnr_db_before"]
    words = f"{polish['steps']} steps, +{gain:.1f} dB, moves the surface by {number(polish['change_um_rms'], 2)} µm rms"
    return [("Polish", f"{words}; {_MILLED_AWAY}" if gain >= _SEEN_GAIN_DB else words)]


def sentences_of_preparation(report: Mapping[str, Any]) -> list[str]:
    """Return what was done to the picture, for the setup sheet; empty where it was to stay as it is."""
    image = table(report.get("image"))
    if image.get("prepare") != "detail":
        return []
    detail = f"{image['prepare_detail_mm']:.2g} mm"
    if not image["prepared"]:
        return [
            "The picture was to be prepared for what will show, and was left as it is: it has two tones only, and no "
            "contrast to bring out."
        ]
    share, black = image["black_share"], ""
    if share >= _BLACK_WORTH_A_WORD:
        black = f"; black is kept at {100 * share:.1f} % of the mean, which valleys under the ball let through"
    return [
        f"The lens aims at a prepared picture: contrast is raised in what is a little larger than {detail}, the "
        "smallest detail that is expected to show on the wall, and tones are spread where there is something to see"
        f"{black}. Scores are against the prepared picture, whose stronger contrast asks for more, so that they are no "
        "measure of what the preparation is worth; against the picture as it was given they are: "
        f"{', '.join(_scores_in_words(report))}. What it is worth, eyes must tell, side by side."
    ]


def _scores_in_words(report: Mapping[str, Any]) -> list[str]:
    parts = (
        ("image", "the prepared picture itself"),
        ("optics", "the lens"),
        ("as_milled", "as milled"),
        ("as_finished", "as finished"),
    )
    found = ((words, table(table(report.get(key)).get("against_original"))) for key, words in parts)
    return [f"{words} {score['psnr_db']:.1f} dB, SSIM {score['ssim']:.3f}" for words, score in found if score]


def light_sentences(spec: Mapping[str, Any]) -> list[str]:
    """Return what the light must be like, for the person who sets up the lamp."""
    optics = table(spec.get("optics"))
    light = table(optics.get("light"))
    is_mirror = optics.get("surface") == "mirror"
    sentences = [describe_light(light, is_mirror=is_mirror)]
    if light.get("gaussian_mm") is not None:
        sentences.append(f"The beam is brightest in the middle and {number(light['gaussian_mm'])} mm wide (1/e²).")
    elif light.get("profile"):
        sentences.append("The light is uneven as measured (optics.light.profile); its middle is the lens's middle.")
    if optics.get("outline", "rectangle") != "rectangle":
        sentences.append("Light beyond the outline of the lens must not pass: cut the block along it, or mask it.")
    return sentences


def screen_sentence(spec: Mapping[str, Any]) -> str | None:
    """Return where the picture is, if not straight before the lens."""
    optics = table(spec.get("optics"))
    aside, up = float(optics.get("screen_shift_x_mm") or 0.0), float(optics.get("screen_shift_y_mm") or 0.0)
    ways = []
    if abs(aside) > _STRAIGHT_MM:
        ways.append(f"{number(abs(aside))} mm to the {'left' if aside > 0 else 'right'}")
    if abs(up) > _STRAIGHT_MM:
        ways.append(f"{number(abs(up))} mm {'above' if up > 0 else 'below'}")
    if not ways:
        return None
    where = " and ".join(ways)
    return (
        f"The middle of the picture lies {where} of the middle of the lens, for a person who looks from it to the wall."
    )


def tolerance_sentences(tolerances: Mapping[str, Any], *, throw_mm: float) -> list[str]:
    """Return sentences on distance, tilt and size of the source; empty where nothing was simulated."""
    if not tolerances:
        return []
    return [_distance(tolerances, throw_mm), _tilt(tolerances), *_source(tolerances)]


def _distance(found: Mapping[str, Any], throw_mm: float) -> str:
    near, far = found["focus_range_mm"]
    off_mm = _PERCENT * throw_mm
    worst = min(point["psnr_db"] for point in found["focus"] if abs(abs(point["offset_mm"]) - off_mm) < 1e-3 * off_mm)
    return (
        f"A distance wrong by 1 % ({number(off_mm, 2)} mm) {_costs(found['psnr_db'] - worst)}; 3 dB are lost when the "
        f"wall is {number(-near, 2)} mm too near or {number(far, 2)} mm too far."
    )


def _tilt(found: Mapping[str, Any]) -> str:
    point = min(found["tilts"], key=lambda tilt: abs(tilt["tilt_deg"] - _TILT_DEG))
    moved = (point["shift_mm"][0] ** 2 + point["shift_mm"][1] ** 2) ** 0.5
    return (
        f"Light that comes {number(point['tilt_deg'])}° aslant moves the picture by {number(moved, 2)} mm and "
        f"{_costs(found['psnr_db'] - point['psnr_db'])} beside that."
    )


def _source(found: Mapping[str, Any]) -> Sequence[str]:
    sentences = []
    if found["blur_mm"] > 0:
        sentences.append(
            f"The source that the lens is made for spreads each point over {number(found['blur_mm'], 2)} mm on the "
            f"wall, {number(found['blur_px'], 1)} pixels."
        )
    for point in found["sources"]:
        if found["blur_mm"] == 0 and abs(point["size_deg"] - 0.53) < 1e-9:
            sentences.append(
                f"The sun's disc (0.53°) would spread each point over {number(point['diameter_mm'], 2)} mm, "
                f"{number(point['diameter_px'], 1)} pixels, and leave {point['psnr_db']:.0f} dB; a small lamp far away "
                f"is sharper."
            )
    return sentences


def _costs(lost_db: float) -> str:
    return f"costs {lost_db:.1f} dB" if lost_db >= _NOTHING_DB else "costs next to nothing"
