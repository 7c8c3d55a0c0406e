"""The commands `plan`, `tools` and `keys`: arguments and calls.

Everything is imported inside the commands, so that --help is fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SourceArgument = Annotated[Path, typer.Argument(metavar="PICTURE|DIR", help="A picture, or an earlier job's folder.")]
ToolsOption = Annotated[Path | None, typer.Option("--tools", metavar="FILE", help="Tool library; see `tools`.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to the command line."""
    app.command()(plan)
    app.command("tools")(list_tools)
    app.command("keys")(list_spec_keys)


def plan(
    source: SourceArgument,
    machine: Annotated[str | None, typer.Option("--machine", metavar="NAME", help="Machine profile.")] = None,
    hours: Annotated[
        float | None, typer.Option("--hours", help="Find the best picture within this machine time.")
    ] = None,
    blur_mm: Annotated[
        float | None, typer.Option("--blur-mm", help="Find the quickest plan that blurs no more than this.")
    ] = None,
    psnr: Annotated[
        float | None, typer.Option("--psnr", help="Find the quickest plan that reaches this PSNR, dB.")
    ] = None,
    tools: ToolsOption = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="Write a picture of the plans, and a spec beside it."),
    ] = None,
    spec: Annotated[Path | None, typer.Option("--spec", metavar="FILE", help="Job spec, TOML or JSON.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One value of the spec. Repeatable.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the plan as JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")] = False,
) -> None:
    """Plan balls, pitches and passes: which picture each gives in how many hours, and which to choose."""
    from service.cli.plan import PlanRequest, run_plan

    request = PlanRequest(
        source=source,
        machine=machine,
        goal={"hours": hours, "blur_mm": blur_mm, "psnr_db": psnr},
        tools=tools,
        output=output,
        spec=spec,
        overrides=tuple(set_ or ()),
    )
    for line in run_plan(request, as_json=json):
        if not quiet:
            print(line)


def list_tools(
    file: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="A library to read and show.")] = None,
) -> None:
    """List the ball end mills that plans choose from."""
    from service.job.spec.tools import library_file, load_tools, table

    for line in table(load_tools(file), library_file(file)):
        print(line)


def list_spec_keys(
    word: Annotated[str, typer.Argument(metavar="[WORD]", help="Only keys in which this occurs.")] = "",
) -> None:
    """List every key of a job with its allowed values, its default and its meaning."""
    from service.errors import InputError
    from service.job.spec.keys import list_keys
    from service.wording import align

    rows = list_keys(word)
    if not rows:
        raise InputError(f"no key has anything to do with '{word}'; `causticmill keys` lists all")
    for line in align([("KEY", "ALLOWED", "DEFAULT", "MEANING"), *rows]):
        print(line)
