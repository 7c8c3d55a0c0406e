"""Examples of what the routes about machines, runs and tokens answer, for the OpenAPI document."""

from __future__ import annotations

from typing import Any

_RUN_ID = "0b0e7e0c-2f1d-4f6e-8f43-0a7b6a1c9d10"
_JOB_ID = "6f1c1f0e-8a52-4f0c-9c0e-0d5f3a1b2c3d"
_HASH = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"

RUN_EXAMPLE: dict[str, Any] = {
    "id": _RUN_ID,
    "machine": "shop-mill",
    "job": _JOB_ID,
    "job_name": "astronaut.png",
    "program": {"number": 2, "name": "pass-2-rough.nc", "sha256": _HASH},
    "state": "parked",
    "open": True,
    "words": "",
    "code": "",
    "values": {},
    "unreachable": False,
    "unreachable_words": "",
    "share": 0.0,
    "executed_line": 0,
    "lines": 41210,
    "time_s": 5400.0,
    "time_left_s": 5400.0,
    "operator": "",
    "recoveries": 0,
    "warnings": [],
    "travel_in_doubt": False,
    "setup": {
        "tool": {"shape": "ball end mill", "radius_mm": 0.5, "spindle_rpm": 18000},
        "stock": {"width_mm": 116.0, "height_mm": 116.0, "thickness_mm": 40.0, "margin_mm": 8.0, "material": "pmma"},
        "zero": "X0 Y0: front left corner of the lens, 8 mm from the block's left and front edges; Z0: the block's top",
        "change": {
            "from_radius_mm": 3.0,
            "to_radius_mm": 0.5,
            "words": "change the tool from R 3 (Ø 6 mm) to R 0.5 (Ø 1 mm), set Z zero again; X and Y zero stay",
        },
    },
    "required_checks": ["tool", "zero", "stock", "clear"],
    "left_out": [],
    "next": {"number": 3, "name": "pass-3-finish.nc", "sha256": _HASH},
    "created_by": "shop-floor",
    "created_at": "2026-11-21T08:00:00.000Z",
    "started_at": None,
    "ended_at": None,
    "links": {"self": f"/v1/runs/{_RUN_ID}", "start": f"/v1/runs/{_RUN_ID}:start"},
    "phrases": {},
}
RUN_EVENTS_EXAMPLE = (
    'event: run\ndata: {"id":"' + _RUN_ID + '","state":"running","share":0.21,"executed_line":8654}\n\n'
    'id: 5c1d-88\nevent: log\ndata: {"number":88,"at_s":1763712000.1,"kind":"state","words":"held"}\n\n'
)

PREPARING_EXAMPLE: dict[str, Any] = RUN_EXAMPLE | {
    "state": "preparing",
    "lines": None,
    "time_s": None,
    "time_left_s": None,
    "required_checks": [],
}
RUNS_EXAMPLE: dict[str, Any] = {"runs": [RUN_EXAMPLE], "next": f"/v1/runs?limit=1&cursor={_RUN_ID}"}
RECOVERY_EXAMPLE: dict[str, Any] = {
    "run": _RUN_ID,
    "executed_line": 8654,
    "resume_line": 8655,
    "overlap_line": 8640,
    "recut_lines": 15,
    "position_mm": [12.4, 7.02, 5.0],
    "plan": "3b1f0c5de2a94c77",
    "blocks": ["G21 G90 G17 G54", "M3 S18000", "G0 Z5.000", "G0 X12.400 Y7.020", "G1 Z-1.20000 F300"],
    "ready": False,
    "refusals": ["the position is not trusted: home the mill, or confirm it"],
    "needs": [
        {"code": "position", "values": {"doubt": "restarted"}, "words": "the controller has restarted: home the mill"}
    ],
    "differences": [],
    "words": [],
    "phrases": {},
}
MACHINE_EXAMPLE: dict[str, Any] = {
    "name": "shop-mill",
    "remote": False,
    "simulated": False,
    "problem": "",
    "profile": {
        "description": "the mill by the window",
        "dialect": "grbl",
        "travel_mm": [300.0, 180.0, 45.0],
        "max_rate_mm_per_min": [2000.0, 2000.0, 1000.0],
        "step_mm": 0.00125,
        "spindle_rpm": [0.0, 24000.0],
        "safe_z_mm": 5.0,
        "homing": True,
        "spindle": {"on_hold": "turns", "on_lost_link": "turns", "words": ["...", "..."]},
    },
    "agent": {"reachable": True, "words": "", "code": "", "values": {}, "phrases": {}},
    "mill": {
        "state": "idle",
        "detail": "",
        "code": "",
        "alarm": 0,
        "work_mm": [0.0, 0.0, 5.0],
        "machine_mm": [-290.0, -170.0, -1.0],
        "feed_mm_per_min": 0.0,
        "buffer_share": 0.0,
        "spindle_rpm": 0.0,
        "overrides": [100, 100, 100],
        "position_trusted": True,
        "spindle_on": False,
        "pins": "",
        "controller": "Grbl 1.1h",
        "connected": True,
        "problem": "",
        "needs": [],
        "latched": "",
        "zeroed": "XYZ",
        "zeroed_anew": "Z",
        "setup": "9a0b4cf07d1e2c33",
        "phrases": {},
    },
    "run": {
        "id": _RUN_ID,
        "state": "parked",
        "job": _JOB_ID,
        "program": "pass-2-rough.nc",
        "words": "",
        "code": "",
        "values": {},
        "share": 0.0,
        "executed_line": 0,
        "lines": 41210,
        "time_s": 5400.0,
        "time_left_s": 5400.0,
        "operator": "",
        "phrases": {},
    },
    "control": {"operator": "Ada", "since": "2026-11-21T08:00:00.000Z"},
    "links": {
        "self": "/v1/machines/shop-mill",
        "events": "/v1/machines/shop-mill/events",
        "control": "/v1/machines/shop-mill/control",
        "runs": "/v1/runs?machine=shop-mill",
    },
    "phrases": {},
}
MACHINES_EXAMPLE: dict[str, Any] = {"machines": [MACHINE_EXAMPLE], "problems": [], "phrases": {}}
ORDERS_EXAMPLE: dict[str, Any] = {
    "orders": [
        {
            "number": 412,
            "at_s": 1763712000.1,
            "kind": "order",
            "words": "jog: taken",
            "code": "order_taken",
            "values": {"order": "jog"},
            "by": "Ada",
            "from": "192.168.1.20",
        }
    ],
    "next": None,
}
GRANT_EXAMPLE: dict[str, Any] = {"grant": "x" * 24, "valid_s": 3.0, "stops": 7}
TOKEN_EXAMPLE: dict[str, Any] = {
    "id": "3f2a9c01d4e8",
    "name": "shop-floor",
    "scopes": ["jobs:read", "machine:run"],
    "created_at": "2026-11-21T08:00:00.000Z",
    "expires_at": "2026-12-21T08:00:00.000Z",
    "last_used_at": None,
    "revoked_at": None,
    "paired": False,
}
NEW_TOKEN_EXAMPLE: dict[str, Any] = TOKEN_EXAMPLE | {"token": "cm_" + "x" * 43}
TOKENS_EXAMPLE: dict[str, Any] = {"tokens": [TOKEN_EXAMPLE]}
CONTROL_EXAMPLE: dict[str, Any] = {
    "operator": "Ada",
    "since": "2026-11-21T08:00:00.000Z",
    "control": "x" * 24,
    "expires_s": 60.0,
}
ORDER_EXAMPLE: dict[str, Any] = {"machine": "shop-mill", "order": "jog", "mill": MACHINE_EXAMPLE["mill"]}
MACHINE_EVENTS_EXAMPLE = (
    'id: 5c1d-87\nevent: status\ndata: {"name":"shop-mill","mill":{"state":"jog"},"run":null,"control":null}\n\n'
    'id: 5c1d-88\nevent: log\ndata: {"number":88,"at_s":1763712000.1,"kind":"state","words":"jog -> idle"}\n\n'
)
WHOAMI_EXAMPLE: dict[str, Any] = {
    "name": "Ada",
    "scopes": ["jobs:read", "jobs:write", "machine:run"],
    "anonymous": False,
    "paired": True,
    "expires_at": "2026-11-22T08:00:00.000Z",
}
PAIRING_EXAMPLE: dict[str, Any] = {
    "token": "cm_" + "x" * 43,
    "name": "Ada",
    "scopes": ["jobs:read", "jobs:write", "machine:run"],
    "expires_at": "2026-11-22T08:00:00.000Z",
}
