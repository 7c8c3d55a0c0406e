"""Words that a person must find again between the lines on a terminal: in a frame."""

from __future__ import annotations

from typing import TextIO

_FINE, _PLAIN = tuple("┌─┐│└┘"), tuple("+-+|++")


def code_lines(stream: TextIO, url: str, code: str) -> str:
    """Where the page is, and the code for running mills from it. For a terminal only."""
    rows = (f"Open  {url}  in a browser.", f"Code  {code}   (the page asks for it before it runs a mill)")
    return framed(rows, fine=(stream.encoding or "").lower().replace("-", "") == "utf8")


def framed(rows: tuple[str, ...], *, fine: bool) -> str:
    """Rows in a box with an empty line before and after it."""
    left_top, across, right_top, down, left, right = _FINE if fine else _PLAIN
    width = max(map(len, rows)) + 4
    inner = (f"{down}  {row:<{width - 4}}  {down}" for row in rows)
    return "\n".join(("", left_top + across * width + right_top, *inner, left + across * width + right, "", ""))
