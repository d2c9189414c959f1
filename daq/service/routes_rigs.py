"""Rigs: what they are, who has control, and the emergency stop."""

import asyncio
import logging
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header
from starlette.concurrency import run_in_threadpool

from daq.service.control import lane
from daq.service.jobs import Job
from daq.service.keys import Principal
from daq.service.state import Controller, Parts, Reader, Service
from daq.service.wire import Lock, LockRequest, Rig, Stopped

router = APIRouter(tags=["rigs"])
log = logging.getLogger("entrain.service")
ControlToken = Annotated[str | None, Header(alias="X-Control-Token", max_length=200)]


def describe(service: Service, name: str) -> Rig:
    """One rig as the API shows it."""
    entry = service.check_rig(name)
    jobs = [job for job in service.jobs.all() if job.lane == lane(name)]
    running = next((job for job in jobs if job.state == "running"), None)
    stopped_by = service.control.stopped(name)
    lease = service.control.holder(name)
    return Rig(
        name=name,
        driver=entry.driver,
        state="stopped" if stopped_by else _moving(running),
        stopped_by=stopped_by,
        holder=lease.holder if lease else None,
        job=running.id if running else None,
        queued=sum(job.state == "queued" for job in jobs),
        removable=entry.source == "added",
    )


def _moving(job: Job | None) -> Literal["idle", "running", "paused"]:
    if job is None:
        return "idle"
    return "paused" if job.hold == "paused" else "running"


@router.get("/rigs")
async def rigs(service: Parts, who: Reader) -> list[Rig]:
    """All configured rigs."""
    return [describe(service, name) for name in service.rigs.names()]


@router.get("/rigs/{name}")
async def rig(name: str, service: Parts, who: Reader) -> Rig:
    """One rig."""
    service.check_rig(name)
    return describe(service, name)


@router.post("/rigs/{name}/lock")
async def lock(
    name: str, body: LockRequest, service: Parts, who: Controller, token: ControlToken = None
) -> Lock:
    """Take control, renew it (with the token), or take it over."""
    service.check_rig(name)
    lease = service.control.acquire(name, who.name, token, body.takeover)
    action = "takeover" if body.takeover else "lock"
    await run_in_threadpool(service.audit.record, who.name, action, name)
    left = service.control.seconds_left(lease)
    return Lock(rig=name, holder=lease.holder, token=lease.token, seconds_left=left)


@router.delete("/rigs/{name}/lock", status_code=204)
async def unlock(name: str, service: Parts, who: Controller, token: ControlToken = None) -> None:
    """Give control back."""
    service.check_rig(name)
    service.control.release(name, token)
    await run_in_threadpool(service.audit.record, who.name, "unlock", name)


async def _stop(service: Service, who: Principal, name: str | None) -> Stopped:
    def stop() -> dict[str, Any]:
        # Silence first; the trail is written behind it, if there is room on the disk.
        reached = service.control.stop(who.name, name)
        try:
            service.audit.record(who.name, "emergency_stop", name or "all rigs")
        except OSError:
            log.exception("the audit trail could not note an emergency stop by %s", who.name)
        return reached

    reached = await asyncio.get_running_loop().run_in_executor(service.stops, stop)
    return Stopped(**reached)


@router.post("/rigs/{name}/emergency-stop")
async def stop_rig(name: str, service: Parts, who: Reader) -> Stopped:
    """Silence this rig now. Needs no lock and only the least scope."""
    service.check_rig(name)
    return await _stop(service, who, name)


@router.post("/emergency-stop")
async def stop_all(service: Parts, who: Reader) -> Stopped:
    """Silence every rig now. Needs no lock and only the least scope."""
    return await _stop(service, who, None)


@router.post("/rigs/{name}/reset")
async def reset(name: str, service: Parts, who: Controller, token: ControlToken = None) -> Rig:
    """Allow output again after an emergency stop."""
    service.check_rig(name)
    service.control.check(name, token)
    service.control.reset(name)
    await run_in_threadpool(service.audit.record, who.name, "reset", name)
    return describe(service, name)
