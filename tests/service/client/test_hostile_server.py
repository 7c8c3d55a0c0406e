"""A server is not trusted with this computer: what it names is checked before it becomes a path or a line."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.service.client.shop import run

_HASH = "0" * 64


@contextmanager
def answering(
    status: int, body: object, kind: str = "application/json", **headers: str
) -> Iterator[tuple[str, list[dict[str, str]]]]:
    """A server that gives one answer to everything; its address, and the headers it was asked with."""
    asked: list[dict[str, str]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(dict(self.headers))
            content = body if isinstance(body, bytes) else json.dumps(body).encode()
            self.send_response(status)
            for name, value in {"Content-Type": kind, "Content-Length": str(len(content)), **headers}.items():
                self.send_header(name.replace("_", "-"), value)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", asked
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["../evil", "/etc/passwd", ".bashrc", "a/b", "", "x" * 200])
def test_a_file_name_that_leaves_the_folder_is_refused(tmp_path: Path, name: str) -> None:
    item = {"name": name, "sha256": _HASH, "bytes": 1, "url": "/x"}
    with answering(200, {"artifacts": [item]}) as (url, _):
        done = run("get", "job-1", "-o", str(tmp_path / "out"), server=url)
    assert done.returncode == 1
    assert "an unusable name" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_another_kind_of_server_is_told_from_ours(tmp_path: Path) -> None:
    with answering(404, b"<h1>nothing here</h1>", "text/html") as (url, _):
        done = run("jobs", server=url)
    assert done.returncode == 2
    assert done.stderr == f"error: {url} answers (HTTP 404), but is not a causticmill job server\n"


def test_another_version_that_is_not_understood_is_named() -> None:
    with answering(404, b"", "text/plain", Causticmill_Version="9.0") as (url, _):
        done = run("jobs", server=url)
    assert done.returncode == 2
    assert "is causticmill 9.0, this command is" in done.stderr


def test_control_characters_of_a_server_do_not_reach_the_terminal() -> None:
    problem = {"title": "x", "status": 404, "detail": "no \x1b[2Jjob"}
    with answering(404, problem, "application/problem+json") as (url, _):
        done = run("jobs", "show", "job-1", server=url)
    assert done.returncode == 2
    assert "\x1b" not in done.stderr and "no ?[2Jjob" in done.stderr


def test_the_token_goes_to_the_server_and_not_to_where_it_points(tmp_path: Path) -> None:
    """A file at another address (the artifact store) is fetched without it."""
    with answering(200, b"x") as (store, asked_store):
        item = {
            "name": "a.txt",
            "sha256": "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881",
            "bytes": 1,
            "url": f"{store}/object",
        }
        with answering(200, {"artifacts": [item]}) as (url, asked):
            done = run("get", "job-1", "-o", str(tmp_path), server=url, CAUSTICMILL_TOKEN="secret")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.txt").read_bytes() == b"x"
    assert [headers.get("Authorization") for headers in asked] == ["Bearer secret"]
    assert [headers.get("Authorization") for headers in asked_store] == [None]
