"""A copy of the program to which something is added, as ARCHITECTURE.md's table "To add something" says."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

TOP = Path(__file__).parents[1]
PACKAGES = ("phrases", "optics", "cam", "machines", "service", "examples")
MOST_FILES = 3


def copy_tree(folder: Path, edits: Mapping[str, tuple[str, str] | str]) -> Path:
    """Copy the packages into `folder` and make the edits: a new file's text, or (a passage that stands there once, what
    stands there instead)."""
    assert len(edits) <= MOST_FILES
    for package in PACKAGES:
        shutil.copytree(TOP / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name, edit in edits.items():
        path = folder / name
        if isinstance(edit, str):
            assert not path.exists(), f"{name} is there already"
            path.write_text(edit, encoding="utf-8")
        else:
            old, new = edit
            text = path.read_text(encoding="utf-8")
            assert text.count(old) == 1, f"{name}: {text.count(old)} times {old!r}"
            path.write_text(text.replace(old, new), encoding="utf-8")
    return folder


def run_in_copy(folder: Path, program: str, *arguments: str) -> str:
    """What a Python program prints that imports the packages from the copy."""
    process = subprocess.run(
        [sys.executable, "-P", "-c", program, *arguments],
        env={**os.environ, "PYTHONPATH": str(folder)},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout
