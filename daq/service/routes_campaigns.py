"""Campaigns on a rig: rehearse, queue, steer."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from fastapi import APIRouter
from starlette.concurrency import run_in_threadpool

from daq.plan import Plan, PlanModel, parse_plan
from daq.service.campaign_names import new_name
from daq.service.control import lane
from daq.service.dry_run import dry_run, require_possible
from daq.service.jobs import Job
from daq.service.plan_facts import planned, require_parameters
from daq.service.problems import Problem
from daq.service.rigs import RigEntry
from daq.service.routes_jobs import find, shown
from daq.service.routes_rigs import ControlToken
from daq.service.routes_store import Id
from daq.service.state import Controller, Parts, Reader, Service
from daq.service.wire import CampaignRequest, DryRun, JobSummary, WatchRequest

router = APIRouter(tags=["campaigns"])
WORK = "daq.service.rig_work"


def ready_rig(service: Service, name: str, token: str | None) -> RigEntry:
    """The rig, if the caller may move it now."""
    entry = service.check_rig(name)
    service.control.check(name, token)
    if who := service.control.stopped(name):
        raise Problem(
            409,
            "stopped",
            f"rig {name!r} is stopped by {who}: POST /api/v1/rigs/{name}/reset allows output again",
        )
    return entry


def queue(
    service: Service, entry: RigEntry, plan: dict[str, Any], owner: str, resume: str | None = None
) -> Job:
    """Queue a campaign on its rig; its id is fixed here, so that it can be named at once."""
    if resume is None:
        parsed = parse_plan(plan)
        require_runnable(service, entry.name, parsed)
        campaign, title = new_name(parsed.title), parsed.title
    else:
        campaign, title = resume, f"resume {resume}"
    arguments = {
        "rig": asdict(entry),
        "store": str(service.settings.store_dir),
        "plan": plan,
        "campaign_id": campaign,
        "resume": resume is not None,
    }
    return service.jobs.submit(
        "campaign",
        title,
        f"{WORK}:campaign",
        arguments,
        lane=lane(entry.name),
        owner=owner,
        about={"campaign": campaign, "rig": entry.name},
    )


@router.get("/plans/schema", tags=["plans"])
async def plan_schema(who: Reader) -> dict[str, Any]:
    """JSON Schema of a campaign plan, `campaign-plan/1`."""
    return PlanModel.model_json_schema()


@router.get("/plans/default", tags=["plans"])
def default_plan(who: Reader) -> dict[str, Any]:
    """The plan that `{}` stands for."""
    plan = asdict(parse_plan({}))
    return {key: value for key, value in plan.items() if value not in ({}, None)}


@router.post("/campaigns/dry-run")
def rehearse(body: CampaignRequest, service: Parts, who: Reader) -> DryRun:
    """What a campaign would do, without moving the rig."""
    service.check_rig(body.rig)
    plan = parse_plan(body.plan)
    expected: list[dict[str, Any]] = []
    if plan.online is not None:
        service.planner.ask(require_parameters, plan)
    rig = service.facts(body.rig)
    if plan.design is not None or plan.continues is not None:
        store = str(service.settings.store_dir)
        plan, expected = service.planner.ask(planned, body.plan, store)
    report = dry_run(
        plan,
        rig.limits,
        rig.sample_rate_hz,
        rig.channels,
        body.free_frequency_hz,
        rig.operating,
        expected,
    )
    return DryRun(**report)


def require_runnable(service: Service, rig: str, plan: Plan) -> None:
    """Refuse with 422 a plan whose dry run finds problems, before it is queued.

    A device that was never looked at is not opened for it: its campaign then ends before it moves.
    """
    if plan.online is not None:
        service.planner.ask(require_parameters, plan)
    known = service.known(rig)
    if known is not None:
        limits, rate, channels = known.limits, known.sample_rate_hz, known.channels
        require_possible(dry_run(plan, limits, rate, channels, operating=known.operating))


@router.post("/campaigns", status_code=202)
def start(
    body: CampaignRequest, service: Parts, who: Controller, token: ControlToken = None
) -> JobSummary:
    """Queue a campaign; it starts when its rig is free. Returns the job that runs it."""
    entry = ready_rig(service, body.rig, token)
    job = queue(service, entry, body.plan, who.name)
    service.audit.record(who.name, "campaign", body.rig, job=job.id, **job.about)
    return shown(job)


@router.post("/campaigns/{campaign}/resume", status_code=202)
def resume_campaign(
    campaign: Id, service: Parts, who: Controller, token: ControlToken = None
) -> JobSummary:
    """Go on with a campaign that was stopped or interrupted, on its own rig."""
    card = service.store.card(campaign)
    if not (Path(service.store.campaign_dir(campaign)) / "plan.json").exists():
        raise Problem(409, "no-plan", f"campaign {campaign!r} was imported: it has no plan")
    if any(
        job.about.get("campaign") == campaign and job.kind == "campaign"
        for job in service.jobs.all()
        if job.state in ("queued", "running")
    ):
        raise Problem(409, "running", f"campaign {campaign!r} is queued or running")
    entry = ready_rig(service, card.rig, token)
    job = queue(service, entry, {}, who.name, resume=campaign)
    service.audit.record(who.name, "resume", card.rig, job=job.id, campaign=campaign)
    return shown(job)


@router.post("/rigs/{name}/watch", status_code=202, tags=["rigs"])
def watch(
    name: str, body: WatchRequest, service: Parts, who: Controller, token: ControlToken = None
) -> JobSummary:
    """Show a rig's channels on the live stream without driving it."""
    entry = ready_rig(service, name, token)
    job = service.jobs.submit(
        "watch",
        f"Watch {name}",
        f"{WORK}:watch",
        {"rig": asdict(entry), "seconds": body.seconds},
        lane=lane(name),
        owner=who.name,
        about={"rig": name},
    )
    service.audit.record(who.name, "watch", name, job=job.id)
    return shown(job)


async def _steer(
    service: Service, who: str, identifier: str, command: str, token: str | None
) -> JobSummary:
    job = find(service, identifier)
    rig = job.about.get("rig")
    if rig is None or job.lane == "analysis":
        raise Problem(409, "no-rig", f"job {identifier!r} runs on no rig: DELETE it to cancel")
    service.control.check(rig, token)
    if job.state == "queued" and command == "stop":
        service.jobs.cancel(identifier)
    elif job.state != "running":
        raise Problem(409, "not-running", f"job {identifier!r} is {job.state}")
    else:
        service.jobs.send(identifier, command, {"reason": f"{command} by {who}"})
    await run_in_threadpool(service.audit.record, who, command, rig, job=identifier)
    return shown(job)


@router.post("/jobs/{job}/pause", status_code=202)
async def pause(
    job: str, service: Parts, who: Controller, token: ControlToken = None
) -> JobSummary:
    """Silence the rig at the campaign's next window, and wait."""
    return await _steer(service, who.name, job, "pause", token)


@router.post("/jobs/{job}/resume", status_code=202)
async def resume(
    job: str, service: Parts, who: Controller, token: ControlToken = None
) -> JobSummary:
    """Go on after a pause."""
    return await _steer(service, who.name, job, "resume", token)


@router.post("/jobs/{job}/skip", status_code=202)
async def skip(job: str, service: Parts, who: Controller, token: ControlToken = None) -> JobSummary:
    """Leave the present condition out."""
    return await _steer(service, who.name, job, "skip", token)


@router.post("/jobs/{job}/stop", status_code=202)
async def stop(job: str, service: Parts, who: Controller, token: ControlToken = None) -> JobSummary:
    """Silence the rig and end the campaign; it can be resumed later."""
    return await _steer(service, who.name, job, "stop", token)
