"""`causticmill get`: all files of a job, or some, with a bar for each on a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

from service.client.download import OnBytes, RemoteFile, download, files_of, require_folder
from service.client.follow import leaving
from service.client.server import Server
from service.errors import FailedError


class _Bars(Protocol):
    def begin(self, file: RemoteFile) -> OnBytes: ...
    def end(self, file: RemoteFile, *, came: bool) -> None: ...


def get_files(server: Server, job_id: str, folder: Path, *, only: Sequence[str] = (), quiet: bool = False) -> None:
    """The files in `folder`. FailedError where the job has none yet."""
    files = files_of(server, job_id, only)
    if not files:
        raise FailedError(f"job {job_id} has no files yet; `causticmill jobs follow {job_id}` waits for them")
    require_folder(folder)
    again = f"what is whole is in {folder}; run the command again to go on"
    with leaving(again), _bars(quiet) as bars:
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
    """A line when a file is there."""

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
