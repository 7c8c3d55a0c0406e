"""The process that looks at photographs of walls. One JSON line in, one out.

In: {"path", "name", "max_pixels", "job": folder with a job's files, "width_mm"}. Out: {"look": {...}}, {"refused":
[lines], "kind"} or {"fault": text}; first of all {"ready": true}.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from service.kernel_cache import use_current_kernels

use_current_kernels()  # before numba is imported

import base64  # noqa: E402

from service.api.line_answers import answer_lines, answer_or_refuse  # noqa: E402
from service.job.photo.foretold import foretold_of  # noqa: E402
from service.job.photo.looking import look_at  # noqa: E402
from service.job.photo.reading import read_wall_photo  # noqa: E402
from service.picture_limits import PictureLimits  # noqa: E402

_BESIDE_BYTES = 1_500_000_000  # kernels, arrays of a lens and of views of it, threads, the figure
_BYTES_PER_PIXEL = 32


def main() -> None:
    answer_lines("cm-photographs", _answer, beside_bytes=_BESIDE_BYTES, bytes_per_pixel=_BYTES_PER_PIXEL)


def _answer(asked: dict[str, Any]) -> dict[str, Any]:
    return answer_or_refuse(lambda: _look(asked))


def _look(asked: dict[str, Any]) -> dict[str, Any]:
    limits = PictureLimits(max_pixels=asked["max_pixels"])
    photo = read_wall_photo(Path(asked["path"]), limits=limits, name=asked["name"])
    found = look_at(photo, foretold_of(Path(asked["job"])), name=asked["name"], picture_width_mm=asked.get("width_mm"))
    return {"look": {**found.figures, "picture": base64.b64encode(found.png(with_words=False)).decode()}}


if __name__ == "__main__":
    main()
