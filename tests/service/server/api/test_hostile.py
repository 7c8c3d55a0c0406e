"""Hundreds of uploads that nobody should send: each refused with a problem, and nothing left on disk."""

from __future__ import annotations

import contextlib
import json
import re
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.service.server.api.hostile import Attack, attacks, form, part, request
from tests.service.server.api.server import ApiServer, api_server, png
from tests.waiting import PATIENCE_S, until

COUNT = 360
MAX_UPLOAD = 300_000


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApiServer]:
    data: Path = tmp_path_factory.mktemp("hostile") / "data"
    with api_server(data, max_upload_mb=MAX_UPLOAD / 1e6, max_megapixels=4) as running:
        running.submit()
        yield running


def sent(server: ApiServer, attack: Attack) -> bytes:
    """The server's first answer, or as much of it as comes."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S) as connection:
        with contextlib.suppress(ConnectionError):  # the server may have closed: its answer can still be read
            connection.sendall(attack.request)
            if attack.cut:
                connection.shutdown(socket.SHUT_WR)
        answer = b""
        with contextlib.suppress(ConnectionError):
            while not is_whole(answer) and (piece := connection.recv(65536)):
                answer += piece
    return answer


def is_whole(answer: bytes) -> bool:
    head, blank, body = answer.partition(b"\r\n\r\n")
    length = re.search(rb"content-length: (\d+)", head.lower())
    return bool(blank and length) and len(body) >= int(length[1])


def judged(attack: Attack, answer: bytes) -> str:
    """Empty if this is how to refuse it."""
    if not answer:
        return "" if attack.cut else "no answer"
    head, _, body = answer.partition(b"\r\n\r\n")
    status = int(head.split()[1])
    if not 400 <= status < 500:
        return f"status {status}: {body[:200]!r}"
    if b"content-type: application/problem+json" not in head.lower():
        return f"no problem: {answer[:200]!r}"
    first = json.JSONDecoder().raw_decode(body.decode())[0]
    good = first["status"] == status and first["detail"] and first["type"].startswith("urn:causticmill:problem:")
    return "" if good and "Traceback" not in body.decode() else f"odd problem: {body[:200]!r}"


@pytest.mark.thorough
def test_every_hostile_upload_is_refused_and_leaves_nothing(small: ApiServer) -> None:
    found = attacks(COUNT, seed=4, max_upload=MAX_UPLOAD)
    before, jobs = small.files(), small.client.get("/v1/jobs?limit=200").json()
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda attack: sent(small, attack), found))
    wrong = [
        (attack.name, words) for attack, answer in zip(found, answers, strict=True) if (words := judged(attack, answer))
    ]
    assert not wrong, f"{len(wrong)} of {COUNT}, the first: {wrong[:12]}"
    until(lambda: small.files() == before)  # those that were cut off end a little later
    assert small.client.get("/v1/jobs?limit=200").json() == jobs
    assert small.client.get("/livez").status_code == 200
    assert small.submit()["state"] == "queued"


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("../../../etc/passwd", "passwd"),
        ("C:\\\\Users\\\\me\\\\cat.png", "cat.png"),
        ("a\tb.png", "a_b.png"),
        ("\u202egnp.exe", "_gnp.exe"),
        ("Жar-птица 鳥.png", "Жar-птица 鳥.png"),
        ("n" * 300 + ".png", "n" * 96 + ".png"),
        ("..", "picture"),
        ("", "picture"),
        ("a.png\"; filename*=\"UTF-8''b.png", "a.png"),
        ("a.png\"; filename*=UTF-8''%E9%B3%A5%20%D0%96.png; x=\"", "鳥 Ж.png"),
        ("a.png\"; filename*=iso-8859-1'de'%FC.png; x=\"", "ü.png"),
        ("a.png\"; filename*=UTF-8''%FF.png; x=\"", "\ufffd.png"),
        ("a.png\"; filename*=UTF-8''..%2F..%2Fetc%2Fpasswd; x=\"", "passwd"),
        ("what %22he%22 said.png", "what _he_ said.png"),
        (b"caf\xe9.png".decode(errors="surrogateescape"), "caf\ufffd.png"),
    ],
)
def test_a_good_picture_keeps_a_harmless_name(small: ApiServer, given: str, kept: str) -> None:
    answer = sent(small, Attack("name", request(form(part(png(), filename=given)))))
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 202"), answer
    job = json.loads(body)
    assert job["name"] == kept
    archive = small.client.get(f"/v1/jobs/{job['id']}/archive.zip")
    assert archive.headers["content-disposition"].isascii()


def test_a_picture_right_at_the_limit_is_taken(small: ApiServer) -> None:
    content = png()
    padded = content + bytes(MAX_UPLOAD - len(content))
    assert small.submit(image=("a.png", padded))["image"]["bytes"] == MAX_UPLOAD
