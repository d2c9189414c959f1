"""Jobs: a process each, progress, log, cancel, result, restart."""

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from daq.service.events import Bus
from daq.service.jobs import FINISHED, Job, JobManager

WORK = "tests.service_work"


@pytest.fixture
def bus() -> Bus:
    return Bus(1000, 1000)


@pytest.fixture
def jobs(tmp_path: Path, bus: Bus) -> Iterator[JobManager]:
    manager = JobManager(tmp_path / "jobs", bus)
    yield manager
    manager.close(2)


def until(condition: object, job: Job, seconds: float = 90) -> None:
    end = time.monotonic() + seconds
    while not condition(job):  # type: ignore[operator]
        assert time.monotonic() < end, f"job {job.state}: {job.error}"
        threading.Event().wait(0.01)


def ended(job: Job) -> bool:
    return job.state in FINISHED


def test_result_progress_log_and_events(jobs: JobManager, bus: Bus) -> None:
    job = jobs.submit("double", "Double", f"{WORK}:double", {"value": 3.0}, about={"campaign": "c"})
    until(ended, job)
    assert job.result is not None
    assert job.result["value"] == 6.0
    assert job.result["process"] != os.getpid()
    assert job.progress == 1.0
    assert "doubling 3.0" in job.log[0]
    events = {event.kind: event for event in bus._history}
    assert events["progress"].data == {
        "job": job.id, "campaign": "c", "progress": 0.5, "message": "half way",
    }  # fmt: skip
    assert events["wave"].samples is not None
    assert events["wave"].samples.tolist() == [[3.0, 6.0]]
    assert events["job"].data["state"] == "succeeded"


@pytest.mark.parametrize(("work", "says"), [("fail", "frequency_hz=-1"), ("die", "exit code 7")])
def test_a_failure_says_why_and_the_service_lives(jobs: JobManager, work: str, says: str) -> None:
    job = jobs.submit(work, work, f"{WORK}:{work}", {})
    until(ended, job)
    assert job.state == "failed"
    assert says in str(job.error)


def test_what_took_long_is_not_forgotten_as_it_ends(tmp_path: Path, bus: Bus) -> None:
    """An hour's acquisition outlasted 500 analyses, and its result was gone before it was read."""
    manager = JobManager(tmp_path / "jobs", bus, keep=2)
    first = manager.submit("wait", "first", f"{WORK}:wait", {}, lane="rig:a")
    later = [manager.submit("d", "d", f"{WORK}:double", {"value": v}) for v in (1.0, 2.0, 3.0)]
    for job in later:
        until(ended, job)
    until(lambda job: job.message == "waiting", first)
    done = manager.send(first.id, "emergency_stop")
    assert done is not None
    assert done.wait(5)
    until(ended, first)
    assert first.result == {"heard": ["emergency_stop"]}
    assert manager.get(first.id) is first
    assert manager.get(later[1].id) is None
    manager.close(2)


def test_a_lane_runs_one_at_a_time_and_waiting_work_can_be_cancelled(jobs: JobManager) -> None:
    first = jobs.submit("wait", "first", f"{WORK}:wait", {}, lane="rig:a")
    second = jobs.submit("wait", "second", f"{WORK}:wait", {}, lane="rig:a")
    until(lambda job: job.message == "waiting", first)
    assert second.state == "queued"
    assert jobs.cancel(second.id)
    assert second.state == "cancelled"
    done = jobs.send(first.id, "emergency_stop")
    assert done is not None
    assert done.wait(5)
    until(ended, first)
    assert first.result == {"heard": ["emergency_stop"]}


def test_cancelling_ends_the_process(jobs: JobManager) -> None:
    job = jobs.submit("wait", "wait", f"{WORK}:wait", {})
    until(lambda job: job.message == "waiting", job)
    assert jobs.cancel(job.id)
    until(ended, job)
    assert job.state == "cancelled"
    assert not jobs.cancel(job.id)


def test_closing_lets_a_rig_stop_by_itself(tmp_path: Path, bus: Bus) -> None:
    manager = JobManager(tmp_path / "jobs", bus)
    job = manager.submit("wait", "wait", f"{WORK}:wait", {}, lane="rig:a")
    until(lambda job: job.message == "waiting", job)
    manager.close(10)
    assert job.result == {"heard": ["stop"]}
    with pytest.raises(RuntimeError, match="shutting down"):
        manager.submit("wait", "wait", f"{WORK}:wait", {})


def test_results_outlive_a_restart_and_old_ones_are_forgotten(tmp_path: Path, bus: Bus) -> None:
    manager = JobManager(tmp_path / "jobs", bus, keep=2)
    made = [manager.submit("d", "d", f"{WORK}:double", {"value": v}) for v in (1.0, 2.0, 3.0)]
    for job in made:
        until(ended, job)
    manager.close(2)
    again = JobManager(tmp_path / "jobs", bus, keep=2)
    assert again.get(made[0].id) is None
    found = again.get(made[2].id)
    assert found is not None
    assert found.result is not None
    assert (found.state, found.result["value"]) == ("succeeded", 6.0)


def test_what_a_kill_of_the_service_cut_off_is_known_to_have_failed(
    tmp_path: Path, bus: Bus, jobs: JobManager
) -> None:
    about = {"campaign": "c"}
    made = [
        jobs.submit("campaign", "c", f"{WORK}:wait", {}, lane="rig:a", about=about),
        jobs.submit("campaign", "c", f"{WORK}:wait", {}, lane="rig:a", about=about),
        jobs.submit("wait", "wait", f"{WORK}:wait", {}),
    ]
    until(lambda job: job.message == "waiting", made[2])
    jobs.cancel(made[2].id)
    until(ended, made[2])
    again = JobManager(tmp_path / "jobs", bus)  # as if the first manager's process were killed
    running, queued, cancelled = (again.get(job.id) for job in made)
    assert running is not None
    assert queued is not None
    assert cancelled is not None
    assert (running.state, queued.state, cancelled.state) == ("failed", "failed", "cancelled")
    assert running.error is not None
    assert "POST /api/v1/campaigns/c/resume" in running.error
    assert running.finished is not None
