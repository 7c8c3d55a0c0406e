"""A simulated mill for trying everything, as a child of `serve --with-simulated-mill`.

It is a model of a GRBL router with homing switches, twenty times as fast as a real one, on its own port. When it ends
it forgets its position, like a mill that is switched off.
"""

from __future__ import annotations

import signal
import sys
import threading
from dataclasses import replace
from typing import NoReturn

from machines.simulated import GRBL_11, CornerPlate, Recording, SimulatedMill, serve_pty
from service.errors import FailedError, ServiceError, sentence_of_os_error
from service.processes import lifeline
from service.processes.files import make_private, write_whole
from service.server.fleet.registry import SIMULATED, folder_of_simulated
from service.settings import ServerSettings

TIME_FACTOR = 20.0
_TOUCHED_AT_MM = (-210.0, -210.0, -30.0)  # machine X, Y, Z of the plate on a block's corner that a probe touches
_PIN_RADIUS_MM = 1.5
_PROFILE = """# Written anew each time that `causticmill serve --with-simulated-mill` starts.
extends = "grbl"
description = "a simulated mill, {factor:g} times as fast as a real one"
homing = true

[link]
port = "{port}"
"""


def main() -> int:
    """Run until SIGTERM."""
    for kind in lifeline.STOPPING:
        signal.signal(kind, _leave)
    try:
        folder = folder_of_simulated(ServerSettings.load())
        try:
            make_private(folder)
            write_whole(folder / f"{SIMULATED}.toml", _PROFILE.format(factor=TIME_FACTOR, port=folder / "port"))
            endpoint = serve_pty(make_mill(), TIME_FACTOR, folder / "port")
        except OSError as error:
            raise FailedError(sentence_of_os_error(error, doing="simulated mill: cannot use")) from None
    except ServiceError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return error.exit_code
    try:
        endpoint.run(threading.Event())
    finally:
        endpoint.close()
    return 0


def _leave(*_: object) -> NoReturn:
    for kind in lifeline.STOPPING:
        signal.signal(kind, signal.SIG_IGN)
    sys.exit(0)


def make_mill() -> SimulatedMill:
    """Return the mill, which keeps no record of its cuts."""
    from_here_mm = GRBL_11.power_up_machine_mm  # position of the recording's zero
    left, front, top = (at - here for at, here in zip(_TOUCHED_AT_MM, from_here_mm, strict=True))
    plate = CornerPlate(left_mm=left, front_mm=front, tool_radius_mm=_PIN_RADIUS_MM)
    traits = replace(GRBL_11, homing=True, probe_surface_mm=top, corner_plate=plate)
    return SimulatedMill(traits, recording=Recording(keep=False))


if __name__ == "__main__":
    sys.exit(main())
