"""Recordings made elsewhere, uploaded: streamed to the disk, counted on the way, read elsewhere.

The body is the file itself (no multipart). It is unpacked and read in an analysis process, so a
hostile file can at worst fail its own job.
"""

import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool

from daq.importers.checks import MOST_V
from daq.service.keys import Principal
from daq.service.problems import Problem
from daq.service.routes_jobs import shown
from daq.service.state import Configurer, Controller, Parts, Service
from daq.service.wire import JobSummary

router = APIRouter(tags=["imports"])
WORK = "daq.service.analysis_work"
FileName = Annotated[
    str,
    Query(
        min_length=1,
        max_length=120,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]*$",
        description="What the file is called; its ending says what it is",
    ),
]
BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}


async def receive(request: Request, service: Service, ending: str) -> Path:
    """Stream the body to a new file of the upload folder."""
    folder = service.settings.data_dir / "uploads"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{secrets.token_hex(8)}{ending}"
    taken = 0
    try:
        with path.open("xb") as sink:
            async for piece in request.stream():
                taken += len(piece)
                await run_in_threadpool(sink.write, piece)
        if taken == 0:
            raise Problem(422, "empty", "the body is empty: send the file itself as the body")
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return path


def start(
    service: Service,
    who: Principal,
    kind: str,
    name: str,
    work: str,
    arguments: Mapping[str, object],
) -> JobSummary:
    """Queue work on an upload, and note whose."""
    job = service.jobs.submit(
        kind, f"{kind} {name}", f"{WORK}:{work}", dict(arguments), owner=who.name
    )
    service.audit.record(who.name, kind, name, job=job.id)
    return shown(job)


@router.post("/imports", status_code=202, openapi_extra=BODY)
async def import_folder(
    request: Request, service: Parts, who: Configurer, name: FileName
) -> JobSummary:
    """Import a zipped campaign folder (`campaign-folder/1`); the body is the zip file."""
    if not name.lower().endswith(".zip"):
        raise Problem(422, "not-zip", f"name={name!r} is not a .zip: zip the campaign folder")
    upload = await receive(request, service, ".zip")
    arguments = {"upload": str(upload), "name": name, "store": str(service.settings.store_dir)}
    return await run_in_threadpool(start, service, who, "import", name, "bring_in", arguments)


@router.post("/recordings/imports", status_code=202, openapi_extra=BODY)
async def import_recording(
    request: Request,
    service: Parts,
    who: Configurer,
    name: FileName,
    channel: Annotated[
        list[str],
        Query(
            max_length=64,
            description="name:quantity:unit:volts_per_unit[:position_m], in column order",
        ),
    ],
    column: Annotated[list[str] | None, Query(max_length=64)] = None,
    rate_hz: Annotated[float | None, Query(gt=0, le=1e9)] = None,
    kind: str = "free",
    frequency_hz: Annotated[float | None, Query(gt=0, le=1e9)] = None,
    amplitude_v: Annotated[float | None, Query(ge=0, le=MOST_V)] = None,
    title: Annotated[str, Query(max_length=200)] = "",
) -> JobSummary:
    """Import one recording described by options (WAV, CSV, NPZ, MAT, HDF5, TDMS)."""
    upload = await receive(request, service, Path(name).suffix.lower())
    arguments = {
        "upload": str(upload),
        "store": str(service.settings.store_dir),
        "title": title or Path(name).stem,
        "channels": channel,
        "columns": column or [],
        "rate_hz": rate_hz,
        "kind": kind,
        "frequency_hz": frequency_hz,
        "amplitude_v": amplitude_v,
    }
    return await run_in_threadpool(
        start, service, who, "import", name, "bring_in_recording", arguments
    )


@router.post("/characterisations", status_code=202, openapi_extra=BODY, tags=["analyses"])
async def characterise(
    request: Request,
    service: Parts,
    who: Controller,
    name: FileName,
    column: Annotated[list[str] | None, Query(max_length=64)] = None,
    rate_hz: Annotated[float | None, Query(gt=0, le=1e9)] = None,
    signal: Annotated[str | None, Query(max_length=100)] = None,
) -> JobSummary:
    """Characterise an unforced recording; the job's result holds `characterisation/1`."""
    upload = await receive(request, service, Path(name).suffix.lower())
    arguments = {
        "upload": str(upload),
        "names": column or [],
        "rate_hz": rate_hz,
        "signal": signal,
    }
    return await run_in_threadpool(
        start, service, who, "characterisation", name, "characterisation", arguments
    )
