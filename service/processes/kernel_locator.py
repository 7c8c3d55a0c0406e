"""Tells numba where a kernel's compiled code is: in a folder named by the hash of all its source code.

numba's own locators identify a kernel by its file. They do not notice a change in a kernel of another file that it
calls, and they do notice changes of docstrings. Here the hash covers the kernel's definition, without docstrings, and
the definitions of all our names that it uses, directly or not, including constants and annotations. So an outdated
kernel is never used, and any copy of the sources, in any place, shares the cache.
"""

from __future__ import annotations

import ast
import atexit
import contextlib
import fcntl
import hashlib
import json
import os
import threading
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import IO, Any

from numba.core import caching, dispatcher
from numba.core import config as numba_config

from service.processes.files import write_whole
from service.processes.source_tree import PACKAGES, hash_files, parse

_ROOT = Path(__file__).parents[2]
_MOST_WAIT_S, _LOOK_S = 30.0, 0.02  # wait for another process that compiles a kernel
_reading = threading.Lock()  # removing docstrings changes syntax trees that all kernels share


class KernelLocator(caching._CacheLocator):
    """The locator that NUMBA_CACHE_LOCATOR_CLASSES gives to numba; None for functions that are not at the top level of
    one of our files.
    """

    def __init__(self, module: str, name: str, root: Path) -> None:
        self._stamp = _find_hash(module, name, root)
        self._folder = f"{_cache_folder()}/{module}.{name}-{self._stamp}"
        with contextlib.suppress(OSError):
            os.utime(self._folder)  # in use: see `use_current_kernels`

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelLocator | None:
        path = Path(py_file).resolve()
        if not (_cache_folder() and path.is_relative_to(_ROOT)) or "." in py_func.__qualname__:
            return None
        return cls(".".join(path.relative_to(_ROOT).with_suffix("").parts), py_func.__name__, _ROOT)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return "kernel"


class _Index(caching.IndexDataCacheFile):
    """The cache index of a kernel. The types of its arguments are stored by their modules' names, which are not part of
    the kernel's definition: if such a module has moved, the index is ignored and the kernel is compiled again.
    """

    def _load_index(self) -> dict[Any, Any]:
        try:
            found: dict[Any, Any] = super()._load_index()  # type: ignore[no-untyped-call]
        except (ImportError, AttributeError):
            return {}
        return found


class _SharedCache(caching.FunctionCache):
    """A kernel's cache that waits while another process compiles the same kernel: two processes that start together, as
    tests do, would otherwise each compile everything.

    There is no deadlock: a process that compiles a kernel waits at most for a kernel that this one calls. A process
    that ends releases its lock.
    """

    _lock: IO[bytes] | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        if found is None and isinstance(self._impl.locator, KernelLocator):
            with contextlib.suppress(OSError):
                self._impl.locator.ensure_cache_path()  # type: ignore[no-untyped-call]
                self._lock = _take_lock(Path(self.cache_path, "compiling"))
                found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            if found is not None:
                self._let_go()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        self._let_go()

    def _let_go(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def _take_lock(path: Path) -> IO[bytes]:
    """Wait for the lock of the file and return the file; after half a minute return it unlocked, because a process that
    could not compile a kernel keeps its lock.
    """
    file = path.open("wb")
    end = time.monotonic() + _MOST_WAIT_S
    while time.monotonic() < end:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_LOOK_S)
        else:
            break
    return file


# numba has no other place for them
caching.IndexDataCacheFile = _Index  # type: ignore[misc]
dispatcher.FunctionCache = _SharedCache  # type: ignore[attr-defined]


def _cache_folder() -> str:
    return str(getattr(numba_config, "CACHE_DIR", ""))  # known to numba only once it runs


def _find_hash(module: str, name: str, root: Path) -> str:
    """Return `kernel_hash` from a cache: computing it for all kernels takes a third of their import time."""
    known, at = _load_known_hashes(root), f"{module}.{name}"
    if at not in known:
        known[at] = kernel_hash(module, name, root)
    return known[at]


@cache
def _load_known_hashes(root: Path) -> dict[str, str]:
    """Return the hashes, by name, that earlier processes have computed for the same sources; this process adds its own
    at its end.
    """
    sources = (path for package in PACKAGES for path in sorted((root / package).rglob("*.py")))
    kept = Path(_cache_folder(), f"hashes-{hash_files(sources)[:16]}.json")
    known = _read_hashes(kept)
    atexit.register(_keep_hashes, kept, known, len(known))
    return known


def _read_hashes(path: Path) -> dict[str, str]:
    try:
        return dict(json.loads(path.read_bytes()))
    except (OSError, ValueError):
        return {}


def _keep_hashes(path: Path, known: dict[str, str], count: int) -> None:
    if len(known) > count:
        with contextlib.suppress(OSError):
            write_whole(path, json.dumps({**_read_hashes(path), **known}))


def kernel_hash(module: str, name: str, root: Path = _ROOT) -> str:
    """Return the hash of the definitions on which a module's top-level `name` depends, in modules under `root`."""
    found: dict[tuple[str, str], str] = {}
    waiting = [(module, name)]
    while waiting:
        at = waiting.pop()
        if at not in found:
            with _reading:
                found[at], uses = _definition(root, *at)
            waiting += uses
    text = "\n".join(f"{module}.{name} {found[module, name]}" for module, name in sorted(found))
    return hashlib.sha256(text.encode()).hexdigest()[:20]


@cache
def _definition(root: Path, module: str, name: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return the statements that bind a module's top-level name, as text without docstrings, and the names from our
    modules that they use. The name "" means the whole module.
    """
    names, text, uses = _names(root, module), [], []
    for bound in [name] if name else names:
        for statement in names.get(bound, []):
            if isinstance(statement, ast.Import | ast.ImportFrom):
                for alias in statement.names:
                    if bound == (alias.asname or alias.name):
                        text.append(f"{getattr(statement, 'module', '')}.{alias.name}")
                        uses += _resolve_import(root, text[-1])
                continue
            for node in ast.walk(statement):
                if isinstance(node, ast.Name) and node.id in names:
                    uses.append((module, node.id))
                elif isinstance(node, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node, clean=False):
                    node.body = node.body[1:]
            text.append(ast.dump(statement))
    return "\n".join(text), tuple(uses)


def _resolve_import(root: Path, imported: str) -> list[tuple[str, str]]:
    """Resolve an import to a name in one of our modules, or to a module, which counts as a whole."""
    module, _, name = imported.rpartition(".")
    return [at for at in ((imported, ""), (module, name)) if _file(root, at[0]).is_file()]


@cache
def _names(root: Path, module: str) -> dict[str, list[ast.stmt]]:
    """Return a module's top-level statements by the names that they bind."""
    names: dict[str, list[ast.stmt]] = {}
    for statement in parse(_file(root, module)).body:
        for one in statement.body if isinstance(statement, ast.If) else [statement]:  # if TYPE_CHECKING
            for name in _bound_names(one):
                names.setdefault(name, []).append(one)
    return names


def _bound_names(statement: ast.stmt) -> Iterator[str]:
    match statement:
        case ast.FunctionDef() | ast.ClassDef():
            yield statement.name
        case ast.Import() | ast.ImportFrom():
            yield from (alias.asname or alias.name for alias in statement.names)
        case _:
            for node in ast.walk(statement):
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                    yield node.id


def _file(root: Path, module: str) -> Path:
    return root.joinpath(*module.split(".")).with_suffix(".py")
