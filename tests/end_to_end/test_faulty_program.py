"""A program that fails its check never reaches the person: exit code 1, the fault in words, no file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from cam.program import generate_parts
from service.cli.main import run
from tests.end_to_end.command import settings

SETTINGS = settings(
    {
        "image.pixels": 32,
        "image.tone": "linear",
        "optics.width_mm": 10,
        "optics.height_mm": 10,
        "optics.throw_mm": 40,
    }
)


def spoiled(how: str) -> Any:
    """A generator of programs that goes wrong in the middle of the aperture."""

    def generate(*arguments: Any, **options: Any) -> Iterator[Iterator[bytes]]:
        lines = (
            b"".join(piece for part in generate_parts(*arguments, **options) for piece in part).decode().splitlines()
        )
        cuts = [k for k, line in enumerate(lines) if re.fullmatch(r"X[\d.]+Z-[\d.]+", line)]
        lines.insert(cuts[len(cuts) // 2] + 1, how)
        yield iter([("\n".join(lines) + "\n").encode()])

    return generate


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("Z-3", ["below the lens"]),  # a gouge
        pytest.param("G0X0", ["rapid"], marks=pytest.mark.thorough),  # through the stock
        pytest.param("G2X1I1", ["arc"], marks=pytest.mark.thorough),  # text that may not run
    ],
)
def test_a_faulty_program_fails_the_job(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, how: str, words: list[str]
) -> None:
    ramp = np.linspace(50, 127, 32)
    Image.fromarray(np.add.outer(ramp, ramp).astype(np.uint8)).save(tmp_path / "p.png")
    monkeypatch.setattr("service.job.stages.programs.generate_parts", spoiled(how))
    paths = [str(tmp_path / "p.png"), "-o", str(tmp_path / "out")]
    code = run(["make", *paths, "--quiet", "--preset", "draft", *SETTINGS])
    told = capsys.readouterr()
    assert code == 1
    assert told.out == ""
    assert told.err.startswith("error: pass-1-rough.nc: ")
    assert all(word in told.err for word in words), told.err
    assert [path.name for path in tmp_path.iterdir()] == ["p.png"]
