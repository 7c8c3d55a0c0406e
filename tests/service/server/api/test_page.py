"""The operator page as it is served: every file, to everybody, and nothing else; nothing in it comes from elsewhere."""

from __future__ import annotations

import gzip
import json
import re
import socket
import tomllib
from importlib import metadata
from pathlib import Path

import httpx
import pytest

from service.page.files import FOLDER
from service.server.api.routes.page import MADE
from tests.service.server.api.server import ApiServer, api_server, problem
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[4]
FILES = sorted(str(path.relative_to(FOLDER)) for path in FOLDER.rglob("*") if path.is_file() and path.suffix != ".pyc")
SERVED = [path for path in FILES if not path.endswith(".py")]
MODULES = [path for path in SERVED if path.endswith(".js")]
IMPORT = re.compile(
    r"""^\s*(?:import|export)\b[^;"'=()]*?\bfrom\s*["']([^"']+)|^\s*import\s*["']([^"']+)|\bimport\(\s*["']([^"']+)""",
    re.MULTILINE,
)
HTML = {"Accept": "text/html,application/xhtml+xml;q=0.9"}


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> ApiServer:
    """A server on which nobody is anonymous any more."""
    with api_server(tmp_path_factory.mktemp("page") / "data") as server:
        server.services.tokens.create("a", ["jobs:read"])
        yield server


def test_a_browser_gets_the_page_at_the_address_and_a_program_gets_json(closed: ApiServer) -> None:
    page = closed.client.get("/", headers=HTML)
    assert page.status_code == 200 and page.headers["content-type"].startswith("text/html")
    assert page.text == (FOLDER / "index.html").read_text(encoding="utf-8")
    assert {"Accept", "Accept-Encoding"} <= set(page.headers["vary"].split(", "))
    assert closed.client.get("/").json()["name"] == "causticmill"


@pytest.mark.parametrize("path", SERVED)
def test_every_file_is_there_for_everybody_packed_and_with_its_policy(closed: ApiServer, path: str) -> None:
    plain = closed.client.get(f"/page/{path}", headers={"Accept-Encoding": "identity"})
    assert plain.status_code == 200 and plain.content == (FOLDER / path).read_bytes()
    assert "content-encoding" not in plain.headers and plain.headers["cache-control"] == "no-cache"
    with (
        httpx.Client(base_url=closed.address, timeout=PATIENCE_S) as client,
        client.stream("GET", f"/page/{path}") as answer,
    ):
        raw = b"".join(answer.iter_raw())
        packed = answer.headers
    if "content-encoding" in packed:
        assert len(raw) < len(plain.content) and gzip.decompress(raw) == plain.content
        assert packed["etag"] != plain.headers["etag"]
    for headers in (plain.headers, packed):
        again = closed.client.get(
            f"/page/{path}",
            headers={"If-None-Match": headers["etag"], "Accept-Encoding": headers.get("content-encoding", "identity")},
        )
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", headers["etag"])
        policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
        assert policy["default-src"] == "'none'" and policy["script-src"] == policy["style-src"] == "'self'"
        assert headers["x-content-type-options"] == "nosniff"
    head = closed.client.head(f"/page/{path}", headers={"Accept-Encoding": "identity"})
    assert (head.content, head.headers["content-length"]) == (b"", str(len(plain.content)))


def test_modules_are_of_the_type_that_browsers_take(closed: ApiServer) -> None:
    kinds = {Path(path).suffix: closed.client.get(f"/page/{path}").headers["content-type"] for path in SERVED}
    assert kinds[".js"].startswith("text/javascript") and kinds[".css"].startswith("text/css")


@pytest.mark.parametrize(
    "path",
    [
        "files.py", "__init__.py", "nothing.js", "", "../settings.py", "..%2fsettings.py", "%2e%2e/spec.py", "lib",
        "/etc/passwd", "lib/../../tools.toml", "index.html/", "index.html%00", ".html", "a/b/c/d/e/f.js",
    ],
)  # fmt: skip
def test_nothing_but_the_page_is_served(closed: ApiServer, path: str) -> None:
    answer = closed.client.get(f"/page/{path}")
    assert answer.status_code in (401, 404), (path, answer.text)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE"])
def test_files_are_only_read(closed: ApiServer, method: str) -> None:
    problem(closed.client.request(method, "/page/index.html"), 405)


def test_a_file_that_is_changed_is_served_as_it_is_now(tmp_path: Path) -> None:
    from service.page.files import PageFiles

    files = PageFiles(tmp_path)
    (tmp_path / "a.js").write_text("one")
    first = files.file("a.js")
    (tmp_path / "a.js").write_text("another")
    second = files.file("a.js")
    assert first is not None and second is not None
    assert (first.content, second.content) == (b"one", b"another") and first.etag != second.etag
    (tmp_path / "a.js").unlink()
    assert files.file("a.js") is None


@pytest.mark.parametrize("path", [path for path in SERVED if path.endswith(".html")])
def test_what_the_policy_forbids_is_not_in_the_html(path: str) -> None:
    """No script or style inside of it, no attribute that would be one."""
    text = (FOLDER / path).read_text(encoding="utf-8")
    assert not re.search(r"<style|\sstyle=|\son[a-z]+=|javascript:", text)
    assert all("src=" in tag for tag in re.findall(r"<script[^>]*>", text))


@pytest.mark.parametrize("path", [path for path in SERVED if not path.endswith((".png", ".jpg", ".avif"))])
def test_nothing_comes_from_elsewhere(path: str) -> None:
    text = re.sub(r"http://(www\.w3\.org/|127\.0\.0\.1:port)", "", (FOLDER / path).read_text(encoding="utf-8"))
    assert not re.search(r"""(?:https?|wss?):\/\/[a-z0-9]|["'(]\/\/[a-z0-9]""", text)
    assert "@import" not in text and "eval(" not in text and "innerHTML" not in text


@pytest.mark.parametrize("path", MODULES)
def test_every_module_that_is_imported_is_there(path: str) -> None:
    text = (FOLDER / path).read_text(encoding="utf-8")
    for found in filter(None, (name for names in IMPORT.findall(text) for name in names)):
        assert found.startswith("."), f"{path}: {found}"
        at = (FOLDER / path).parent.joinpath(found).resolve()
        assert at.is_file() or str(at.relative_to(FOLDER.resolve())) in MADE, f"{path}: {found}"


@pytest.mark.parametrize("path", MADE)
def test_a_module_that_the_server_makes_is_served_as_a_file_is(closed: ApiServer, path: str) -> None:
    answer = closed.client.get(f"/page/{path}")
    name, value = MADE[path]
    exported = answer.text.removeprefix(f"export const {name} = ").removesuffix(";\n")
    assert json.loads(exported) == json.loads(json.dumps(value()))
    assert (
        answer.headers["content-type"].startswith("text/javascript") and answer.headers["cache-control"] == "no-cache"
    )
    assert not (FOLDER / path).exists()
    again = closed.client.get(f"/page/{path}", headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_an_installed_server_has_every_file() -> None:
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["service"]
    shipped = {path for pattern in patterns for path in (ROOT / "service").glob(pattern)}
    assert {FOLDER / path for path in SERVED} <= shipped


VERSION = metadata.version("causticmill")


def test_the_root_tells_what_is_here_and_where_the_rest_is(server: ApiServer) -> None:
    told = server.client.get("/").json()
    assert (told["name"], told["version"]) == ("causticmill", VERSION)
    for path in told["links"].values():
        assert server.client.get(path).status_code in (200, 401, 503), path


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [("GET", "/livez", 200), ("GET", "/nowhere", 404), ("PUT", "/livez", 405), ("GET", "/v1/jobs?limit=x", 422)],
)
def test_every_answer_tells_the_version(server: ApiServer, method: str, path: str, status: int) -> None:
    answer = server.client.request(method, path)
    assert (answer.status_code, answer.headers.get_list("causticmill-version")) == (status, [VERSION])


def test_what_the_guard_and_the_wire_refuse_tells_the_version_too(server: ApiServer) -> None:
    assert (
        httpx.get(f"{server.address}/livez", headers={"Host": "evil"}, timeout=PATIENCE_S).headers[
            "causticmill-version"
        ]
        == VERSION
    )
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S) as wire:
        wire.sendall(b"this is no request\r\n\r\n")
        answer = wire.makefile("rb").read().decode()
    assert answer.startswith("HTTP/1.1 400") and f"causticmill-version: {VERSION}" in answer.lower()
