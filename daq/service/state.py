"""What the service consists of, built once from the settings and handed to every route."""

import asyncio
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from daq.service import rig_facts
from daq.service.audit import AuditTrail
from daq.service.control import Control, lane
from daq.service.events import Bus
from daq.service.guard import Tickets, require
from daq.service.jobs import JobManager
from daq.service.keys import KeyStore, Principal, Scope
from daq.service.metrics import Metrics
from daq.service.problems import Problem, not_found
from daq.service.processes import Aside
from daq.service.rig_facts import RigFacts
from daq.service.rigs import SIMULATED, RigEntry, Rigs
from daq.service.settings import Settings
from daq.store import RunStore


@dataclass
class Service:
    """The parts; `closing` turns true once, at shutdown, and ends the live streams.

    `stops` are threads for the emergency stop alone: whatever fills the pool that serves all
    other requests, a stop does not wait for it.
    """

    settings: Settings
    keys: KeyStore
    tickets: Tickets
    metrics: Metrics
    bus: Bus
    jobs: JobManager
    audit: AuditTrail
    control: Control
    rigs: Rigs
    aside: Aside
    planner: Aside = field(default_factory=Aside)  # fits for dry runs: too long for `aside`
    closing: bool = False
    stops: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(16, thread_name_prefix="stop")
    )
    searching: asyncio.Lock = field(default_factory=asyncio.Lock)
    seen: dict[str, RigFacts] = field(default_factory=dict)

    @cached_property
    def store(self) -> RunStore:
        return RunStore(self.settings.store_dir)

    def check_rig(self, name: str) -> RigEntry:
        """The rig of that name, or the 404 that says there is none."""
        entry = self.rigs.get(name)
        if entry is None:
            raise not_found("rig", name, self.rigs.names())
        return entry

    def facts(self, name: str) -> RigFacts:
        """What the rig of that name is.

        A device that is in use is not opened beside it, which could disturb the recording: what was
        seen last is told, and 409 where it was never looked at.
        """
        entry = self.check_rig(name)
        if entry.driver != SIMULATED and self.jobs.running(lane(name)):
            if name not in self.seen:
                raise Problem(
                    409, "running", f"rig {name!r} is running: look at it when it is idle"
                )
            return self.seen[name]
        self.seen[name] = self.aside.ask(rig_facts.facts, entry)
        return self.seen[name]

    def known(self, name: str) -> RigFacts | None:
        """The same as far as it can be told without opening a device."""
        simulated = self.check_rig(name).driver == SIMULATED
        return self.facts(name) if simulated else self.seen.get(name)


def build(settings: Settings) -> Service:
    """All parts, wired."""
    bus = Bus(settings.live.history, settings.live.queue)
    jobs = JobManager(
        settings.data_dir / "jobs",
        bus,
        workers=settings.jobs.workers,
        keep=settings.jobs.keep,
        timeout_s=settings.jobs.timeout_s,
    )
    metrics = Metrics()
    rigs = Rigs(settings.rigs, settings.data_dir / "rigs.json")
    control = Control(rigs.names, jobs, bus)
    _gauges(metrics, settings, bus, jobs)
    return Service(
        settings,
        KeyStore(settings.keys_file),
        Tickets(),
        metrics,
        bus,
        jobs,
        AuditTrail(settings.audit_file),
        control,
        rigs,
        Aside(),
    )


def _gauges(metrics: Metrics, settings: Settings, bus: Bus, jobs: JobManager) -> None:
    """What Prometheus sees beside the requests."""
    count: dict[str, str] = {"kind": "counter"}
    metrics.gauge("entrain_jobs", "Jobs by state.", jobs.count, "state")
    metrics.gauge("entrain_live_clients", "Live streams served now.", lambda: bus.clients)
    metrics.gauge("entrain_events_total", "Events published.", lambda: bus.counts, "event", **count)
    metrics.gauge(
        "entrain_events_dropped_total",
        "Events that lagging clients lost.",
        lambda: bus.dropped,
        **count,
    )
    metrics.gauge(
        "entrain_rig_frames", "Frames of the stream last seen.", lambda: bus.level("frames"), "rig"
    )
    metrics.gauge(
        "entrain_rig_lost_frames",
        "Frames lost in that stream.",
        lambda: bus.level("lost_frames"),
        "rig",
    )
    metrics.gauge(
        "entrain_disk_free_bytes",
        "Room where the run store lies.",
        lambda: shutil.disk_usage(settings.data_dir).free if settings.data_dir.exists() else 0,
    )


async def get_service(connection: HTTPConnection) -> Service:
    """The dependency by which routes reach the service; a coroutine, since others take a thread."""
    service = connection.app.state.service
    assert isinstance(service, Service)
    return service


class Needs:
    """The dependency that refuses whoever lacks `scope`, and returns who asks."""

    def __init__(self, scope: Scope) -> None:
        self.scope: Scope = scope

    async def __call__(self, connection: HTTPConnection) -> Principal:
        principal: Principal = connection.scope["state"]["principal"]
        require(principal, self.scope)
        return principal


Parts = Annotated[Service, Depends(get_service)]
Reader = Annotated[Principal, Depends(Needs("read"))]
Controller = Annotated[Principal, Depends(Needs("control"))]
Configurer = Annotated[Principal, Depends(Needs("configure"))]
Admin = Annotated[Principal, Depends(Needs("admin"))]
