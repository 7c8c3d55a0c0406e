"""A camera beside a mill: whatever it sends, in whatever pieces, is one whole JPEG or a refusal within seconds."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
from collections.abc import AsyncIterator, Sequence
from itertools import pairwise
from pathlib import Path

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import InputError
from service.http.problems import Problem
from service.server.fleet import cameras
from service.server.fleet.cameras import Cameras
from service.server.fleet.fleet import Fleet
from service.settings import ServerSettings
from tests.service.mills import Bench
from tests.service.server.fleet.shop import MACHINE, shop
from tests.waiting import until

JPEG = b"\xff\xd8\xff\xe0 a thumbnail ends with \xff\xd9 within \r\n\r\n and this \r\n-- is no boundary \xff\xd9"
MULTIPART = b"Content-Type: multipart/x-mixed-replace; boundary=%s\r\n"


@contextlib.asynccontextmanager
async def run_camera(pieces: Sequence[bytes], *, then_hang: bool = False) -> AsyncIterator[tuple[str, list[int]]]:
    """Yield the address of a camera that answers everybody with these bytes, and how many asked."""
    asked: list[int] = []
    tasks: set[asyncio.Task[None] | None] = set()

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        tasks.add(asyncio.current_task())
        with contextlib.suppress(ConnectionError):
            await reader.readuntil(b"\r\n\r\n")
            asked.append(1)
            for piece in pieces:
                writer.write(piece)
                await writer.drain()
                await asyncio.sleep(0)
            if then_hang:
                await asyncio.Event().wait()
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    try:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/stream", asked
    finally:
        for task in tasks:
            if task is not None:
                task.cancel()
        server.close()


async def take(pieces: Sequence[bytes], *, then_hang: bool = False) -> bytes:
    async with httpx.AsyncClient(trust_env=False) as client, run_camera(pieces, then_hang=then_hang) as (url, _):
        return await Cameras(lambda: client).take_picture(url)


def part(boundary: bytes, *, sized: bool, picture: bytes = JPEG) -> bytes:
    size = b"Content-Length: %d\r\n" % len(picture) if sized else b""
    return b"--%s\r\nContent-Type: image/jpeg\r\n%s\r\n%s\r\n" % (boundary, size, picture)


@given(
    st.booleans(),
    st.sampled_from([b"frame", b'"frame"', b"--frame"]),
    st.lists(st.integers(0, 400), max_size=5).map(sorted),
)
def test_the_first_picture_of_a_stream_is_whole_however_it_arrives(sized: bool, said: bytes, cuts: list[int]) -> None:
    """Some cameras put the boundary into quotes, some say it with its dashes."""
    whole = b"HTTP/1.1 200 OK\r\n" + MULTIPART % said + b"\r\n" + 2 * part(b"frame", sized=sized)
    pieces = [whole[a:b] for a, b in pairwise([0, *(cut for cut in cuts if cut < len(whole)), len(whole)]) if b > a]
    assert asyncio.run(take(pieces, then_hang=True)) == JPEG


def test_a_plain_jpeg_is_taken_as_it_is() -> None:
    head = b"HTTP/1.1 200 OK\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(JPEG)
    assert asyncio.run(take([head, JPEG])) == JPEG


BAD = {
    "status 401": (b"HTTP/1.1 401 No\r\nContent-Length: 0\r\n\r\n", 502),
    "does not send a JPEG": (b"HTTP/1.1 200 OK\r\nContent-Type: image/jpeg\r\n\r\n<html>", 502),
    "no whole picture": (b"HTTP/1.1 200 OK\r\n" + MULTIPART % b"x" + b"\r\n--x\r\nContent-Length: 99\r\n\r\n\xff", 502),
    "does not answer": (b"nonsense\r\n\r\n", 502),
    "status 302": (b"HTTP/1.1 302 Away\r\nLocation: http://127.0.0.1:1/\r\nContent-Length: 0\r\n\r\n", 502),
}  # fmt: skip


@pytest.mark.parametrize("words", BAD)
def test_what_is_no_picture_is_refused_in_words(words: str) -> None:
    sent, status = BAD[words]
    with pytest.raises(Problem, match=words) as refused:
        asyncio.run(take([sent]))
    assert refused.value.status == status


def test_a_camera_that_hangs_or_floods_costs_neither_time_nor_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "_WAIT_S", 0.2)
    monkeypatch.setattr(cameras, "MOST_BYTES", 100_000)
    with pytest.raises(Problem) as hangs:
        asyncio.run(take([b"HTTP/1.1 200 OK\r\n" + MULTIPART % b"x" + b"\r\n--x\r\n"], then_hang=True))
    assert hangs.value.status == 504
    with pytest.raises(Problem, match="more than"):
        asyncio.run(take([b"HTTP/1.1 200 OK\r\n\r\n", *[JPEG[:3] + bytes(50_000)] * 3]))
    with pytest.raises(Problem, match="no whole picture"):
        asyncio.run(take([b"HTTP/1.1 200 OK\r\n" + MULTIPART % b"x" + b"\r\n", bytes(50_000)], then_hang=True))


def test_many_who_look_are_one_who_asks_also_where_nothing_comes() -> None:
    async def crowd(pieces: Sequence[bytes]) -> tuple[int, list[object]]:
        async with httpx.AsyncClient(trust_env=False) as client, run_camera(pieces) as (url, asked):
            found = Cameras(lambda: client)
            looks = (found.take_picture(url) for _ in range(20))
            answers = await asyncio.gather(*looks, return_exceptions=True)
        return len(asked), list(answers)

    asked, answers = asyncio.run(crowd([b"HTTP/1.1 200 OK\r\n\r\n", JPEG]))
    assert (asked, answers) == (1, 20 * [JPEG])
    asked, answers = asyncio.run(crowd([b"HTTP/1.1 500 No\r\nContent-Length: 0\r\n\r\n"]))
    assert asked == 1 and all(isinstance(one, Problem) for one in answers)


def test_addresses_are_of_the_web() -> None:
    with pytest.raises(InputError, match="CAMERAS"):
        ServerSettings.load(cameras={"shop": "file:///etc/passwd"})
    given_back = json.loads(ServerSettings(cameras={"shop": "http://x/"}).environment()["CAUSTICMILL_CAMERAS"])
    assert given_back == {"shop": "http://x/"}


def test_it_is_linked_and_looked_through_and_its_pictures_stay_with_the_run(
    tmp_path: Path, mill: Bench, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.setattr(Fleet.watch, "__defaults__", (0.2,))
    ready, end, urls = threading.Event(), threading.Event(), []
    request.addfinalizer(end.set)  # also where the test fails: its thread would outlive it

    async def camera() -> None:
        async with run_camera([b"HTTP/1.1 200 OK\r\n\r\n", JPEG]) as (url, _):
            urls.append(url)
            ready.set()
            await asyncio.to_thread(end.wait)

    threading.Thread(target=lambda: asyncio.run(camera()), daemon=True).start()
    assert ready.wait(60)
    with shop(tmp_path / "data", mill, cameras={MACHINE: urls[0], "gone": urls[0]}) as floor:
        links = floor.get(f"/v1/machines/{MACHINE}")["links"]
        with floor.client("jobs:read") as client:
            answer = client.get(links["camera"])
        assert (answer.content, answer.headers["content-type"]) == (JPEG, "image/jpeg")
        run = floor.park(floor.job((600,)))
        assert floor.get(run["links"]["timelapse"]) == {"pictures": []}
        floor.start(run)
        until(lambda: floor.get(run["links"]["timelapse"])["pictures"])
        floor.until_finished(run)
        taken = floor.operator.get(floor.get(run["links"]["timelapse"])["pictures"][0]["url"])
        assert (taken.content, taken.headers["content-type"]) == (JPEG, "image/jpeg")
        floor.get(f"/v1/runs/{run['id']}/timelapse/1.jpg", 404)
    with shop(tmp_path / "data", mill) as floor:
        assert "camera" not in floor.get(f"/v1/machines/{MACHINE}")["links"]
        floor.get(f"/v1/machines/{MACHINE}/camera.jpg", 404)
