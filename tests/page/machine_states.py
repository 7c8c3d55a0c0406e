"""Machines in every state, told to a page in place of what its server says: what a person would see then."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable
from typing import Any

from playwright.sync_api import Page, Route, expect

from machines.grbl.replies import alarm_words
from phrases.phrase import Phrase, phrases_in
from tests.page import canned_job
from tests.page.browser import open_blank

NAME = "shop"
RUN_ID = "0b0e7e0c-2f1d-4f6e-8f43-0a7b6a1c9d10"
_JOB = "6f1c1f0e-8a52-4f0c-9c0e-0d5f3a1b2c3d"
_CHECKS = ["tool", "zero", "stock", "clear"]
_SINCE = "2026-11-21T08:00:00.000Z"

MACHINE: dict[str, Any] = {
    "name": NAME,
    "remote": False,
    "simulated": False,
    "problem": "",
    "profile": {
        "description": "the mill by the window",
        "dialect": "grbl",
        "travel_mm": [300, 300, 80],
        "max_rate_mm_per_min": [5000, 5000, 1500],
        "step_mm": 0.004,
        "spindle_rpm": [8000, 30000],
        "safe_z_mm": 5,
        "homing": True,
        "spindle": {"on_hold": "turns", "on_lost_link": "turns", "words": ["the spindle keeps turning in a hold"]},
    },
    "agent": {"reachable": True, "words": "", "code": "", "values": {}},
    "mill": {
        "state": "idle",
        "detail": "",
        "phrases": {},
        "code": "",
        "alarm": 0,
        "work_mm": [12.4, -7.02, 5.0],
        "machine_mm": [-137.6, -157.02, -15.0],
        "feed_mm_per_min": 0,
        "spindle_rpm": 0,
        "spindle_on": False,
        "pins": "",
        "buffer_share": 0.0,
        "overrides": [100, 100, 100],
        "position_trusted": True,
        "controller": "Grbl 1.1h.20190830",
        "connected": True,
        "problem": "",
        "needs": ["a program has ended: if the tool is changed now, touch off Z again (probe or set zero)"],
        "latched": "",
        "zeroed": "XYZ",
        "zeroed_anew": "",
        "setup": "5e" * 32,
        "stops": 7,
    },
    "run": None,
    "control": None,
    "links": {},
}
_SENTENCES = {
    "warnings": [
        Phrase(
            "{axis} would go from {least_mm:.3f} to {most_mm:.3f} mm in machine coordinates ({frame}); "
            "the machine reaches {low_mm:g} to {high_mm:g}",
            axis="X",
            least_mm=-152,
            most_mm=-36,
            frame="G54",
            low_mm=-100,
            high_mm=0,
        )
    ],
    "zero": Phrase(
        "X0 Y0: front left corner of the lens, {margin_mm:g} mm from the block's left and front edges; Z0: {top}",
        margin_mm=8,
        top=Phrase("the block's top"),
    ),
    "change": Phrase(
        "change the tool from {old} to {new}, set Z zero again; X and Y zero stay",
        old="R 3 (Ø 6 mm)",
        new="R 0.5 (Ø 1 mm)",
    ),
    "shape": Phrase("ball end mill"),
}
RUN: dict[str, Any] = {
    "id": RUN_ID,
    "machine": NAME,
    "job": _JOB,
    "job_name": "astronaut.png",
    "program": {"number": 2, "name": "pass-2-finish.nc", "sha256": "9f" * 32},
    "state": "parked",
    "open": True,
    "words": "",
    "code": "",
    "values": {},
    "share": 0.0,
    "executed_line": 0,
    "lines": 41210,
    "time_s": 5400.0,
    "time_left_s": 5400.0,
    "operator": "",
    "lift_mm": None,
    "recoveries": 0,
    "warnings": _SENTENCES["warnings"],
    "travel_in_doubt": True,
    "setup": {
        "tool": {"shape": "ball end mill", "radius_mm": 0.5, "spindle_rpm": 18000},
        "stock": {"width_mm": 116.0, "height_mm": 116.0, "thickness_mm": 40.0, "margin_mm": 8.0, "material": "pmma"},
        "zero": _SENTENCES["zero"],
        "change": {
            "from_radius_mm": 3.0,
            "to_radius_mm": 0.5,
            "words": _SENTENCES["change"],
        },
    },
    "required_checks": _CHECKS,
    "left_out": [],
    "next": {"number": 3, "name": "pass-3-finish.nc", "sha256": "9f" * 32},
    "unreachable": False,
    "unreachable_words": "",
    "created_by": "Ada",
    "created_at": _SINCE,
    "started_at": None,
    "ended_at": None,
    "links": {},
    "phrases": phrases_in(_SENTENCES),
}
_OF_OPEN = {
    *("id", "state", "job", "program", "words", "code", "values", "operator"),
    *("share", "executed_line", "lines", "time_s", "time_left_s", "lift_mm"),
}  # of a run, as its mill tells it
PLAN: dict[str, Any] = {
    "run": RUN_ID,
    "plan": "a1" * 32,
    "executed_line": 8654,
    "resume_line": 8655,
    "overlap_line": 8640,
    "recut_lines": 15,
    "position_mm": [12.4, 7.02, 5.0],
    "blocks": ["G21 G90 G17 G54", "M3 S18000", "G0 Z5.000", "G0 X12.400 Y7.020", "G1 Z-1.20000 F300"],
    "ready": False,
    "refusals": [],
    "needs": [
        {
            "code": "unlock",
            "values": {"alarm": 3},
            "words": "the mill is locked (ALARM:3 (reset while moving)): home it",
        },
        {
            "code": "position",
            "values": {"doubt": "restarted"},
            "words": "the controller has restarted (trust position)",
        },
    ],
    "differences": ["G54 was X-150.000, is X-150.250"],
    "zero_back": "",
    "words": ["lines up to 8654 are cut for certain; line 8655 is the next one"],
}
GRANT = {"grant": "a word", "valid_s": 3.0, "stops": 7}
STOPS = "**/v1/stops"
_CUT = {"share": 0.21, "executed_line": 8654, "time_left_s": 4300.0, "operator": "Ada"}
ABSENT = {"reachable": False, "words": "machine 'shop' has no agent at present", "code": "agent_absent", "values": {}}
_STOPPED = _CUT | {"required_checks": [*_CHECKS, "position"], "time_left_s": None}


def locked(number: int) -> dict[str, Any]:
    """A mill that this alarm has locked."""
    return {"state": "alarm", "detail": alarm_words(number), "code": "locked", "alarm": number}


# state: (changes to the machine, changes to the mill, changes to its run, or None where there is none)
STATES: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any] | None]] = {
    "idle": ({}, {}, None),
    "locked": ({}, locked(1), None),
    "parked": ({}, {}, {}),
    "running": (
        {"control": {"operator": "Grace", "since": _SINCE}},
        {"state": "run", "spindle_on": True, "spindle_rpm": 18000, "feed_mm_per_min": 1480},
        _CUT | {"state": "running"},
    ),
    "simulated": ({"simulated": True}, {"state": "run", "spindle_on": True}, _CUT | {"state": "running"}),
    "held": ({}, {"state": "held"}, _CUT | {"state": "held"}),
    "tool": ({}, {"state": "tool"}, _CUT | {"state": "running"}),
    "interrupted": (
        {},
        locked(3),
        _STOPPED | {"state": "interrupted", "code": "alarm", "values": {"alarm": 3, "detail": "ALARM:3"}},
    ),
    "unplugged": (
        {},
        {"state": "disconnected", "connected": False, "problem": "port lost: the device is gone", "latched": "hold"},
        _STOPPED
        | {"state": "interrupted", "code": "port lost", "values": {"alarm": 0, "detail": "the device is gone"}},
    ),
    "no-agent": ({"agent": ABSENT}, {}, None),
    "stopped": (
        {},
        {"work_mm": [12.4, 7.02, -2.3], "machine_mm": [-137.6, -142.98, -22.3], "needs": []},
        _STOPPED | {"state": "aborted", "open": False, "code": "aborted"},
    ),
    "finished": ({}, {}, _CUT | {"state": "finished", "open": False, "share": 1.0, "executed_line": 41210}),
    "refused": ({}, {}, {"state": "refused", "words": "the program leaves the travel: X 312.4 of 300 mm at line 120"}),
    "bad-profile": ({"problem": 'shop.toml: extends = "grlb": allowed: "grbl", "grbl-3018"'}, {}, None),
}

USED = ("idle", "parked", "running", "held", "interrupted", "stopped")  # mills with every button that is on


def machine_in(state: str, own: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The machine as the API tells it, and the run that is on it, or was the last one; own: what is different there."""
    changes, mill, run = STATES[state]
    machine = copy.deepcopy(MACHINE) | changes
    machine["mill"] |= mill
    whole = None if run is None else copy.deepcopy(RUN) | run | (own or {})
    if whole is not None and whole["open"]:
        told = whole | {"program": whole["program"]["name"]}
        machine["run"] = {key: told[key] for key in _OF_OPEN}
    if "agent" in changes or "problem" in changes:
        machine["mill"] = None
    return machine, whole


def taken(route: Route) -> dict[str, Any]:
    """The answer to an order: about the mill, or about its run."""
    order = re.split("[/:]", route.request.url)[-1]
    if "/control/" not in route.request.url:
        return RUN | {"state": "held"}
    return {"machine": NAME, "order": order, "mill": machine_in("held")[0]["mill"]}


def told(
    page: Page,
    state: str,
    *,
    operator: str = "",
    mill: dict[str, Any] | None = None,
    run: dict[str, Any] | None = None,
    before: dict[str, Any] | None = None,
    plan: Callable[[Route], Any] = lambda route: route.fulfill(json=PLAN),
    camera: bool = False,
) -> None:
    """From now on this page hears of one machine in this state; whoever takes control of it is that operator.

    mill, run : what is different about them; a page that listens already hears of it at once
    before : the run before that one
    plan : answers whoever asks how to go on
    camera : there is one beside it
    """
    machine, whole = machine_in(state, run)
    if camera:
        machine["links"] |= {"camera": "/v1/machines/shop/camera.jpg"}
    if mill:
        machine["mill"] |= mill
    if operator:
        machine["control"] = {"operator": operator, "since": _SINCE}
        control = machine["control"] | {"control": "a secret", "expires_s": 10.0}
        page.route("**/v1/machines/shop/control", lambda route: route.fulfill(json=control))
    entry = {"number": 5, "at_s": 1795284531.5, "kind": "fault", "words": "port lost: the device is gone", "by": "Ada"}
    events = f"event: status\ndata: {json.dumps(machine)}\n\nevent: log\ndata: {json.dumps(entry)}\n\n"
    last = [whole] if whole is not None and not whole["open"] else [before] if before else []
    page.route("**/v1/machines", lambda route: route.fulfill(json={"machines": [machine], "problems": []}))
    page.route("**/v1/machines/shop/grants", lambda route: route.fulfill(status=201, json=GRANT))
    page.route("**/v1/machines/shop/events", lambda route: route.fulfill(body=events, content_type="text/event-stream"))
    page.route("**/v1/runs?**", lambda route: route.fulfill(json={"runs": last, "next": None}))
    page.route(
        "**/v1/runs/*", lambda route: route.fulfill(status=200 if route.request.method == "GET" else 202, json=whole)
    )
    page.route("**/v1/runs/*/recovery", plan)
    page.route(f"**/v1/jobs/{_JOB}", lambda route: route.fulfill(json=_job()))
    page.route(f"**/v1/jobs/{_JOB}/artifacts", lambda route: route.fulfill(json={"artifacts": []}))
    page.evaluate("window.dispatchEvent(new Event('online'))")  # a stream that waits asks again


def with_control(
    opened: Callable[..., Page],
    state: str,
    *,
    mill: dict[str, Any] | None = None,
    run: dict[str, Any] | None = None,
    **how: Any,
) -> Page:
    """A page at this mill, with control of it."""
    page = open_blank(opened, "machine", key="Ada", **how)
    told(page, state, operator="Ada", mill=mill, run=run)
    page.evaluate(f"location.hash = '#/machines/{NAME}'")
    page.get_by_role("button", name="Take over").click()
    page.get_by_role("group", name="Take over").get_by_role("button", name="Take over").click()
    expect(page.get_by_text("You have control.")).to_be_visible()
    return page


def _job() -> dict[str, Any]:
    optics = {"width_mm": 100, "height_mm": 100, "outline": "rectangle"}
    return canned_job.job() | {"id": _JOB, "spec": {"optics": optics, "stock": {"margin_mm": 8}}, "programs": []}
