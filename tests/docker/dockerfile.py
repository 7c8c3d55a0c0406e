"""A Dockerfile as its stages and instructions, and its build steps carried out in a folder instead of an image."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass
class Stage:
    """One FROM ... and what follows it: (instruction, rest of the line) in order."""

    name: str
    base: str
    steps: list[tuple[str, str]] = field(default_factory=list)

    def all(self, instruction: str) -> list[str]:
        return [rest for kind, rest in self.steps if kind == instruction]

    def json(self, instruction: str) -> list[str]:
        (rest,) = self.all(instruction)
        return list(json.loads(rest))


def read(path: Path) -> list[Stage]:
    """The stages; what stands before the first FROM is one of its own without a base."""
    text = "\n".join(line for line in path.read_text().splitlines() if not line.startswith("#"))
    stages = [Stage("", "")]
    for line in text.replace("\\\n", " ").splitlines():
        if not line.strip():
            continue
        kind, _, rest = line.strip().partition(" ")
        if kind == "FROM":
            base, _, name = rest.partition(" AS ")
            stages.append(Stage(name, base))
        else:
            stages[-1].steps.append((kind, " ".join(rest.split())))
    return stages


def ignored(path: str) -> bool:
    """As .dockerignore says: everything but what it lists again, without caches."""
    lines = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and line[0] != "#"]
    assert lines[0] == "*"
    return not any(path == line[1:].rstrip("/") or path.startswith(line[1:]) for line in lines if line[0] == "!")


def build(stage: Stage, folder: Path, *, moved: dict[str, str], environment: dict[str, str]) -> None:
    """Its COPY and RUN steps, with paths of the image moved to paths of this computer."""
    work = folder
    for kind, rest in stage.steps:
        for inside, outside in moved.items():
            rest = rest.replace(inside, outside)
        if kind == "WORKDIR":
            work = folder / rest.lstrip("/")
            work.mkdir(parents=True)
        elif kind == "COPY":
            *sources, target = rest.split()
            for source in sources:
                _copy(source, work / target)
        elif kind == "RUN":
            subprocess.run(["/bin/sh", "-euc", rest], cwd=work, env=environment, check=True, capture_output=True)
        else:
            raise AssertionError(f"{kind} is not known here")


def _copy(source: str, target: Path) -> None:
    assert not ignored(source), f".dockerignore keeps {source} from the build"
    if (ROOT / source).is_dir():
        shutil.copytree(ROOT / source, target, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        shutil.copy(ROOT / source, target / Path(source).name)


def words(command: str) -> list[str]:
    return shlex.split(command)
