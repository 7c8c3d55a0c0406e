"""The process that evaluates photographs: of walls, and of test pieces, which it also makes.

Request: {"path", "name", "max_pixels"} of a photograph, and {"job": folder with a job's files} or {"machine",
"pieces": folder of test pieces}; without a photograph the test piece is only made.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from service.processes.kernel_cache import use_current_kernels

use_current_kernels()  # before numba is imported

import base64  # noqa: E402
from collections.abc import Callable  # noqa: E402

from service.job import files as job_files  # noqa: E402
from service.job.coupon.findings import draw_fit, fit_photo  # noqa: E402
from service.job.coupon.photograph import read_photo  # noqa: E402
from service.job.coupon.programs import keep_coupon  # noqa: E402
from service.job.files import plain  # noqa: E402
from service.job.photo.looking import load_predicted_light, look_at  # noqa: E402
from service.job.picture import PictureLimits  # noqa: E402
from service.job.picture.reading import read_wall_photo  # noqa: E402
from service.processes.child_work import answer_requests  # noqa: E402

_BESIDE_BYTES = 2_500_000_000  # kernels, arrays of a lens, of a test piece and of views of them, threads, the figure
_BYTES_PER_PIXEL = 48


def main() -> None:
    answer_requests("cm-photographs", _answer, beside_bytes=_BESIDE_BYTES, bytes_per_pixel=_BYTES_PER_PIXEL)


def _answer(asked: dict[str, Any], _: Callable[[float], None]) -> dict[str, Any]:
    return _look(asked) if "job" in asked else _measure(asked)


def _look(asked: dict[str, Any]) -> dict[str, Any]:
    photo = read_wall_photo(Path(asked["path"]), limits=_limits(asked), name=asked["name"])
    found = look_at(photo, load_predicted_light(Path(asked["job"])), name=asked["name"])
    return {**found.figures, "picture": _as_text(found.png(with_words=False))}


def _measure(asked: dict[str, Any]) -> dict[str, Any]:
    if "path" not in asked:
        return {"archive": str(keep_coupon(Path(asked["pieces"]), asked["machine"]) / job_files.COUPON_ARCHIVE)}
    shot = read_photo(Path(asked["path"]), limits=_limits(asked), name=asked["name"])
    found = fit_photo(asked["name"], shot, keep_coupon(Path(asked["pieces"]), asked["machine"]))
    picture = _as_text(draw_fit(found, viewed_from_lens=False))
    return {**plain(found.report()), "values": found.values(), "picture": picture}


def _limits(asked: dict[str, Any]) -> PictureLimits:
    return PictureLimits(max_pixels=asked["max_pixels"])


def _as_text(png: bytes) -> str:
    return base64.b64encode(png).decode()


if __name__ == "__main__":
    main()
