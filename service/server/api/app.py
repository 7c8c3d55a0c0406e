"""The job server's HTTP application: routes behind the guard, every refusal as a problem."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import metadata
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.middleware import Middleware

from service.http.admission import STOPS
from service.server.api.access.guard import Guard
from service.server.api.access.requests import BodyLimits
from service.server.api.errors import ANYWHERE, install_problems, refusals, with_problems
from service.server.api.monitoring import MetricsMiddleware
from service.server.api.routes import files, jobs, machines, operations, page, photos, profiles, runs, submit
from service.server.api.services import Services
from service.server.fleet.home_assistant import show_mills
from service.server.fleet.notifications import Delivery, list_ways_out, watch_mills

_ABOUT = """A picture goes in; out come the programs that mill a block so that light through it paints the picture.

`POST /v1/jobs` takes a picture and a job spec; `GET /v1/jobs/{id}/events` follows the job; its files are artifacts, its
programs are offered as soon as all of them have been checked. `POST /v1/machines/{m}/runs` hands a program to a mill,
where it waits, parked, until a person starts it. Errors are `application/problem+json` (RFC 9457) with the `field` at
fault. There is no /docs page, because its scripts would come from elsewhere: load `/openapi.json` into a viewer.
"""
_TAGS = [
    {"name": "jobs", "description": "Pictures to programs."},
    {"name": "artifacts", "description": "The files of a job."},
    {"name": "machines", "description": "The mills."},
    {"name": "runs", "description": "Programs on mills. Nothing moves before `:start`, and none of it by itself."},
    {"name": "operations", "description": "For the person who runs the server."},
]
_ROUTERS = (
    submit,
    photos,
    jobs,
    files,
    profiles,
    machines,
    runs,
    operations,
    page,
)
_WITH_PICTURES = re.compile(r"/v1/(jobs|estimates|jobs/[^/]+/photos|profiles/[^/]+/coupon/photos)")
_QUIET: Any = {"tracing": False, "metrics": False, "logs": False, "operation_spans": False}


def make_app(services: Services) -> FastAPI:
    app = FastAPI(
        title="causticmill",
        version=metadata.version("causticmill"),
        description=_ABOUT,
        openapi_tags=_TAGS,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        telemetry=_QUIET,
        lifespan=lambda _app: _life(services),
        middleware=[
            Middleware(MetricsMiddleware, metrics=services.metrics),
            Middleware(Guard, services=services),
            Middleware(BodyLimits, but=_WITH_PICTURES),
        ],
    )
    app.state.services = services
    install_problems(app)
    for module in _ROUTERS:
        app.include_router(module.router, responses=refusals(*ANYWHERE))
    app.openapi = lambda: _document(app)  # type: ignore[method-assign]
    return app


@asynccontextmanager
async def _life(services: Services) -> AsyncIterator[None]:
    """Look at runs as long as the server serves; then end streams and links to the mills' agents."""
    behind = [services.fleet.watch(), services.stop_access.keep_fresh()]
    if ways := list_ways_out(services.settings):
        delivery = Delivery(ways)
        behind += [delivery.run(), watch_mills(services.fleet, delivery.enqueue)]
    if url := services.settings.mqtt_url:
        behind.append(show_mills(services.fleet, url))
    tasks = [asyncio.create_task(work) for work in behind]
    await services.fleet.meet_agents()
    yield
    services.feed.close()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    await services.fleet.aclose()


def _document(app: FastAPI) -> dict[str, Any]:
    if app.openapi_schema is None:
        document = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes, tags=app.openapi_tags
        )
        app.openapi_schema = with_problems(document)
        for path, item in document["paths"].items():
            if path.endswith(STOPS):  # the token is optional: on the server's own computer none is needed
                item["post"]["security"].append({})
    return app.openapi_schema
