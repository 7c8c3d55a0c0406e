"""The journal of a run on disk: append-only, checksummed, and readable after a power failure.

A journal is a folder of files journal-000001.log ...; each line is `crc32 json`. Every record carries a sequence number
and the fields that changed; the state is all records laid over each other. The first record of a file holds the whole
state, so that one file is enough: an older one is deleted only after the newer one is safe on disk. Reading stops at
the first incomplete line. Only the latest records are lost that way; a run that is resumed from an earlier point cuts
some segments twice but skips none.

Appending does not wait for the disk: fsync runs on a timer, in a thread of its own. A failure there appears at the next
append, as JournalError.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machines.errors import JournalError
from machines.journal.disk import Disk, File, RealDisk, Syncer, ThreadSyncer, os_words
from phrases.phrase import Phrase, join, phrases_in, restore

ROTATE_BYTES = 4_000_000
_PATTERN = "journal-*.log"


@dataclass(frozen=True, slots=True)
class JournalContent:
    """The state that the records add up to. `torn` describes the part that could not be read, "" if there is none."""

    state: dict[str, Any]
    sequence: int
    records: int
    torn: str = ""


def encode(record: Mapping[str, Any]) -> bytes:
    """Encode one line of a journal; phrases with their templates and values."""
    phrases = phrases_in(record)
    text = json.dumps(
        {**record, "phrases": phrases} if phrases else record, separators=(",", ":"), allow_nan=False
    ).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _describe_failure(place: Path, reason: str) -> Phrase:
    return Phrase("journal {path}: {reason}", path=place, reason=reason)


def decode(line: bytes) -> dict[str, Any] | None:
    """Return the record of one line without its end; None if it is not whole."""
    head, _, text = line.partition(b" ")
    try:
        if len(head) != 8 or int(head, 16) != zlib.crc32(text):
            return None
        record = json.loads(text)
    except ValueError:
        return None
    if not isinstance(record, dict):
        return None
    return restore(record, record["phrases"]) if "phrases" in record else record


def records_in(data: bytes) -> Iterator[dict[str, Any]]:
    """Return the records up to the first that is incomplete or does not follow the one before it."""
    expected = None
    start = 0
    while (end := data.find(b"\n", start)) >= 0:
        record = decode(data[start:end])
        if record is None or (expected is not None and record.get("n") != expected):
            return
        expected = int(record.get("n", 0)) + 1
        yield record
        start = end + 1


def read_journal(folder: Path) -> JournalContent | None:
    """Return the newest state that can be read; None if the folder holds no readable journal. Never writes."""
    torn: list[Phrase] = []
    for path in sorted(folder.glob(_PATTERN), reverse=True):
        try:
            data = path.read_bytes()
        except OSError as error:
            words = Phrase("journal {path}: cannot be read ({reason})", path=path, reason=os_words(error))
            raise JournalError(words) from error
        content = _fold_records(data)
        whole = sum(len(encode(record)) for record in records_in(data))
        if whole < len(data) or not data:
            torn.append(
                Phrase(
                    "{file}: {count} bytes from byte {whole} on are torn or damaged and do not count",
                    file=path.name,
                    count=len(data) - whole,
                    whole=whole,
                )
            )
        if content is not None:
            state, sequence, count = content
            return JournalContent(state, sequence, count, join("; ", torn))
    return None


def _fold_records(data: bytes) -> tuple[dict[str, Any], int, int] | None:
    """State, last sequence number and number of records; None if the file does not begin with a whole state."""
    state: dict[str, Any] = {}
    sequence = count = 0
    for record in records_in(data):
        if count == 0 and record.get("kind") != "state":
            return None
        sequence = int(record.pop("n"))
        record.pop("kind", None)
        state.update(record)
        count += 1
    return (state, sequence, count) if count else None


class Journal:
    """Writes one run's journal. Opening one that exists begins a new file with the whole state as read."""

    def __init__(
        self, folder: Path, *, disk: Disk | None = None, syncer: Syncer | None = None, rotate_bytes: int = ROTATE_BYTES
    ) -> None:
        self.folder = folder
        self._disk = disk or RealDisk()
        self._syncer = syncer or ThreadSyncer()
        self._rotate_bytes = rotate_bytes
        self._file: File | None = None
        self._written = 0
        self._failure: Phrase | None = None
        try:
            self._disk.make_folder(folder)
            found = read_journal(folder)
        except OSError as error:
            raise JournalError(_describe_failure(folder, os_words(error))) from error
        self.torn = found.torn if found else ""
        self.state: dict[str, Any] = dict(found.state) if found else {}
        self._sequence = found.sequence if found else 0

    @property
    def failure(self) -> Phrase | None:
        """Why nothing can be written at present; None if nothing is wrong."""
        if self._failure is None and (words := self._syncer.failure):
            self._failure = _describe_failure(self.folder, words)
        return self._failure

    def append(self, kind: str, **fields: Any) -> None:
        """Add one record. JournalError if this one, or an fsync since the last call, failed."""
        self.state.update(fields)
        if (failure := self.failure) is not None:
            raise JournalError(failure)
        if self._file is None or self._written >= self._rotate_bytes:
            self._rotate()
            return
        self._sequence += 1
        self._write(self._file, encode({"n": self._sequence, "kind": kind, **fields}))

    def sync(self) -> None:
        """Wait until everything appended is safe on disk: before anything may move."""
        if self._file is not None and not self.failure:
            self._syncer.sync()
        if (failure := self.failure) is not None:
            raise JournalError(failure)

    def hasten(self) -> None:
        """Ask for a sync soon, without waiting; if it fails, `failure` says so."""
        if self._file is not None and not self.failure:
            self._syncer.hasten()

    def repair(self) -> None:
        """After a failure, begin a new file with the whole state. JournalError if the disk still refuses."""
        if self.failure:
            self._rotate()

    def close(self) -> None:
        """Close the file; it is synced in the background."""
        if self._file is not None:
            self._syncer.let_go()
            self._file = None

    def _rotate(self) -> None:
        """Begin a new file with the whole state. The older ones go when the syncer has made the new one safe."""
        older = sorted(self.folder.glob(_PATTERN))
        number = int(older[-1].stem.removeprefix("journal-")) + 1 if older else 1
        path = self.folder / f"journal-{number:06d}.log"
        before, file = self._file, None

        def drop_older() -> None:
            self._disk.sync_folder(self.folder)
            if before is not None:
                before.close()
            for old in older:
                self._disk.remove(old)

        try:
            file = self._disk.create(path)
            data = encode({"n": self._sequence + 1, "kind": "state", **self.state})
            file.write(data)
        except OSError as error:
            if file is not None:
                file.close()
            self._failure = _describe_failure(path, os_words(error))
            raise JournalError(self._failure) from error
        self._sequence += 1
        self._file, self._written, self._failure = file, len(data), None
        self._syncer.take(file, drop_older)

    def _write(self, file: File, data: bytes) -> None:
        try:
            file.write(data)
        except OSError as error:
            self._failure = _describe_failure(self.folder, os_words(error))
            raise JournalError(self._failure) from error
        self._written += len(data)
        self._syncer.note_written()
