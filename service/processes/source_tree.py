"""Our own sources: where a child process finds them, their syntax trees, and a hash of all that a module can run: its
own source and, along all imports, those it uses.
"""

from __future__ import annotations

import ast
import hashlib
import os
import threading
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

_parsing = threading.Lock()  # CPython before 3.12 may fail where two threads parse at once (its issue 106905)
_ROOT = Path(__file__).parents[2]
PACKAGES = ("phrases", "optics", "cam", "machines", "service")
"""All of ours."""


def parse(path: Path) -> ast.Module:
    with _parsing:
        return ast.parse(path.read_bytes())


def hash_files(paths: Iterable[Path]) -> str:
    """Return a hash of the names and contents of these files, in this order."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def python_path() -> str:
    """Return PYTHONPATH for a child: this tree, then the value of the present environment."""
    return os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))


@cache
def state_of_sources(module: str, data: tuple[tuple[str, str], ...] = ()) -> str:
    """Return a hash that changes when the module changes, or one of our modules that it imports, directly or not, even
    inside a function.

    data : (module, file or folder below the root) that this module reads as if it were code
    """
    digest = hashlib.sha256()
    for name in sorted(modules_used(module)):
        for path in (_file(name), *_data_of(name, data)):
            digest.update(f"{name} {path.name} ".encode() + path.read_bytes())
    return digest.hexdigest()


def modules_used(module: str) -> set[str]:
    """Return the module and all of our modules that it imports, directly or not."""
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
    """Yield every name that an import mentions, also inside functions; `from a import b` gives a and a.b."""
    for node in _list_statements(parse(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _list_statements(module: ast.Module) -> Iterator[ast.AST]:
    """Yield all statements. Expressions cannot import and are skipped: they are ten times as many nodes."""
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


def _data_of(name: str, data: tuple[tuple[str, str], ...]) -> list[Path]:
    places = [_ROOT / place for reader, place in data if reader == name]
    inside = (path for place in places for path in place.rglob("*"))
    return sorted(path for path in (*places, *inside) if path.is_file())
