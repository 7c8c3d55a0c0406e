"""The common HTTP settings of the API and its standby: limits, places and headers."""

from __future__ import annotations

from importlib import metadata
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.websockets.wsproto_impl import WSProtocol

from service.http.admission import PLACE, Admission
from service.http.uvicorn_protocol import HEADER_BYTES, SOCKET_BYTES, VERSION_HEADER

_CONNECTIONS, _STRANGERS = 1000, 200


def make_config(app: ASGIApp, **more: Any) -> uvicorn.Config:
    """Return uvicorn's configuration. more : settings of only one of the two"""
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


class PlacedWebSocket(WSProtocol):
    """A WebSocket with a place. A stranger's ends after a time, or for the next stranger."""

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.app_state[PLACE].leave()
