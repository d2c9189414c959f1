"""Upkeep of the run store: catalogue anew, checksums, a campaign as one file.

What reads whole recordings is a job in an analysis process; an export's number names its file.
"""

from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import FileResponse

from daq.service.problems import Problem, not_found
from daq.service.routes_jobs import find, shown
from daq.service.routes_store import Id
from daq.service.state import Configurer, Controller, Parts, Reader, Service
from daq.service.wire import JobSummary

router = APIRouter(tags=["store"])
WORK = "daq.service.analysis_work"
KEPT = 5  # exports; older ones make room


@router.post("/store/rebuild")
def rebuild(service: Parts, who: Configurer) -> dict[str, Any]:
    """Make the catalogue anew from the run files."""
    service.audit.record(who.name, "rebuild", "catalogue")
    return {"left_out": service.store.rebuild()}


@router.post("/store/verify", status_code=202)
def verify(
    service: Parts,
    who: Controller,
    campaign: Annotated[str | None, Query(max_length=200, description="Only this one")] = None,
) -> JobSummary:
    """Compare every run with the checksum of its recording; the job's result lists what differs."""
    title = service.store.card(campaign).title if campaign else "the run store"
    arguments = {"store": str(service.settings.store_dir), "campaign": campaign}
    job = service.jobs.submit(
        "verification", f"verify {title}", f"{WORK}:verification", arguments, owner=who.name
    )
    service.audit.record(who.name, "verify", campaign or "store", job=job.id)
    return shown(job)


@router.post("/campaigns/{campaign}/exports", status_code=202)
def export(campaign: Id, service: Parts, who: Controller) -> JobSummary:
    """Write a campaign as one zip with a manifest of checksums; then `GET /exports/{job}`."""
    title = service.store.card(campaign).title
    _make_room(service)
    name = service.jobs.new_id()
    arguments = {
        "store": str(service.settings.store_dir),
        "campaign": campaign,
        "archive": str(_archive(service, name)),
    }
    job = service.jobs.submit(
        "export",
        f"export {title}",
        f"{WORK}:export",
        arguments,
        owner=who.name,
        about={"campaign": campaign},
        identifier=name,
    )
    service.audit.record(who.name, "export", campaign, job=job.id)
    return shown(job)


@router.get("/exports/{job}", response_class=FileResponse)
def exported(job: str, service: Parts, who: Reader) -> FileResponse:
    """The zip of a finished export. The newest few are kept."""
    found = find(service, job)
    if found.kind != "export":
        raise not_found("export", job)
    if found.result is None:
        reason = f": {found.error}" if found.error else ""
        raise Problem(409, "no-result", f"export {job!r} is {found.state}{reason}")
    path = _archive(service, found.id)
    if not path.is_file():
        raise Problem(404, "not-found", f"export {job!r} is no longer kept: export it again")
    name = f"{found.about['campaign']}.zip"
    return FileResponse(path, media_type="application/zip", filename=name)


def _archive(service: Service, job: str) -> Path:
    return service.settings.data_dir / "exports" / f"{job}.zip"


def _make_room(service: Service) -> None:
    """Remove all but the newest exports."""
    files = list((service.settings.data_dir / "exports").glob("*.zip"))
    for path in sorted(files, key=lambda path: path.stat().st_mtime)[: -(KEPT - 1)]:
        path.unlink(missing_ok=True)
