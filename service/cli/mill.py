"""The commands `mill`, `stream`, `sim-mill` and `machines`: arguments and calls.

Everything is imported inside the commands, so that --help is fast.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from service.errors import FailedError, InputError
from service.processes.linux import go_first

_DEFAULT_MACHINE = "grbl"

MachineOption = Annotated[str, typer.Option("--machine", metavar="NAME", help="Machine profile; see `machines`.")]
PortOption = Annotated[
    str | None,
    typer.Option(
        "--port",
        metavar="URL",
        help="/dev/serial/by-id/..., socket://host:23, rfc2217://..; default: from the profile.",
    ),
]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to the command line."""
    app.command("mill")(run_agent)
    app.command()(stream)
    app.command("sim-mill")(run_simulated_mill)
    app.command("machines")(list_machines)


def run_agent(
    machine: MachineOption,
    port: PortOption = None,
    host: Annotated[str, typer.Option("--host", help="Address to serve on.")] = "127.0.0.1",
    bind_port: Annotated[int, typer.Option("--bind-port", help="TCP port to serve on; 0: any free port.")] = 8765,
    data: Annotated[Path | None, typer.Option("--data", metavar="DIR", help="Folder for journal and programs.")] = None,
    token_file: Annotated[
        Path | None, typer.Option("--token-file", metavar="FILE", help="Token that callers must send.")
    ] = None,
    behind_proxy: Annotated[
        bool, typer.Option("--behind-proxy", help="A proxy with TLS is in front; needed for any other --host.")
    ] = False,
) -> None:
    """Run the agent of one mill: it owns the port, keeps program and journal, and takes orders over HTTP."""
    with _translate_errors():
        from service.milling.agent.main import run_agent
        from service.milling.agent.settings import make_agent_settings
        from service.milling.connect import machine_and_port

        profile, port_url = machine_and_port(machine, port)
        settings = make_agent_settings(
            machine=machine,
            port_url=port_url,
            own_port=profile.link.port,
            host=host,
            bind_port=bind_port,
            data=data,
            token_file=token_file,
            behind_proxy=behind_proxy,
        )
        run_agent(settings, profile)


def stream(
    program: Annotated[Path, typer.Argument(metavar="PROGRAM", help="The program to run.")],
    port: PortOption = None,
    machine: MachineOption = _DEFAULT_MACHINE,
    yes: Annotated[
        bool, typer.Option("--yes", help="You confirm: tool in, zero set, stock clamped, nobody in the way.")
    ] = False,
    recover: Annotated[bool, typer.Option("--recover", help="Continue an interrupted run of this program.")] = False,
    confirm_position: Annotated[
        bool, typer.Option("--confirm-position", help="With --recover: you confirm that the mill's position is right.")
    ] = False,
    frame: Annotated[
        bool, typer.Option("--frame", help="First go around the program's outline at the safe height, cutting nothing.")
    ] = False,
    dry_pass: Annotated[
        float | None,
        typer.Option("--dry-pass", metavar="MM", help="The whole program so much higher, spindle and coolant off."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="The controller reads everything and moves nothing ($C).")
    ] = False,
) -> None:
    """Run a program on a mill and watch it from this terminal. Ctrl-C holds the mill and asks."""
    with _translate_errors():
        from service.milling.connect import machine_and_port
        from service.milling.terminal.stream import StreamOrder, stream_program

        profile, port_url = machine_and_port(machine, port)
        order = StreamOrder(
            program=program,
            profile=profile,
            port_url=port_url,
            port_given=port,
            confirmed=yes,
            recover=recover,
            position_confirmed=confirm_position,
            frame=frame,
            lift_mm=dry_pass,
            dry_run=dry_run,
        )
        go_first()
        stream_program(order)


def run_simulated_mill(
    pty: Annotated[bool, typer.Option("--pty", help="Offer a pseudo terminal (the default).")] = False,
    tcp: Annotated[str | None, typer.Option("--tcp", metavar="HOST:PORT", help="Offer a TCP port instead.")] = None,
    firmware: Annotated[str, typer.Option("--firmware", help="grbl11, grblhal, fluidnc or grbl11-echo.")] = "grbl11",
    time_factor: Annotated[float, typer.Option("--time-factor", help="Simulated seconds per second.")] = 1.0,
    link: Annotated[Path | None, typer.Option("--link", metavar="PATH", help="Link to the pseudo terminal.")] = None,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="FILE", help="Write the path that was cut to this file.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="KIND",
            help="Fault to inject: drop@line=40, power-cycle@t=12, hold-button (somewhere), random:3. Repeatable.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the faults.")] = 0,
) -> None:
    """Run a simulated mill that behaves, and misbehaves, like real firmware. Stop it with Ctrl-C."""
    with _translate_errors():
        from service.cli.simulator import run_sim_mill

        if pty and tcp is not None:
            raise InputError("--pty and --tcp exclude each other; allowed: one of them")
        try:
            run_sim_mill(
                listen="pty" if tcp is None else f"tcp:{tcp}",
                firmware=firmware,
                time_factor=time_factor,
                link=link,
                record=record,
                faults=tuple(fault or ()),
                seed=seed,
            )
        except ValueError as error:
            raise InputError(str(error)) from None


def list_machines(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Show this machine in full.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Check profiles; with NAME its port, too.")] = False,
) -> None:
    """List the machine profiles, show one, or check them."""
    with _translate_errors():
        from service.cli.machines import run_machines

        if code := run_machines(name, check=check):
            raise typer.Exit(code)


@contextlib.contextmanager
def _translate_errors() -> Iterator[None]:
    """Translate errors of the machine layer into errors of the service: wrong input, or a failure."""
    from machines.errors import JournalError, MachineError, PortLostError
    from machines.profile import UnknownProfileError

    try:
        yield
    except UnknownProfileError as error:
        raise InputError(f"--machine: {error}") from None
    except (JournalError, PortLostError) as error:
        raise FailedError(str(error)) from None
    except MachineError as error:
        raise InputError(str(error)) from None
