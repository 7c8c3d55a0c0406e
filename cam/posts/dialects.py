"""Every dialect that programs can be written in, by the name that machine profiles give it, and what each can do.

The figures of each (digits, words, line ends) are in `cam.posts.iso` and `cam.posts.post`.

Plain data without arrays; `cam.posts.writers` writes.
"""

from __future__ import annotations

from collections.abc import Iterator

from cam.posts.iso import GRBL_FAMILY, ISO
from cam.posts.post import RML, Post, RmlPost
from cam.posts.setup import ProgramSetup

Dialect = Post | RmlPost

_ALL: tuple[Dialect, ...] = (*GRBL_FAMILY, *ISO, RML)
POSTS: dict[str, Dialect] = {post.name: post for post in _ALL}


def find_unsupported(dialect: str, setup: ProgramSetup) -> Iterator[tuple[str, str, str]]:
    """Yield (field, value in words, what is allowed) of all that a control of this dialect cannot do."""
    post = POSTS[dialect]
    if setup.coolant != "none" and setup.coolant not in post.coolant:
        allowed = " or ".join(f"'{name}'" for name in ("none", *post.coolant))
        yield "coolant", f"'{setup.coolant}'", f"{allowed} in dialect '{dialect}'"
    if setup.blend_tolerance_mm is not None and not post.blends:
        able = " and ".join(other.name for other in _ALL if other.blends)
        yield (
            "blend_tolerance_mm",
            f"{setup.blend_tolerance_mm:g}",
            f"left out in dialect '{dialect}', which cannot be told a tolerance; {able} can",
        )
    if setup.work_offset != 1 and not post.offsets:
        yield "work_offset", f"{setup.work_offset}", f"1 in dialect '{dialect}', whose zero is set at the mill"
    if setup.high_precision != "none" and not post.high_precision:
        able = " and ".join(f"'{other.name}'" for other in _ALL if other.high_precision)
        yield "high_precision", f"'{setup.high_precision}'", f"'none' in dialect '{dialect}'; {able} has such modes"
