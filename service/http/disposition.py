"""The header that names a download, in any script."""

from __future__ import annotations

from typing import Literal
from urllib.parse import quote


def name_download(kind: Literal["inline", "attachment"], name: str) -> str:
    """Return the value of Content-Disposition (RFC 6266).

    A name that is not plain ASCII is encoded by RFC 8187, beside an ASCII one for clients that cannot read that.
    """
    plain = "".join(c if c.isascii() and c.isprintable() and c not in '"\\%' else "_" for c in name)
    shown = f'{kind}; filename="{plain}"'
    return shown if plain == name else f"{shown}; filename*=UTF-8''{quote(name.encode('utf-8', 'replace'), safe='')}"
