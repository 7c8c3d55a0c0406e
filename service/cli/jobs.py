"""The commands `submit`, `get` and `jobs`: arguments and calls. `runs` is in `service.cli.runs`.

Everything is imported inside the commands, so that --help is fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli import runs
from service.cli.options import JobArgument, QuietOption, ServerOption, TokenOption, connect, print_lines

OutputOption = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the files.")]
LimitOption = Annotated[int, typer.Option("--limit", min=1, help="At most this many.")]
StateOption = Annotated[list[str] | None, typer.Option("--state", help="Only jobs in this state. Repeatable.")]

jobs_app = typer.Typer(
    help="The jobs of a server: list, show, follow, cancel, retry, delete.", invoke_without_command=True
)


def register(app: typer.Typer) -> None:
    """Add the commands of this package to the command line."""
    app.command()(submit)
    app.command()(get)
    app.add_typer(jobs_app, name="jobs")
    runs.register(app)


def submit(
    picture: Annotated[Path, typer.Argument(metavar="PICTURE", help="The picture, as for `make`.")],
    spec: Annotated[Path | None, typer.Option("--spec", metavar="FILE", help="Job spec, TOML or JSON.")] = None,
    preset: Annotated[
        str | None, typer.Option("--preset", metavar="NAME", help="Passes: paper, draft or recommended.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One value, e.g. optics.width_mm=40. Repeatable."),
    ] = None,
    light_picture: Annotated[
        Path | None,
        typer.Option("--light-picture", metavar="FILE", help="Measured picture of the light, as for `make`."),
    ] = None,
    priority: Annotated[str, typer.Option("--priority", help="low, normal or high.")] = "normal",
    follow: Annotated[bool, typer.Option("--follow", "--wait", help="Wait until the job has ended.")] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Follow, then download all files into this folder."),
    ] = None,
    server: ServerOption = None,
    token_file: TokenOption = None,
    quiet: QuietOption = False,
) -> None:
    """Submit a picture to the job server. Prints the job's id."""
    from service.client.submit import Submission, spec_text, submit_job

    text = spec_text(file=spec, preset=preset, overrides=set_ or (), light_picture=light_picture)
    order = Submission(picture=picture, spec=text, priority=priority)
    with connect(server, token_file) as link:
        if output is not None:
            from service.client.download import require_folder

            require_folder(output)
        job_id = str(submit_job(link, order)["id"])
        print(job_id, flush=True)
        if follow or output is not None:
            _follow(link, job_id, quiet=quiet, fetched=output is not None)
        if output is not None:
            _download(link, job_id, output, (), quiet)


def get(
    job: JobArgument,
    output: OutputOption,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="NAME", help="Download only this file. Repeatable.")
    ] = None,
    server: ServerOption = None,
    token_file: TokenOption = None,
    quiet: QuietOption = False,
) -> None:
    """Download the files of a job. Continues an interrupted download; every file is checked by its hash."""
    with connect(server, token_file) as link:
        _download(link, job, output, tuple(only or ()), quiet)


@jobs_app.callback()
def take_server(context: typer.Context, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """List, show and change the jobs of a server. Without a subcommand: list the latest."""
    if context.invoked_subcommand is None:
        list_jobs(server=server, token_file=token_file)


@jobs_app.command("list")
def list_jobs(
    state: StateOption = None, limit: LimitOption = 20, server: ServerOption = None, token_file: TokenOption = None
) -> None:
    """List the latest jobs."""
    from service.client.jobs import job_table, list_jobs

    with connect(server, token_file) as link:
        print_lines(job_table(list(list_jobs(link, states=tuple(state or ()), limit=limit))))


@jobs_app.command("show")
def show_job(job: JobArgument, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """Show one job: state, stages, programs."""
    from service.client.jobs import job_lines

    with connect(server, token_file) as link:
        print_lines(job_lines(link.get(f"/v1/jobs/{job}")))


@jobs_app.command("follow")
def follow_job(
    job: JobArgument, server: ServerOption = None, token_file: TokenOption = None, quiet: QuietOption = False
) -> None:
    """Watch a job until it has ended; exit code 1 if it did not succeed."""
    with connect(server, token_file) as link:
        link.get(f"/v1/jobs/{job}")  # report a missing server or job at once
        _follow(link, job, quiet=quiet)


@jobs_app.command("cancel")
def cancel_job(job: JobArgument, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """Cancel a job."""
    _send_command(job, "cancel", server, token_file)


@jobs_app.command("retry")
def retry_job(job: JobArgument, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """Start a failed or cancelled job again; finished stages are kept."""
    _send_command(job, "retry", server, token_file)


@jobs_app.command("delete")
def delete_job(job: JobArgument, server: ServerOption = None, token_file: TokenOption = None) -> None:
    """Delete a job that has ended, and its files."""
    with connect(server, token_file) as link:
        link.delete(f"/v1/jobs/{job}")
    print(f"{job} deleted")


def _send_command(job: str, verb: str, server: str | None, token_file: Path | None) -> None:
    from service.client.jobs import state_words

    with connect(server, token_file) as link:
        answer = link.post(f"/v1/jobs/{job}:{verb}")
    print(f"{job} {state_words(answer)}")


def _follow(link: Any, job_id: str, *, quiet: bool, fetched: bool = False) -> None:
    from service.client.follow import follow, job_screen, require_success
    from service.client.jobs import program_lines

    with job_screen(quiet=quiet) as screen:
        job = follow(link, job_id, screen)
    require_success(job)
    if not quiet:
        hint = "" if fetched else f"; `causticmill get {job_id} -o DIR` downloads its files"
        print_lines([f"succeeded{hint}", *program_lines(job)])


def _download(link: Any, job_id: str, folder: Path, only: tuple[str, ...], quiet: bool) -> None:
    from service.client.download import get_files

    get_files(link, job_id, folder, only=only, quiet=quiet)
