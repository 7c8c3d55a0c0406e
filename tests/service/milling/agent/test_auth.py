"""Who may reach the agent: the token, and no Host header that a web page could have made up."""

from __future__ import annotations

import asyncio
import socket
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest
from starlette.types import Message, Receive, Scope, Send

from service.errors import InputError
from service.milling.agent.card import make_token, read_token
from service.milling.agent.requests import AgentGuard
from service.milling.agent.settings import make_agent_settings, mill_folder, port_slug

TOKEN = "a-token-of-some-length"


def status(path: str, *headers: tuple[str, str]) -> int:
    """What a request with these headers is answered; 200 = it got through to the app."""
    answered: list[int] = []

    async def app(_scope: Scope, _receive: Receive, _send: Send) -> None:
        answered.append(200)

    async def send(message: Message) -> None:
        if message["type"] == "http.response.start":
            answered.append(message["status"])

    async def receive() -> Message:
        raise AssertionError

    scope = {
        "type": "http",
        "path": path,
        "method": "GET",
        "headers": [(name.lower().encode(), value.encode()) for name, value in headers],
    }
    asyncio.run(AgentGuard(app, token=TOKEN)(scope, receive, send))
    return answered[0]


GOOD = ("Authorization", f"Bearer {TOKEN}")


@pytest.mark.parametrize(
    "host", ["localhost", "localhost:8765", "127.0.0.1:8765", "[::1]:8765", "192.168.1.7", socket.gethostname()]
)
def test_addresses_and_own_names_are_let_through(host: str) -> None:
    assert status("/v1/status", ("Host", host), GOOD) == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8765", "", "127.0.0.1.evil.example", "[evil]:1", "local"]
)
def test_a_host_that_a_page_could_have_pointed_here_is_refused(host: str) -> None:
    assert status("/v1/status", ("Host", host), GOOD) == 403
    assert status("/livez", ("Host", host)) == 403


@pytest.mark.parametrize("shown", ["", "Bearer", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", f"Basic {TOKEN}", TOKEN])
def test_without_the_token_nothing_but_livez_answers(shown: str) -> None:
    host, token = ("Host", "localhost"), ("Authorization", shown)
    assert status("/v1/status", host, token) == 401
    assert status("/v1/control/hold", host, token) == 401
    assert status("/livez", host, token) == 200


def test_two_headers_of_one_kind_are_refused() -> None:
    assert status("/v1/status", ("Host", "evil.example"), ("Host", "localhost"), GOOD) == 400
    assert status("/v1/status", ("Host", "localhost"), ("Authorization", "Bearer no"), GOOD) == 400


def test_a_made_token_is_private_and_stays_the_same(tmp_path: Path) -> None:
    token, path = make_token(tmp_path / "mill")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert len(token) >= 32
    assert make_token(tmp_path / "mill") == (token, path)


@pytest.mark.parametrize("content", ["", "short", "two words of some length", "x" * 20 + "\ny"])
def test_a_token_file_must_hold_one_word(tmp_path: Path, content: str) -> None:
    path = tmp_path / "token"
    path.write_text(content)
    path.chmod(0o600)
    with pytest.raises(InputError, match="one word"):
        read_token(path)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644])
def test_a_token_file_that_others_can_read_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "token"
    path.write_text(TOKEN)
    path.chmod(mode)
    with pytest.raises(InputError, match="chmod 600"):
        read_token(path)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", "mill.shop"])
def test_an_address_others_can_reach_needs_tls_and_a_token_of_the_person(tmp_path: Path, host: str) -> None:
    """As the job server does: in the clear, whoever listens on the wire has the token, and the mill with it."""

    def settings(token_file: Path | None, *, behind_proxy: bool) -> str:
        return make_agent_settings(
            machine="m", port_url="p", own_port=None, host=host, bind_port=1, data=tmp_path / "data",
            token_file=token_file, behind_proxy=behind_proxy,
        ).token  # fmt: skip

    token_file = tmp_path / "t"
    token_file.write_text(TOKEN)
    token_file.chmod(0o600)
    for given in (None, token_file):
        with pytest.raises(InputError, match="--behind-proxy"):
            settings(given, behind_proxy=False)
    with pytest.raises(InputError, match="--token-file"):
        settings(None, behind_proxy=True)
    assert not (tmp_path / "data").exists(), "nothing is made before the address is allowed"
    assert settings(token_file, behind_proxy=True) == TOKEN


def test_a_certain_mill_keeps_its_name_and_a_general_one_its_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    url = "/dev/serial/by-id/usb-1a86_USB-if00"
    assert mill_folder("shop", own_port=url, port_url=url) == Path("/state/causticmill/shop")
    assert mill_folder("grbl", own_port=None, port_url=url) == Path(
        "/state/causticmill/dev-serial-by-id-usb-1a86-USB-if00"
    )
    assert port_slug("socket://127.0.0.1:23") != port_slug("socket://127.0.0.1:24")
    assert port_slug("../..") == "port"


def test_agents_that_start_at_once_have_one_token(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        for number in range(50):
            folder, ready = tmp_path / str(number), Barrier(8)
            made = list(pool.map(lambda _: (ready.wait(), make_token(folder))[1], range(8)))  # noqa: B023
            assert len(set(made)) == 1
            assert [path.name for path in folder.iterdir()] == ["token"]
