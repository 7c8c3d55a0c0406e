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

from typer.main import get_command

from service.cli.app import app
from service.settings import PREFIX, ServerSettings

TOP = Path(__file__).parents[1]
OPENAPI = TOP / "tests" / "service" / "server" / "api" / "openapi.json"
NAV: dict[str, dict[str, str]] = {
    "Start": {
        "Home": "index.md",
        "Install, five minutes": "start.md",
        "How good will it be?": "how-good.md",
        "The page, step by step": "page.md",
    },
    "Make": {
        "The first lens": "first-lens.md",
        "Passes and finish": "passes.md",
        "Light, frame, shape": "light.md",
    },
    "Mill": {
        "Run the mill": "mill.md",
        "Which mills were tried": "hardware.md",
        "The first Roland": "roland.md",
        "The spindle in a hold": "spindle.md",
    },
    "Shop": {
        "Server and farm": "server.md",
        "Dashboards, Home Assistant": "monitoring.md",
        "REST with curl": "rest.md",
    },
    "Look up": {
        "Every key of a job": "keys.md",
        "Commands": "commands.md",
        "Settings": "settings.md",
        "REST reference": "rest-reference.md",
        "The paper's claims": "paper.md",
        "Long trials": "soak.md",
        "Architecture": "architecture.md",
        "Changes": "changelog.md",
    },
}
PAGES = [page for pages in NAV.values() for page in pages.values()]
_THEME = {
    "name": "material",
    "font": False,
    "logo": "icon.svg",
    "favicon": "icon.svg",
    "palette": [
        {"media": f"(prefers-color-scheme: {name})", "scheme": scheme, "primary": "custom", "accent": "custom"}
        | {"toggle": {"icon": icon, "name": f"Change to {other}"}}
        for name, scheme, icon, other in (
            ("light", "default", "material/weather-sunny", "dark"),
            ("dark", "slate", "material/weather-night", "light"),
        )
    ],
    "features": [
        *("navigation.tabs", "navigation.top", "navigation.footer", "toc.follow"),
        *("search.suggest", "search.highlight", "content.code.copy"),
    ],
}
_EXTENSIONS = ["admonition", "attr_list", "md_in_html", "tables", "pymdownx.superfences", {"toc": {"permalink": True}}]


def main(folder: Path) -> None:
    pages = folder / "pages"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(TOP / "docs", pages, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for picture in ("icon.svg", "jobs/focus.avif"):
        shutil.copy(TOP / "service" / "page" / picture, pages)
    for source, page in (
        ("README.md", "start.md"),
        ("ARCHITECTURE.md", "architecture.md"),
        ("CHANGELOG.md", "changelog.md"),
    ):
        text = (TOP / source).read_text(encoding="utf-8")
        (pages / page).write_text(_as_page(text), encoding="utf-8")
    _write_lines(pages / "commands.md", _command_lines())
    _write_lines(pages / "settings.md", _settings_lines())
    _write_lines(pages / "rest-reference.md", _rest_lines(json.loads(OPENAPI.read_text(encoding="utf-8"))))
    settings = {
        "site_name": "causticmill",
        "docs_dir": "pages",
        "site_dir": str((folder.parent / "docs").absolute()),
        "theme": _THEME,
        "extra_css": ["site.css"],
        "extra": {"polyfills": ["iframe-worker.js"], "generator": False},  # or the plugin downloads one
        "markdown_extensions": _EXTENSIONS,
        "plugins": ["search", "offline"],  # it is read from files, without a server
        "nav": [{part: [{title: page} for title, page in pages.items()]} for part, pages in NAV.items()],
    }
    (folder / "mkdocs.yml").write_text(json.dumps(settings, indent=1), encoding="utf-8")  # JSON is YAML


def _write_lines(page: Path, lines: Iterator[str]) -> None:
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _as_page(text: str) -> str:
    """Links as they lead from the site's first folder."""
    return text.replace("](docs/", "](").replace("](ARCHITECTURE.md)", "](architecture.md)")


def _command_lines() -> Iterator[str]:
    """Yield each command with its complete help; Typer's own page shortens the sentences of its list."""
    yield "# Commands\n"
    yield "Exit code 0: all went well. 1: the job or the mill failed. 2: the input cannot be used. 130: Ctrl-C.\n"
    found = list(_walk(get_command(app), "causticmill"))
    yield "| command | what it does |\n|---|---|"
    for command, name in found:
        yield f"| [`{name}`](#{name.replace(' ', '-')}) | {_help_of(command)[0]} |"
    for command, name in found:
        context = command.make_context(name, [], resilient_parsing=True)
        usage = " ".join([name, *command.collect_usage_pieces(context)])
        yield "\n\n".join([f"\n## {name}", *_help_of(command), f"```sh\n{usage}\n```\n"])
        yield "| | |\n|---|---|"
        for one in command.params:
            names = one.opts if one.param_type_name == "option" else [one.metavar or one.name.upper()]
            text = " ".join(str(getattr(one, "help", None) or "").split()).replace("|", "\\|")
            must = " Must be given." if one.required and one.param_type_name == "option" else ""
            yield f"| {', '.join(f'`{name}`' for name in names)} | {text}{must} |"


def _walk(command: Any, name: str) -> Iterator[tuple[Any, str]]:
    """Yield the commands below one, without their groups. command: of the click that Typer brings along"""
    below = getattr(command, "commands", None)
    if below is None:
        yield command, name
    for each, one in (below or {}).items():
        if not one.hidden:
            yield from _walk(one, f"{name} {each}")


def _help_of(command: Any) -> list[str]:
    """Return the paragraphs of its help."""
    return [" ".join(one.split()) for one in (command.help or "").replace("\b", "").strip().split("\n\n")]


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
