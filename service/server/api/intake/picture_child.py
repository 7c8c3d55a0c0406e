"""The process that decodes uploaded pictures: small, limited, and expendable.

Request: {"path", "name", "max_pixels"}. Result: the fields of `PictureFacts`.
"""

from __future__ import annotations

import dataclasses
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Named one by one: opening "all formats" would import and trust dozens of them.
from PIL import (  # noqa: F401
    BmpImagePlugin,
    GifImagePlugin,
    JpegImagePlugin,
    MpoImagePlugin,
    PngImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from service.job.picture import PictureLimits
from service.job.picture.decoding import check_picture
from service.processes.child_work import answer_requests

_BYTES_PER_PIXEL = 16  # a progressive CMYK JPEG holds its coefficients beside its pixels; an animation two canvases
_BESIDE_BYTES = 96_000_000  # the file, its notes, the decoder's tables


def main() -> None:
    answer_requests(
        "cm-pictures",
        _check,
        beside_bytes=_BESIDE_BYTES,
        bytes_per_pixel=_BYTES_PER_PIXEL,
        barred=(resource.RLIMIT_CORE, resource.RLIMIT_FSIZE),  # it writes nothing but answers
    )


def _check(asked: dict[str, Any], _: Callable[[float], None]) -> dict[str, Any]:
    limits = PictureLimits(max_pixels=asked["max_pixels"])
    return dataclasses.asdict(check_picture(Path(asked["path"]), limits, asked["name"]))


if __name__ == "__main__":
    main()
