"""Names that come from elsewhere, made harmless: no folders, no control characters, not too long."""

from __future__ import annotations

import unicodedata

_LONGEST = 100
_KEPT_ENDING = 12


def harmless_name(given: bytes | str, *, default: str) -> str:
    """The last part of a path in any system's spelling, printable, at most 100 characters; `default` for nothing."""
    text = given if isinstance(given, str) else given.decode("utf-8", "replace")
    text = unicodedata.normalize("NFC", text.replace("\\", "/").rpartition("/")[2])
    text = "".join(c if c.isprintable() and c not in '<>:"|?*' else "_" for c in text).strip(" .")
    if len(text) > _LONGEST:
        stem, dot, ending = text.rpartition(".")
        kept = f"{dot}{ending}" if 0 < len(ending) <= _KEPT_ENDING else ""
        text = (stem if kept else text)[: _LONGEST - len(kept)] + kept
    return text or default
