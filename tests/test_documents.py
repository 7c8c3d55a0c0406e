"""README and ARCHITECTURE say what is: their commands run, their files exist, their spec is accepted."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from service.spec_files import resolve_spec

TOP = Path(__file__).parents[1]
README = (TOP / "README.md").read_text(encoding="utf-8")
ARCHITECTURE = (TOP / "ARCHITECTURE.md").read_text(encoding="utf-8")
SMALL = ["image.pixels=48", "optics.width_mm=8", "optics.height_mm=8"]


def matching(folder: Path, pattern: str) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.glob(pattern))


def tour() -> list[list[str]]:
    """The commands of the five-minute tour, as words without the program's name and comments."""
    lines = re.findall(r"^\.venv/bin/causticmill (.*)$", README, flags=re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


def test_the_tour_runs(tmp_path: Path) -> None:
    """In order, in an empty folder, at a small size; everything else as printed."""
    assert len(tour()) >= 4
    (tmp_path / "examples").symlink_to(TOP / "examples")
    for words in tour():
        sizes = [part for value in SMALL for part in ("--set", value)] if words[0] in ("make", "design") else []
        found = [name for word in words for name in (matching(tmp_path, word) if "*" in word else [word])]
        done = subprocess.run(
            [sys.executable, "-c", "from service.cli import main; main()", *found, *sizes],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{' '.join(words)}\n{done.stdout}\n{done.stderr}"


def test_the_spec_in_the_readme_is_accepted(tmp_path: Path) -> None:
    (toml,) = re.findall(r"^```toml\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)
    file = tmp_path / "job.toml"
    file.write_text(toml)
    spec = resolve_spec(file=file)
    assert spec.optics.throw_mm == 200
    assert [row.name for row in spec.passes] == ["rough", "finish"]


@pytest.mark.parametrize("text", [README, ARCHITECTURE], ids=["README", "ARCHITECTURE"])
def test_linked_files_exist(text: str) -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (TOP / target).exists(), target


def test_the_map_names_every_module_and_no_other() -> None:
    """Each module of the four packages is found through ARCHITECTURE.md, by name or by a pattern there."""
    named: set[str] = set()
    for package, rest in re.findall(r"^\| `(optics|cam|machines|service)/(.*?) \| ", ARCHITECTURE, flags=re.MULTILINE):
        for pattern in re.findall(r"[\w*/]+(?:\.py|/)(?=`|,|$)", f"{rest}"):
            names = matching(TOP, f"{package}/{pattern}*" if pattern.endswith("/") else f"{package}/{pattern}")
            assert names, f"ARCHITECTURE.md names {package}/{pattern}, which is not there"
            named |= set(names)
    modules = {
        str(path.relative_to(TOP))
        for package in ("optics", "cam", "machines", "service")
        for path in (TOP / package).rglob("*.py")
        if path.name != "__init__.py"
    }
    assert modules - named == set()
