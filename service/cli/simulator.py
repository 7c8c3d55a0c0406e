"""`causticmill sim-mill`: run the simulated mill behind a pty or a TCP port until interrupted."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import IO

from machines.simulated import (
    KINDS,
    PRESETS,
    CutSegment,
    Fault,
    Faults,
    Recording,
    SimulatedMill,
    parse_fault,
    serve_pty,
    serve_tcp,
)
from machines.simulated.endpoints import Endpoint

RECORD_HEADER = "x0,y0,z0,x1,y1,z1,rapid,feed,spindle,line,at_s,whole,kind"


def run_sim_mill(
    *,
    listen: str | None,
    firmware: str,
    time_factor: float,
    link: Path | None,
    record: Path | None,
    faults: tuple[str, ...],
    seed: int,
    stop: threading.Event | None = None,
) -> None:
    """Serve until Ctrl-C (or `stop`). Bad values raise ValueError with one line for the user.

    listen : "pty" (default) or "tcp:HOST:PORT"; record: a CSV of the path cut, a line per executed block
    faults : "kind@line=N[:seconds]", "kind@byte=N", "kind@t=S", "kind" alone (somewhere, by seed) or "random:COUNT"
    """
    if firmware not in PRESETS:
        raise ValueError(f"firmware = '{firmware}' is unknown: {', '.join(PRESETS)}")
    if link is not None and not link.parent.is_dir():
        raise ValueError(f"--link {link}: there is no folder {link.parent}")
    if link is not None and link.exists() and not link.is_symlink():
        raise ValueError(f"--link {link} is a file and not a link; allowed: a new name, or a link to replace")
    traits = PRESETS[firmware]
    plan = _faults(faults, seed)
    with _Recorder(record) as recording:
        mill = SimulatedMill(traits, plan, seed, recording=recording)
        endpoint = _endpoint(mill, listen or "pty", time_factor, link)
        try:
            print(f"simulated {traits.banner.split('[')[0].strip()} at {endpoint.url}", flush=True)
            print(
                f"time x{time_factor:g}, {traits.baud} baud, RX {traits.rx_bytes} bytes, {traits.planner_blocks} blocks"
                f"{', echoes lines' if traits.echo else ''}; Ctrl-C ends it",
                flush=True,
            )
            endpoint.run(stop if stop is not None else threading.Event())
        except KeyboardInterrupt:
            pass
        finally:
            endpoint.close()
            for done in plan.log:
                print(f"fault at {done.at_s:.3f} s: {done.kind}, byte {done.byte}, line {done.line} {done.words}")
            print(f"{recording.count} segments cut, {mill.serial.lost_overflow} bytes lost to overflow", flush=True)


def _faults(texts: tuple[str, ...], seed: int) -> Faults:
    plan: list[Fault] = []
    for text in texts:
        if text.startswith("random:"):
            count = text.removeprefix("random:")
            if not count.isdigit():
                raise ValueError(f"fault '{text}' is not understood: write random:COUNT")
            plan += Faults.by_seed(seed, count=int(count)).plan
        elif text in KINDS:
            plan += Faults.by_seed(seed, kinds=(text,)).plan
        else:
            plan.append(parse_fault(text))
    return Faults(plan)


def _endpoint(mill: SimulatedMill, listen: str, time_factor: float, link: Path | None) -> Endpoint:
    if listen == "pty":
        return serve_pty(mill, time_factor, link)
    kind, _, address = listen.partition(":")
    host, _, port = address.rpartition(":")
    if kind != "tcp" or not port.isdigit():
        raise ValueError(f"--tcp {address} is not understood; allowed: HOST:PORT")
    try:
        return serve_tcp(mill, host or "127.0.0.1", int(port), time_factor)
    except (OSError, OverflowError) as error:
        raise ValueError(f"--tcp {address}: {(getattr(error, 'strerror', None) or str(error)).lower()}") from None


class _Recorder(Recording):
    """Writes segments to a CSV file at once; keeps none in memory."""

    def __init__(self, path: Path | None) -> None:
        super().__init__(self._write if path is not None else None, keep=False)
        self._file: IO[str] | None = path.open("w") if path is not None else None
        if self._file is not None:
            self._file.write(RECORD_HEADER + "\n")

    def _write(self, s: CutSegment) -> None:
        assert self._file is not None
        x0, y0, z0 = s.start
        x1, y1, z1 = s.end
        self._file.write(
            f"{x0:.6f},{y0:.6f},{z0:.6f},{x1:.6f},{y1:.6f},{z1:.6f},"
            f"{s.rapid:d},{s.feed:g},{s.spindle_on:d},{s.line},{s.at_s:.6f},{s.whole:d},{s.kind}\n"
        )

    def __enter__(self) -> _Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()
