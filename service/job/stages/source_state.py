"""The state of those of our sources that a module can run: its own and, along all imports, those it uses."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from service.processes.source_tree import PACKAGES, parse

_ROOT = Path(__file__).parents[3]
_DATA = {  # files, or folders of them, that a module reads as if they were code
    "service.job.report.setup_sheet": ("service/job/report/templates", "service/page/languages"),
    "service.job.spec.finish_library": ("service/job/spec/finishing.toml",),
}


@cache
def state_of_sources(module: str) -> str:
    """Return a hash that changes when the module or anything of ours that it imports, anywhere in it, changes."""
    digest = hashlib.sha256()
    for name in sorted(modules_used(module)):
        for path in (_file(name), *_data_of(name)):
            digest.update(f"{name} {path.name} ".encode() + path.read_bytes())
    return digest.hexdigest()


def modules_used(module: str) -> set[str]:
    """Return the module and all of ours that it imports, directly or not."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += [*_imports(name), *filter(None, [name.rpartition(".")[0]])]  # a package runs before its modules
    return found


@cache
def _imports(module: str) -> tuple[str, ...]:
    return tuple(
        {name for name in _list_imported_names(_file(module)) if name.split(".")[0] in PACKAGES and _exists(name)}
    )


def _list_imported_names(path: Path) -> Iterator[str]:
    """Yield every name that an import mentions, `from a import b` as a and as a.b, in any function, too."""
    for node in _list_statements(parse(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _list_statements(module: ast.Module) -> Iterator[ast.AST]:
    """Yield all statements, but no expressions, which cannot import: ten times as many nodes."""
    waiting: list[ast.AST] = [module]
    while waiting:
        yield (node := waiting.pop())
        for name in ("body", "orelse", "finalbody", "handlers", "cases"):
            waiting += getattr(node, name, ())


def _exists(name: str) -> bool:
    return _file(name).is_file()


def _file(name: str) -> Path:
    path = _ROOT.joinpath(*name.split("."))
    module = path.with_suffix(".py")
    return module if module.is_file() else path / "__init__.py"  # a folder of data may have a module's name


def _data_of(name: str) -> list[Path]:
    places = [_ROOT / place for place in _DATA.get(name, ())]
    inside = (path for place in places for path in place.rglob("*"))
    return sorted(path for path in (*places, *inside) if path.is_file())
