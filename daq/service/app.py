"""The application: routes under /api/v1, the page under /, the guard around both."""

import asyncio
import logging
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Depends, FastAPI
from fastapi.staticfiles import StaticFiles
from starlette.types import ASGIApp

from daq import store_upkeep
from daq.service import (
    problems,
    processes,
    routes_analyses,
    routes_calibrations,
    routes_campaigns,
    routes_devices,
    routes_imports,
    routes_jobs,
    routes_keys,
    routes_live,
    routes_loops,
    routes_rigs,
    routes_simulated,
    routes_store,
    routes_system,
    routes_upkeep,
    wire,
)
from daq.service.asked import only_asked
from daq.service.guard import Guard
from daq.service.jobs import Job
from daq.service.settings import Settings
from daq.service.state import Service, build

PREFIX = "/api/v1"
# The loop lets go of the interpreter with every packet sent, and a thread that makes an answer
# would keep it for Python's 5 ms each time.
SWITCH_S = 5e-4
log = logging.getLogger("entrain.service")
PAGE = Path(__file__).parent / "static"
REFUSALS: dict[int | str, dict[str, Any]] = {
    status: {"model": wire.Problem, "description": problems.TITLES[status]}
    for status in (400, 401, 403, 404, 409, 413, 422, 423, 429)
}
ROUTERS: tuple[APIRouter, ...] = (
    routes_system.router,
    routes_keys.router,
    routes_rigs.router,
    routes_devices.router,
    routes_calibrations.router,
    routes_campaigns.router,
    routes_store.router,
    routes_upkeep.router,
    routes_simulated.router,
    routes_imports.router,
    routes_analyses.router,
    routes_loops.router,
    routes_jobs.router,
    routes_live.router,
)


def recover(service: Service) -> None:
    """Put the store in order after whatever ended the service's last life, or a rig's process."""
    for finding in store_upkeep.recover(service.store):
        log.warning("%s: %s: %s", finding.kind, finding.path, finding.detail)


def recover_after(service: Service, job: Job) -> None:
    """Put the store in order after a job on a rig that failed."""
    if job.lane != "analysis":
        recover(service)


def create_api(service: Service) -> FastAPI:
    """The bare application around `service`."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        service.bus.attach(asyncio.get_running_loop())
        sys.setswitchinterval(SWITCH_S)
        processes.warm()
        yield
        service.closing = True
        service.bus.detach()
        await asyncio.to_thread(service.jobs.close, service.settings.server.shutdown_s)
        await asyncio.to_thread(service.aside.close)
        await asyncio.to_thread(service.planner.close)
        service.stops.shutdown(wait=False)

    app = FastAPI(
        title="entrain",
        version=version("entrain"),
        description=__doc__ or "",
        openapi_url=f"{PREFIX}/openapi.json",
        docs_url=None,  # the usual viewers load from elsewhere; this works offline
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.service = service
    app.state.hide = service.jobs.hide
    problems.install(app)
    for router in ROUTERS:
        app.include_router(
            router, prefix=PREFIX, responses=REFUSALS, dependencies=[Depends(only_asked)]
        )
    app.mount("/", StaticFiles(directory=PAGE, html=True), name="page")
    return app


def create_app(settings: Settings) -> tuple[ASGIApp, Service]:
    """What uvicorn serves, and the service inside it."""
    service = build(settings)
    service.jobs.when_failed(partial(recover_after, service))
    api = create_api(service)
    return Guard(api, settings, service.keys, service.tickets, service.metrics), service
