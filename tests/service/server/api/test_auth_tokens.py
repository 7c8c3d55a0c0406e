"""Tokens: shown once, kept as a hash, ended by time or by a person; the guard before every route; the commands."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import sqlalchemy as sa

from service.errors import InputError
from service.server.api.access.guard import refuse_foreign_bind
from service.server.database.connection import begin_reading
from service.server.database.tokens import TokenBook
from service.settings import ServerSettings
from tests.service.server.api.server import ApiServer, api_server, png, problem
from tests.waiting import PATIENCE_S


class Clock:
    now = 1_000_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def own(tmp_path: Path) -> Iterator[ApiServer]:
    with api_server(tmp_path / "data") as server:
        yield server


def test_a_token_opens_until_it_expires_or_is_revoked(database: sa.Engine) -> None:
    clock = Clock()
    book = TokenBook(database, clock=clock)
    assert not book.has_ever_had_any() and not book.has_live()
    token, secret = book.create("Ada laptop", ["jobs:read", "admin"], expires_at=clock.now + 10)
    assert book.find(secret) == token and token.scopes == {"jobs:read", "admin"}
    clock.now += 10
    assert book.find(secret) is None and book.has_ever_had_any() and not book.has_live()
    other, secret = book.create("other", ["machine:run"])
    assert book.find(secret) == other
    book.revoke(other.id)
    assert book.find(secret) is None
    with pytest.raises(LookupError):
        book.revoke("none")


def test_a_new_token_of_an_old_name_sees_nothing_by_the_old_ones_keys(own: ApiServer) -> None:
    """Were a key bound to the name, the second caller would get the first one's job, or a refusal that tells of it."""
    book, picture, made = own.services.tokens, png(), []
    for _ in range(2):
        token, secret = book.create("Ada", ["jobs:write"])
        headers = {"Authorization": f"Bearer {secret}", "Idempotency-Key": "order-1"}
        made += [own.client.post("/v1/jobs", files={"image": picture}, headers=headers) for _ in range(2)]
        assert book.revoke(token.id).name == "Ada"
    ids = [answer.json()["id"] for answer in made]
    assert ids[0] == ids[1] != ids[2] == ids[3]
    assert {own.services.book.get(job_id).created_by for job_id in ids} == {"Ada"}


def test_the_database_holds_no_token(database: sa.Engine) -> None:
    _, secret = TokenBook(database).create("a", ["admin"])
    assert secret.startswith("cm_") and len(secret) == 46
    with begin_reading(database) as connection:
        assert secret[3:] not in str(connection.execute(sa.text("SELECT * FROM tokens")).all())


def test_its_use_is_written_down_once_a_minute(database: sa.Engine) -> None:
    clock = Clock()
    book = TokenBook(database, clock=clock)
    _, secret = book.create("a", ["admin"])
    for step_s, noted in ((0, 0.0), (59, 0.0), (2, 61.0), (30, 61.0)):
        clock.now += step_s
        token = book.find(secret)
        assert token is not None
        book.note_use(token)
        assert book.list_rows()[0].last_used_at == 1_000_000.0 + noted


@pytest.mark.parametrize(
    "secret", ["", "cm_", "cm_" + "x" * 43, "x" * 46, "cm_" + "é" * 43, "' OR 1=1 --", "cm_" + "x" * 9999]
)
def test_what_is_no_token_opens_nothing(database: sa.Engine, secret: str) -> None:
    book = TokenBook(database)
    book.create("a", ["admin"])
    assert book.find(secret) is None


@pytest.mark.parametrize(
    ("name", "scopes"), [("", ["admin"]), ("a\nb", ["admin"]), ("a", []), ("a", ["root"]), ("x" * 81, ["admin"])]
)
def test_bad_names_and_scopes_are_refused(database: sa.Engine, name: str, scopes: list[str]) -> None:
    with pytest.raises(InputError):
        TokenBook(database).create(name, scopes)


def test_a_living_tokens_name_is_taken(database: sa.Engine) -> None:
    book = TokenBook(database)
    token, _ = book.create("a", ["admin"])
    with pytest.raises(InputError, match="name"):
        book.create("a", ["jobs:read"])
    book.revoke(token.id)
    book.create("a", ["jobs:read"])


@pytest.mark.parametrize(
    ("host", "proxy", "token", "allowed"),
    [
        ("127.0.0.1", False, False, True),
        ("::1", False, False, True),
        ("0.0.0.0", False, True, False),
        ("0.0.0.0", True, False, False),
        ("192.168.1.5", True, False, False),
        ("", False, True, False),
        ("0.0.0.0", True, True, True),
    ],
)
def test_binding_elsewhere_needs_a_token_and_a_proxy(
    database: sa.Engine, host: str, proxy: bool, token: bool, allowed: bool
) -> None:
    book = TokenBook(database)
    if token:
        book.create("a", ["jobs:read"])
    settings = ServerSettings(host=host, behind_proxy=proxy)
    if allowed:
        refuse_foreign_bind(settings, book)
    else:
        with pytest.raises(InputError, match="--host"):
            refuse_foreign_bind(settings, book)


# ---------------------------------------------------------------------- over HTTP


def test_the_first_token_ends_what_nobody_in_particular_could_do(own: ApiServer) -> None:
    """And it stays so when that token expires or is revoked: an end of something must not open a door."""
    assert own.client.get("/v1/jobs").status_code == 200
    token, _ = own.services.tokens.create("a", ["jobs:read"])
    problem(own.client.get("/v1/jobs"), 401, "Authorization")
    own.services.tokens.revoke(token.id)
    problem(own.client.get("/v1/jobs"), 401, "Authorization")
    assert own.client.get("/livez").status_code == 200


def test_admin_makes_lists_and_revokes_tokens_within_its_own_scopes(own: ApiServer) -> None:
    _, secret = own.services.tokens.create("root", ["admin", "jobs:read"])
    with httpx.Client(base_url=own.address, headers={"Authorization": f"Bearer {secret}"}, timeout=PATIENCE_S) as admin:
        made = admin.post("/v1/tokens", json={"name": "reader", "scopes": ["jobs:read"], "expires_in_s": 60})
        assert made.status_code == 201 and made.headers["cache-control"] == "no-store"
        problem(admin.post("/v1/tokens", json={"name": "m", "scopes": ["machine:run"]}), 403, "scopes")
        problem(admin.post("/v1/tokens", json={"name": "m", "scopes": ["jobs:read", "jobs:write"]}), 403, "scopes")
        shown = admin.get("/v1/tokens").json()["tokens"]
        assert [one["name"] for one in shown] == ["root", "reader"]
        assert made.json()["token"] not in admin.get("/v1/tokens").text
        header = {"Authorization": f"Bearer {made.json()['token']}"}
        assert own.client.get("/v1/jobs", headers=header).status_code == 200
        problem(own.client.get("/v1/tokens", headers=header), 403)
        assert admin.delete(f"/v1/tokens/{made.json()['id']}").json()["revoked_at"]
        assert own.client.get("/v1/jobs", headers=header).status_code == 401
        problem(admin.delete("/v1/tokens/none"), 404, "id")


def test_one_who_asks_too_much_waits_and_a_hold_never_does(tmp_path: Path) -> None:
    with api_server(tmp_path / "data", requests_per_s=1, jobs_per_min=2) as server:
        _, secret = server.services.tokens.create("a", ["jobs:read"])
        _, other = server.services.tokens.create("b", ["machine:run", "jobs:write"])
        header, holder = {"Authorization": f"Bearer {secret}"}, {"Authorization": f"Bearer {other}"}
        codes = [server.client.get("/v1/jobs", headers=header).status_code for _ in range(12)]
        assert codes.count(200) in (10, 11) and codes[-1] == 429
        refused = server.client.get("/v1/jobs", headers=header)
        assert int(refused.headers["retry-after"]) >= 1 and refused.json()["type"].endswith("too-many")
        nowhere = "/v1/runs/00000000-0000-4000-8000-000000000000:hold"
        assert {server.client.post(nowhere, headers=holder).status_code for _ in range(30)} == {404}
        posts = [server.client.post("/v1/jobs", headers=holder).status_code for _ in range(4)]
        assert posts[:2] == [posts[0]] * 2 and posts[0] != 429 and posts[2:] == [429, 429]


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 403),
        ({"Host": ""}, 403),
        ({"Origin": "https://evil.example"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({f"X-{number}": "x" for number in range(120)}, 431),
        ({"X": "x" * 33_000}, 431),
    ],
    ids=lambda value: str(value)[:40],
)
def test_requests_that_a_browser_or_a_stranger_could_make_up(
    own: ApiServer, headers: dict[str, str], status: int
) -> None:
    answer = own.client.post("/v1/jobs/00000000-0000-4000-8000-000000000000:cancel", headers=headers)
    assert answer.status_code in (status, 400 if status == 431 else status), answer.text


# ---------------------------------------------------------------------- the commands


def causticmill(*arguments: str, data: Path | None = None) -> subprocess.CompletedProcess[str]:
    own = {"CAUSTICMILL_DATA": str(data)} if data is not None else {}
    return subprocess.run(
        [sys.executable, "-m", "service.cli.main", *arguments],
        capture_output=True,
        text=True,
        env=os.environ | own,
        timeout=PATIENCE_S,
    )


@pytest.mark.thorough
def test_the_commands_make_list_and_revoke(tmp_path: Path) -> None:
    data = tmp_path / "data"
    made = causticmill(
        "token", "create", "shop", "--scope", "jobs:read,machine:run", "--expires", "30d", "-q", data=data
    )
    secret = made.stdout.strip()
    assert (made.returncode, len(secret), made.stdout.count("\n")) == (0, 46, 1), made.stderr
    listed = causticmill("token", "list", "--data", str(data))
    assert "jobs:read,machine:run" in listed.stdout and "expires" in listed.stdout and secret not in listed.stdout
    token_id = listed.stdout.split()[0]
    assert causticmill("token", "revoke", token_id, data=data).returncode == 0
    assert "revoked" in causticmill("token", "list", data=data).stdout
    with sqlite3.connect(data / "causticmill.sqlite") as database:
        assert database.execute("SELECT count(*) FROM tokens WHERE revoked_at IS NOT NULL").fetchone() == (1,)
    assert causticmill("token", "create", "a", "--scope", "admin", data=data).returncode == 0
    assert "1 of them" in causticmill("token", "revoke", "--all", data=data).stdout


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("create", "a", "--scope", "root"), "root"),
        (("create", "a", "--scope", "admin", "--expires", "soon"), "--expires"),
        (("create", "a", "--scope", "admin", "--expires", "0d"), "--expires"),
        (("revoke", "none"), "none"),
        (("revoke",), "--all"),
        (("revoke", "none", "--all"), "--all"),
    ],
)
def test_the_commands_refuse_in_one_line(tmp_path: Path, arguments: tuple[str, ...], word: str) -> None:
    found = causticmill("token", *arguments, "--data", str(tmp_path / "data"))
    assert (found.returncode, found.stdout) == (2, "")
    assert word in found.stderr and found.stderr.count("\n") == 1
