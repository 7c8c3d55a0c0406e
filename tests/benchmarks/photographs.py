"""Pictures that no setting was chosen by: all that scikit-image and matplotlib bundle, and our own drawings.

Middle square, area averaged (interpolated where smaller: said), pixel values taken as linear light like every figure of
`quality`; beside it the picture read as sRGB, which is darker and harder, as a job does by default.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import skimage
from PIL import Image

from optics.irradiance import target_irradiance
from tests.benchmarks.pictures import EXAMPLES, PAPER_SETTING
from tests.benchmarks.scoring import designed
from tests.benchmarks.timing import Figure

_TUNED_ON = ("camera", "astronaut", "logo")  # in `quality`
_NO_PICTURE = ("chessboard_RGB", "Minduka_Present_Blue_Pack", "logo2")  # seen already, icons
_POLISH_STEPS = 10
_ENDINGS = (".png", ".jpg", ".jpeg")


def files() -> Iterator[tuple[str, Path]]:
    """Name and file of each picture."""
    bundled, samples = Path(skimage.__file__).parent / "data", Path(matplotlib.get_data_path()) / "sample_data"
    for folder in (bundled, samples, EXAMPLES):
        for path in sorted(folder.iterdir()):
            if path.suffix in _ENDINGS and path.stem not in _NO_PICTURE + _TUNED_ON:
                yield path.stem, path


def square(path: Path, pixels: int) -> tuple[np.ndarray, str]:
    """The middle of a picture as pixels x pixels grey values 0..1, row 0 on top, and how it was sized."""
    with Image.open(path) as image:
        if image.mode in ("RGBA", "LA", "P"):
            image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image.convert("RGBA"))
        grey = np.asarray(image.convert("L"), dtype=np.float32) / 255
    side = min(grey.shape)
    top, left = (grey.shape[0] - side) // 2, (grey.shape[1] - side) // 2
    how = Image.Resampling.BOX if pixels <= side else Image.Resampling.BICUBIC
    piece = Image.fromarray(grey[top : top + side, left : left + side]).resize((pixels, pixels), how)
    sized = f"from {side}" if pixels <= side else f"interpolated from {side}"
    return np.clip(np.asarray(piece, dtype=np.float64), 0.0, 1.0), sized


def linear(srgb: np.ndarray) -> np.ndarray:
    """Light of sRGB values 0..1 (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def figures(pixels: int = 512) -> Iterator[Figure]:
    plain = replace(PAPER_SETTING, corrections=2, min_radius_mm=0.5)
    for name, path in files():
        grey, sized = square(path, pixels)
        goal = target_irradiance(grey, viewed_from="lens")
        lens = designed(goal, plain)
        as_srgb = designed(target_irradiance(linear(grey), viewed_from="lens"), plain)
        black = 100 * float(np.mean(goal < 0.02 * goal.max()))
        note = (
            f"{lens.sentence}; read as sRGB {as_srgb.score.psnr_db:.1f} dB, misplaced "
            f"{100 * as_srgb.score.misplaced_light:.2f} %; {black:.0f} % black, {sized}"
        )
        yield Figure(f"{name} {pixels}, 2 corrections, ball 0.5 mm", lens.score.psnr_db, "dB", note)
    for name, path in files():
        goal = target_irradiance(square(path, pixels)[0], viewed_from="lens")
        lens = designed(goal, replace(plain, polish_steps=_POLISH_STEPS))
        yield Figure(f"{name} {pixels}, {_POLISH_STEPS} polish steps besides", lens.score.psnr_db, "dB", lens.sentence)
