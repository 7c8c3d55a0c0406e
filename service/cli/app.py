"""The command line: every group of commands, in the order in which --help lists them."""

from __future__ import annotations

import typer

from service.cli import jobs, make, mill, photographs, plan_options, serve, tokens

app = typer.Typer(
    name="causticmill",
    help="Turn a picture into programs that mill a clear block; light through the block paints the picture on a wall.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def print_version() -> None:
    """Print the version."""
    from importlib import metadata

    print(f"causticmill {metadata.version('causticmill')}")


make.register(app)
app.command("version")(print_version)
for module in (plan_options, photographs, mill, tokens, jobs, serve):
    module.register(app)
