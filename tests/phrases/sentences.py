"""What of a document another language cannot say."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from phrases.phrase import phrases_in

KEYS = {
    *("warnings", "warnings_by_part", "notes", "why", "words", "warning", "what", "message"),
    *("title", "needs", "steps", "donts", "removal", "when_to_stop", "law"),
}
"""Under which documents of jobs hold sentences of ours."""


def untold(document: dict[str, Any], *more: str) -> list[str]:
    """Return the sentences under these keys that no phrase tells.

    document : with its table `phrases`, or before it has one
    more     : keys, beside those of every document
    """
    phrases = document.get("phrases") or phrases_in(document)
    found = list(_under(document, KEYS | set(more)))
    assert found, "no sentence at all"
    return [text for text in found if text not in phrases]


def _under(value: Any, keys: set[str], *, inside: bool = False) -> Iterator[str]:
    if isinstance(value, str) and inside:
        yield value
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _under(each, keys, inside=inside)
    elif isinstance(value, dict):
        for key, each in value.items():
            if key != "phrases":
                yield from _under(each, keys, inside=inside or key in keys)
