"""Identifications, diagnoses, their reports, and the next experiment.

An analysis is a job of kind ``identification`` or ``diagnosis``; its number names the result.
"""

from pathlib import Path
from typing import Any, Literal

from fastapi import APIRouter
from fastapi.responses import FileResponse

from daq.service.jobs import Job
from daq.service.keys import Principal
from daq.service.problems import Problem, not_found
from daq.service.routes_campaigns import queue, ready_rig
from daq.service.routes_jobs import find, shown
from daq.service.routes_rigs import ControlToken
from daq.service.routes_store import Id
from daq.service.state import Controller, Parts, Reader, Service
from daq.service.wire import JobSummary, NextExperimentRequest

router = APIRouter(tags=["analyses"])
Kind = Literal["identification", "diagnosis"]


def report_path(service: Service, job: str) -> Path:
    """Where an analysis writes its HTML report."""
    return service.settings.data_dir / "reports" / f"{job}.html"


def submit(service: Service, who: Principal, kind: Kind, campaign: str) -> JobSummary:
    """Queue an analysis of a campaign."""
    card = service.store.card(campaign)
    name = service.jobs.new_id()
    arguments = {
        "campaign": campaign,
        "store": str(service.settings.store_dir),
        "report": str(report_path(service, name)),
    }
    job = service.jobs.submit(
        kind,
        f"{kind} of {card.title}",
        f"daq.service.analysis_work:{kind}",
        arguments,
        owner=who.name,
        about={"campaign": campaign},
        identifier=name,
    )
    service.audit.record(who.name, kind, campaign, job=job.id)
    return shown(job)


def result(service: Service, identifier: str, kind: Kind) -> tuple[Job, dict[str, Any]]:
    """A finished analysis of that kind, or the refusal that says how it stands."""
    job = find(service, identifier)
    if job.kind != kind:
        raise not_found(kind, identifier)
    result = job.result  # read from its file
    if result is None:
        reason = f": {job.error}" if job.error else ""
        raise Problem(409, "no-result", f"{kind} {identifier!r} is {job.state}{reason}")
    return job, result


def report(service: Service, identifier: str, kind: Kind) -> FileResponse:
    """The HTML report of a finished analysis."""
    return html_report(service, result(service, identifier, kind)[0].id)


def html_report(service: Service, job: str) -> FileResponse:
    """The file that a job wrote as its report."""
    path = report_path(service, job)
    if not path.is_file():
        raise not_found("report of", job)
    # Self-contained: its own styles and drawings, and nothing that runs.
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    return FileResponse(path, media_type="text/html", headers={"Content-Security-Policy": policy})


@router.post("/campaigns/{campaign}/identifications", status_code=202)
def identify(campaign: Id, service: Parts, who: Controller) -> JobSummary:
    """Fit the campaign's declared model."""
    return submit(service, who, "identification", campaign)


@router.get("/identifications/{job}")
def identification(job: str, service: Parts, who: Reader) -> dict[str, Any]:
    """The result, `identification/1`."""
    answer: dict[str, Any] = result(service, job, "identification")[1]["answer"]
    return answer


@router.get("/identifications/{job}/details")
def identification_details(job: str, service: Parts, who: Reader) -> dict[str, Any]:
    """Every run's measured and modelled harmonics; the model's curves with 95 % bands."""
    details: dict[str, Any] = result(service, job, "identification")[1]["details"]
    return details


@router.get("/identifications/{job}/report", response_class=FileResponse)
def identification_report(job: str, service: Parts, who: Reader) -> FileResponse:
    """The report as one HTML file."""
    return report(service, job, "identification")


@router.post("/campaigns/{campaign}/diagnoses", status_code=202)
def diagnose(campaign: Id, service: Parts, who: Controller) -> JobSummary:
    """Trace what the campaign's declared model lacks."""
    return submit(service, who, "diagnosis", campaign)


@router.get("/diagnoses/{job}")
def diagnosis(job: str, service: Parts, who: Reader) -> dict[str, Any]:
    """The result, `diagnosis/1`."""
    answer: dict[str, Any] = result(service, job, "diagnosis")[1]["answer"]
    return answer


@router.get("/diagnoses/{job}/details")
def diagnosis_details(job: str, service: Parts, who: Reader) -> dict[str, Any]:
    """Every run's measured and modelled harmonics, before and after; the model's curves."""
    details: dict[str, Any] = result(service, job, "diagnosis")[1]["details"]
    return details


@router.get("/diagnoses/{job}/report", response_class=FileResponse)
def diagnosis_report(job: str, service: Parts, who: Reader) -> FileResponse:
    """The report as one HTML file."""
    return report(service, job, "diagnosis")


@router.post("/diagnoses/{job}/next-experiment", status_code=202)
def run_next(
    job: str,
    body: NextExperimentRequest,
    service: Parts,
    who: Controller,
    token: ControlToken = None,
) -> JobSummary:
    """Queue what the diagnosis proposes to measure next, on `rig`."""
    answer = result(service, job, "diagnosis")[1]["answer"]
    plan = (answer["next_experiment"] or {}).get("plan")
    if not plan:
        raise Problem(409, "no-proposal", f"diagnosis {job!r} proposes no plan to run")
    entry = ready_rig(service, body.rig, token)
    queued = queue(service, entry, plan, who.name)
    service.audit.record(who.name, "next experiment", body.rig, job=queued.id, diagnosis=job)
    return shown(queued)
