"""The command line: `causticmill make`, `design`, `cam`, `caustic`, `check`, `version`.

Everything heavy is imported inside the commands, so that --help answers at once. Errors end in one line each on stderr
and an exit code: 2 for what the person gave, 1 for a job that failed, 130 for Ctrl-C.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.errors import EXIT_FAILURE, EXIT_INPUT, EXIT_INTERRUPTED, JobError, sentence_of_os_error
from service.kernel_cache import use_current_kernels

if TYPE_CHECKING:
    from service.progress import Reporter

app = typer.Typer(
    name="causticmill",
    help="From a picture to the programs that mill a clear block whose light paints it on a wall.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

PictureArgument = Annotated[Path, typer.Argument(metavar="PICTURE", help="Any picture Pillow reads.")]
FolderArgument = Annotated[Path, typer.Argument(metavar="DIR", help="The folder of an earlier design or make.")]
OutputOption = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for all files of the job.")]
SpecOption = Annotated[Path | None, typer.Option("--spec", metavar="FILE", help="Job spec, TOML or JSON.")]
PresetOption = Annotated[str | None, typer.Option("--preset", metavar="NAME", help="Passes: paper or draft.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One value, e.g. optics.width_mm=40. Repeatable.")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Write into a folder that holds other files.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]


@app.command()
def make(
    picture: PictureArgument,
    output: OutputOption,
    spec: SpecOption = None,
    preset: PresetOption = None,
    set_: SetOption = None,
    force: ForceOption = False,
    quiet: QuietOption = False,
) -> None:
    """Picture to lens, checked programs, previews and setup sheet."""
    from service import pipeline, spec_files

    resolved = spec_files.resolve_spec(file=spec, preset=preset, overrides=set_ or ())
    with _reporter(quiet) as reporter:
        report = pipeline.make(picture, output, resolved, reporter=reporter, force=force)
    _summary(output, report, quiet)


@app.command()
def design(
    picture: PictureArgument,
    output: OutputOption,
    spec: SpecOption = None,
    preset: PresetOption = None,
    set_: SetOption = None,
    force: ForceOption = False,
    quiet: QuietOption = False,
) -> None:
    """Picture to lens only: heightfield, solid, simulated caustic. No programs."""
    from service import pipeline, spec_files

    resolved = spec_files.resolve_spec(file=spec, preset=preset, overrides=set_ or ())
    with _reporter(quiet) as reporter:
        report = pipeline.design(picture, output, resolved, reporter=reporter, force=force)
    _summary(output, report, quiet)


@app.command()
def cam(
    folder: FolderArgument,
    spec: SpecOption = None,
    preset: PresetOption = None,
    set_: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Lens to checked programs, in the folder of an earlier design or make."""
    from service import pipeline, spec_files

    stored = spec_files.stored_spec(folder)
    resolved = spec_files.resolve_spec(base=stored.plain(), file=spec, preset=preset, overrides=set_ or ())
    spec_files.require_same_lens(stored, resolved)
    with _reporter(quiet) as reporter:
        report = pipeline.cam(folder, resolved, reporter=reporter)
    _summary(folder, report, quiet)


@app.command()
def caustic(folder: FolderArgument, quiet: QuietOption = False) -> None:
    """Simulate the light of an earlier design again: scores, caustic, through-focus."""
    from service import pipeline, spec_files

    stored = spec_files.stored_spec(folder)
    with _reporter(quiet) as reporter:
        report = pipeline.caustic(folder, stored, reporter=reporter)
    _summary(folder, report, quiet)


@app.command()
def check(
    programs: Annotated[list[Path], typer.Argument(metavar="PROGRAM...", help="Programs in the order they are run.")],
    heightfield: Annotated[Path, typer.Option("--heightfield", metavar="FILE", help="The lens: heightfield.npz.")],
    radius_mm: Annotated[
        list[float] | None, typer.Option("--radius-mm", help="Ball radius of each program; one serves all.")
    ] = None,
    pitch_mm: Annotated[list[float] | None, typer.Option("--pitch-mm", help="Pitch of each program.")] = None,
    stock_to_leave_mm: Annotated[
        list[float] | None, typer.Option("--stock-to-leave-mm", help="Stock each program leaves; default 0.")
    ] = None,
    step_down_mm: Annotated[
        list[float] | None, typer.Option("--step-down-mm", help="Most stock one move may take off.")
    ] = None,
    thickness_mm: Annotated[float | None, typer.Option("--thickness-mm", help="Thickness of the block.")] = None,
    margin_mm: Annotated[float | None, typer.Option("--margin-mm", help="Margin of the block.")] = None,
    machine: Annotated[str | None, typer.Option("--machine", help="Machine profile.")] = None,
    quiet: QuietOption = False,
) -> None:
    """Simulate the removal of written programs; exit code 1 on a gouge or a crash.

    Beside a job's spec.json all settings come from there, and the job's earlier passes are run first.
    """
    from service import checking

    settings = checking.CheckSettings(
        radius_mm=tuple(radius_mm or ()),
        pitch_mm=tuple(pitch_mm or ()),
        stock_to_leave_mm=tuple(stock_to_leave_mm or ()),
        step_down_mm=tuple(step_down_mm or ()),
        thickness_mm=thickness_mm,
        margin_mm=margin_mm,
        machine=machine,
    )
    with _reporter(quiet) as reporter:
        verdicts = checking.check_programs(programs, heightfield, settings, reporter=reporter)
    for verdict in verdicts:
        if not quiet or not verdict.ok:
            print(verdict.line(), file=sys.stdout if verdict.ok else sys.stderr)
    if not all(verdict.ok for verdict in verdicts):
        raise typer.Exit(EXIT_FAILURE)


@app.command()
def version() -> None:
    """Print the version."""
    from importlib import metadata

    print(f"causticmill {metadata.version('causticmill')}")


def main() -> None:
    """Entry point of the command `causticmill`."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code; every error becomes one line on stderr."""
    use_current_kernels()
    return _told(lambda: app(args=list(arguments), prog_name="causticmill", standalone_mode=False))


def _told(command: Callable[[], Any]) -> int:
    """Run a command; translate whatever ends it into a line and an exit code."""
    try:
        with _termination_as_interrupt():
            result = command()
        if result == EXIT_INTERRUPTED:  # typer catches Ctrl-C itself and says nothing
            raise KeyboardInterrupt
        return result if isinstance(result, int) else 0
    except JobError as error:
        return _fail(str(error), error.exit_code)
    except typer.Exit as leave:
        return leave.exit_code
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted; nothing was written", EXIT_INTERRUPTED)
    except MemoryError:
        return _fail("out of memory; a smaller image.pixels needs less", EXIT_FAILURE)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILURE
    except OSError as error:
        return _fail(sentence_of_os_error(error, doing="cannot use"), EXIT_FAILURE)
    except Exception as error:
        if (message := getattr(error, "format_message", None)) is not None:  # a usage error from the parser
            return _fail(" ".join(str(message()).split()), EXIT_INPUT)
        raise


def _fail(text: str, code: int) -> int:
    for line in text.splitlines():
        print(f"error: {line}", file=sys.stderr)
    return code


@contextlib.contextmanager
def _termination_as_interrupt() -> Iterator[None]:
    """SIGTERM cleans up as Ctrl-C does."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, interrupt)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _reporter(quiet: bool) -> Iterator[Reporter]:
    from service import progress

    if quiet:
        yield progress.QuietReporter()
    elif sys.stdout.isatty():
        from rich.console import Console

        with progress.TerminalReporter(Console()) as bars:
            yield bars
    else:
        yield progress.PlainReporter(sys.stdout)


def _summary(folder: Path, report: dict[str, Any], quiet: bool) -> None:
    if quiet:
        return
    from service.summary import summary_lines

    for line in summary_lines(folder, report):
        print(line)


if __name__ == "__main__":
    main()
