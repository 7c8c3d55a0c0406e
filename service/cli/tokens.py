"""The commands `token create`, `token list` and `token revoke`: they work on the database itself, without a server."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.errors import FailedError, InputError

if TYPE_CHECKING:
    from service.server.database.tokens import Token, TokenBook

_UNITS = {"m": 60.0, "h": 3600.0, "d": 86400.0}

tokens_app = typer.Typer(help="Tokens of the job server: permissions of its callers.", no_args_is_help=True)
DataOption = Annotated[
    Path | None, typer.Option("--data", metavar="DIR", help="Data folder of the server; default causticmill-data.")
]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to the command line."""
    app.add_typer(tokens_app, name="token")


@tokens_app.command()
def create(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of its user or purpose.")],
    scope: Annotated[
        list[str],
        typer.Option("--scope", metavar="SCOPE", help="jobs:read, jobs:write, machine:run, admin. Repeatable."),
    ],
    expires: Annotated[
        str | None, typer.Option("--expires", metavar="TIME", help="30d, 12h or 90m from now; default: never.")
    ] = None,
    data: DataOption = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the token and nothing else.")] = False,
) -> None:
    """Create a token and show it, once."""
    life_s = None if expires is None else _seconds(expires)
    words = [word for one in scope for word in one.replace(",", " ").split()]
    with _token_book(data) as book:
        token, secret = book.create(name, words, expires_at=None if life_s is None else time.time() + life_s)
    if quiet:
        print(secret)
        return
    print(f"token {token.id} of {token.name}: {', '.join(sorted(token.scopes))}; {_until(token)}")
    print(f"{secret}\nKeep it: it is not stored and not shown again.")


@tokens_app.command()
def pair(data: DataOption = None) -> None:
    """Print a new code for the page to run mills, valid for a day. Only on terminals."""
    if not sys.stdout.isatty():
        raise InputError(
            "a code gives access to a mill, so it is printed only on a terminal, not into files and pipes (ssh: use -t)"
        )
    from service.server.database.pairing import PairingBook
    from service.server.pairing_code import code_of, new_offer

    offer = new_offer()
    with _token_book(data) as book:
        PairingBook(book.engine, book).offer(offer)
    print(code_of(offer))


@tokens_app.command("list")
def list_(data: DataOption = None) -> None:
    """List all tokens and their state. The tokens themselves are not stored."""
    with _token_book(data) as book:
        found = book.list_rows()
    if all(token.paired for token in found):
        print("no token was ever created; on this computer, jobs need none")
    for token in found:
        print(
            f"{token.id}  {token.name}  {','.join(sorted(token.scopes))}  made {_date(token.created_at)}, "
            f"{_until(token)}, {_format_last_use(token)}{', by a page' if token.paired else ''}"
        )


@tokens_app.command()
def revoke(
    token_id: Annotated[str, typer.Argument(metavar="[ID]", help="Id, as `token list` shows it.")] = "",
    every: Annotated[bool, typer.Option("--all", help="Revoke every token and every code of `token pair`.")] = False,
    data: DataOption = None,
) -> None:
    """Revoke a token at once."""
    if every == bool(token_id):
        raise InputError("ID or --all: allowed: one of them")
    with _token_book(data) as book:
        if every:
            print(f"every token is revoked; {book.revoke_all()} of them were valid until now")
            return
        try:
            token = book.revoke(token_id)
        except LookupError as error:
            raise InputError(f"{error}; `causticmill token list` shows them") from None
    print(f"token {token.id} of {token.name} is revoked")


@contextmanager
def _token_book(data: Path | None) -> Iterator[TokenBook]:
    from sqlalchemy.exc import SQLAlchemyError

    from service.server.database.schema import open_database
    from service.server.database.tokens import TokenBook
    from service.settings import ServerSettings

    try:
        database = open_database(ServerSettings.load(data=data), migrate=True)
        try:
            yield TokenBook(database)
        finally:
            database.dispose()
    except SQLAlchemyError as error:
        reason = " ".join(str(getattr(error, "orig", None) or error).split())
        raise FailedError(f"the database cannot be used: {reason}") from None


def _seconds(text: str) -> float:
    number, unit = text[:-1], text[-1:]
    if not (number.isascii() and number.isdigit()) or int(number) == 0 or len(number) > 6 or unit not in _UNITS:
        raise InputError(f"--expires '{text[:40]}'; allowed: a whole number with m, h or d, such as 30d")
    return int(number) * _UNITS[unit]


def _date(at: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(at))


def _until(token: Token) -> str:
    if token.revoked_at is not None:
        return f"revoked {_date(token.revoked_at)}"
    if token.expires_at is None:
        return "never expires"
    return f"expire{'s' if token.live(time.time()) else 'd'} {_date(token.expires_at)}"


def _format_last_use(token: Token) -> str:
    return "never used" if token.last_used_at is None else f"last used {_date(token.last_used_at)}"
