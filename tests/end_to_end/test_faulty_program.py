"""A program that fails its check never reaches the person: exit code 1, the fault in words, and the lens alone."""

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
from service.job.files import is_program, read_report
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
    make = ["make", str(tmp_path / "p.png"), "-o", str(tmp_path / "out"), "--quiet", "--preset", "draft", *SETTINGS]
    code = run(make)
    told = capsys.readouterr()
    assert code == 1
    assert told.out == ""
    fault, *_, kept = told.err.splitlines()
    assert fault.startswith("error: pass-1-rough.nc: ")
    assert all(word in fault for word in words), fault
    assert "pass 1 is refused" in kept and "cam" in kept and "passes.0.KEY=VALUE" in kept
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "p.png"]
    files, report = {path.name for path in (tmp_path / "out").iterdir()}, read_report(tmp_path / "out")
    assert {"heightfield.npz", "lens.stl", "caustic.png", "spec.json", "report.html"} <= files
    assert not any(map(is_program, files)) and report["passes"] == [] and "optics" in report
    assert any(fault.removeprefix("error: ") in warning for warning in report["warnings"])

    assert run(["cam", str(tmp_path / "out"), "--quiet"]) == 1  # still the faulty generator
    assert {path.name for path in (tmp_path / "out").iterdir()} == files
    monkeypatch.undo()
    assert run(["cam", str(tmp_path / "out"), "--quiet", "--set", "passes.0.step_down_mm=1.2"]) == 0
    before = (tmp_path / "out" / "pass-1-rough.nc").read_bytes()
    monkeypatch.setattr("service.job.stages.programs.generate_parts", spoiled(how))
    assert run(make) == 1  # a finished job is not given up for one that fails
    assert (tmp_path / "out" / "pass-1-rough.nc").read_bytes() == before
