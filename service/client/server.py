"""Client of the job server: address and token come from the options, then the environment, then this user's token file;
every refusal and every lost connection becomes one line.
"""

from __future__ import annotations

import contextlib
import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote, urlsplit

import httpx

from machines.clock import suspend_aware_clock_s
from machines.profile import user_folders
from service.errors import (
    EXIT_FAILURE,
    EXIT_INPUT,
    FailedError,
    InputError,
    ServiceError,
    printable,
    sentence_of_os_error,
)
from service.http.hosts import is_loopback
from service.http.problems import GRANT

VERSION_HEADER = "Causticmill-Version"
_CONNECT_S, _READ_S = 5.0, 60.0
GRANT_WAIT_S = 2.0
_AGAIN_S = (0.1, 0.3, 1.0, 2.0)
_TRY_AGAIN = {502, 503, 504}
DEFAULT_URL = "http://127.0.0.1:8000"
SERVER_VARIABLE = "CAUSTICMILL_SERVER"
TOKEN_VARIABLE = "CAUSTICMILL_TOKEN"
_LONGEST_TOKEN = 500


@dataclass(frozen=True, slots=True)
class Target:
    """A server's address without a slash at its end, and the token to show, if any."""

    url: str
    token: str | None


def target_of(*, server: str | None, token_file: Path | None) -> Target:
    """Return the given target; by default the environment's, or this computer and its token file."""
    url = _address(server, "--server") if server else _address(os.environ.get(SERVER_VARIABLE, ""), SERVER_VARIABLE)
    if token_file is not None:
        return Target(url, _token(_read(token_file), f"--token-file {token_file}"))
    if text := os.environ.get(TOKEN_VARIABLE):
        return Target(url, _token(text, TOKEN_VARIABLE))
    for path in own_token_files():
        if path.is_file():
            return Target(url, _token(_read(path), str(path)))
    return Target(url, None)


def own_token_files() -> tuple[Path, ...]:
    """Return the paths where a person may keep the token: `token` beside the folder of the machine profiles."""
    return tuple(folder.parent / "token" for folder in user_folders())


def _address(text: str, given_as: str) -> str:
    url = (text or DEFAULT_URL).rstrip("/")
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port is None or parts.port > 0)
    except ValueError:
        usable = False
    if not usable or parts.query or parts.fragment or parts.username is not None:
        raise InputError(
            f"{given_as}: '{text}' is not the address of a server; allowed: http://HOST:PORT or https://HOST"
        )
    return url


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except UnicodeDecodeError:
        raise InputError(f"{path} holds no token") from None
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing="cannot read")) from None


def _token(text: str, given_as: str) -> str:
    token = text.strip()
    if not token.isascii() or not token.isprintable() or " " in token or not 0 < len(token) <= _LONGEST_TOKEN:
        raise InputError(
            printable(f"{given_as}: this is not a token; allowed: the one line that `token create` printed")
        )
    return token


class GoneError(FailedError):
    """The server cannot be reached; `begun`: a request may have arrived, so asking again needs a key."""

    def __init__(self, line: str, *, begun: bool) -> None:
        super().__init__(line)
        self.begun = begun


class RefusedError(ServiceError):
    """The server refused: `status`, and the `field` of the request at fault (empty if none)."""

    def __init__(self, status: int, *lines: str, field: str = "", wait_s: float | None = None) -> None:
        super().__init__(*lines)
        self.status = status
        self.field = field
        self.wait_s = wait_s
        self.exit_code = EXIT_FAILURE if status >= 500 or status == 429 else EXIT_INPUT


class ServerClient:
    """`with Server(target) as server: server.get("/v1/jobs")`."""

    def __init__(self, target: Target) -> None:
        self.url = target.url
        headers = {"User-Agent": f"causticmill/{own_version()}"}
        if target.token is not None:
            headers["Authorization"] = f"Bearer {target.token}"
        self._has_token = target.token is not None
        self.http = httpx.Client(
            base_url=target.url,
            headers=headers,
            timeout=httpx.Timeout(_READ_S, connect=_CONNECT_S),
            verify=target.url.startswith("https:"),  # loading certificates takes longer than an answer
            trust_env=not is_loopback(httpx.URL(target.url).host),  # requests to this computer bypass proxies
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.http.close()

    def get(self, path: str, **parameters: Any) -> Any:
        """Get the JSON of an answer. Wait a little for a server that is being restarted."""
        return self.retry(lambda: self._json("GET", path, params=parameters))

    def post(self, path: str, body: Mapping[str, Any] | None = None) -> Any:
        """Send one order, once."""
        return self._json("POST", path, json=body)

    def order(self, machine: str, path: str, body: Mapping[str, Any] | None = None) -> Any:
        """Send an order to a mill once, under a fresh grant. FailedError if it was refused or not sent."""
        begun_s = suspend_aware_clock_s()
        granted = self._json("POST", f"/v1/machines/{quote(machine, safe='')}/grants")
        if suspend_aware_clock_s() - begun_s > GRANT_WAIT_S:
            raise FailedError(
                f"{self.url} took more than {GRANT_WAIT_S:g} s to grant it: the order was not sent; give it again"
            )
        headers = {GRANT: str(granted["grant"])}
        return self._json("POST", path, json=dict(body or {}), headers=headers)

    def post_idempotent(self, path: str, body: Mapping[str, Any]) -> Any:
        """Send a request that may be sent again: its key marks the repetition."""
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        return self.retry(lambda: self._json("POST", path, json=dict(body), headers=headers), timeout_s=60.0)

    def delete(self, path: str) -> None:
        self._json("DELETE", path)

    def send(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send one request and return a successful answer. GoneError, RefusedError."""
        with self._translate_errors():
            answer = self.http.request(method, path, **options)
        self.raise_for_status(answer)
        return answer

    @contextlib.contextmanager
    def stream_answer(self, url: str, *, headers: Mapping[str, str], read_s: float) -> Iterator[httpx.Response]:
        """Open an answer that is read piece by piece. A connection lost meanwhile also raises GoneError.

        The token is not sent to another server (an artifact store).
        """
        own = url.startswith(f"{self.url}/") or (url.startswith("/") and not url.startswith("//"))
        opened = self.http.stream if own else httpx.stream
        timeout = httpx.Timeout(read_s, connect=_CONNECT_S)
        with self._translate_errors(), opened("GET", url, headers=dict(headers), timeout=timeout) as answer:
            if answer.status_code >= 400:
                answer.read()
            yield answer

    def retry(self, ask: Callable[[], Any], *, timeout_s: float = 10.0) -> Any:
        """Call `ask`, which is safe to repeat, until it is answered. Do not wait for a server that never answered."""
        give_up_s, tries = time.monotonic() + timeout_s, 0
        while True:
            try:
                return ask()
            except GoneError as error:
                if (not error.begun and tries == 0) or time.monotonic() > give_up_s:
                    raise
            except RefusedError as error:
                if error.status not in _TRY_AGAIN and error.status != 429:
                    raise
                if time.monotonic() + (error.wait_s or 0.0) > give_up_s:
                    raise
                time.sleep(error.wait_s or 0.0)
            time.sleep(_AGAIN_S[min(tries, len(_AGAIN_S) - 1)])
            tries += 1

    def raise_for_status(self, answer: httpx.Response) -> None:
        """Raise RefusedError for a refusal, or for an answer that does not come from a job server."""
        if answer.status_code < 400:
            return
        problem = _problem(answer)
        if problem is None:
            if answer.status_code in _TRY_AGAIN:  # a proxy whose server is down
                raise RefusedError(answer.status_code, f"{self.url} is not ready: HTTP {answer.status_code}")
            raise RefusedError(answer.status_code, self._explain_mismatch(answer))
        raise RefusedError(
            answer.status_code,
            *self._problem_lines(answer.status_code, problem),
            field=str(problem.get("field", "")),
            wait_s=_seconds(answer.headers.get("Retry-After")),
        )

    def _json(self, method: str, path: str, **options: Any) -> Any:
        answer = self.send(method, path, **options)
        if not answer.content:
            return None
        try:
            return answer.json()
        except ValueError:
            raise RefusedError(500, self._explain_mismatch(answer)) from None

    @contextlib.contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """Translate httpx's errors into ours."""
        try:
            yield
        except (httpx.ConnectError, httpx.ConnectTimeout):
            words = f"no server answers at {self.url}; `causticmill serve` starts one, --server names another"
            raise GoneError(words, begun=False) from None
        except httpx.TimeoutException:
            raise GoneError(f"{self.url} did not answer in time", begun=True) from None
        except (httpx.TransportError, httpx.StreamError) as error:
            words = " ".join(str(error).split()) or type(error).__name__
            raise GoneError(f"the connection to {self.url} was lost: {words}", begun=True) from None

    def _problem_lines(self, status: int, problem: Mapping[str, Any]) -> list[str]:
        """Return a problem of the server as lines; each names the key at fault."""
        parts = [part for part in problem.get("problems") or () if isinstance(part, dict)] or [dict(problem)]
        lines = []
        for part in parts:
            detail, field = str(part.get("detail") or problem.get("title", "")), str(part.get("field", ""))
            key = field.removeprefix("spec.")
            lines.append(detail if not key or key in detail else f"{key}: {detail}")
        if status == 401 and not self._has_token:
            lines.append("a token is needed: --token-file FILE, CAUSTICMILL_TOKEN, or `causticmill token create`")
        return lines

    def _explain_mismatch(self, answer: httpx.Response) -> str:
        """Explain what kind of server gives such an answer."""
        version = answer.headers.get(VERSION_HEADER)
        if version is None:
            return f"{self.url} answers (HTTP {answer.status_code}), but is not a causticmill job server"
        return (
            f"the server at {self.url} is causticmill {version}, this command is {own_version()}, and they do not "
            "understand each other; use the same version"
        )


def own_version() -> str:
    return metadata.version("causticmill")


def make_mismatch_error(server: ServerClient, answer: httpx.Response) -> RefusedError:
    """Return the error for an answer that lacks what this version needs."""
    return RefusedError(500, server._explain_mismatch(answer))


def _problem(answer: httpx.Response) -> dict[str, Any] | None:
    if "problem+json" not in answer.headers.get("Content-Type", ""):
        return None
    try:
        problem = answer.json()
    except ValueError:
        return None
    return problem if isinstance(problem, dict) else None


def _seconds(text: str | None) -> float | None:
    return min(60.0, float(text)) if text and text.isdigit() else None


def clean(value: object) -> str:
    """Return a server's text as one printable line."""
    return printable(str(value))
