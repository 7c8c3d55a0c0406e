"""An agent that is none: says whatever a test wants, over real HTTP."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

HANGS_S = 60.0
Answer = tuple[int, dict[str, str], bytes]


class Rogue:
    """`answers` gives the answer to a method and path; None: the connection hangs. It takes anybody's word for control
    and gives grants for the asking, where `answers` is not asked for these, too (`strict`).
    """

    def __init__(self, name: str) -> None:
        self.asked: list[tuple[str, str]] = []
        self.answers: Callable[[str, str], Answer | None] = lambda _method, _path: (404, {}, b"{}")
        self.strict = False
        self.over = threading.Event()
        rogue = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *_: Any) -> None: ...

            def answer(self) -> None:
                rogue.asked.append((self.command, self.path))
                self.rfile.read(int(self.headers.get("Content-Length") or 0))
                known = None if rogue.strict else KNOWN.get(self.path)
                told = as_json({"name": name}) if self.path == "/v1/machine" else known
                told = told or rogue.answers(self.command, self.path)
                if told is None:
                    rogue.over.wait(HANGS_S)
                    self.close_connection = True
                    return
                status, headers, body = told
                self.send_response(status)
                for key, value in ({"Content-Length": str(len(body))} | headers).items():
                    self.send_header(key, value)
                self.end_headers()
                with contextlib.suppress(OSError):
                    self.wfile.write(body)

            do_GET = do_POST = do_PUT = do_DELETE = answer

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.server.server_port}"


@contextlib.contextmanager
def rogue_agent(name: str) -> Iterator[Rogue]:
    rogue = Rogue(name)
    thread = threading.Thread(target=rogue.server.serve_forever, daemon=True)
    thread.start()
    try:
        yield rogue
    finally:
        rogue.over.set()
        rogue.server.shutdown()
        rogue.server.server_close()
        thread.join()


def as_json(values: object, status: int = 200) -> Answer:
    return status, {"Content-Type": "application/json"}, json.dumps(values).encode()


KNOWN = {
    "/v1/lease": as_json({"operator": "Ada", "since_s": 1.0, "control": "s" * 24, "expires_s": 60.0}, 201),
    "/v1/lease/check": (204, {}, b""),
    "/v1/grants": as_json({"grant": "g" * 24, "valid_s": 3.0, "stops": 0}, 201),
}
