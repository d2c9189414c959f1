"""Jobs: what runs, how far it is, what came out, and how to end it."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query

from daq.service.jobs import Job, State
from daq.service.problems import Problem, not_found
from daq.service.state import Controller, Parts, Reader, Service
from daq.service.wire import JobSummary, Page

router = APIRouter(tags=["jobs"])
JobKind = Literal[
    "campaign",
    "watch",
    "close_loop",
    "import",
    "identification",
    "diagnosis",
    "characterisation",
    "verification",
    "export",
]


def find(service: Service, identifier: str) -> Job:
    """The job, or the 404 that says there is none."""
    job = service.jobs.get(identifier)
    if job is None:
        raise not_found("job", identifier)
    return job


def shown(job: Job) -> JobSummary:
    """A job as lists show it."""
    return JobSummary(**job.summary())


@router.get("/jobs")
async def jobs(
    service: Parts,
    who: Reader,
    kind: JobKind | None = None,
    state: State | None = None,
    after: Annotated[str | None, Query(max_length=20)] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> Page[JobSummary]:
    """Jobs, newest first."""
    found = [
        job
        for job in service.jobs.all()
        if (kind is None or job.kind == kind) and (state is None or job.state == state)
    ]
    if after is not None:
        places = [index for index, job in enumerate(found) if job.id == after]
        found = found[places[0] + 1 :] if places else []
    page = found[:limit]
    return Page(
        items=[shown(job) for job in page],
        next=page[-1].id if len(found) > limit else None,
    )


@router.get("/jobs/{job}")
async def get_job(job: str, service: Parts, who: Reader) -> JobSummary:
    """One job's state and progress."""
    return shown(find(service, job))


@router.get("/jobs/{job}/log")
async def job_log(job: str, service: Parts, who: Reader) -> list[str]:
    """The job's last log lines, oldest first."""
    return list(find(service, job).log)


@router.get("/jobs/{job}/result")
def job_result(job: str, service: Parts, who: Reader) -> dict[str, Any]:
    """What the job returned, or a campaign came to that was stopped; 409 where there is nothing."""
    found = find(service, job)
    result = found.result  # read from its file
    if result is None:
        reason = f": {found.error}" if found.error else ""
        raise Problem(409, "no-result", f"job {job!r} is {found.state}{reason}")
    return result


@router.delete("/jobs/{job}", status_code=202)
def cancel(job: str, service: Parts, who: Controller) -> JobSummary:
    """End an analysis that waits or runs. What runs on a rig ends by `POST /jobs/{job}/stop`."""
    found = find(service, job)
    if found.lane != "analysis" and found.state == "running":
        raise Problem(409, "use-stop", f"what runs on a rig ends by POST /api/v1/jobs/{job}/stop")
    service.audit.record(who.name, "cancel", job)
    service.jobs.cancel(job)
    return shown(found)
