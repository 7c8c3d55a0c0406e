"""Every dialect that programs can be written in, by the name that machine profiles give it, and what each can do.

The figures of each (digits, words, line ends) are in `cam.posts.iso` and `cam.posts.post`.

Plain data without arrays; `cam.posts.writers` writes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import reduce

from cam.posts.iso import GRBL_FAMILY, ISO
from cam.posts.post import RML, Post, RmlPost
from cam.posts.setup import ProgramSetup
from phrases.phrase import Phrase

Dialect = Post | RmlPost

_ALL: tuple[Dialect, ...] = (*GRBL_FAMILY, *ISO, RML)
POSTS: dict[str, Dialect] = {post.name: post for post in _ALL}


def find_unsupported(dialect: str, setup: ProgramSetup) -> Iterator[tuple[str, str, Phrase]]:
    """Yield (field, value in words, what is allowed) of all that a control of this dialect cannot do."""
    post = POSTS[dialect]
    if setup.coolant != "none" and setup.coolant not in post.coolant:
        names = [f"'{name}'" for name in ("none", *post.coolant)]
        able = reduce(lambda names, name: Phrase("{names} or {name}", names=names, name=name), names)
        yield (
            "coolant",
            f"'{setup.coolant}'",
            Phrase("{allowed} in dialect '{dialect}'", allowed=able, dialect=dialect),
        )
    if setup.blend_tolerance_mm is not None and not post.blends:
        able = _list_all(other.name for other in _ALL if other.blends)
        yield (
            "blend_tolerance_mm",
            f"{setup.blend_tolerance_mm:g}",
            Phrase(
                "left out in dialect '{dialect}', which has no word for a tolerance; {able} has one",
                dialect=dialect,
                able=able,
            ),
        )
    if setup.work_offset != 1 and not post.offsets:
        allowed = Phrase("1 in dialect '{dialect}', whose zero is set at the mill", dialect=dialect)
        yield "work_offset", f"{setup.work_offset}", allowed
    if setup.high_precision != "none" and not post.high_precision:
        able = _list_all(f"'{other.name}'" for other in _ALL if other.high_precision)
        allowed = Phrase("'none' in dialect '{dialect}'; {able} has such modes", dialect=dialect, able=able)
        yield "high_precision", f"'{setup.high_precision}'", allowed


def _list_all(names: Iterable[str]) -> str:
    return reduce(lambda names, name: Phrase("{names} and {name}", names=names, name=name), names)
