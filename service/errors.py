"""Errors of a job for the person at the command line: one line each, and an exit code."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from typing import Any

from phrases.phrase import Phrase, join

EXIT_FAILURE = 1
EXIT_INPUT = 2
EXIT_INTERRUPTED = 130


class ServiceError(Exception):
    """Base of the service's own errors: each line names a thing, its value and what is allowed."""

    exit_code = EXIT_FAILURE

    def __init__(self, *lines: str) -> None:
        self.lines = tuple(map(printable, lines))
        super().__init__(self.lines[0] if len(lines) == 1 else join("\n", self.lines))


class InputError(ServiceError):
    """A value that a person gave cannot be used. field: its name in a request to the API, "" if it has none."""

    exit_code = EXIT_INPUT

    def __init__(self, *lines: str, field: str = "") -> None:
        super().__init__(*lines)
        self.field = field


class SpecError(InputError):
    """An unusable job spec; `problems`: (key, sentence) pairs; `use`: values that would be allowed, by key."""

    def __init__(self, problems: list[tuple[str, Phrase]], use: Mapping[str, float] | None = None) -> None:
        super().__init__(*(Phrase("{key}: {sentence}", key=key, sentence=sentence) for key, sentence in problems))
        self.problems = problems
        self.use = dict(use or {})

    def rows(self) -> list[dict[str, Any]]:
        """Return the problems as the API sends them."""
        return [
            {"field": "spec" if key == "spec" else printable(f"spec.{key}"), "detail": printable(sentence)}
            | ({"use": self.use[key]} if key in self.use else {})
            for key, sentence in self.problems
        ]


class PictureError(InputError):
    """A picture that cannot be used."""

    def __init__(self, *lines: Phrase) -> None:
        super().__init__(*lines)


class FailedError(ServiceError):
    """The job itself failed: a check, the disk, a method that found no lens."""


class DiskError(FailedError):
    """The disk did not take a file of the job."""


def printable(text: str) -> str:
    """Return the text on one line, control characters replaced by '?': names and values may come from anywhere."""
    if text.isprintable():
        return text
    if isinstance(text, Phrase):
        return text.map(printable)
    return "".join(c if c.isprintable() else "?" for c in text)


def sentence_of_os_error(error: OSError, *, doing: str) -> Phrase:
    """Describe a failed file operation in one line, without errno names."""
    where = f" {error.filename}" if error.filename else ""
    reasons = {
        errno.ENOSPC: Phrase("no space left on the disk"),
        errno.EDQUOT: Phrase("the disk quota is used up"),
        errno.EFBIG: Phrase("the file is larger than this system allows"),
        errno.EACCES: Phrase("permission denied"),
        errno.EPERM: Phrase("permission denied"),
        errno.EROFS: Phrase("the file system is read-only"),
        errno.ENOENT: Phrase("there is no such file or folder"),
        errno.ENOTDIR: Phrase("a part of the path is not a folder"),
        errno.EISDIR: Phrase("this is a folder, not a file"),
        errno.ENAMETOOLONG: Phrase("the name is too long"),
    }
    reason = reasons.get(error.errno or 0, (error.strerror or str(error)).lower())
    return Phrase("{doing}{where}: {reason}", doing=doing, where=printable(where), reason=reason)
