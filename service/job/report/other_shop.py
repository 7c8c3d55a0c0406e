"""The setup sheet's part for another shop, which mills the lens from the STEP file with programs of its own: what it
must hold, and why. From spec.json and report.json.

A lens turns a slope that is wrong by s into a shift of (n - 1) s throw on the wall, a mirror into 2 s throw. Half a
pixel is allowed. A wave of length l and height a (from trough to crest) has slopes up to pi a / l. Roughness scatters
the variance of the phase that it adds, (2 pi (n - 1) sigma / wavelength)^2 for a lens and (4 pi sigma / wavelength)^2
for a mirror (Bennett and Porteus 1961): 1 % is allowed, at 550 nm.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import pi, sqrt
from typing import Any

from phrases.phrase import Phrase
from service.job.files import PACKED_STEP, STEP, table
from service.wording import ball, number

_PIXELS_ASTRAY = 0.5
_SCATTERED = 0.01
_WAVELENGTH_NM = 550.0
_WAVES_MM = (1.0, 10.0)
_LEAST_MM = 0.05


def rows_for_another_shop(
    spec: Mapping[str, Any], report: Mapping[str, Any], files: frozenset[str]
) -> list[tuple[Phrase, Phrase]]:
    """Return (property, figure in words); none if the job has no STEP file."""
    optics, stock, image = (table(spec.get(part)) for part in ("optics", "stock", "image"))
    if not {STEP, PACKED_STEP} & files or not optics.get("throw_mm"):
        return []
    throw_mm, width_mm = optics["throw_mm"], optics.get("screen_width_mm") or optics["width_mm"]
    mirrors = optics.get("surface") == "mirror"
    turned = 2.0 if mirrors else optics["refractive_index"] - 1.0
    slope_rad = _PIXELS_ASTRAY * width_mm / image["pixels"] / (turned * throw_mm)
    roughness_nm = sqrt(_SCATTERED) * _WAVELENGTH_NM / (2 * pi * turned)
    waves = [(length_mm, 1000 * slope_rad * length_mm / pi) for length_mm in _WAVES_MM]
    rows = [
        (
            Phrase("File"),
            Phrase(
                "{name}, mm, origin at the lower left corner of the lens, Z0 {skim_mm:g} mm above its highest point; "
                "sides upright, without the margin",
                name=STEP if STEP in files else Phrase("{packed}, a ZIP of {name}", packed=PACKED_STEP, name=STEP),
                skim_mm=stock.get("skim_mm", 0.0),
            ),
        ),
        (
            Phrase("Tolerance of the milled face"),
            Phrase(
                "slopes within {slope_mrad:.2g} µm per mm ({slope_mrad:.2g} mrad): light then goes astray by half a "
                "pixel. So waves of {short:g} mm may be {short_um:.2g} µm high, waves of {long:g} mm {long_um:.2g} µm; "
                "its place as a whole, {place_mm:.2g} mm",
                slope_mrad=1000 * slope_rad,
                short=waves[0][0],
                short_um=waves[0][1],
                long=waves[1][0],
                long_um=waves[1][1],
                place_mm=max(_LEAST_MM, _PIXELS_ASTRAY * width_mm / image["pixels"]),
            ),
        ),
        (
            Phrase("Finish of the milled face"),
            Phrase(
                "bright, roughness (Rq) at most {roughness_nm:.2g} nm, which scatters 1 % of the light; no rounding of "
                "the pattern by the polish",
                roughness_nm=roughness_nm,
            )
            if mirrors
            else Phrase(
                "clear, roughness (Rq) at most {roughness_nm:.2g} nm on both faces, which scatters 1 % of the light; "
                "no rounding of the pattern by the polish",
                roughness_nm=roughness_nm,
            ),
        ),
    ]
    if radius_mm := table(report.get("optics")).get("min_radius_mm"):
        rows.append((Phrase("Cutter of the last pass"), Phrase("at most {size}", size=ball(radius_mm))))
    height_mm = optics.get("screen_height_mm") or width_mm * optics["height_mm"] / optics["width_mm"]
    wall = Phrase(
        "flat, {throw_mm:g} mm from Z0, parallel to the back; the picture is {width} × {height} mm",
        throw_mm=throw_mm,
        width=number(width_mm, 1),
        height=number(height_mm, 1),
    )
    return [*rows, (Phrase("Wall that the picture falls on"), wall)]
