"""The end mills that the shop has: plans choose among these."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter

from service.job.spec.tools import BUILT_IN, forget_tools, library_file, load_tools, save_tools
from service.server.api.access.scopes import Reader, Writer
from service.server.schemas.tools import ToolList, ToolsBody, ToolView

router = APIRouter()


@router.get("/v1/tools", tags=["machines"], summary="List the end mills that plans choose among")
async def get_tools(_: Reader) -> ToolList:
    """Those of the file tools.toml of whoever runs the server; without one, the usual ones."""
    return await asyncio.to_thread(_read)


@router.put("/v1/tools", tags=["machines"], summary="State the end mills that the shop has")
async def put_tools(_: Writer, body: ToolsBody) -> ToolList:
    """From now on new jobs are planned with these alone; jobs that are there keep what they were planned with."""
    await asyncio.to_thread(save_tools, [tool.model_dump(exclude_none=True) for tool in body.tools])
    return await asyncio.to_thread(_read)


@router.delete("/v1/tools", tags=["machines"], summary="Go back to the usual end mills")
async def delete_tools(_: Writer) -> ToolList:
    await asyncio.to_thread(forget_tools)
    return await asyncio.to_thread(_read)


def _read() -> ToolList:
    tools = [ToolView.model_validate(tool) for tool in load_tools()]
    return ToolList(tools=tools, own=library_file() != BUILT_IN)
