"""Runs as lines of text, the questions a person answers before a mill moves, and the stop of a run through the agents
of this computer's mills, if no server answers.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx

from service.client.follow import explain_interrupt, stream_events
from service.client.jobs import when
from service.client.server import ServerClient, clean
from service.errors import FailedError, InputError
from service.milling.agent.card import AgentCard, read_card, read_token
from service.milling.agent.settings import state_home
from service.wording import align, duration

QUESTIONS = {
    "tool": "The tool named above is in the spindle, its length is measured",
    "zero": "The work zero is set as described above",
    "stock": "The block named above is clamped",
    "clear": "Nobody and nothing is in the way of the mill",
    "order": "Earlier passes of this job were not finished on this mill; run this one all the same",
    "position": "The mill's position is right",
}
_OVER = ("finished", "aborted", "interrupted", "refused", "lost")


def run_table(runs: Sequence[dict[str, Any]]) -> list[str]:
    rows = [("ID", "MACHINE", "STATE", "DONE", "PROGRAM", "CREATED")]
    rows += [
        (
            clean(run["id"]),
            clean(run["machine"]),
            clean(run["state"]),
            f"{100 * float(run['share']):.0f} %",
            clean(run["program"]["name"]),
            when(run["created_at"]),
        )
        for run in runs
    ]
    return align(rows) if runs else ["no runs"]


def run_lines(run: dict[str, Any]) -> list[str]:
    """Return one run and its setup."""
    program = run["program"]
    lines = [
        f"{clean(run['id'])}  {clean(program['name'])} (program {program['number']} of job {clean(run['job'])})",
        f"machine:  {clean(run['machine'])}",
        f"state:    {state_line(run)}",
    ]
    if run.get("unreachable"):
        lines.append(f"mill:     not reachable: {clean(run.get('unreachable_words') or '')}")
    lines += [f"warning:  {clean(words)}" for words in run.get("warnings") or ()]
    return [*lines, *setup_lines(run)]


def state_line(run: dict[str, Any]) -> str:
    words = f": {clean(run['words'])}" if run.get("words") else ""
    if run["state"] in ("running", "holding", "held", "recovering"):
        left_s = run.get("time_left_s")
        left = f", {duration(left_s)} left" if isinstance(left_s, int | float) else ""
        return f"{run['state']}, {100 * float(run['share']):.1f} % of its time{left}{words}"
    return f"{clean(run['state'])}{words}"


def setup_lines(run: dict[str, Any]) -> list[str]:
    """Return tool, block and zero of a waiting run, or the next step after a finished one."""
    setup = run.get("setup") or {}
    lines = []
    if (lift_mm := run.get("lift_mm")) is not None:
        lines.append(f"dry pass: {lift_mm:g} mm higher, spindle and coolant off; it never counts as cut")
    if run["state"] in ("preparing", "parked"):
        tool, stock = setup.get("tool") or {}, setup.get("stock") or {}
        size = " x ".join(f"{stock.get(name) or 0:g}" for name in ("width_mm", "height_mm", "thickness_mm"))
        lines += [
            f"tool:     {clean(tool.get('shape'))}, radius {tool.get('radius_mm')} mm, {tool.get('spindle_rpm')} rpm",
            f"stock:    {size} mm, {clean(stock.get('material'))}",
            f"zero:     {clean(setup.get('zero'))}",
        ]
        if change := setup.get("change"):
            lines.append(f"change:   {clean(change.get('words'))}")
        lines += [f"left out: {clean(one['name'])} was not finished on this mill" for one in run.get("left_out") or ()]
    if run["state"] == "finished" and (following := run.get("next")):
        lines.append(f"next:     program {following['number']}, {clean(following['name'])}")
    return lines


def confirm_checks(run: dict[str, Any], given: Sequence[str]) -> list[str]:
    """Return the confirmed checks of the run: those given on the command line, or a person's answers to each."""
    needed = [str(check) for check in run.get("required_checks") or ()]
    if not needed:
        raise InputError(f"run {clean(run['id'])} is {state_line(run)}; there is nothing to confirm")
    words = {word for text in given for word in text.replace(",", " ").split()}
    if words:
        if unknown := sorted(words - set(needed)):
            raise InputError(f"--confirm: '{clean(unknown[0])}' is not asked for; allowed: {', '.join(needed)}")
        if missing := [check for check in needed if check not in words]:
            raise InputError(f"--confirm: not confirmed: {', '.join(missing)}; the mill was not moved")
        return needed
    if not sys.stdin.isatty():
        raise InputError(f"a person has to confirm this: run it on a terminal, or give --confirm {','.join(needed)}")
    from service.milling.terminal.confirm import ask_person

    ask_person({check: QUESTIONS.get(check, clean(check)) for check in needed})
    return needed


def follow_run(server: ServerClient, run_id: str) -> dict[str, Any]:
    """Follow the run and print a line for each change; return its final state."""
    shown, state, reached = "", "", 0.0
    with explain_interrupt(f"the run goes on; `causticmill runs follow {run_id}` shows it, `runs hold` stops the mill"):
        for event in stream_events(
            server,
            f"/v1/runs/{run_id}/events",
            on_lost=lambda words: print(f"{words}; trying again, the run goes on", flush=True),
            on_back=lambda: print("connected again", flush=True),
        ):
            if event is not None and not {"state", "share"} <= set(event.data):
                continue  # an event of the mill; the state of the run has its own events
            run = event.data if event is not None else server.get(f"/v1/runs/{run_id}")
            if run["state"] == state and float(run["share"]) < reached:
                continue  # sent before our request
            state, reached = run["state"], float(run["share"])
            key = f"{state} {10 * reached:.0f} {run.get('words')} {run.get('unreachable')}"
            if key != shown:
                shown = key
                print(state_line(run), flush=True)
            if run["state"] in _OVER:
                break
        return dict(server.get(f"/v1/runs/{run_id}"))


def require_finished(run: dict[str, Any]) -> None:
    if run["state"] != "finished":
        raise FailedError(f"run {clean(run['id'])} is {state_line(run)}")


_DATA, _USUAL_DATA = "CAUSTICMILL_DATA", "causticmill-data"
_TIMEOUT = httpx.Timeout(3.0, connect=1.0)


def stop_at_agents(run_id: str, stop: str) -> str | None:
    """Stop a run at the agent that has it; return its machine, or None if no agent has stopped it.

    Agents are found by the cards that `serve` and `mill` of this account have written.
    """
    for card, token in _list_agents():
        with contextlib.suppress(httpx.HTTPError):
            headers = {"Authorization": f"Bearer {token}"}
            url = f"{card.url}/v1/runs/{run_id}:{stop}"
            if httpx.post(url, headers=headers, timeout=_TIMEOUT, trust_env=False).status_code == 202:
                return card.machine
    return None


def _list_agents() -> Iterator[tuple[AgentCard, str]]:
    homes = (Path(os.environ.get(_DATA) or _USUAL_DATA) / "agents", state_home())
    for folder in (folder for home in homes if home.is_dir() for folder in sorted(home.iterdir())):
        if (card := read_card(folder)) is not None:
            with contextlib.suppress(InputError):
                yield card, read_token(Path(card.token_file))
