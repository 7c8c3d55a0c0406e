"""Fetches a program from the job server: streamed, never whole in memory; the store checks size and hash."""

from __future__ import annotations

from urllib.parse import urlsplit

from service.agent.programs import ProgramStore, StoredProgram
from service.web.problems import Problem

_WAIT_S = 30.0
_REDIRECTS = 3


async def fetch_program(store: ProgramStore, url: str, sha256: str, *, token: str | None) -> tuple[StoredProgram, bool]:
    """Bring the program at `url` into the store. `token` goes to that host only, never along a redirect elsewhere."""
    import httpx  # costs memory and is seldom needed

    if urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).hostname:
        raise Problem(422, f"url is '{url[:100]}'; allowed: http:// or https:// addresses", field="url")
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    client = httpx.AsyncClient(
        timeout=_WAIT_S,
        follow_redirects=True,
        max_redirects=_REDIRECTS,
        trust_env=False,
        headers={"User-Agent": "causticmill"},
    )
    try:
        async with client, client.stream("GET", url, headers=headers) as response:
            if response.status_code != 200:
                raise Problem(502, f"{url} answered {response.status_code}", field="url")
            announced = response.headers.get("content-length", "")
            encoded = "content-encoding" in response.headers
            size = int(announced) if announced.isdigit() and not encoded else None
            return await store.receive(sha256, response.aiter_bytes(), announced_bytes=size)
    except httpx.InvalidURL as error:
        raise Problem(422, f"url is '{url[:100]}': {error}", field="url") from None
    except httpx.HTTPError as error:
        reason = str(error) or type(error).__name__
        raise Problem(502, f"cannot fetch {url}: {reason}", field="url") from None
