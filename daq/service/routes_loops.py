"""The closed loop over HTTP: measure, diagnose, measure what tells most next, until it is known.

A loop is a job of kind ``close_loop`` on its rig's lane; it is steered like a campaign (pause,
resume, skip, stop). Its rounds are ordinary campaigns of the store.
"""

from dataclasses import asdict

from fastapi import APIRouter
from fastapi.responses import FileResponse

from daq.plan import parse_plan
from daq.service.campaign_names import begun_with, new_name
from daq.service.control import lane
from daq.service.jobs import Job
from daq.service.problems import Problem, not_found
from daq.service.rigs import RigEntry
from daq.service.routes_analyses import html_report, report_path
from daq.service.routes_campaigns import ready_rig, require_runnable
from daq.service.routes_jobs import find, shown
from daq.service.routes_rigs import ControlToken
from daq.service.routes_store import Id
from daq.service.state import Controller, Parts, Reader, Service
from daq.service.wire import CloseLoopBudget, CloseLoopRequest, JobSummary

router = APIRouter(tags=["analyses"])


def queue(
    service: Service,
    entry: RigEntry,
    name: str,
    title: str,
    budget: CloseLoopBudget,
    owner: str,
    plan: dict[str, object] | None = None,
) -> Job:
    """Queue a loop on its rig; without a plan it goes on with the one of that name."""
    number = service.jobs.new_id()
    arguments = {
        "rig": asdict(entry),
        "store": str(service.settings.store_dir),
        "plan": plan or {},
        "name": name,
        "rounds": budget.rounds,
        "rig_minutes": budget.rig_minutes,
        "report": str(report_path(service, number)),
        "resume": plan is None,
    }
    return service.jobs.submit(
        "close_loop",
        title,
        "daq.service.loop_work:work",
        arguments,
        lane=lane(entry.name),
        owner=owner,
        about={"campaign": name, "rig": entry.name},
        identifier=number,
    )


@router.post("/close-loops", status_code=202)
def start(
    body: CloseLoopRequest, service: Parts, who: Controller, token: ControlToken = None
) -> JobSummary:
    """Campaign, diagnosis, next experiment, and again, until a verdict stands or the budget is
    spent. The job's result is the account of all rounds, `close-loop/1`."""
    first = parse_plan(body.plan)
    entry = ready_rig(service, body.rig, token)
    require_runnable(service, body.rig, first)
    name = new_name(first.title)
    job = queue(service, entry, name, first.title, body, who.name, body.plan)
    service.audit.record(who.name, "close loop", body.rig, job=job.id, campaign=name)
    return shown(job)


@router.post("/campaigns/{campaign}/close-loop", status_code=202)
def go_on(
    campaign: Id,
    body: CloseLoopBudget,
    service: Parts,
    who: Controller,
    token: ControlToken = None,
) -> JobSummary:
    """Go on with the loop that began with this campaign; what is done is not done again."""
    card = service.store.card(campaign)
    begun_with(service.store, campaign)
    if any(
        job.about.get("campaign") == campaign and job.state in ("queued", "running")
        for job in service.jobs.all()
        if job.lane != "analysis"
    ):
        raise Problem(409, "running", f"campaign {campaign!r} is queued or running")
    entry = ready_rig(service, card.rig, token)
    job = queue(service, entry, campaign, f"close the loop on {card.title}", body, who.name)
    service.audit.record(who.name, "close loop", card.rig, job=job.id, campaign=campaign)
    return shown(job)


@router.get("/close-loops/{job}/report", response_class=FileResponse)
def report(job: str, service: Parts, who: Reader) -> FileResponse:
    """The HTML report of the loop's last diagnosis."""
    found = find(service, job)
    if found.kind != "close_loop":
        raise not_found("closed loop", job)
    return html_report(service, found.id)
