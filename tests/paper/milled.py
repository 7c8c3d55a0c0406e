"""Figure 15: the light of the surface that the ball really leaves: blurred across the rows, sharper, striped."""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cam.as_milled.rows import tip_error_mm
from cam.as_milled.surface import MilledSurface
from cam.as_milled.tracks import Noise
from optics.metrics import CausticScore, score_caustic
from optics.milled import simulate_milled
from optics.milled_blur import Deviations, deviations
from tests.cam.programs import row_tracks
from tests.paper import figures
from tests.paper.cases import by_transport, setting, target
from tests.paper.section import Section, Sizes

PICTURE = "camera"
RADIUS_MM = 0.5
CASES = (  # caption, pitch, sigma of the rows' heights [mm]
    ("(a) pitch 0.02 mm", 0.02, 0.0),
    ("(b) pitch 0.005 mm", 0.005, 0.0),
    ("(c) 0.02 mm, rows off by 0.5 µm", 0.02, 0.0005),
)
PART = (0.18, 0.48, 0.33, 0.63)  # top, bottom, left, right


class Milled(NamedTuple):
    light: np.ndarray
    score: CausticScore
    found: Deviations
    chords: int
    cpu_s: float


@cache
def milled(pixels: int, side_mm: float, pitch_mm: float, noise_mm: float) -> Milled:
    """The whole part, rows along x."""
    lens, bench = by_transport(PICTURE, pixels, side_mm).heightfield, setting(side_mm).bench
    started = time.process_time()
    tracks = row_tracks(lens, radius_mm=RADIUS_MM, pitch_mm=pitch_mm).run_on_mill(noise=Noise(sigma_mm=noise_mm))
    surface = MilledSurface.of_tracks(
        [tracks],
        lens,
        pitch_mm=pitch_mm,
        error_mm=tip_error_mm(step_mm=0.0, z_noise_mm=noise_mm),
    )
    del tracks
    light = simulate_milled(surface.part, surface.parts, lens, bench, pixels=(pixels, pixels)).irradiance
    parts = [surface.part(k) for k in np.linspace(0, surface.parts - 1, 16).astype(int)]
    return Milled(
        light=light,
        score=score_caustic(light, target(PICTURE, pixels)),
        found=deviations(parts, lens, bench, (pixels, pixels)),
        chords=int(surface.chords.joined.sum()),
        cpu_s=time.process_time() - started,
    )


def figure_15(sizes: Sizes, folder: Path) -> Section:
    n, side_mm = sizes.main, sizes.milled_mm
    wanted, design = target(PICTURE, n), by_transport(PICTURE, n, side_mm)
    peak, seen = wanted.max(), [milled(n, side_mm, pitch, noise) for _, pitch, noise in CASES]
    shown = [("as designed", design.light), *((case[0], one.light) for case, one in zip(CASES, seen, strict=True))]
    figures.panels(
        folder / "figure-15.jpg",
        [
            [(caption, figures.picture(light, peak)) for caption, light in shown],
            [("", figures.picture(light, peak, part=PART)) for _, light in shown],
        ],
    )
    rows = [f"| as designed | {design.score.psnr_db:.1f} dB | {design.score.ssim:.3f} | - | - | - |"]
    rows += [
        f"| {case[0]} | {one.score.psnr_db:.1f} dB | {one.score.ssim:.3f} | {one.found.slope_mrad:.1f} mrad | "
        f"{one.found.blur_px:.2f} px | {one.chords / 1e6:.1f} M, {one.cpu_s:.0f} s |"
        for case, one in zip(CASES, seen, strict=True)
    ]
    table = "\n".join(rows)
    coarse, fine, noisy = seen
    return Section(
        f"15 | grooves of a 0.5 mm ball blur; a pitch of 0.005 mm blurs far less; deviations in z make stripes | blur "
        f"{coarse.found.blur_px:.1f} px, {fine.found.blur_px:.1f} px; SSIM {coarse.score.ssim:.2f}, "
        f"{fine.score.ssim:.2f}, with deviations {noisy.score.ssim:.2f}",
        f"""## Figure 15: the light of the milled surface

*Claim*: a ball of 0.5 mm radius at a pitch of 0.02 mm leaves bumps that blur the caustic; 0.005 mm "can significantly
reduce this blurriness"; deviations in z, modelled as white noise, make "similar striped artifacts" as their blocks
show. *Ours*, {n} x {n}, the whole {side_mm:g} x {side_mm:g} mm: every groove of the rows that a program has (along the
picture's width), heights in hundredths of a micrometre as written, each facet's light followed exactly. The paper does
not say how large its deviations are; 0.5 µm, one error per row, is our guess for a stiff mill.

![Figure 15](paper/figure-15.jpg)

| | PSNR | SSIM | slope error, rms | blur, rms | moves, CPU |
|---|---|---|---|---|---|
{table}

The blur is across the rows only, pitch / 2R = 20 mrad to either side in (a), which is a millimetre on the wall.
""",
    )
