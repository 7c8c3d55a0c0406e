"""Checks uploaded pictures in a child process, so that no decoder ever runs in the process that serves."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import Any

from phrases.phrase import Phrase
from service.errors import FailedError, PictureError
from service.job.picture import PictureFacts
from service.processes.child import ChildCrashed, ChildDied, ChildError, ChildLate
from service.processes.kept_child import ChildClosed, KeptChild

__all__ = ["PictureChecker", "PictureFacts"]

_MODULE = "service.server.api.intake.picture_child"
_TRIES = 2  # a child that dies is no proof against a picture


class PictureChecker:
    """`check` may be called from any thread (it blocks: use a thread pool); checks are done one after the other."""

    def __init__(self, *, time_limit_s: float = 10.0) -> None:
        self._time_limit_s = time_limit_s
        self._child = KeptChild(_MODULE, answer_s=time_limit_s)
        self._child.start()
        self._numbers = count()

    def check(self, path: Path, name: str, max_pixels: int) -> PictureFacts:
        """Decode the picture whole. PictureError, which calls it by `name`, where it cannot be used.

        FailedError where no picture can be checked: the checker is closed, or its process cannot be started.
        """
        try:
            return PictureFacts(**self._ask({"path": str(path), "name": name, "max_pixels": max_pixels}))
        except ChildLate:
            limit_s = self._time_limit_s
            words = Phrase("{name}: takes longer than {limit_s:g} s to decode", name=name, limit_s=limit_s)
            raise PictureError(words) from None
        except (ChildDied, ChildCrashed):
            raise PictureError(
                Phrase("{name}: the picture is damaged (decoding it ended the process that did it)", name=name)
            ) from None
        except ChildClosed:
            raise FailedError(Phrase("pictures are no longer checked: the server is shutting down")) from None
        except ChildError:
            raise FailedError(Phrase("pictures cannot be checked: the process that does it does not start")) from None

    def close(self) -> None:
        """End the child."""
        self._child.close()

    @property
    def child_pid(self) -> int | None:
        """Of the process, while there is one."""
        return self._child.child_pid

    def _ask(self, asked: dict[str, Any]) -> dict[str, Any]:
        for _ in range(_TRIES - 1):
            try:
                return self._ask_once(asked)
            except (ChildDied, ChildCrashed):
                continue
        return self._ask_once(asked)

    def _ask_once(self, asked: dict[str, Any]) -> dict[str, Any]:
        return self._child.ask(f"check {next(self._numbers)}", asked).result()
