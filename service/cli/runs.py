"""The command `runs`: programs on the mills of a server. No command moves a mill without a person's confirmation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.options import JobArgument, RunArgument, ServerOption, TokenOption, connect, print_lines

ConfirmOption = Annotated[
    list[str] | None,
    typer.Option("--confirm", metavar="WORDS", help="What you have checked, e.g. tool,zero,stock,clear; default: ask."),
]
OperatorOption = Annotated[str | None, typer.Option("--operator", metavar="NAME", help="Who confirms; default: you.")]
FollowOption = Annotated[bool, typer.Option("--follow", help="Wait until the run has ended.")]

runs_app = typer.Typer(
    help="Programs on the mills of a server: park, start, hold, resume, abort, recover, follow.",
    invoke_without_command=True,
)


def register(app: typer.Typer) -> None:
    """Add the commands of this module to the command line."""
    app.add_typer(runs_app, name="runs")


@runs_app.callback()
def take_server(context: typer.Context, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """List, show and control the runs of a server. Without a subcommand: list the latest."""
    if context.invoked_subcommand is None:
        list_runs(server=server, token_file=token_file)


@runs_app.command("list")
def list_runs(
    machine: Annotated[
        str | None, typer.Option("--machine", metavar="NAME", help="Only the runs of this mill.")
    ] = None,
    server: ServerOption = None,
    token_file: TokenOption = None,
) -> None:
    """List the latest runs."""
    from service.client.runs import run_table

    with connect(server, token_file) as link:
        print_lines(run_table(link.get("/v1/runs", **({"machine": machine} if machine else {}))["runs"]))


@runs_app.command("show")
def show_run(run: RunArgument, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """Show one run: state, tool, stock, zero."""
    from service.client.runs import run_lines

    with connect(server, token_file) as link:
        print_lines(run_lines(link.get(f"/v1/runs/{run}")))


@runs_app.command("park")
def park_run(
    job: JobArgument,
    machine: Annotated[str, typer.Option("--machine", metavar="NAME", help="The mill.")],
    program: Annotated[
        int | None, typer.Option("--program", min=1, help="Number of the pass; default: the next one.")
    ] = None,
    server: ServerOption = None,
    token_file: TokenOption = None,
) -> None:
    """Hand a program of a job to a mill. Nothing moves: the run waits for `runs start`."""
    from urllib.parse import quote

    from service.client.runs import run_lines

    with connect(server, token_file) as link:
        body = {"job": job} | ({"program": program} if program is not None else {})
        run = link.post_idempotent(f"/v1/machines/{quote(machine, safe='')}/runs", body)
    print_lines(run_lines(run))


@runs_app.command("start")
def start_run(
    run: RunArgument,
    confirm: ConfirmOption = None,
    operator: OperatorOption = None,
    follow: FollowOption = False,
    server: ServerOption = None,
    token_file: TokenOption = None,
) -> None:
    """Start a parked run, after you have seen and confirmed its setup."""
    _send_confirmed(run, "start", confirm, operator, follow, server, token_file)


@runs_app.command("recover")
def recover_run(
    run: RunArgument,
    confirm: ConfirmOption = None,
    operator: OperatorOption = None,
    follow: FollowOption = False,
    server: ServerOption = None,
    token_file: TokenOption = None,
) -> None:
    """Recover an interrupted or aborted run, after you have seen and confirmed the way back."""
    _send_confirmed(run, "recover", confirm, operator, follow, server, token_file)


@runs_app.command("hold")
def hold_run(run: RunArgument, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """Hold the mill: it stands still. Not an emergency stop."""
    _stop(run, "hold", server, token_file)


@runs_app.command("resume")
def resume_run(run: RunArgument, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """Go on after a hold."""
    from service.client.runs import state_line

    with connect(server, token_file) as link:
        machine = link.get(f"/v1/runs/{run}")["machine"]
        print(state_line(link.order(machine, f"/v1/runs/{run}:resume")))


@runs_app.command("abort")
def abort_run(run: RunArgument, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """Abort a run."""
    _stop(run, "abort", server, token_file)


@runs_app.command("follow")
def follow_run(run: RunArgument, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """Watch a run until it has ended; exit code 1 if it was not finished."""
    with connect(server, token_file) as link:
        link.get(f"/v1/runs/{run}")
        _follow(link, run)


def _send_confirmed(
    run: str,
    verb: str,
    confirm: list[str] | None,
    operator: str | None,
    follow: bool,
    server: str | None,
    token_file: Path | None,
) -> None:
    from urllib.parse import quote

    from service.client.runs import confirm_checks, run_lines, state_line
    from service.milling.terminal.confirm import operator_name

    with connect(server, token_file) as link:
        seen = link.get(f"/v1/runs/{run}")
        print_lines(run_lines(seen))
        if verb == "recover":
            plan = link.get(f"/v1/runs/{run}/recovery")
            _print_plan(plan)
            rests_on = {"plan": str(plan.get("plan", ""))}
        else:
            mill = link.get(f"/v1/machines/{quote(seen['machine'], safe='')}").get("mill") or {}
            rests_on = {"setup": str(mill.get("setup", ""))}
        body = {"operator": operator or operator_name(), "checks": confirm_checks(seen, confirm or ())} | rests_on
        print(state_line(link.order(seen["machine"], f"/v1/runs/{run}:{verb}", body)), flush=True)
        if follow:
            _follow(link, run)


def _print_plan(plan: dict[str, Any]) -> None:
    """Print the way back; raise FailedError if it is refused."""
    from service.client.server import clean
    from service.errors import InputError

    obstacles = [*plan.get("refusals", ()), *(need["words"] for need in plan.get("needs", ()))]
    if obstacles:
        raise InputError(*(clean(words) for words in obstacles))
    print_lines([clean(words) for words in plan.get("words", ())])


def _stop(run: str, verb: str, server: str | None, token_file: Path | None) -> None:
    """Send a stop to the server, or, if it does not answer, to the mill's agent on this computer. If the stop may not
    have arrived, the error says to use the mill's own stop.
    """
    from service.client.runs import stop_at_agents
    from service.client.server import GoneError, RefusedError
    from service.errors import FailedError

    try:
        _send_command(run, verb, server, token_file)
    except (GoneError, RefusedError) as error:
        if isinstance(error, RefusedError) and error.status < 500:
            raise
        if (machine := stop_at_agents(run, verb)) is not None:
            print(f"{verb}: accepted by the agent of {machine}; {error}")
            return
        doubt = f"the {verb} may not have arrived: use the mill's own stop"
        raise FailedError(*str(error).split("\n"), doubt) from None


def _send_command(run: str, verb: str, server: str | None, token_file: Path | None) -> None:
    from service.client.runs import state_line

    with connect(server, token_file) as link:
        print(state_line(link.post(f"/v1/runs/{run}:{verb}")))


def _follow(link: Any, run_id: str) -> None:
    from service.client.runs import follow_run, require_finished, setup_lines

    run = follow_run(link, run_id)
    print_lines(setup_lines(run))
    require_finished(run)
