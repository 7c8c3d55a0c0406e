"""What the commands of the client share: arguments, checked before a request is sent, and the way to the server."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

_ID = re.compile(r"[A-Za-z0-9-]{1,64}")


def _id(text: str) -> str:
    if not _ID.fullmatch(text):
        raise typer.BadParameter(f"'{text}' is not an id; `causticmill jobs` and `causticmill runs` list them")
    return text


JobArgument = Annotated[str, typer.Argument(metavar="JOB", help="Id of the job.", callback=_id)]
RunArgument = Annotated[str, typer.Argument(metavar="RUN", help="Id of the run.", callback=_id)]
ServerOption = Annotated[
    str | None,
    typer.Option("--server", metavar="URL", help="The job server; default: CAUSTICMILL_SERVER, or this computer's."),
]
TokenOption = Annotated[
    Path | None,
    typer.Option("--token-file", metavar="FILE", help="File that holds the token; default: CAUSTICMILL_TOKEN."),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")]


def connect(server: str | None, token_file: Path | None) -> Any:
    from service.client.server import ServerClient, target_of

    return ServerClient(target_of(server=server, token_file=token_file))


def print_lines(lines: Iterable[str]) -> None:
    for line in lines:
        print(line)
