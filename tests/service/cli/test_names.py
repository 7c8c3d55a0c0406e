"""Files whose names are of any script, or of none: the whole command runs, and shows what can be shown."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

CAUSTICMILL = Path(sys.executable).with_name("causticmill")


def causticmill(*words: str | bytes, locale: str = "C.UTF-8") -> subprocess.CompletedProcess[bytes]:
    environment = {**os.environ, "LC_ALL": locale, "PYTHONIOENCODING": "ascii" if locale == "C" else "utf-8"}
    return subprocess.run([CAUSTICMILL, *words], env=environment, capture_output=True, check=False)


@pytest.mark.skipif(sys.platform != "linux", reason="names that are no text exist on Linux only")
@pytest.mark.parametrize(
    ("name", "shown", "locale"),
    [
        (b"caf\xe9.png", "caf?.png", "C.UTF-8"),
        ('猫 кот ümläut "q" \'s.png'.encode(), '猫 кот ümläut "q" \'s.png', "C"),
        (b"two\nlines.png", "two?lines.png", "C.UTF-8"),
    ],
)
def test_a_lens_of_a_picture_of_any_name_in_a_folder_of_any_name(
    tmp_path: Path, name: bytes, shown: str, locale: str
) -> None:
    picture, out = os.path.join(os.fsencode(tmp_path), name), os.path.join(os.fsencode(tmp_path), b"out-" + name)  # noqa: PTH118
    Image.radial_gradient("L").resize((32, 32)).save(Path(os.fsdecode(picture)))
    done = causticmill("design", picture, "-o", out, "--set", "image.pixels=16", locale=locale)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    assert b"Traceback" not in done.stderr and b"report.html" in done.stdout.splitlines()[-1]
    folder = Path(os.fsdecode(out))
    assert json.loads((folder / "report.json").read_text())["source"]["file"] == shown
    assert "<html" in (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.skipif(sys.platform != "linux", reason="names that are no text exist on Linux only")
@pytest.mark.parametrize(
    "words",
    [
        ("design", b"\xff.png", "-o", b"out\xff"), ("cam", b"\xff"), ("caustic", b"\xff"), (b"\xff",),
        ("look", b"\xff", "--job", b"\xff"), ("check", b"\xff.nc", "--heightfield", b"\xff.npz"),
        ("plan", b"\xff.png"), ("stream", b"\xff.nc", "--port", b"\xff"), ("mill", "--data", b"\xff"),
        ("design", "a.png", "--spec", b"\xff.toml", "-o", "out"), ("design", "a.png", "-o", "out", "--set", b"\xff=1"),
        ("submit", b"\xff.png", "--server", "http://127.0.0.1:9"),
    ],
    ids=lambda words: words[0],
)  # fmt: skip
def test_a_missing_file_whose_name_is_no_text_is_one_line(words: tuple[str | bytes, ...]) -> None:
    done = causticmill(*words)
    said = done.stderr.decode()
    assert done.returncode in (1, 2) and said.startswith("error: ") and "Traceback" not in said, said
