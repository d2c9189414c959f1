"""Calibrations: the files, a new one, and which of them apply to a rig.

A calibration is never changed or removed: a newer one takes its place.
"""

import threading
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query

from daq.calibration.book import Calibration, CalibrationBook
from daq.service import wire
from daq.service.problems import not_found
from daq.service.state import Configurer, Parts, Reader, Service
from daq.service.wire import CalibrationUpload, ChannelCalibration, Page, RigCalibration

router = APIRouter(tags=["calibrations"])
Name = Annotated[str, Path(max_length=200, pattern=r"^[A-Za-z0-9][A-Za-z0-9.+-]*$")]
_adding = threading.Lock()  # two at once must not choose the same name


def book(service: Service) -> CalibrationBook:
    """The calibrations of the run store, which campaigns apply."""
    return CalibrationBook(service.store.root / "calibrations")


def shown(name: str, calibration: Calibration) -> wire.Calibration:
    """A calibration as the API shows it."""
    stale = calibration.stale(datetime.now(UTC))
    return wire.Calibration(id=name, stale=stale, **asdict(calibration))


@router.get("/calibrations")
def calibrations(
    service: Parts,
    who: Reader,
    subject: Annotated[str | None, Query(max_length=100)] = None,
    method: Literal["pistonphone", "exchange", "skew", "response"] | None = None,
    after: Annotated[str | None, Query(max_length=200)] = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
) -> Page[wire.Calibration]:
    """Calibrations, newest first."""
    found = [
        shown(name, one)
        for name, one in reversed(book(service).named().items())
        if subject in (None, one.subject) and method in (None, one.method)
    ]
    names = [one.id for one in found]
    rest = found[names.index(after) + 1 :] if after in names else found
    page = rest[:limit]
    return Page(items=page, next=page[-1].id if len(rest) > limit else None)


@router.get("/calibrations/{calibration}")
def calibration(calibration: Name, service: Parts, who: Reader) -> wire.Calibration:
    """One calibration."""
    found = book(service).named().get(calibration)
    if found is None:
        raise not_found("calibration", calibration)
    return shown(calibration, found)


@router.post("/calibrations", status_code=201)
def add(body: CalibrationUpload, service: Parts, who: Configurer) -> wire.Calibration:
    """Add a calibration (`calibration/1`); from now on it is in force if it is the newest."""
    fields = body.model_dump(exclude={"format", "at"})
    if body.at is not None:
        fields["at"] = body.at.astimezone(UTC).isoformat().replace("+00:00", "Z")
    made = Calibration(**fields)
    with _adding:
        name = book(service).add(made).stem
    service.audit.record(who.name, "calibrate", made.subject, calibration=name, value=made.value)
    return shown(name, made)


@router.get("/rigs/{name}/calibrations")
def of_rig(name: str, service: Parts, who: Reader) -> RigCalibration:
    """Which calibrations a campaign on this rig would use now, and what is missing or stale."""
    channels = service.facts(name).channels
    kept = book(service)
    applied, skews, remarks = kept.apply(channels)
    rows = zip(applied, skews, kept.in_force(channels), strict=True)
    return RigCalibration(
        channels=[
            ChannelCalibration(
                channel=channel.name,
                volts_per_unit=channel.volts_per_unit,
                unit=channel.unit,
                skew_s=skew,
                in_force={str(method): one for method, one in names.items()},
            )
            for channel, skew, names in rows
        ],
        remarks=remarks,
    )
