"""The trials as figures. A note that begins with BROKEN tells of a law that did not hold."""

from __future__ import annotations

import random
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from machines.gcode.program import ProgramReader
from machines.profile import load_profile
from service.milling.preflight import run_preflight
from tests.benchmarks.timing import Figure
from tests.service.server.fleet.test_order_laws import run_histories
from tests.trials import estimate as estimates
from tests.trials import fault_matrix, kill_trial, latency_trial, live, load_trial
from tests.trials.real_kills import real_kills
from tests.trials.soak import soak

SOAK_LINES = 10_000_000
SEEDS = range(100)
KILLS = 1000
HISTORIES = 2000
BIG_CUTS = 50_000_000  # lines of 20 bytes: 1 GB
WIRE_BYTES_PER_S = 11520.0
# Ten kinds that show on the wire or at the mill; those of one byte to the mill may be silent and come with `echo`.
VISIBLE = (
    "disconnect", "power-cycle", "reset-button", "hold-button", "door", "lose-reply", "mangle-reply", "drop-reply-byte",
    "delay", "delay-reply",
)  # fmt: skip


def _law(broken: object, words: str) -> str:
    return f"BROKEN: {words}: {broken}" if broken else words


def clean() -> Iterator[Figure]:
    """Ten million short lines on a clean link."""
    result = soak(SOAK_LINES)
    wrong = {key: result[key] for key in ("lost", "doubled", "foreign") if result[key]}
    if result["ended"] != "done" or result["worst_in_flight_bytes"] > 127:
        wrong |= {key: result[key] for key in ("ended", "worst_in_flight_bytes")}
    yield Figure("clean soak: lines cut", result["cut"], "lines", _law(wrong, "0 lost, 0 doubled, 0 foreign"))
    yield Figure("clean soak: most bytes in flight", result["worst_in_flight_bytes"], "bytes", "of 128")
    yield Figure(
        "clean soak: share of the 115200 wire", 100 * result["wire_share"], "%", f"{result['simulated_s']} simulated s"
    )
    yield Figure(
        "clean soak: CPU per line, streamer and mill",
        result["cpu_us_per_line_both_sides"],
        "us",
        f"{result['wall_s']} s wall",
    )


def faults() -> Iterator[Figure]:
    """Every visible kind at a hundred places; then single damaged bytes, as far as a plain protocol shows them."""
    for kind in VISIBLE:
        yield from _kind(kind, silent_allowed=False)
    for kind in fault_matrix.SILENT_KINDS:
        yield from _kind(kind, silent_allowed=True)


def echo() -> Iterator[Figure]:
    """Single damaged bytes with a controller that echoes: all must be stopped before the cut."""
    traits = replace(fault_matrix.TRAITS, echo=True)
    for kind in fault_matrix.SILENT_KINDS:
        yield from _kind(kind, silent_allowed=False, traits=traits, label=f"{kind}, echoing controller")


def _kind(
    kind: str, *, silent_allowed: bool, traits: fault_matrix.Traits = fault_matrix.TRAITS, label: str = ""
) -> Iterator[Figure]:
    trials = list(fault_matrix.matrix((kind,), SEEDS, traits=traits))
    label = label or kind
    silent = [t for t in trials if not t.verdict.clean]
    broken = [] if silent_allowed else [f"seed {t.seed}" for t in silent]
    broken += [f"seed {t.seed} ended {t.ended}" for t in trials if t.ended != "finished" or not t.done]
    broken += [f"seed {t.seed} recut {t.verdict.recut}" for t in trials if t.verdict.recut > 17]
    slow = [t.stop_delay_s for t in trials if t.stop_delay_s is not None]
    broken += [f"{delay_s:.3f} s to stop" for delay_s in slow if delay_s > 0.05]
    causes = Counter(words.split(":")[0][:40] or "held" for t in trials for words in t.causes)
    words = f"0 skipped, 0 foreign; seen as: {dict(causes) or 'nothing, and nothing was wrong'}"
    if silent_allowed:
        words = f"{len(silent)} silent, as the protocol cannot show them; seen as: {dict(causes)}"
    yield Figure(
        f"{label}: most segments cut twice", max(t.verdict.recut for t in trials), "of 17", _law(broken, words)
    )


def kills() -> Iterator[Figure]:
    """The agent killed at a thousand random moments, half of them with the host's power."""
    trials = [kill_trial.one_kill(seed) for seed in range(KILLS)]
    broken = [f"seed {t.seed}: {t.faults[:2]}" for t in trials if t.faults]
    yield Figure("kills survived", sum(t.kills for t in trials), "kills", _law(broken[:3], "0 skipped, 0 foreign"))
    loss_s = max(t.journal_loss_s for t in trials)
    yield Figure("kills: most journal time lost", loss_s, "s", _law(loss_s > 1.0 and loss_s, "allowed 1 s"))
    yield Figure("kills: most segments cut twice", max(t.recut for t in trials), "segments")


def agent() -> Iterator[Figure]:
    """The agent's process killed with kill -9 over a real pty."""
    yield from real_kills(20)


def wire() -> Iterator[Figure]:
    """Lines of 20 bytes at 115200, in simulated time and in real time over a pty, with the processor time of it."""
    yield Figure(
        "share of the wire, simulated time", 100 * soak(200_000, line_bytes=20)["wire_share"], "%", "20-byte lines"
    )
    with tempfile.TemporaryDirectory() as folder:
        program = live.write_program(Path(folder) / "wire.nc", 60_000)
        samples, _ = live.watch_stream(program, Path(folder), seconds=90.0, enough=lambda s: s[-1].lines > 30_000)
    begin = next(sample for sample in samples if sample.lines > 1000)
    took_s, lines = samples[-1].at_s - begin.at_s, samples[-1].lines - begin.lines
    yield Figure(
        "share of the wire, real time over a pty",
        100 * lines * 20 / took_s / WIRE_BYTES_PER_S,
        "%",
        f"{lines / took_s:.0f} lines/s",
    )
    yield Figure(
        "processor share of the streaming process", 100 * (samples[-1].cpu_s - begin.cpu_s) / took_s, "% of a core"
    )


def big() -> Iterator[Figure]:
    """A program of 1 GB: memory, first motion, seek."""
    with tempfile.TemporaryDirectory() as folder:
        state = Path(folder)
        program = live.write_program(state / "big.nc", BIG_CUTS)
        began_s = time.monotonic()
        facts = run_preflight(program, load_profile("grbl"), cache=state / "cache")
        yield Figure("1 GB: pre-flight, first time", time.monotonic() - began_s, "s", f"{facts.lines:,} lines")
        _, first_s = live.watch_stream(program, state, seconds=240.0, enough=lambda s: s[-1].lines > 50)
        yield Figure("1 GB: start of `stream` to first motion, never seen", first_s, "s")
        samples, first_s = live.watch_stream(program, state, seconds=120.0, enough=lambda s: s[-1].lines > 50_000)
        yield Figure("1 GB: start of `stream` to first motion, seen before", first_s, "s")
        running = [sample.rss_mb for sample in samples if sample.lines > 100]
        yield Figure("1 GB: resident memory of `stream`, most", max(running), "MB")
        yield Figure("1 GB: growth of it while streaming 50 000 lines", running[-1] - running[0], "MB")
        reader, chance, worst_s = ProgramReader(program, facts.index), random.Random(1), 0.0
        for _ in range(50):
            line, began_s = chance.randrange(1, facts.lines), time.monotonic()
            reader.state_before(line)
            next(reader.lines(line))
            worst_s = max(worst_s, time.monotonic() - began_s)
        yield Figure("1 GB: seek to a line with its modal state, slowest of 50", worst_s, "s")


def latency() -> Iterator[Figure]:
    """A hold from the API call to the wire, while the agent streams."""
    yield from latency_trial.figures(200)


def orders() -> Iterator[Figure]:
    """Orders and stops over a network, a database and people who do as they like."""
    try:
        tally = run_histories(HISTORIES, derandomize=False)
    except AssertionError as error:
        words = " ".join([*getattr(error, "__notes__", ()), str(error)])  # the seed first
        yield Figure("histories of orders and stops", 0, "histories", _law(words[:500], "every act was for now"))
        return
    acts = {what: count for what, count in sorted(tally.items()) if what != "histories"}
    words = f"none late, none after a later stop, none twice; carried out: {acts}"
    yield Figure("histories of orders and stops", tally["histories"], "histories", words)


def load() -> Iterator[Figure]:
    """Fifty busy loops, and the job server started anew while a program runs."""
    yield from load_trial.figures()
    yield from load_trial.figures(killed=True)


def estimate() -> Iterator[Figure]:
    """Pre-flight's time against the simulated mill's."""
    for name, estimated_s, took_s in estimates.compared(10.0):
        error = 100 * (estimated_s / took_s - 1)
        yield Figure(
            f"estimate of {name}",
            error,
            "%",
            _law(abs(error) > 3 and f"{error:.1f} %", f"{estimated_s:.1f} s for {took_s:.1f} s"),
        )
