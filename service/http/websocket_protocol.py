"""uvicorn's WebSockets, which keep their connection's place until it is lost."""

from __future__ import annotations

from uvicorn.protocols.websockets.wsproto_impl import WSProtocol

from service.http.admission import PLACE


class PlacedWebSocket(WSProtocol):
    """A stranger's place ends by time, or for the next stranger, until the application knows the caller."""

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.app_state[PLACE].leave()
