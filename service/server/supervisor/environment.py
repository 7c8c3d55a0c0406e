"""Misspelt variables: a setting that is none would be passed over in silence, and a limit with it."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping

from service.settings import PREFIX, ServerSettings

# What others of ours read: clients, profiles, secrets, the command itself. TRIAL... belong to the trials of the server.
_OTHERS = ("SERVER", "TOKEN", "CONFIG_DIR", "SECRETS", "BEGAN", "PUBLISHED_PORT")
_TRIALS = ("TRIAL", "BENCH_", "FUZZ_", "SLOW", "REWRITE_")


def unknown_settings(environment: Mapping[str, str]) -> Iterator[str]:
    """Yield a sentence for each variable that looks like one of ours and is none."""
    settings = [name.upper() for name in ServerSettings.model_fields]
    for variable in sorted(environment):
        name = variable.upper().removeprefix(PREFIX)
        if name == variable.upper() or name in settings or name in _OTHERS or name.startswith(_TRIALS):
            continue
        meant = difflib.get_close_matches(name, settings, n=1)
        hint = f"; {PREFIX}{meant[0]} is one" if meant else ""
        yield f"{variable} is no setting{hint}"
