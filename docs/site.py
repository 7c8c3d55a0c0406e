"""Writes the sources of the site into a folder, for `make docs`:  python -m docs.site FOLDER

The guides of docs/ as they stand, the README as the first page, and references of commands, settings and REST made from
the code: the command line's own help, the settings' docstring, and the OpenAPI document that a test holds against the
server.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
from typer.cli import get_docs_for_click
from typer.main import get_command

from service.cli.app import app
from service.settings import PREFIX, ServerSettings

TOP = Path(__file__).parents[1]
OPENAPI = TOP / "tests" / "service" / "server" / "api" / "openapi.json"
NAV: dict[str, str] = {
    "Home": "index.md",
    "The first lens": "first-lens.md",
    "Passes and finish": "passes.md",
    "Light, frame, shape": "light.md",
    "Run the mill": "mill.md",
    "The spindle in a hold": "spindle.md",
    "Every key of a job": "keys.md",
    "The page": "page.md",
    "Server and farm": "server.md",
    "REST with curl": "rest.md",
    "Commands": "commands.md",
    "Settings": "settings.md",
    "REST reference": "rest-reference.md",
    "The paper's claims": "paper.md",
    "Architecture": "architecture.md",
    "Changes": "changelog.md",
}


def main(folder: Path) -> None:
    pages = folder / "pages"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(TOP / "docs", pages, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for source, page in (
        ("README.md", "index.md"),
        ("ARCHITECTURE.md", "architecture.md"),
        ("CHANGELOG.md", "changelog.md"),
    ):
        text = (TOP / source).read_text(encoding="utf-8")
        (pages / page).write_text(_as_page(text), encoding="utf-8")
    command = get_command(app)
    context = click.Context(command, info_name="causticmill")
    (pages / "commands.md").write_text(
        get_docs_for_click(obj=command, ctx=context, name="causticmill"), encoding="utf-8"
    )
    (pages / "settings.md").write_text("\n".join(_settings_lines()) + "\n", encoding="utf-8")
    document = json.loads(OPENAPI.read_text(encoding="utf-8"))
    (pages / "rest-reference.md").write_text("\n".join(_rest_lines(document)) + "\n", encoding="utf-8")
    settings = {
        "site_name": "causticmill",
        "docs_dir": "pages",
        "site_dir": str((folder.parent / "docs").absolute()),
        "use_directory_urls": False,  # it is read from files, without a server
        "theme": {"name": "material", "font": False},
        "plugins": ["search"],
        "nav": [{title: page} for title, page in NAV.items()],
        "not_in_nav": "soak.md",
    }
    (folder / "mkdocs.yml").write_text(json.dumps(settings, indent=1), encoding="utf-8")  # JSON is YAML


def _as_page(text: str) -> str:
    """Links as they lead from the site's first folder."""
    return text.replace("](docs/", "](").replace("](ARCHITECTURE.md)", "](architecture.md)")


def describe_settings() -> dict[str, str]:
    """Return the description of each setting of the server, from the docstring of the settings."""
    rows = re.findall(r"^ *([a-z_, ]+?) +: (.+)$", ServerSettings.__doc__ or "", flags=re.MULTILINE)
    return {name: words for names, words in rows for name in names.split(", ")}


def _settings_lines() -> Iterator[str]:
    yield "# Settings of the server\nEach is an environment variable. Empty: there is no default.\n"
    yield "| variable | default | |\n|---|---|---|"
    for name, words in describe_settings().items():
        default = ServerSettings.model_fields[name].default
        shown = "" if default in (None, (), {}) else f"`{default}`"
        yield f"| `{PREFIX}{name.upper()}` | {shown} | {words} |"


def _rest_lines(document: dict[str, Any]) -> Iterator[str]:
    yield "# REST reference"
    yield "Refusals are `application/problem+json`; `GET /openapi.json` has the schemas of bodies and answers."
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            yield f"\n## {method.upper()} {path}\n{operation['summary']}. {operation.get('description', '')}\n"
            parameters = [one for one in operation.get("parameters", []) if "$ref" not in one]
            if parameters:
                yield "| parameter | in | |\n|---|---|---|"
            for one in parameters:
                yield f"| `{one['name']}` | {one['in']} | {one.get('description', '')} |"
            yield "\nAnswers: " + ", ".join(sorted(operation["responses"]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
