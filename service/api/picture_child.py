"""The process that decodes uploaded pictures: small, limited, and expendable. One JSON line in, one out.

In: {"path", "name", "max_pixels"}. Out: {"facts": {...}} or {"refused": [lines]}; first of all {"ready": true}.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

# Named one by one: a look for "all formats" would import and trust dozens of them.
from PIL import (  # noqa: F401
    BmpImagePlugin,
    GifImagePlugin,
    JpegImagePlugin,
    MpoImagePlugin,
    PngImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from service.decoding import checked
from service.errors import PictureError
from service.picture_limits import UPLOAD_FORMATS, PictureLimits
from service.worker.linux import address_space_bytes, die_with_parent, name_process

_BYTES_PER_PIXEL = 16  # a progressive CMYK JPEG holds its coefficients beside its pixels; an animation two canvases
_BESIDE_BYTES = 96_000_000  # the file, its notes, the decoder's tables


def main() -> None:
    """Argument: the process to die with."""
    if sys.platform == "linux":
        die_with_parent(int(sys.argv[1]))
        name_process("cm-pictures")
    for kind in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE):  # it writes nothing but answers
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(kind, (0, 0))
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    base = address_space_bytes() if sys.platform == "linux" else 0
    _say(answers, {"ready": True})
    for line in sys.stdin:
        asked = json.loads(line)
        _limit(base + _BESIDE_BYTES + _BYTES_PER_PIXEL * asked["max_pixels"])
        _say(answers, _answer(asked))


def _answer(asked: dict[str, Any]) -> dict[str, Any]:
    limits = PictureLimits(max_pixels=asked["max_pixels"], formats=UPLOAD_FORMATS)
    try:
        return {"facts": dataclasses.asdict(checked(Path(asked["path"]), limits, asked["name"]))}
    except PictureError as error:
        return {"refused": str(error).split("\n")}


def _limit(most: int) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _say(answers: Any, word: dict[str, Any]) -> None:
    answers.write(json.dumps(word) + "\n")
    answers.flush()


if __name__ == "__main__":
    main()
