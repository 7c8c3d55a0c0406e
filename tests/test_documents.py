"""README, guides and ARCHITECTURE say what is: their commands run, their files exist, their spec is accepted."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from docs import site
from docs.release import LOCK, bill_of_materials
from machines.mill.orders import GRANT_S
from machines.profile import load_profile
from service.cli.main import run
from service.client.server import GRANT_WAIT_S
from service.job.planning import witness
from service.job.spec.loading import resolve_spec
from service.job.stages import kept_plans
from service.server.fleet import timelapse
from service.settings import ServerSettings

TOP = Path(__file__).parents[1]
README = (TOP / "README.md").read_text(encoding="utf-8")
GUIDES = ("first-lens", "passes", "light", "mill", "page", "server", "rest", "spindle")
"""Of docs/, in the order in which a person reads them."""
PAGES = sorted(path.name for path in (TOP / "docs").glob("*.md"))
ALL = README + "".join((TOP / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in GUIDES)
ARCHITECTURE = (TOP / "ARCHITECTURE.md").read_text(encoding="utf-8")
RIDDLE = re.compile(r"\b(?:whoever|whatever|whence|foretold|foretell|told|aslant|anew)\b", re.IGNORECASE)
SMALL = ["image.pixels=32", "optics.width_mm=5", "optics.height_mm=5"]


def matching(folder: Path, pattern: str) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.glob(pattern))


def tour() -> list[list[str]]:
    """The commands of the five-minute tour, as words without the program's name and comments."""
    lines = re.findall(r"^\.venv/bin/causticmill (.*)$", ALL, flags=re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


@pytest.mark.thorough
def test_the_tour_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, in an empty folder, at a small size; what ends in & goes on beside the next ones, from when it says
    that it is ready.
    """
    assert len(tour()) >= 6
    (tmp_path / "examples").symlink_to(TOP / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    beside: list[subprocess.Popen[str]] = []
    try:
        for words in tour():
            words = [word.replace("/tmp/", f"{tmp_path}/") for word in words]
            if words[-1] == "&":
                beside.append(begun(words[:-1], tmp_path))
                assert beside[-1].stdout is not None and beside[-1].stdout.readline(), " ".join(words)
                continue
            sized = words[0] in ("make", "design", "plan")
            sizes = [part for value in SMALL for part in ("--set", value)] if sized else []
            found = [name for word in words for name in (matching(tmp_path, word) if "*" in word else [word])]
            if words[0] != "stream":
                assert run([*found, *sizes]) == 0, " ".join(words)
                continue
            process = begun([*found, "--yes"], tmp_path)  # no terminal here
            output, errors = process.communicate()
            assert process.returncode == 0, f"{' '.join(words)}\n{output}\n{errors}"
    finally:
        for process in beside:
            process.terminate()
            process.communicate()


def begun(words: list[str], folder: Path) -> subprocess.Popen[str]:
    """A command of the tour, started; what it keeps goes into `folder`."""
    return subprocess.Popen(
        [sys.executable, "-c", "from service.cli.main import main; main()", *words],
        cwd=folder,
        env={**os.environ, "XDG_STATE_HOME": str(folder / "state")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_the_toml_of_the_guides_is_accepted(tmp_path: Path) -> None:
    """A job's spec, and a machine of one's own with its spindle."""
    guides = ((TOP / "docs" / name).read_text(encoding="utf-8") for name in ("first-lens.md", "mill.md", "spindle.md"))
    blocks = (re.findall(r"^```toml\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL) for text in guides)
    (job,), (machine,), (spindle,) = blocks
    (tmp_path / "job.toml").write_text(job)
    spec = resolve_spec(file=tmp_path / "job.toml")
    assert spec.optics.throw_mm == 200
    assert [row.name for row in spec.passes] == ["rough", "finish"]
    (tmp_path / "router.toml").write_text(machine + spindle)
    profile = load_profile("router", [tmp_path])
    assert profile.travel_mm == (400, 400, 90)
    assert profile.dialect == "grbl"
    assert profile.spindle.on_hold == "turns"


def test_guides_and_messages_use_plain_words() -> None:
    """No sentence for people has a word that nobody says to a colleague; a message is the key of its translation."""
    tables = [*(TOP / "service/page/languages").rglob("*.json")]
    messages = {key for table in tables for key in json.loads(table.read_text(encoding="utf-8"))}
    assert len(messages) > 2000
    pages = [(TOP / "docs" / name).read_text(encoding="utf-8") for name in PAGES]
    texts = {
        re.sub(r"\{\w+\}", "", text) for text in (*messages, *"\n".join([README, ARCHITECTURE, *pages]).splitlines())
    }
    assert sorted(filter(RIDDLE.search, texts)) == []


@pytest.mark.parametrize("file", ["README.md", "ARCHITECTURE.md", *(f"docs/{name}" for name in PAGES)])
def test_linked_files_exist(file: str) -> None:
    """Those that `make docs` writes are there only in the site; it refuses a link that leads nowhere."""
    path, written = TOP / file, {name for name in site.PAGES if name not in PAGES} | {"focus.avif"}
    for target in re.findall(r"\]\(([^)#:]+)\)", path.read_text(encoding="utf-8")):
        assert target in written or (path.parent / target).exists(), target


def test_pictures_of_the_docs_are_small() -> None:
    """Each page of the docs is read on a phone, too."""
    pictures = [path for folder in ("page", "how-good") for path in (TOP / "docs" / folder).iterdir()]
    assert len(pictures) >= 12
    for path in pictures:
        assert path.suffix == ".webp" and path.stat().st_size <= 100_000, path
        assert any(f"]({path.parent.name}/{path.name})" in (TOP / "docs" / name).read_text() for name in PAGES), path


def test_the_site_has_every_page_of_docs_every_command_and_every_route(tmp_path: Path) -> None:
    """Built by `make docs`, which refuses a link that leads nowhere."""
    site.main(tmp_path / "source")
    pages = tmp_path / "source" / "pages"
    assert {page.name for page in pages.glob("*.md")} == set(site.PAGES)
    commands, routes = ((pages / name).read_text(encoding="utf-8") for name in ("commands.md", "rest-reference.md"))
    assert all(f"causticmill {name}" in commands for name in ("make", "stream", "service backup"))
    assert "..." not in commands.partition("## ")[0]  # no sentence of the list is cut
    assert all(route in routes for route in ("POST /v1/jobs", "GET /v1/jobs/{id}"))


def test_likeness_is_stated_only_where_the_bench_measures_it() -> None:
    """A page that states dB names the section of `make bench` that measures them. Programs write the others."""
    written = {"paper.md", "how-good.md", "keys.md", "soak.md"}
    for name in (name for name in PAGES if name not in written):
        text = (TOP / "docs" / name).read_text(encoding="utf-8")
        states = re.search(r"\d dB", re.sub(r"about \d dB|more than 0\.3 dB", "", text))  # limits of warnings
        named = set(re.findall(r"section `(\w+)`", text))
        assert bool(named) >= bool(states), name
        assert named <= set(re.findall(r'^    "(\w+)": ', (TOP / "tests/benchmarks/__main__.py").read_text(), re.M)), (
            name
        )


def test_times_and_sizes_in_the_guides_are_those_of_the_code() -> None:
    """Any other figure of a guide is a maker's, or `make docs-pictures`, `make bench` or `make soak` has written it."""
    stated = {
        "page.md": [f"(`plans`, {kept_plans.KEPT_BYTES / 1e6:g} MB at most)"],
        "passes.md": [f"a free strip at least {witness.LEAST_ROW_MM:g} mm wide"],
        "rest.md": [f"within {GRANT_S:g} s", f"after {GRANT_WAIT_S:g} s, send nothing"],
        "server.md": [
            f"once, within {GRANT_S:g} s",
            f"up to {timelapse.MOST_PICTURES} pictures ({timelapse.MOST_BYTES / 1e6:g} MB)",
            f"`CAUSTICMILL_LEASE_S` ({ServerSettings.model_fields['lease_s'].default:g} s)",
        ],
    }
    for name, sentences in stated.items():
        text = " ".join((TOP / "docs" / name).read_text(encoding="utf-8").split())
        assert [words for words in sentences if words not in text] == [], name


def test_every_setting_of_the_server_is_described() -> None:
    assert site.describe_settings().keys() == ServerSettings.model_fields.keys()
    assert all(f"`{name}`" in ALL for name in ("KEEP_DAYS", "QUOTA_MB", "FREE_DISK_MB"))


def test_the_map_names_every_folder_and_no_other() -> None:
    """Each folder of code is found through ARCHITECTURE.md, and says in its `__init__.py` what it holds."""
    tree = ARCHITECTURE.partition("## Where things are")[2].partition("```")[2].partition("```")[0]
    named = set(re.findall(r"[a-z_]+", tree))
    there = {
        part
        for package in ("phrases", "optics", "cam", "machines", "service")
        for path in (TOP / package).rglob("*")
        if path.suffix in (".py", ".js", ".toml") and path.name != "__init__.py"
        for part in path.parent.relative_to(TOP).parts
    }
    assert named == there
    for path, module in parsed_modules().items():
        assert ast.get_docstring(module), path


BANNED = {
    "nursery": "fork server",
    "errand": "command sequence",
    "heart": "lease renewer",
    "walk": "stage runner; of lines, trace",
    "patience": "timeout",
    "whence": "source",
    "ashore": "unattended",
    "adrift": "unattended",
    "stepover": "pitch",
    "workpiece": "stock",
}
"""Words for what has another one already."""


@cache
def parsed_modules() -> dict[Path, ast.Module]:
    packages = ("phrases", "optics", "cam", "machines", "service")
    paths = [path for package in packages for path in (TOP / package).rglob("*.py")]
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def identifiers(module: ast.Module) -> Iterator[str]:
    """Names that a module gives to something."""
    for node in ast.walk(module):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name
            case ast.arg():
                yield node.arg
            case ast.Name(ctx=ast.Store()):
                yield node.id
            case ast.Attribute(ctx=ast.Store()):
                yield node.attr


def words_of(identifier: str) -> str:
    """ "_ForkServer", "fork_server" -> "fork server"."""
    return " ".join(re.findall(r"[a-z0-9]+|[A-Z]+(?![a-z])|[A-Z][a-z0-9]*", identifier)).lower()


def test_each_word_of_the_glossary_is_defined_once_and_used_by_the_code() -> None:
    """In an identifier, or in a docstring."""
    glossary = " ".join(ARCHITECTURE.partition("## Glossary")[2].split())
    defined = [word.lower() for word in re.findall(r"\*\*(.+?)\*\*", glossary)]
    assert len(defined) > 20 and sorted(defined) == sorted(set(defined))
    said: list[str] = []
    for module in parsed_modules().values():
        said += map(words_of, identifiers(module))
        documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        nodes = (node for node in ast.walk(module) if isinstance(node, documented))
        said += (" ".join((ast.get_docstring(node) or "").lower().split()) for node in nodes)
    text = "\n".join(said)
    assert not [word for word in defined if not re.search(rf"\b{re.escape(word)}s?\b", text)]


def test_what_has_a_word_has_no_other() -> None:
    """In Python by the identifiers; of the page all that is written with an underscore or as one word."""
    named = [(path, name) for path, module in parsed_modules().items() for name in identifiers(module)]
    for path in (TOP / "service" / "page").rglob("*.js"):
        code = re.sub(r"^\s*(?:\*|/\*\*|//).*$", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        named += [(path, name) for name in re.findall(r"[A-Za-z_]\w+", code)]
    assert len(named) > 20_000
    found = {
        f"{path.relative_to(TOP)}: {name} (say {BANNED[word]})"
        for path, name in named
        for word in (part.removesuffix("s") for part in words_of(name).split())
        if word in BANNED
    }
    assert not found


def test_the_bill_of_materials_has_every_package_and_hash_of_the_lock() -> None:
    lock = LOCK.read_text("utf-8")
    components = bill_of_materials(lock)["components"]
    pinned = re.findall(r"^([\w-]+)(?:\[.*\])?==([^ ]+)", lock, flags=re.MULTILINE)
    assert [(one["name"], one["version"]) for one in components] == pinned
    hashes = [file["hashes"][0]["content"] for one in components for file in one["externalReferences"]]
    assert hashes == re.findall(r"sha256:(\w+)", lock) and len(hashes) > 1000
    colorama = next(one for one in components if one["name"] == "colorama")
    assert colorama["properties"] == [{"name": "environment", "value": "sys_platform == 'win32'"}]
