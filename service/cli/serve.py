"""The commands `serve`, `worker` and `service ...`: arguments and calls.

`serve` and `worker` check their settings and then *become* the process that does the work (exec), so that nothing of
the command line stays in memory for the months that a server runs.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from service.settings import ServerSettings

DataOption = Annotated[
    Path | None, typer.Option("--data", metavar="DIR", help="Folder of database, artifacts and locks.")
]
HostOption = Annotated[str | None, typer.Option("--host", help="Address to serve on; default 127.0.0.1.")]
ServerPortOption = Annotated[
    int | None, typer.Option("--port", min=0, max=65535, help="TCP port; default 8000; 0: any free port.")
]
SlotsOption = Annotated[
    int | None, typer.Option("--slots", min=1, max=64, help="Number of jobs that run at the same time.")
]
DatabaseOption = Annotated[
    str | None, typer.Option("--database-url", metavar="URL", help="postgresql://...; default: a SQLite file in DIR.")
]
StoreOption = Annotated[
    str | None,
    typer.Option("--store-url", metavar="URL", help="file:///folder, s3://bucket/prefix; default: in DIR."),
]
SharedOption = Annotated[
    bool, typer.Option("--store-is-shared", help="The file:// store is the same folder on every host.")
]
VerboseOption = Annotated[bool, typer.Option("--verbose", "-v", help="Write the log on a terminal as well.")]

service_commands = typer.Typer(
    name="service", help="The job server as a service of this computer: unit files, backup.", no_args_is_help=True
)


def register(app: typer.Typer) -> None:
    """Add the commands of this module to the command line."""
    app.command()(serve)
    app.command("worker")(run_worker)
    app.add_typer(service_commands)


def serve(
    data: DataOption = None,
    host: HostOption = None,
    port: ServerPortOption = None,
    slots: SlotsOption = None,
    no_worker: Annotated[bool, typer.Option("--no-worker", help="API only; workers run elsewhere.")] = False,
    database_url: DatabaseOption = None,
    store_url: StoreOption = None,
    store_is_shared: SharedOption = False,
    behind_proxy: Annotated[
        bool, typer.Option("--behind-proxy", help="A proxy with TLS and its own authentication is in front.")
    ] = False,
    no_agents: Annotated[bool, typer.Option("--no-agents", help="Start no agents of mills.")] = False,
    with_simulated_mill: Annotated[
        bool, typer.Option("--with-simulated-mill", help="Also offer a simulated mill, to try everything on.")
    ] = False,
    verbose: VerboseOption = False,
) -> None:
    """Run the job server: API, worker and page. Stop it with Ctrl-C. Every setting is also an environment variable."""
    began = time.time()
    settings = _settings(
        data=data,
        host=host,
        port=port,
        slots=slots,
        database_url=database_url,
        store_url=store_url,
        store_is_shared=store_is_shared or None,
        behind_proxy=behind_proxy or None,
        start_agents=False if no_agents else None,
        simulated_mill=with_simulated_mill or None,
        log_level=_log_level(verbose),
    )
    arguments = ["worker="] if no_worker else []
    _exec_module(
        "service.server.supervisor.supervisor", arguments, settings.environment() | {"CAUSTICMILL_BEGAN": str(began)}
    )


def run_worker(
    data: DataOption = None,
    slots: SlotsOption = None,
    database_url: DatabaseOption = None,
    store_url: StoreOption = None,
    store_is_shared: SharedOption = False,
    executor: Annotated[str | None, typer.Option("--executor", help="This worker's name in the farm.")] = None,
    verbose: VerboseOption = False,
) -> None:
    """Run a worker of a farm, on the jobs of the database that CAUSTICMILL_DATABASE_URL or --database-url names."""
    settings = _settings(
        data=data,
        slots=slots,
        database_url=database_url,
        store_url=store_url,
        store_is_shared=store_is_shared or None,
        executor=executor,
        log_level=_log_level(verbose),
    )
    _exec_module("service.server.worker.main", [], settings.environment())


@service_commands.command()
def install(
    data: DataOption = None,
    system: Annotated[bool, typer.Option("--system", help="For the whole computer (as root), not for you.")] = False,
    user: Annotated[bool, typer.Option("--user", help="For you (the default).")] = False,
    account: Annotated[str, typer.Option("--account", help="With --system: the account that runs it.")] = "causticmill",
    machine: Annotated[
        str | None, typer.Option("--machine", metavar="NAME", help="The agent of this mill instead of the server.")
    ] = None,
    mill_port: Annotated[str | None, typer.Option("--mill-port", metavar="URL", help="Its port.")] = None,
    only_print: Annotated[bool, typer.Option("--print", help="Show the unit and write nothing.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a unit that is not ours.")] = False,
) -> None:
    """Write a systemd unit that starts the server, or the agent of a mill, with the computer."""
    from service.errors import InputError
    from service.server.supervisor.systemd import UnitOrder, install, unit_text

    if system and user:
        raise InputError("--system and --user exclude each other; allowed: one of them")
    if mill_port is not None and machine is None:
        raise InputError("--mill-port: allowed only with --machine NAME")
    order = UnitOrder(
        data=_settings(data=data).data.absolute(), system=system, account=account, machine=machine, mill_port=mill_port
    )
    if only_print:
        print(unit_text(order), end="")
        return
    for line in install(order, force=force):
        print(line)


@service_commands.command("backup")
def back_up(
    target: Annotated[Path, typer.Argument(metavar="FILE.tar", help="File for the backup; -: standard output.")],
    data: DataOption = None,
) -> None:
    """Write the whole data folder into one tar file, consistent while the server runs."""
    from service.server.database.backup import back_up

    for line in back_up(_settings(data=data), target):
        print(line, file=sys.stderr)


@service_commands.command()
def restore(
    source: Annotated[Path, typer.Argument(metavar="FILE.tar", help="A backup.")],
    data: DataOption = None,
    keep_tokens: Annotated[
        bool, typer.Option("--keep-tokens", help="Keep all tokens valid, even those revoked since the backup.")
    ] = False,
) -> None:
    """Restore a backup into an empty data folder: check every hash, revoke every token. `serve` continues its jobs."""
    from service.server.database.backup import restore_backup

    for line in restore_backup(source, _settings(data=data), keep_tokens=keep_tokens):
        print(line, file=sys.stderr)


@service_commands.command()
def verify(data: DataOption = None) -> None:
    """Read every object of the artifact store and compare it with its hash; exit code 1 if one differs."""
    from service.server.database.backup import verify_store

    for line in verify_store(_settings(data=data)):
        print(line, file=sys.stderr)


def _settings(**given: object) -> ServerSettings:
    from service.settings import ServerSettings, unknown_settings

    for line in unknown_settings(os.environ):
        print(f"warning: {line}", file=sys.stderr)
    return ServerSettings.load(**given)


def _log_level(verbose: bool) -> str | None:
    """Return the log level; on a terminal only warnings for a person, unless they ask for more."""
    if verbose:
        return "info"
    return "warning" if sys.stderr.isatty() and "CAUSTICMILL_LOG_LEVEL" not in os.environ else None


def _exec_module(module: str, arguments: list[str], environment: dict[str, str]) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(sys.executable, [sys.executable, "-P", "-m", module, *arguments], environment)
