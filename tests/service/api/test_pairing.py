"""Pairing: a short code makes a page an operator's, wrong tries are counted, and nothing else opens or closes by it."""

from __future__ import annotations

import concurrent.futures
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from service.api.auth import refuse_foreign_bind
from service.errors import InputError
from service.jobs.codes import code_of, new_offer
from service.jobs.database import reading, writing
from service.jobs.pairing import CODE_LIFE_S, MOST_WRONG, PairingBook, WrongCodeError
from service.jobs.tables import pairings, tokens
from service.jobs.tokens import TokenBook
from service.settings import ServerSettings
from tests.service.api.server import ApiServer, api_server, problem

WRONG = "0000-0000"


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
    }  # fmt: skip
    ada = bearer(paired(own, code))
    told = whoami(own, ada)
    assert (told["name"], told["anonymous"], told["paired"]) == ("Ada", False, True)
    assert told["scopes"] == ["jobs:read", "jobs:write", "machine:run"]
    problem(own.client.get("/v1/tokens", headers=ada), 403)


@pytest.mark.parametrize("form", ["{0}-{1}", "{0}{1}", " {0} {1} ", "{0} - {1}"])
def test_a_code_is_taken_as_people_type_it(own: ApiServer, form: str) -> None:
    assert paired(own, form.format(*offered(own).split("-"))).status_code == 201


def test_wrong_tries_end_the_code_and_a_new_one_works(own: ApiServer) -> None:
    code = offered(own)
    left = [problem(paired(own, WRONG), 403, "code")["left"] for _ in range(MOST_WRONG)]
    assert left == [4, 3, 2, 1, 0]
    assert "token pair" in problem(paired(own, code), 403, "code")["detail"]
    assert paired(own, offered(own)).status_code == 201


def test_a_right_try_does_not_give_the_wrong_ones_back(own: ApiServer) -> None:
    code = offered(own)
    for _ in range(MOST_WRONG - 1):
        problem(paired(own, WRONG), 403)
    assert paired(own, code).status_code == 201
    assert problem(paired(own, WRONG), 403)["left"] == 0
    problem(paired(own, code), 403)


def test_neither_a_restart_nor_the_same_offer_again_gives_tries_back(tmp_path: Path) -> None:
    offer = other_than(WRONG)
    for left in (3, 1):
        with api_server(tmp_path / "data") as server:
            server.services.pairings.offer(offer)
            assert [problem(paired(server, WRONG), 403)["left"] for _ in range(2)][-1] == left
    with api_server(tmp_path / "data") as server:
        problem(paired(server, WRONG), 403)
        server.services.pairings.offer(offer)
        problem(paired(server, code_of(offer)), 403)


def test_tries_at_once_are_counted_one_by_one(database: sa.Engine) -> None:
    """However many come at the same time: after five wrong ones the right one opens nothing."""
    book, offer = PairingBook(database, TokenBook(database)), other_than(WRONG)
    book.offer(offer)
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        assert not any(pool.map(lambda _: tried(book, WRONG), range(24)))
    assert not tried(book, code_of(offer))
    with reading(database) as connection:
        assert connection.execute(sa.select(pairings.c.wrong)).scalar_one() >= MOST_WRONG


def tried(book: PairingBook, code: str) -> bool:
    try:
        book.pair(code, "Ada")
    except WrongCodeError:
        return False
    return True


def test_a_code_ends_after_a_day(database: sa.Engine) -> None:
    clock = Clock()
    book, offer = PairingBook(database, TokenBook(database), clock=clock), new_offer()
    book.offer(offer)
    clock.now += CODE_LIFE_S - 1
    assert tried(book, code_of(offer))
    clock.now += 2
    assert not tried(book, code_of(offer))


def test_the_database_holds_no_code(own: ApiServer) -> None:
    code = offered(own)
    with reading(own.services.database) as connection:
        row = str(connection.execute(sa.select(pairings)).all())
    assert code not in row and code.replace("-", "") not in row


def test_a_foreign_page_can_neither_pair_nor_use_the_tries_up(own: ApiServer) -> None:
    code = offered(own)
    for headers in ({"Origin": "https://evil.example"}, {"Sec-Fetch-Site": "cross-site"}, {"Host": "evil.example"}):
        for _ in range(MOST_WRONG):
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
        with writing(server.services.database) as connection:
            assert connection.execute(row).scalar_one() == pytest.approx(86400)
            connection.execute(tokens.update().values(expires_at=tokens.c.created_at))
        assert whoami(server, ada) == 401
        assert server.client.get("/v1/jobs").status_code == 200
        bearer(paired(server, offered(server)))
        assert len(server.services.tokens.listed()) == 1, "what has ended is forgotten"


def test_two_pages_of_one_name_are_two_callers(own: ApiServer) -> None:
    """By name a caller's Idempotency-Keys and runs are told apart."""
    code = offered(own)
    names = [paired(own, code, "Ada").json()["name"] for _ in range(3)]
    assert names == ["Ada", "Ada 2", "Ada 3"]
    assert paired(own, code, "Jürgen 李").status_code == 201
    for bad in ("", " ", "\n", "Ada\x00", "<b>", "x" * 61):
        problem(paired(own, code, bad), 422, "name")


def test_the_command_prints_a_code_that_works(own: ApiServer) -> None:
    command = [sys.executable, "-m", "service.cli", "token", "pair", "--data", str(own.services.settings.data)]
    code = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    assert paired(own, code).status_code == 201
