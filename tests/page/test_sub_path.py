"""The page in a folder of a proxy's: everything it loads, asks for and links to is below that folder."""

from __future__ import annotations

import contextlib
import http.client
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import expect

from tests.page.browser import Watched
from tests.page.canned_job import JOB_ID
from tests.page.stub import Stub

FOLDER = "/lens"


@contextlib.contextmanager
def proxied(url: str) -> Iterator[tuple[str, list[str]]]:
    """As nginx does it, `location /lens/ { proxy_pass http://server/; }`, without WebSockets.

    With its address: the paths that were asked for outside of the folder.
    """
    parts, astray = urlsplit(url), []  # type: ignore[var-annotated]

    class Handler(BaseHTTPRequestHandler):
        def pass_on(self) -> None:
            if not self.path.startswith(f"{FOLDER}/"):
                astray.append(self.path)
                self.send_error(404)
                return
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            server = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=60)
            headers = {name: value for name, value in self.headers.items() if name.lower() not in _HOP_BY_HOP}
            server.request(self.command, self.path.removeprefix(FOLDER), body, headers)
            answer = server.getresponse()
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() not in (*_HOP_BY_HOP, "content-length"):
                    self.send_header(name, value)
            self.send_header("Connection", "close")
            self.end_headers()
            with contextlib.suppress(OSError):
                while piece := answer.read1(65536):
                    self.wfile.write(piece)

        do_GET = do_POST = do_PUT = do_DELETE = pass_on

        def log_message(self, *_: Any) -> None: ...

    proxy = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    proxy.daemon_threads = True
    thread = threading.Thread(target=proxy.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{proxy.server_port}{FOLDER}/", astray
    proxy.shutdown()
    proxy.server_close()
    thread.join()


_HREFS = "all => all.map(one => one.getAttribute('href'))"
_HOP_BY_HOP = ("connection", "transfer-encoding", "upgrade", "host")


def test_every_screen_works_below_a_folder(watched: Callable[..., Watched], stub: Stub) -> None:
    with proxied(stub.url) as (address, astray):
        context = watched("wide", "light")
        context.expect_errors("WebSocket", "status of 404")
        page = context.page()
        for screen, heading in (("", "Jobs"), ("#/new", "New job"), ("#/machines", "Machines")):
            page.goto(f"{address}?{heading}{screen}")
            expect(page.get_by_role("heading", level=1, name=heading)).to_be_visible()
        page.goto(f"{address}?job#/jobs/{JOB_ID}")
        links = page.locator("a[download]")
        expect(links.first).to_be_attached()
        assert all(str(link).startswith(f"{FOLDER}/v1/") for link in links.evaluate_all(_HREFS))
        sheets = page.evaluate("[...document.styleSheets].map(one => one.href)")
        assert sheets and all(f"{FOLDER}/page/" in sheet for sheet in sheets)
        assert astray in ([], ["/favicon.ico"])
