"""The way of its own for stops (service/server/stop_socket.py)."""

from __future__ import annotations

from fastapi import APIRouter
from starlette.websockets import WebSocket

from service.server.api.services import services_of
from service.server.stop_socket import PATH

router = APIRouter()


@router.websocket(PATH)
async def stops(socket: WebSocket) -> None:
    await services_of(socket).stop_sockets.serve(socket)
