"""Pairing: a short code makes a page an operator's, wrong tries are counted, and nothing else opens or closes by it."""

from __future__ import annotations

import concurrent.futures
import io
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from service.errors import InputError
from service.server.api.access.guard import refuse_foreign_bind
from service.server.api.routes.operations import PairingBody
from service.server.database.connection import begin_reading, begin_writing
from service.server.database.pairing import (
    ALL,
    CODE_LIFE_S,
    EACH,
    NoCodeError,
    PairingBook,
    TooManyTriesError,
    WrongCodeError,
)
from service.server.database.tables import pairings, tokens
from service.server.database.tokens import TokenBook
from service.server.pairing_code import ALPHABET, CodeOnTerminal, code_of, new_offer, read_code
from service.settings import ServerSettings
from tests.service.server.api.server import ApiServer, api_server, problem
from tests.service.server.supervisor.processes import CODE
from tests.service.terminal import Terminal

WRONG = "0000-0000-0000"


class Clock:
    now = 1_000_000.0

    def __call__(self) -> float:
        return self.now


def offered(server: ApiServer) -> str:
    """A code that is taken from now on."""
    offer = other_than(WRONG)
    server.services.pairings.offer(offer)
    return code_of(offer)


def other_than(code: str) -> str:
    return next(offer for offer in iter(new_offer, None) if code_of(offer) != code)


def test_the_documented_example_looks_like_a_code() -> None:
    examples = PairingBody.model_json_schema()["properties"]["code"]["examples"]
    assert all(re.fullmatch(CODE, code) for code in [*examples, code_of(new_offer())]), examples


def test_a_code_is_sixty_bits_and_read_as_people_type_it() -> None:
    """At 10^6 slow digests a second a day is too short to find one, by a factor of 10^7."""
    assert len(set(ALPHABET)) == 32 and not set("OIL") & set(ALPHABET)
    seen = [code_of(new_offer()) for _ in range(200)]
    assert set("".join(seen)) == set(ALPHABET) | {"-"} and len(set(seen)) == 200
    assert 32**12 / (1e6 * CODE_LIFE_S) > 1e7
    for typed in ("7k3d0qxm91tz", " 7K3D 0QXM 91TZ ", "7k3d-oqxm-9ltz", "7K3D-OQXM-9iTZ", "7K-3D-0Q-XM-91-TZ"):
        assert read_code(typed) == "7K3D-0QXM-91TZ"


def paired(server: ApiServer, code: str, name: str = "Ada", **headers: str) -> httpx.Response:
    return server.client.post("/v1/pairings", json={"code": code, "name": name}, headers=headers)


def bearer(answer: httpx.Response) -> dict[str, str]:
    assert answer.status_code == 201, answer.text
    return {"Authorization": f"Bearer {answer.json()['token']}"}


@pytest.fixture
def own(tmp_path: Path) -> Iterator[ApiServer]:
    with api_server(tmp_path / "data") as server:
        yield server


def whoami(server: ApiServer, headers: dict[str, str] | None = None) -> Any:
    answer = server.client.get("/v1/whoami", headers=headers)
    return answer.json() if answer.status_code == 200 else answer.status_code


def test_the_code_makes_an_operator_and_no_administrator(own: ApiServer) -> None:
    code = offered(own)
    assert whoami(own) == {
        "name": "anonymous", "scopes": ["jobs:read", "jobs:write"], "anonymous": True, "paired": False,
        "expires_at": None,
    }  # fmt: skip
    ada = bearer(paired(own, code))
    told = whoami(own, ada)
    assert (told["name"], told["anonymous"], told["paired"]) == ("Ada", False, True)
    assert told["scopes"] == ["jobs:read", "jobs:write", "machine:run"]
    problem(own.client.get("/v1/tokens", headers=ada), 403)


def through(server: ApiServer, address: str, code: str) -> httpx.Response:
    """A try that the proxy in front of the server says comes from there."""
    return paired(server, code, **{"X-Forwarded-For": f"6.6.6.6, {address}"})


@pytest.fixture
def behind(tmp_path: Path) -> Iterator[ApiServer]:
    with api_server(tmp_path / "behind", behind_proxy=True) as server:
        yield server


def test_wrong_tries_shut_out_nobody_but_where_they_come_from(behind: ApiServer) -> None:
    """Five at once from an address; then it is told when to try again, and the others are let in as before."""
    code = offered(behind)
    left = [problem(through(behind, "10.0.0.1", WRONG), 403, "code")["left"] for _ in range(EACH.most)]
    assert left == [4, 3, 2, 1, 0]
    for tried_now in (WRONG, code):
        answer = through(behind, "10.0.0.1", tried_now)
        wait_s = int(answer.headers["Retry-After"])
        assert 0 < wait_s <= EACH.refill_s
        assert f"try again in {wait_s} s" in problem(answer, 429, "code")["detail"]
    assert through(behind, "10.0.0.2", code).status_code == 201
    assert paired(behind, code).status_code == 201, "the proxy itself is another address, too"


def test_an_address_of_ipv6_is_its_network(behind: ApiServer) -> None:
    """One household has 2^64 of them."""
    code = offered(behind)
    answers = [through(behind, f"2001:db8::{n:x}", WRONG).status_code for n in range(EACH.most + 1)]
    assert answers == [403] * EACH.most + [429]
    assert through(behind, "2001:db8:0:1::1", code).status_code == 201


def test_a_caller_that_no_proxy_stands_before_cannot_make_addresses_up(own: ApiServer) -> None:
    offered(own)
    answers = [through(own, f"10.0.0.{n}", WRONG).status_code for n in range(EACH.most + 1)]
    assert answers == [403] * EACH.most + [429]


def test_a_right_try_costs_nothing_and_gives_the_wrong_ones_not_back(own: ApiServer) -> None:
    code = offered(own)
    for _ in range(EACH.most - 1):
        problem(paired(own, WRONG), 403)
    assert [paired(own, code).status_code for _ in range(3)] == [201] * 3
    assert problem(paired(own, WRONG), 403)["left"] == 0
    problem(paired(own, code), 429)


@pytest.mark.thorough
def test_a_restart_gives_no_tries_back(tmp_path: Path) -> None:
    offer = other_than(WRONG)
    for left in (3, 1):
        with api_server(tmp_path / "data") as server:
            server.services.pairings.offer(offer)
            assert [problem(paired(server, WRONG), 403)["left"] for _ in range(2)][-1] == left
    with api_server(tmp_path / "data") as server:
        problem(paired(server, WRONG), 403)
        problem(paired(server, code_of(offer)), 429)


def test_tries_at_once_are_counted_one_by_one(database: sa.Engine) -> None:
    """However many come at the same time: five are looked at, and then not even the right one is."""
    book, offer = PairingBook(database, TokenBook(database), clock=Clock()), other_than(WRONG)
    book.offer(offer)
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        told = list(pool.map(lambda _: tried(book, WRONG), range(24)))
    assert sorted(told) == ["too many"] * (24 - EACH.most) + ["wrong"] * EACH.most
    assert tried(book, code_of(offer)) == "too many"


@pytest.mark.thorough
def test_a_crowd_of_addresses_is_slowed_down_but_not_shut_out(
    database: sa.Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever guesses all day wherever they can has no chance; who sits at the server never waits for them."""
    clock = Clock()
    book, offer = PairingBook(database, TokenBook(database), clock=clock), other_than(WRONG)
    monkeypatch.setattr(
        "service.server.database.pairing._digest", lambda code, salt: code
    )  # the slow one is not what is tested
    book.offer(offer)
    told = [tried(book, WRONG, f"10.0.0.{n // 5}") for n in range(ALL.most + 5)]
    assert told == ["wrong"] * ALL.most + ["too many"] * 5
    assert tried(book, code_of(offer), "here", counts_for_all=False) == "right"
    clock.now += ALL.refill_s
    assert tried(book, code_of(offer), "10.1.1.1") == "right", "a right one uses nothing up"
    assert [tried(book, WRONG, f"10.2.2.{n}") for n in range(2)] == ["wrong", "too many"]
    assert 4 * (ALL.most + 86400 / ALL.refill_s) / 32**12 < 1e-13


def test_with_time_tries_come_back_one_by_one(database: sa.Engine) -> None:
    clock = Clock()
    book, offer = PairingBook(database, TokenBook(database), clock=clock), other_than(WRONG)
    book.offer(offer)
    for _ in range(EACH.most):
        tried(book, WRONG)
    clock.now += EACH.refill_s - 1
    assert tried(book, WRONG) == "too many", "asking does not make the wait longer"
    clock.now += 1
    assert [tried(book, WRONG) for _ in range(2)] == ["wrong", "too many"]


def tried(book: PairingBook, code: str, address: str = "10.0.0.1", *, counts_for_all: bool = True) -> str:
    try:
        book.pair(code, "Ada", address=address, counts_for_all=counts_for_all)
    except WrongCodeError:
        return "wrong"
    except TooManyTriesError:
        return "too many"
    except NoCodeError:
        return "none"
    return "right"


def test_a_code_ends_after_a_day(database: sa.Engine) -> None:
    clock = Clock()
    book, offer = PairingBook(database, TokenBook(database), clock=clock), new_offer()
    book.offer(offer)
    clock.now += CODE_LIFE_S - 1
    assert tried(book, code_of(offer)) == "right"
    clock.now += 2
    assert tried(book, code_of(offer)) == "none"


def test_the_database_holds_no_code(own: ApiServer) -> None:
    code = offered(own)
    with begin_reading(own.services.database) as connection:
        row = str(connection.execute(sa.select(pairings)).all())
    assert code not in row and code.replace("-", "") not in row


def test_a_foreign_page_can_neither_pair_nor_use_the_tries_up(own: ApiServer) -> None:
    code = offered(own)
    for headers in ({"Origin": "https://evil.example"}, {"Sec-Fetch-Site": "cross-site"}, {"Host": "evil.example"}):
        for _ in range(EACH.most):
            problem(paired(own, WRONG, **headers), 403)
        problem(paired(own, code, **headers), 403)
    assert paired(own, code, Origin=own.address).status_code == 201


def test_jobs_stay_open_on_this_computer_after_pairing_until_a_token_is_made(own: ApiServer) -> None:
    ada = bearer(paired(own, offered(own)))
    assert own.client.get("/v1/jobs").status_code == 200 and own.submit()
    own.services.tokens.create("lock", ["jobs:read"])
    problem(own.client.get("/v1/jobs"), 401)
    assert own.client.get("/v1/jobs", headers=ada).status_code == 200
    assert paired(own, offered(own)).status_code == 201, "who is nobody can still be paired"


def test_a_paired_page_does_not_make_a_server_fit_for_strangers(own: ApiServer) -> None:
    bearer(paired(own, offered(own)))
    abroad = ServerSettings(host="0.0.0.0", behind_proxy=True)
    with pytest.raises(InputError, match="make a token first"):
        refuse_foreign_bind(abroad, own.services.tokens)


def test_a_pairing_outlives_a_restart_and_ends_after_a_day(tmp_path: Path) -> None:
    with api_server(tmp_path / "data") as server:
        ada = bearer(paired(server, offered(server)))
    with api_server(tmp_path / "data") as server:
        assert whoami(server, ada)["paired"]
        row = sa.select(tokens.c.expires_at - tokens.c.created_at)
        with begin_writing(server.services.database) as connection:
            assert connection.execute(row).scalar_one() == pytest.approx(86400)
            connection.execute(tokens.update().values(expires_at=tokens.c.created_at))
        assert whoami(server, ada) == 401
        assert server.client.get("/v1/jobs").status_code == 200
        bearer(paired(server, offered(server)))
        assert len(server.services.tokens.list_rows()) == 2, "what has just ended may still stop a mill"
        with begin_writing(server.services.database) as connection:
            connection.execute(tokens.update().values(expires_at=tokens.c.created_at - 15 * 86400))
        bearer(paired(server, offered(server)))
        assert len(server.services.tokens.list_rows()) == 1, "what ended long ago is forgotten"


def test_two_pages_of_one_name_are_two_callers(own: ApiServer) -> None:
    """By name it is seen who made a job, and who gave a program to a mill."""
    code = offered(own)
    names = [paired(own, code, "Ada").json()["name"] for _ in range(3)]
    assert names == ["Ada", "Ada 2", "Ada 3"]
    assert paired(own, code, "Jürgen 李").status_code == 201
    for bad in ("", " ", "\n", "Ada\x00", "<b>", "x" * 61):
        problem(paired(own, code, bad), 422, "name")


def test_the_command_prints_a_code_that_works(own: ApiServer) -> None:
    """On a terminal; into a pipe it prints nothing, and makes none."""
    arguments = ("token", "pair", "--data", str(own.services.settings.data))
    refused = subprocess.run([sys.executable, "-m", "service.cli.main", *arguments], capture_output=True, text=True)
    assert (refused.returncode, refused.stdout) == (2, "") and "only on a terminal" in refused.stderr
    with begin_reading(own.services.database) as connection:
        assert connection.execute(sa.select(pairings)).all() == []
    with Terminal(*arguments) as person:
        assert person.ends() == 0
    assert paired(own, person.text.strip()).status_code == 201


class Screen(io.StringIO):
    """Where the server's words go."""

    def __init__(self, *, is_terminal: bool) -> None:
        super().__init__()
        self.is_terminal = is_terminal

    def isatty(self) -> bool:
        return self.is_terminal


def test_the_code_is_shown_again_on_a_terminal_only(database: sa.Engine) -> None:
    """And one that is taken: a new one where the first has ended. Not at every guess."""
    clock, offer = Clock(), new_offer()
    book = PairingBook(database, TokenBook(database), clock=clock)
    book.offer(offer)
    log = Screen(is_terminal=False)
    assert not CodeOnTerminal(book, offer, "http://here", stream=log, clock=clock).show()
    assert log.getvalue() == ""
    screen = Screen(is_terminal=True)
    shown = CodeOnTerminal(book, offer, "http://here", stream=screen, clock=clock)
    assert [shown.show() for _ in range(3)] == [True] * 3
    assert screen.getvalue().count(code_of(offer)) == 1
    clock.now += CODE_LIFE_S + 1
    assert shown.show()
    (newest,) = re.findall(CODE, screen.getvalue())[1:]
    assert newest != code_of(offer) and tried(book, newest) == "right"


def test_a_wrong_code_has_the_right_one_printed(own: ApiServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The person at the page is told where to look."""
    offered(own)
    assert "printed" not in problem(paired(own, WRONG), 403)["detail"]
    monkeypatch.setattr(type(own.services.terminal), "show", lambda _: True)
    assert "printed again where the server runs" in problem(paired(own, WRONG), 403)["detail"]
