"""What can go wrong in a job, as the person at the command line is told: one line each, and an exit code."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from typing import Any

EXIT_FAILURE = 1
EXIT_INPUT = 2
EXIT_INTERRUPTED = 130


class ServiceError(Exception):
    """Base of the service's own errors: a line for each thing, which names it, its value and what is allowed."""

    exit_code = EXIT_FAILURE

    def __init__(self, *lines: str) -> None:
        super().__init__(printable(lines[0]) if len(lines) == 1 else "\n".join(map(printable, lines)))


class InputError(ServiceError):
    """Something the person gave cannot be used."""

    exit_code = EXIT_INPUT


class SpecError(InputError):
    """A job spec that cannot be used; `problems` holds (key, sentence) pairs, `use` values that would do, by key."""

    def __init__(self, problems: list[tuple[str, str]], use: Mapping[str, float] | None = None) -> None:
        super().__init__(*(f"{key}: {sentence}" for key, sentence in problems))
        self.problems = problems
        self.use = dict(use or {})

    def rows(self) -> list[dict[str, Any]]:
        """Return the problems as the API tells them."""
        return [
            {"field": printable(f"spec.{key}"), "detail": printable(sentence)}
            | ({"use": self.use[key]} if key in self.use else {})
            for key, sentence in self.problems
        ]


class PictureError(InputError):
    """A picture that cannot be used."""


class FailedError(ServiceError):
    """The job itself failed: a check, the disk, a method that found no lens."""


def printable(text: str) -> str:
    """Return the text on one line, control characters shown as '?': names and values may come from anywhere."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)


def sentence_of_os_error(error: OSError, *, doing: str) -> str:
    """Return one line about a failed file operation, in words rather than errno names."""
    where = f" {error.filename}" if error.filename else ""
    reasons = {
        errno.ENOSPC: "no space left on the disk",
        errno.EDQUOT: "the disk quota is used up",
        errno.EFBIG: "the file is larger than this system allows",
        errno.EACCES: "permission denied",
        errno.EPERM: "permission denied",
        errno.EROFS: "the file system is read-only",
        errno.ENOENT: "there is no such file or folder",
        errno.ENOTDIR: "a part of the path is not a folder",
        errno.EISDIR: "this is a folder, not a file",
        errno.ENAMETOOLONG: "the name is too long",
    }
    reason = reasons.get(error.errno or 0, (error.strerror or str(error)).lower())
    return printable(f"{doing}{where}: {reason}")
