"""How the API and its standby serve HTTP: the same limits, places and headers."""

from __future__ import annotations

from importlib import metadata
from typing import Any

import uvicorn
from starlette.types import ASGIApp

from service.http.admission import Admission
from service.http.uvicorn_protocol import HEADER_BYTES, SOCKET_BYTES, VERSION_HEADER
from service.http.websocket_protocol import PlacedWebSocket

_CONNECTIONS, _STRANGERS = 1000, 200


def make_config(app: ASGIApp, **more: Any) -> uvicorn.Config:
    """Return uvicorn's configuration. more : what only one of the two needs"""
    return uvicorn.Config(
        app,
        ws=PlacedWebSocket,
        ws_max_size=SOCKET_BYTES,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        headers=[(VERSION_HEADER, metadata.version("causticmill"))],
        h11_max_incomplete_event_size=HEADER_BYTES,
        timeout_keep_alive=30,
        **more,
    )


def make_admission() -> Admission:
    """Return the places of one server."""
    return Admission(most=_CONNECTIONS, strangers=_STRANGERS)
