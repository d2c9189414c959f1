"""The run store over HTTP: campaigns, runs, and what the runs hold."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import PurePath
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Header, Path, Query, Response
from fastapi.responses import StreamingResponse

from daq.records import ExitStatus, Kind, Role, Verdict
from daq.service import run_data
from daq.service.problems import Problem
from daq.service.state import Parts, Reader, Service
from daq.service.wire import Campaign, CampaignDetail, Envelope, Page, Run, Slice, Spectrum
from daq.store_catalogue import RunQuery

router = APIRouter(tags=["campaigns"])
Id = Annotated[str, Path(max_length=200, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
Name = Annotated[str, Path(max_length=200, pattern=r"^[^/\\\x00-\x1f]+$")]
Text = Annotated[str | None, Query(max_length=200)]
Hertz = Annotated[float | None, Query(ge=0, allow_inf_nan=False)]
Frame = Annotated[int, Query(ge=0, le=1 << 53)]
Stop = Annotated[int | None, Query(ge=1, le=1 << 53)]
Limit = Annotated[int, Query(ge=1, le=500)]
IfNoneMatch = Annotated[str | None, Header(max_length=200)]
MOST_FRAMES = 200_000
NO_LIMIT = -1  # to SQLite
Given = TypeVar("Given")


def tagged(content: Any, response: Response, if_none_match: str | None) -> None:
    """Set the ETag of `content`; answer 304 where the client has it already."""
    digest = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode())
    tag = f'"{digest.hexdigest()[:24]}"'
    if if_none_match == tag:
        raise NotModified(tag)
    response.headers["ETag"] = tag


class NotModified(Problem):
    """The client's copy is current: 304, without a body."""

    def __init__(self, tag: str) -> None:
        super().__init__(304, "not-modified", "", headers={"ETag": tag})


@router.get("/campaigns")
def campaigns(
    service: Parts,
    who: Reader,
    verdict: Verdict | None = None,
    after: Text = None,
    limit: Limit = 50,
) -> Page[Campaign]:
    """Campaigns in the order of their ids."""
    rows = service.store.campaigns(after=after, limit=limit + 1, verdict=verdict)
    items = [Campaign(**asdict(row)) for row in rows[:limit]]
    return Page(items=items, next=items[-1].id if len(rows) > limit else None)


@router.get("/campaigns/{campaign}")
def campaign(
    campaign: Id,
    service: Parts,
    who: Reader,
    response: Response,
    if_none_match: IfNoneMatch = None,
) -> CampaignDetail:
    """A campaign's card and runs."""
    card = asdict(service.store.card(campaign))
    card["source"] = PurePath(card["source"]).name  # where it lay on this machine is not told
    # From the catalogue: a look into every run's file would take a hundred times as long.
    found = service.store.runs(RunQuery(campaign=campaign), limit=NO_LIMIT)
    runs = [{**vars(run), "id": run.id} for run in found]
    tagged([card, runs], response, if_none_match)
    return CampaignDetail(**card, runs=[Run(**run) for run in runs])


@router.get("/runs", tags=["runs"])
def runs(
    service: Parts,
    who: Reader,
    campaign: Text = None,
    rig: Text = None,
    kind: Kind | None = None,
    role: Role | None = None,
    exit_status: ExitStatus | None = None,
    min_frequency_hz: Hertz = None,
    max_frequency_hz: Hertz = None,
    since: Text = None,
    until: Text = None,
    verdict: Verdict | None = None,
    after: Text = None,
    limit: Limit = 50,
) -> Page[Run]:
    """Search all runs; every filter given must match. `since`, `until` are RFC 3339, UTC."""
    query = RunQuery(
        campaign=campaign,
        rig=rig,
        kind=kind,
        role=role,
        exit_status=exit_status,
        min_frequency_hz=min_frequency_hz,
        max_frequency_hz=max_frequency_hz,
        since=_instant("since", since),
        until=_instant("until", until),
        verdict=verdict,
    )
    rows = service.store.runs(query, after=after, limit=limit + 1)
    items = [Run(**asdict(row), id=row.id) for row in rows[:limit]]
    return Page(items=items, next=items[-1].id if len(rows) > limit else None)


def _instant(name: str, text: str | None) -> str | None:
    """A time as the catalogue writes it, so that they compare as text."""
    if text is None:
        return None
    try:
        told = datetime.fromisoformat(text)
    except ValueError:
        raise Problem(
            422,
            "validation",
            f"{name}={text!r} is neither a time nor a date as in RFC 3339, such as "
            "2026-01-31T12:00:00Z or 2026-01-31",
        ) from None
    utc = told.replace(tzinfo=UTC) if told.tzinfo is None else told.astimezone(UTC)
    return utc.isoformat(timespec="milliseconds").removesuffix("+00:00")


def _read(
    service: Service, campaign: str, name: str, read: Callable[..., Given], *args: Any
) -> Given:
    return read(service.store.run_path(f"{campaign}/{name}"), *args)


@router.get("/campaigns/{campaign}/runs/{name}", tags=["runs"])
def run(
    campaign: Id,
    name: Name,
    service: Parts,
    who: Reader,
    response: Response,
    if_none_match: IfNoneMatch = None,
) -> dict[str, Any]:
    """A run's metadata: channels, conditions, outcome, gaps."""
    content = _read(service, campaign, name, run_data.metadata)
    tagged(content, response, if_none_match)
    return content


@router.get("/campaigns/{campaign}/runs/{name}/samples", tags=["runs"])
def samples(
    campaign: Id, name: Name, service: Parts, who: Reader, start: Frame = 0, stop: Stop = None
) -> Slice:
    """Frames `start` to `stop` of every channel, in its unit."""
    return Slice(**_read(service, campaign, name, run_data.read_slice, start, stop, MOST_FRAMES))


@router.get("/campaigns/{campaign}/runs/{name}/envelope", tags=["runs"])
def envelope(
    campaign: Id,
    name: Name,
    service: Parts,
    who: Reader,
    start: Frame = 0,
    stop: Stop = None,
    points: Annotated[int, Query(ge=1, le=10_000)] = 1000,
) -> Envelope:
    """Smallest and largest values in at most `points` bins, for drawing."""
    return Envelope(**_read(service, campaign, name, run_data.envelope, start, stop, points))


@router.get("/campaigns/{campaign}/runs/{name}/spectrum", tags=["runs"])
def spectrum(
    campaign: Id,
    name: Name,
    service: Parts,
    who: Reader,
    channel: Text = None,
    start: Frame = 0,
    stop: Stop = None,
    max_hz: Annotated[float | None, Query(gt=0, allow_inf_nan=False)] = None,
    points: Annotated[int, Query(ge=1, le=50_000)] = 4000,
) -> Spectrum:
    """Amplitude spectrum (Hann window), thinned to `points` without losing a line."""
    given = (channel, start, stop, max_hz, points)
    return Spectrum(**_read(service, campaign, name, run_data.spectrum, *given))


@router.get(
    "/campaigns/{campaign}/runs/{name}/download",
    tags=["runs"],
    response_class=StreamingResponse,
)
def download(
    campaign: Id, name: Name, service: Parts, who: Reader, format: run_data.Format = "hdf5"
) -> StreamingResponse:
    """The run as a file: HDF5 (as recorded), CSV, NPZ or MATLAB 5."""
    pieces, media = _read(service, campaign, name, run_data.exported, format)
    ending = {"hdf5": "h5"}.get(format, format)
    safe = "".join(c if c.isascii() and (c.isalnum() or c in "._-") else "_" for c in name)
    headers = {"Content-Disposition": f'attachment; filename="{campaign}-{safe}.{ending}"'}
    return StreamingResponse(pieces, media_type=media, headers=headers)
