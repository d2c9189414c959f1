"""Long work: a job has a state, a progress, a log, a result, and can be cancelled.

Each job runs in a process of its own (`daq.service.processes`): an analysis can neither stall the
acquisition nor take the service down, and cancelling is certain. Jobs of one *lane* wait for each
other: analyses share one lane with a few workers, each rig is a lane of its own with room for one
campaign.

The work is a function ``work(link, **arguments) -> dict``, named as ``"module:function"``. Through
`Link` it reports progress, log lines and events, and hears commands (``pause``, ``stop``).
Jobs are kept as JSON files from the start, so that results outlive a restart, and what a kill of
the service cut off is known to have failed. A result stays there and is read when somebody asks, so
that a service that has made hundreds is no larger for it.
"""

import contextlib
import importlib
import json
import logging
import os
import secrets
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from daq.service.audit import utc_text
from daq.service.events import Bus
from daq.service.plain import plain
from daq.service.processes import context

State = Literal["queued", "running", "succeeded", "failed", "cancelled"]
Hold = Literal["pausing", "paused"]
FINISHED: frozenset[str] = frozenset({"succeeded", "failed", "cancelled"})
LOG_LINES = 500
ANALYSIS_NICE = 10  # a fit gives way to the acquisition and to the service
ACKNOWLEDGED = "acknowledged"
POSIX = os.name == "posix"
log = logging.getLogger("entrain.jobs")


class Cancelled(Exception):
    """Raised by work that gives up because it was told to; `result`: what it came to by then."""

    def __init__(self, reason: str, result: dict[str, Any] | None = None) -> None:
        super().__init__(reason)
        self.result = result


class Link:
    """The work's side of the pipe to the service."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._lock = threading.Lock()
        self._handlers: dict[str, Callable[[dict[str, Any]], None]] = {}
        self._hearing = threading.Lock()
        self._early: list[tuple[str, dict[str, Any]]] = []  # commands that nobody heard yet

    def _send(self, kind: str, *body: Any) -> None:
        # A service that is gone cannot listen; the work goes on and notices by its own means.
        with self._lock, contextlib.suppress(OSError):
            self._pipe.send((kind, *body))

    def progress(self, fraction: float, text: str = "") -> None:
        """`fraction` of the work is done, 0 to 1."""
        self._send("progress", min(1.0, max(0.0, float(fraction))), text)

    def log(self, text: str) -> None:
        self._send("log", text)

    def event(
        self, kind: str, data: dict[str, Any], samples: npt.NDArray[Any] | None = None
    ) -> None:
        """Publish on the live bus."""
        self._send(
            "event", kind, data, None if samples is None else np.asarray(samples, np.float32)
        )

    def hold(self, how: Hold | None) -> None:
        """The work is about to wait for its operator, waits, or (None) goes on."""
        self._send("hold", how)

    def on(self, command: str, handler: Callable[[dict[str, Any]], None]) -> None:
        """Call `handler` (on a thread of its own) when the service sends `command`.

        One that came while the work was still preparing itself is heard now: a stop counts then.
        """
        with self._hearing:
            self._handlers[command] = handler
            early = [body for name, body in self._early if name == command]
            self._early = [one for one in self._early if one[0] != command]
        for body in early:
            handler(body)

    def listen(self) -> None:
        """Hear commands until the pipe closes; `lost` is the command that says so.

        It ends the process, unless the work has said what else to do.
        """
        while True:
            try:
                number, command, body = self._pipe.recv()
            except (EOFError, OSError):
                self._handlers.get("lost", _give_up)({})
                return
            with self._hearing:
                handler = self._handlers.get(command)
                if handler is None:
                    self._early.append((command, body))
            if handler is not None:
                handler(body)
            self._send(ACKNOWLEDGED, number, handler is not None)


def _give_up(body: dict[str, Any]) -> None:
    """End this process, which works for nobody any more, and an analysis's helpers with it.

    A rig's own process is left to notice by itself: it ramps down first.
    """
    if POSIX and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def _process(pipe: Connection, target: str, arguments: dict[str, Any], analysis: bool) -> None:
    """Main function of the job's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the service decides, not the terminal
    if analysis and POSIX:
        os.setpgrp()  # so that helpers which it starts end together with it
        os.nice(ANALYSIS_NICE)
    link = Link(pipe)
    threading.Thread(target=link.listen, daemon=True, name="commands").start()
    try:
        module, _, name = target.partition(":")
        work = getattr(importlib.import_module(module), name)
        link._send("done", plain(work(link, **arguments)))
    except Cancelled as error:
        link._send("cancelled", str(error), plain(error.result))
    except Exception as error:
        link._send("failed", f"{type(error).__name__}: {error}", traceback.format_exc())


@dataclass
class Job:
    """One piece of work, as the service knows it."""

    id: str
    kind: str
    title: str
    lane: str
    owner: str
    target: str
    arguments: dict[str, Any]
    about: dict[str, Any] = field(default_factory=dict)
    state: State = "queued"
    progress: float = 0.0
    message: str = ""
    hold: Hold | None = None
    created: str = ""
    started: str | None = None
    finished: str | None = None
    error: str | None = None
    outcome: dict[str, Any] | None = None  # the result, where it lies in no file
    file: Path | None = None
    log: deque[str] = field(default_factory=lambda: deque(maxlen=LOG_LINES))

    @property
    def result(self) -> dict[str, Any] | None:
        """What the work returned; None before it has, and where it did not."""
        if self.file is None:
            return self.outcome
        try:
            kept: dict[str, Any] | None = json.loads(self.file.read_text(encoding="utf-8"))[
                "result"
            ]
        except (OSError, ValueError, KeyError):
            log.exception("the result of job %s cannot be read", self.id)
            return None
        return kept

    @property
    def remedy(self) -> str:
        """What to do where its process broke off."""
        if self.kind == "campaign":
            return f"POST /api/v1/campaigns/{self.about['campaign']}/resume goes on with it"
        return "start it again"

    def summary(self) -> dict[str, Any]:
        """What lists and events show: all but log, result and arguments."""
        names = ("id", "kind", "title", "lane", "owner", "about", "state", "progress", "message")
        times = ("hold", "created", "started", "finished", "error")
        return {name: getattr(self, name) for name in (*names, *times)}


class JobManager:
    """Queues, runs, watches and keeps jobs; results lie in `folder`."""

    def __init__(
        self,
        folder: Path,
        bus: Bus,
        *,
        workers: int = 1,
        keep: int = 500,
        timeout_s: float = 3600.0,
        now: Callable[[], str] = utc_text,
    ) -> None:
        self._folder = folder
        self.hide = str(folder.parent.resolve())  # where the data lie concerns no client
        self._bus = bus
        self._workers = workers
        self._keep = keep
        self._timeout_s = timeout_s
        self._now = now
        self._lock = threading.RLock()
        self._jobs: dict[str, Job] = {}
        self._running: dict[str, _Running] = {}
        self._closed = False
        self._listeners: list[Callable[[Job], None]] = []
        self._load()

    def when_failed(self, listener: Callable[[Job], None]) -> None:
        """Call `listener` with every job that fails, before that is told."""
        self._listeners.append(listener)

    def submit(
        self,
        kind: str,
        title: str,
        target: str,
        arguments: dict[str, Any],
        *,
        lane: str = "analysis",
        owner: str = "local",
        about: dict[str, Any] | None = None,
        identifier: str | None = None,
    ) -> Job:
        """Queue `target`; it starts when its lane has room. `identifier`: one from `new_id`."""
        with self._lock:
            if self._closed:
                raise RuntimeError("the service is shutting down and takes no more work")
            name = identifier or self.new_id()
            job = Job(name, kind, title, lane, owner, target, arguments, about or {})
            job.created = self._now()
            self._jobs[job.id] = job
            self._keep_file(job)
            self._tell(job)
            self._dispatch()
            return job

    @staticmethod
    def new_id() -> str:
        """A fresh name for a job, for work whose arguments must mention it."""
        return secrets.token_hex(6)

    def get(self, identifier: str) -> Job | None:
        return self._jobs.get(identifier)

    def all(self) -> list[Job]:
        """Newest first."""
        with self._lock:
            return list(reversed(self._jobs.values()))

    def count(self) -> dict[str, int]:
        """Jobs by state."""
        states = [job.state for job in self.all()]
        return {
            s: states.count(s) for s in ("queued", "running", "succeeded", "failed", "cancelled")
        }

    def cancel(self, identifier: str) -> bool:
        """End a job; True where it had not ended yet. Its process is killed."""
        with self._lock:
            job = self._jobs[identifier]
            if job.state == "queued":
                self._finish(job, "cancelled", error="cancelled before it started")
                return True
            running = self._running.get(identifier)
        if running is None:
            return False
        running.cancelled = True
        running.end()
        return True

    def send(
        self, identifier: str, command: str, body: dict[str, Any] | None = None
    ) -> threading.Event | None:
        """Send a command to a running job; the event is set when the job has carried it out."""
        running = self._running.get(identifier)
        return running.send(command, body or {}) if running else None

    def running(self, lane: str) -> list[Job]:
        """The jobs of `lane` that run now."""
        return [job for job in self.all() if job.lane == lane and job.state == "running"]

    def close(self, timeout_s: float) -> None:
        """Take no more work; end what runs, giving it `timeout_s` where it can stop by itself."""
        with self._lock:
            self._closed = True
            waiting = [job for job in self._jobs.values() if job.state == "queued"]
            running = dict(self._running)
        for job in waiting:
            self._finish(job, "cancelled", error="the service was shut down")
        for one in running.values():
            done = one.send("stop", {"reason": "the service is shutting down"})
            if one.job.lane == "analysis" or done is None:
                one.end()
        for one in running.values():
            one.thread.join(timeout_s)
            if one.thread.is_alive():
                one.end(kill=True)
                one.thread.join(5.0)

    def _dispatch(self) -> None:
        with self._lock:
            if self._closed:
                return
            for job in list(self._jobs.values()):
                if job.state != "queued":
                    continue
                busy = sum(one.job.lane == job.lane for one in self._running.values())
                if busy < (self._workers if job.lane == "analysis" else 1):
                    job.state, job.started = "running", self._now()
                    self._keep_file(job)
                    self._running[job.id] = _Running(self, job, self._timeout_s)
                    self._tell(job)

    def _tell(self, job: Job) -> None:
        self._bus.publish("job", job.summary())

    def _finish(
        self,
        job: Job,
        state: State,
        *,
        result: dict[str, Any] | None = None,
        error: str | None = None,
    ) -> None:
        for listener in self._listeners if state == "failed" else ():
            try:
                listener(job)
            except Exception:
                log.exception("a listener failed for job %s", job.id)
        with self._lock:
            self._running.pop(job.id, None)
            job.finished, job.outcome, job.error, job.hold = self._now(), result, error, None
            if state == "succeeded":
                job.progress = 1.0
            job.file = self._keep_file(job, state)
            if job.file is not None:
                job.outcome = None
            job.state = state
            self._forget()
        self._tell(job)
        self._dispatch()

    def _forget(self) -> None:
        """Drop what ended longest ago: an hour's job that ends now is news, however old it is."""
        done = [job for job in self._jobs.values() if job.state in FINISHED]
        done.sort(key=lambda job: job.finished or "")
        for job in done[: max(0, len(done) - self._keep)]:
            del self._jobs[job.id]
            (self._folder / f"{job.id}.json").unlink(missing_ok=True)

    def _keep_file(self, job: Job, state: State | None = None) -> Path | None:
        """Write the job down; None where that fails."""
        body = {**asdict(job), "log": list(job.log), "result": job.outcome}
        body["state"] = state or job.state
        del body["outcome"], body["file"]
        temporary = self._folder / f".{job.id}.tmp"
        path = self._folder / f"{job.id}.json"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            temporary.write_text(json.dumps(body, default=str), encoding="utf-8")
            os.replace(temporary, path)
        except OSError:  # a full disk: the job goes on, or is over, all the same
            log.exception("job %s cannot be kept", job.id)
            return None
        return path

    def _load(self) -> None:
        rows: list[dict[str, Any]] = []
        for path in self._folder.glob("*.json"):
            try:
                row = json.loads(path.read_text(encoding="utf-8"))
                rows.append({key: row[key] for key in row if key != "result"} | {"file": path})
            except (OSError, ValueError, TypeError):
                log.warning("job file %s is unreadable and left out", path)
        for row in sorted(rows, key=lambda row: str(row.get("created"))):
            try:
                job = Job(**{**row, "log": deque(row["log"], maxlen=LOG_LINES)})
            except (KeyError, TypeError):
                log.warning("a job file without the usual keys is left out")
                continue
            self._jobs[job.id] = job
            if job.state not in FINISHED:
                job.error = f"the service ended before this job did: {job.remedy}"
                job.state, job.finished, job.hold = "failed", self._now(), None
                self._keep_file(job)


class _Running:
    """A job's process, and the thread that reads from it."""

    def __init__(self, manager: JobManager, job: Job, timeout_s: float) -> None:
        self.job = job
        self.cancelled = False
        self._manager = manager
        analysis = job.lane == "analysis"
        self._timeout_s = timeout_s if analysis else None
        self._waiting: dict[int, threading.Event] = {}
        self._number = 0
        self._sending = threading.Lock()
        self._starting = threading.Lock()
        self._unwanted = False
        self._pipe, theirs = context.Pipe()
        self.process = context.Process(
            target=_process,
            args=(theirs, job.target, job.arguments, analysis),
            # It may have processes of its own: the one that holds the rig's device.
            daemon=False,
            name=job.kind,
        )
        self._theirs = theirs
        self.thread = threading.Thread(target=self._watch, daemon=True, name=f"job-{job.id}")
        self.thread.start()

    def send(self, command: str, body: dict[str, Any]) -> threading.Event | None:
        with self._sending:
            self._number += 1
            done = self._waiting[self._number] = threading.Event()
            try:
                self._pipe.send((self._number, command, body))
            except OSError:
                return None
        return done

    def end(self, kill: bool = False) -> None:
        """End the process, even one that is only about to start."""
        with self._starting:
            self._unwanted = True
            if self.process.pid is None:
                return
            if POSIX and self.job.lane == "analysis":
                # Not there before the process leads its group, nor after it has ended.
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self.process.pid, signal.SIGKILL)
            if kill:
                self.process.kill()
            else:
                self.process.terminate()

    def _watch(self) -> None:
        with self._starting:
            self.process.start()
            if self._unwanted:
                self.process.terminate()
        self._theirs.close()
        timer: threading.Timer | None = None
        if self._timeout_s is not None:
            timer = threading.Timer(self._timeout_s, self._time_out)
            timer.daemon = True
            timer.start()
        outcome = self._read()
        self.process.join()
        if timer is not None:
            timer.cancel()
        self._pipe.close()
        for done in self._waiting.values():
            done.set()
        self._manager._finish(self.job, *outcome[:1], **outcome[1])

    def _time_out(self) -> None:
        self.job.message = f"took longer than jobs.timeout_s={self._timeout_s:g}"
        self.end()

    def _read(self) -> tuple[State, dict[str, Any]]:
        job = self.job
        while True:
            try:
                kind, *body = self._pipe.recv()
            except (EOFError, OSError):
                break
            if kind == "done":
                return "succeeded", {"result": body[0]}
            if kind == "failed":
                log.error("job %s failed: %s\n%s", job.id, body[0], body[1])
                return "failed", {"error": body[0].replace(self._manager.hide, "")}
            if kind == "cancelled":
                return "cancelled", {"error": body[0] or "cancelled", "result": body[1]}
            self._heard(kind, body)
        if self.cancelled:
            return "cancelled", {"error": "cancelled"}
        self.process.join()
        code = self.process.exitcode
        if "jobs.timeout_s" in job.message:
            return "failed", {"error": f"{job.message} (exit code {code})"}
        reason = f"its process ended unexpectedly (exit code {code})"
        return "failed", {"error": f"{reason}: {job.remedy}"}

    def _heard(self, kind: str, body: Iterable[Any]) -> None:
        job, bus = self.job, self._manager._bus
        items = list(body)
        if kind == "progress":
            job.progress, job.message = items
            about = {"job": job.id, **job.about}
            bus.publish("progress", {**about, "progress": items[0], "message": items[1]})
        elif kind == "hold":
            job.hold = items[0]
            self._manager._tell(job)
        elif kind == "log":
            job.log.append(f"{self._manager._now()} {items[0]}")
            bus.publish("log", {"job": job.id, **job.about, "text": items[0]})
        elif kind == "event":
            bus.publish(items[0], {"job": job.id, **job.about, **items[1]}, items[2])
        elif kind == ACKNOWLEDGED and (done := self._waiting.pop(items[0], None)):
            done.set()
