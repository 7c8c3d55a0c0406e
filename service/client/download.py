"""Download files of a job into a folder: resume an interrupted download, accept a file only if its hash is right.

An unfinished file is `NAME.<first digits of its hash>.part`, so that a download never continues with another file's
bytes; it is renamed when its SHA-256 is the one in the server's list.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import httpx

from service.client.follow import explain_interrupt
from service.client.server import GoneError, ServerClient, clean
from service.errors import FailedError, InputError, sentence_of_os_error
from service.job.files import is_drawing

_READ_S = 30.0
_TIMEOUT_S = 120.0
_AGAIN_S = 0.5
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_HASH = re.compile(r"[0-9a-f]{64}")

OnBytes = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class RemoteFile:
    """An artifact as the server lists it."""

    name: str
    sha256: str
    bytes: int
    url: str

    @classmethod
    def of(cls, item: dict[str, Any]) -> RemoteFile:
        """Make it from the server's answer. FailedError for a name that no file of ours has, so that a server cannot
        choose a place to write.
        """
        try:
            file = cls(str(item["name"]), str(item["sha256"]), int(item["bytes"]), str(item["url"]))
        except (KeyError, TypeError, ValueError):
            raise FailedError("the server's list of files cannot be read; use the same version on both sides") from None
        if not _NAME.fullmatch(file.name) or not _HASH.fullmatch(file.sha256) or file.bytes < 0:
            raise FailedError(f"the server offers a file with an unusable name: '{clean(file.name)}'")
        return file


def files_of(server: ServerClient, job_id: str, only: Sequence[str] = ()) -> list[RemoteFile]:
    """Return the files with the given names; without names, all files except the data that only the page draws."""
    listing = server.get(f"/v1/jobs/{job_id}/artifacts")
    files = [RemoteFile.of(item) for item in listing["artifacts"]]
    known = {file.name for file in files}
    if missing := [name for name in only if name not in known]:
        names = ", ".join(sorted(known)) or "none yet"
        raise InputError(*(f"--only: job {job_id} has no file '{name}'; there are: {names}" for name in missing))
    return [file for file in files if (file.name in only if only else not is_drawing(file.name))]


def download(server: ServerClient, file: RemoteFile, folder: Path, on_bytes: OnBytes) -> bool:
    """Download the file into the folder; False if it was there already. `on_bytes` is called with the bytes so far."""
    target = folder / file.name
    try:
        if target.is_file() and target.stat().st_size == file.bytes and _hash_of(target).hexdigest() == file.sha256:
            on_bytes(file.bytes)
            return False
        part = folder / f"{file.name}.{file.sha256[:12]}.part"
        for _ in range(2):  # a part with a wrong hash is discarded once
            _fetch(server, file, part, on_bytes)
            if _hash_of(part).hexdigest() == file.sha256:
                part.replace(target)
                return True
            part.unlink()
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot write")) from None
    raise FailedError(
        f"{file.name}: the downloaded file has another SHA-256 than the server's list says; it was discarded"
    )


def _fetch(server: ServerClient, file: RemoteFile, part: Path, on_bytes: OnBytes) -> None:
    """Fetch all bytes into `part`; reconnect after a lost connection as long as bytes arrive."""
    heard_s, size = time.monotonic(), -1
    while True:
        try:
            _go_on(server, file, part, on_bytes)
            return
        except GoneError as error:
            now_s, reached = time.monotonic(), part.stat().st_size if part.exists() else 0
            if reached != size:
                heard_s, size = now_s, reached
            if now_s - heard_s > _TIMEOUT_S:
                raise FailedError(f"{error}; run the command again to go on at byte {reached:,}") from None
            time.sleep(_AGAIN_S)


def _go_on(server: ServerClient, file: RemoteFile, part: Path, on_bytes: OnBytes) -> None:
    """Send one request for the bytes after the end of the part."""
    have = part.stat().st_size if part.exists() else 0
    if have > file.bytes:
        part.unlink()
        have = 0
    if have == file.bytes and (have or part.exists()):
        on_bytes(have)
        return
    headers = {"Accept-Encoding": "identity"}
    if have:
        headers |= {"Range": f"bytes={have}-", "If-Range": f'"{file.sha256}"'}
    with contextlib.ExitStack() as stack:
        answer = stack.enter_context(server.stream_answer(file.url, headers=headers, read_s=_READ_S))
        if answer.is_redirect:  # redirected to the artifact store, whose ETag is its own
            headers.pop("If-Range", None)
            answer = stack.enter_context(
                server.stream_answer(answer.headers["Location"], headers=headers, read_s=_READ_S)
            )
        if answer.status_code == 416:
            part.unlink(missing_ok=True)
            raise GoneError("the server did not continue at the end of the partial file", begun=True)
        server.raise_for_status(answer)
        _append(answer, part, file, on_bytes, whole=answer.status_code != 206)


def _append(answer: httpx.Response, part: Path, file: RemoteFile, on_bytes: OnBytes, *, whole: bool) -> None:
    with part.open("wb" if whole else "ab") as out:
        for piece in answer.iter_raw():  # write bytes as they arrive: a lost connection would lose a larger buffer
            out.write(piece)
            if out.tell() > file.bytes:
                raise FailedError(f"{file.name}: the server sends more than the {file.bytes:,} bytes it names")
            on_bytes(out.tell())
        out.flush()
        os.fsync(out.fileno())
        if out.tell() < file.bytes:
            raise GoneError("the connection ended before the file was complete", begun=True)


def _hash_of(path: Path) -> Any:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256")


def require_folder(folder: Path) -> None:
    """Make the folder if it does not exist."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--output: {sentence_of_os_error(error, doing='cannot use')}") from None


class _Bars(Protocol):
    def begin(self, file: RemoteFile) -> OnBytes: ...
    def end(self, file: RemoteFile, *, came: bool) -> None: ...


def get_files(
    server: ServerClient, job_id: str, folder: Path, *, only: Sequence[str] = (), quiet: bool = False
) -> None:
    """Download the files into `folder`. FailedError if the job has none yet."""
    files = files_of(server, job_id, only)
    if not files:
        raise FailedError(f"job {job_id} has no files yet; `causticmill jobs follow {job_id}` waits for them")
    require_folder(folder)
    again = f"complete files are in {folder}; run the command again to go on"
    with explain_interrupt(again), _bars(quiet) as bars:
        for file in files:
            came = download(server, file, folder, bars.begin(file))
            bars.end(file, came=came)
    if not quiet:
        print(f"{len(files)} files in {folder}")


@contextlib.contextmanager
def _bars(quiet: bool) -> Iterator[_Bars]:
    if quiet or not sys.stdout.isatty():
        yield _PlainBars(quiet)
        return
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

    columns = (TextColumn("{task.description:<28}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    with Progress(*columns, console=Console()) as progress:
        yield _LiveBars(progress)


class _PlainBars:
    """Print a line for each finished file."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet

    def begin(self, file: RemoteFile) -> OnBytes:
        return lambda _count: None

    def end(self, file: RemoteFile, *, came: bool) -> None:
        if not self._quiet:
            print(f"{file.name}: {file.bytes:,} bytes{'' if came else ', there already'}", flush=True)


class _LiveBars:
    def __init__(self, progress: object) -> None:
        from rich.progress import Progress

        assert isinstance(progress, Progress)
        self._progress = progress

    def begin(self, file: RemoteFile) -> OnBytes:
        task = self._progress.add_task(file.name, total=file.bytes)
        return lambda count: self._progress.update(task, completed=count)

    def end(self, file: RemoteFile, *, came: bool) -> None: ...
