"""uvicorn's WebSockets, which keep the place of the connection that they began as until it is lost."""

from __future__ import annotations

from uvicorn.protocols.websockets.wsproto_impl import WSProtocol

from service.http.admission import PLACE


class PlacedWebSocket(WSProtocol):
    """A stranger's place is given up by time, or to the next stranger, until the application knows who it is."""

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.app_state[PLACE].leave()
