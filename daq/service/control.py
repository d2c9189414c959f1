"""One rig, one master: control locks, and the emergency stop that needs none.

A lock is a lease: it names its holder, carries a token that only the holder knows, and lapses
unless it is used or renewed. Another may take it over; the former holder learns of it from the
live stream and by the refusal of the next command. Where nobody holds the lock, a command is free
to come from anyone with the scope `control`. Reading needs no lock.

The emergency stop latches: it silences the rig and nothing starts on it until `reset`.
"""

import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from daq.service.events import Bus
from daq.service.jobs import JobManager
from daq.service.problems import Problem

STOP_WAIT_S = 0.03  # an answer in under 50 ms must not wait longer for the confirmation


@dataclass(frozen=True)
class Lease:
    """Who has control of a rig, and until when on the monotonic clock."""

    rig: str
    holder: str
    token: str
    until: float


class Control:
    """Leases and stop latches of the rigs named `names`."""

    def __init__(
        self,
        names: Callable[[], list[str]],
        jobs: JobManager,
        bus: Bus,
        *,
        clock: Callable[[], float] = time.monotonic,
        lease_s: float = 60.0,
    ) -> None:
        self._names = names
        self._jobs = jobs
        self._bus = bus
        self._clock = clock
        self._lease_s = lease_s
        self._lock = threading.Lock()
        self._leases: dict[str, Lease] = {}
        self._stopped: dict[str, str] = {}

    def holder(self, rig: str) -> Lease | None:
        lease = self._leases.get(rig)
        return lease if lease and lease.until > self._clock() else None

    def acquire(self, rig: str, who: str, token: str | None, takeover: bool) -> Lease:
        """Take, renew (with the token) or take over the lock."""
        with self._lock:
            held = self.holder(rig)
            mine = (
                held is not None and token is not None and secrets.compare_digest(held.token, token)
            )
            if held is not None and not mine and not takeover:
                raise self._refusal(held)
            fresh = held.token if held is not None and mine else secrets.token_urlsafe(16)
            lease = Lease(rig, who, fresh, self._clock() + self._lease_s)
            self._leases[rig] = lease
        if not mine:
            previous = held.holder if held else None
            self._bus.publish("control", {"rig": rig, "holder": who, "previous": previous})
        return lease

    def release(self, rig: str, token: str | None) -> None:
        """Give the lock back; only its holder can."""
        self.check(rig, token)
        with self._lock:
            held = self._leases.pop(rig, None)
        if held is not None:
            self._bus.publish("control", {"rig": rig, "holder": None, "previous": held.holder})

    def check(self, rig: str, token: str | None) -> None:
        """Refuse with 423 unless `token` holds the lock, or nobody does; renews the lease."""
        with self._lock:
            held = self.holder(rig)
            if held is None:
                return
            if token is None or not secrets.compare_digest(held.token, token):
                raise self._refusal(held)
            self._leases[rig] = replace(held, until=self._clock() + self._lease_s)

    def seconds_left(self, lease: Lease) -> float:
        return max(0.0, lease.until - self._clock())

    def _refusal(self, held: Lease) -> Problem:
        return Problem(
            423,
            "control",
            f"{held.holder} has control of rig {held.rig!r}: send the lock's token as "
            'X-Control-Token, or take over with {"takeover": true}',
            holder=held.holder,
        )

    def stopped(self, rig: str) -> str | None:
        """Why nothing may start on `rig`; None where it may."""
        return self._stopped.get(rig)

    def reset(self, rig: str) -> None:
        """Allow output again after an emergency stop."""
        if self._stopped.pop(rig, None) is not None:
            self._bus.publish("reset", {"rig": rig})

    def stop(self, who: str, rig: str | None = None) -> dict[str, Any]:
        """Silence one rig, or all: no lock, no queue, no waiting beyond `STOP_WAIT_S`.

        Says for each rig that ran whether its process has confirmed the silence by now.
        """
        rigs = [rig] if rig is not None else self._names()
        waiting: dict[str, threading.Event | None] = {}
        for name in rigs:
            self._stopped[name] = who
            for job in self._jobs.running(lane(name)):
                waiting[name] = self._jobs.send(job.id, "emergency_stop", {"who": who})
        until = time.monotonic() + STOP_WAIT_S
        confirmed = {
            name: done is not None and done.wait(max(0.0, until - time.monotonic()))
            for name, done in waiting.items()
        }
        self._bus.publish("emergency_stop", {"rigs": rigs, "who": who, "confirmed": confirmed})
        return {"rigs": rigs, "was_running": sorted(waiting), "confirmed": confirmed}


def lane(rig: str) -> str:
    """The job lane of a rig."""
    return f"rig:{rig}"
