"""The arrows between the packages point one way, and the pure ones touch neither files nor clocks nor the web."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("phrases", "optics", "cam", "machines", "service")
WEB = {
    *("pydantic", "pydantic_settings", "fastapi", "starlette", "uvicorn", "httpx", "typer", "rich", "jinja2"),
    *("sqlalchemy", "alembic", "dbos", "structlog", "prometheus_client"),
}
FILE_CALLS = {"open", "read_text", "write_text", "read_bytes", "write_bytes", "savez", "save", "tofile", "unlink"}
FILE_MODULES = {"pathlib", "shutil", "tempfile", "io", "socket", "sqlite3", "subprocess"}


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Full names of the modules a file imports, `from a import b` as both a and a.b."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {str(node.module)} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def roots(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in imported(path)}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_has_modules(package: str) -> None:
    """Guards the other tests: an empty list of modules would pass them all."""
    assert len(modules(package)) >= 2


@pytest.mark.parametrize("package", ["phrases", "optics", "machines"])
def test_phrases_optics_and_machines_import_no_sibling(package: str) -> None:
    """Whoever says something uses `phrases`."""
    siblings = set(PACKAGES) - {package, "phrases"}
    assert {str(path): roots(path) & siblings for path in modules(package) if roots(path) & siblings} == {}


def test_cam_imports_the_heightfield_of_optics_and_nothing_else_of_ours() -> None:
    for path in modules("cam"):
        ours = {name for name in imported(path) if name.partition(".")[0] in set(PACKAGES) - {"cam", "phrases"}}
        assert all(f"{name}.".startswith("optics.heightfield.") for name in ours), (path, ours)


@pytest.mark.parametrize("package", ["phrases", "optics", "cam", "machines"])
def test_web_and_validation_libraries_live_only_in_service(package: str) -> None:
    assert {str(path): roots(path) & WEB for path in modules(package) if roots(path) & WEB} == {}


@pytest.mark.parametrize("package", ["optics", "cam"])
def test_nothing_in_optics_or_cam_opens_a_file(package: str) -> None:
    for path in modules(package):
        assert not roots(path) & FILE_MODULES, path
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                assert name not in FILE_CALLS, f"{path}:{node.lineno}: {name}()"


def test_only_the_port_knows_pyserial() -> None:
    assert [path.name for path in modules("machines") if "serial" in roots(path)] == ["port.py"]
    assert not any("serial" in roots(path) for path in modules("service"))


def test_only_the_adapter_knows_the_job_engine() -> None:
    assert [path.name for path in modules("service") if "dbos" in roots(path)] == ["dbos.py"]


def test_the_adapter_uses_of_the_job_engine_what_is_public() -> None:
    path = ROOT / "service" / "server" / "queue" / "dbos.py"
    private = [name for name in imported(path) if name.startswith("dbos.") and "._" in name]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_"):
            private += [] if getattr(node.value, "id", "") == "self" else [node.attr]
    assert private == []


FLOORS = (
    ("cli",),
    ("client", "server"),
    ("job",),
    ("milling",),
    ("store", "page"),
    ("settings", "progress"),
    ("processes", "http", "logs", "wording"),
    ("errors",),
)
"""Of `service`, from the top down: each room knows only rooms below it."""


def test_nothing_in_service_knows_what_stands_above_or_beside_it() -> None:
    floor = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
    rooms = {path.relative_to(ROOT / "service").parts[0].removesuffix(".py") for path in modules("service")}
    assert rooms - {"__init__"} == set(floor)
    for path in modules("service"):
        own = path.relative_to(ROOT / "service").parts[0].removesuffix(".py")
        known = {name.split(".")[1] for name in imported(path) if name.startswith("service.")}
        assert not [room for room in known - {own} if floor[room] <= floor[own]], (path, known)


def test_the_client_needs_of_the_server_only_its_address() -> None:
    """It may run on a computer where there is neither a store nor settings of a server, and no stage is run."""
    for path in modules("service/client"):
        inside = ("service.store.", "service.settings.", "service.job.stages.")
        assert not [name for name in imported(path) if f"{name}.".startswith(inside)], path


def test_the_simulated_mill_reads_programs_by_itself() -> None:
    """A parser shared with the streamer would hide the streamer's mistakes from every test."""
    for path in modules("machines/simulated"):
        ours = {name for name in imported(path) if name.startswith("machines.")}
        allowed = ("machines.simulated", "machines.errors")
        assert all(name.startswith(allowed) for name in ours), (path, ours)


def test_what_streams_does_without_arrays() -> None:
    """The streaming process stays small: arrays and compiled code belong to pre-flight's child."""
    heavy = {"numpy", "numba", "scipy"}
    users = [path.name for path in modules("machines") if roots(path) & heavy]
    assert sorted(users) == ["scan.py", "scan_kernel.py", "scan_moves.py"]


def test_the_protocol_core_has_no_thread_port_or_clock() -> None:
    shell = {"threading", "time", "socket", "select", "os", "serial", "asyncio"}
    for path in modules("machines/grbl"):
        if path.name != "driver.py":
            assert not roots(path) & shell, path


def test_no_circle_between_modules() -> None:
    """Of all imports: at the top, in functions, and for types alone."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for p in PACKAGES for path in modules(p)}
    edges = {name: imported(path) & set(names) - {name} for name, path in names.items()}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail, name))
        if name not in done:
            for target in edges[name]:
                visit(target, (*trail, name))
            done.add(name)

    for name in names:
        visit(name, ())
