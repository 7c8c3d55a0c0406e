"""The light of a made test piece on its screen, and photographs of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from optics.finish import Finish
from optics.irradiance import picture_from_irradiance
from service.job.coupon.programs import mill_piece, predict_light
from service.job.picture.linear_light import linear_to_srgb
from service.job.spec.loading import load_stored_job
from tests.optics.photographs import camera, photographed


def photograph(folder: Path, finish: Finish, *, throw_mm: float) -> Image.Image:
    """From aside, a stop too dark, blurred by 2 pixels, of the piece as its mill cuts it and a person finishes it."""
    job = load_stored_job(folder)
    made = mill_piece(folder, job, seed=12)
    whole = predict_light(job, made, [finish.transfer], throw_mm=throw_mm, pixels_per_mm=30)[0]
    seen = picture_from_irradiance(whole, viewed_from="behind")
    place = camera(aside_deg=30.0, quarter_turns=1, aspect=48 / 28, shape=(1500, 2200), filling=0.75)
    metered = np.log2(0.18 * np.quantile(seen, 0.99) / 0.8)
    shot = photographed(seen, place, shape=(1500, 2200), stops=metered - 1.0, blur_px=2.0, background=0.003)
    return Image.fromarray(np.rint(255 * linear_to_srgb(shot.photo)).astype(np.uint8))
