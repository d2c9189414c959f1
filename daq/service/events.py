"""The live bus: what happens, in order, to everyone who listens, at no cost to what happens.

Every event has a sequence number. The last `history` events stay, so that a client which was
away resumes behind the number it last saw; pictures of the moment (`TRANSIENT`) are not worth
keeping and do not, and of those that wait for a client only the newest of a kind and rig does:
when all is slow, less is sent. Each client has a queue of its own with a bound:
when it lags, its oldest events are dropped and counted, and nobody else notices. `publish` may
be called from any thread and never waits.

Hundreds of clients are served a few at a time, so that a request which arrives meanwhile (the
emergency stop above all) waits for some of them, never for all.

An event is encoded once, however many listen. Waveforms travel as binary frames:

    4 bytes "ENT1" | uint32 little-endian: length n of the header | n bytes of JSON | float32 ...

the JSON holds `seq`, `kind`, `time`, and the array's `shape`.
"""

import asyncio
import json
import secrets
import struct
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from daq.service.audit import utc_text

MAGIC = b"ENT1"
TRANSIENT = frozenset({"waveform", "spectrum", "levels"})
AT_ONCE = 16  # clients served in one turn of the loop: 1 ms at about 50 µs each


@dataclass(frozen=True)
class Event:
    """One thing that happened: `data` is JSON-ready, `samples` an array of float32 or None."""

    seq: int
    kind: str
    time: str
    data: dict[str, Any]
    samples: npt.NDArray[np.float32] | None = None

    @cached_property
    def text(self) -> str:
        """JSON, without the samples."""
        body = {"seq": self.seq, "kind": self.kind, "time": self.time, "data": self.data}
        return json.dumps(body, separators=(",", ":"), default=float)

    @cached_property
    def binary(self) -> bytes:
        """The binary frame; an empty array where the event has no samples."""
        samples = self.samples if self.samples is not None else np.zeros(0, np.float32)
        head = {"seq": self.seq, "kind": self.kind, "time": self.time, **self.data}
        header = json.dumps({**head, "shape": samples.shape}, default=float).encode()
        header += b" " * (-len(header) % 4)  # so that the floats can be read in place
        return MAGIC + struct.pack("<I", len(header)) + header + samples.astype("<f4").tobytes()


class Subscription:
    """One client's queue; iterate with `next`. `dropped` counts what it lost by lagging."""

    def __init__(self, limit: int, kinds: frozenset[str] | None, behind: int) -> None:
        self._queue: OrderedDict[object, Event] = OrderedDict()
        self._behind = behind  # events up to this number have been offered
        self._limit = limit
        self._kinds = kinds
        self._ready = asyncio.Event()
        self.dropped = 0
        self.last_seq = 0

    def offer(self, event: Event) -> None:
        """Queue `event`, on the loop's thread; the oldest goes when there is no room."""
        if event.seq <= self._behind:
            return
        self._behind = event.seq
        if self._kinds is not None and event.kind not in self._kinds:
            return
        picture = event.kind in TRANSIENT
        place: object = (event.kind, event.data.get("rig")) if picture else event.seq
        self._queue.pop(place, None)
        if len(self._queue) >= self._limit:
            self._queue.popitem(last=False)
            self.dropped += 1
        self._queue[place] = event
        self._ready.set()

    async def next(self, timeout_s: float) -> list[Event]:
        """All waiting events, at least one; empty after `timeout_s` without any."""
        if not self._queue:
            self._ready.clear()
            try:
                async with asyncio.timeout(timeout_s):
                    await self._ready.wait()
            except TimeoutError:
                return []
        events = list(self._queue.values())
        self._queue.clear()
        self.last_seq = events[-1].seq
        return events


class Bus:
    """The event bus; `attach` it to the loop that serves the clients."""

    def __init__(self, history: int, queue: int, now: Callable[[], str] = utc_text) -> None:
        self._history: deque[Event] = deque(maxlen=history)
        self._limit = queue
        self._now = now
        self._lock = threading.Lock()
        self._seq = 0
        self._counts: Counter[str] = Counter()
        self._levels: dict[str, dict[str, Any]] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._clients: set[Subscription] = set()
        self._pending: deque[Event] = deque()  # on its way to the loop's thread
        self._delivering = False
        self._dropped_before = 0
        self._forgotten = 0  # kept events that had to give way, and the last one's number
        self._forgotten_seq = 0
        self.born = secrets.token_hex(4)  # another one's events are numbered anew

    def attach(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._delivering = loop, False

    def detach(self) -> None:
        """Deliver to nobody from here on; publishing stays harmless."""
        with self._lock:
            self._loop = None
            self._pending.clear()

    @property
    def seq(self) -> int:
        return self._seq

    @property
    def counts(self) -> dict[str, int]:
        """Events published, by kind."""
        return dict(self._counts)

    def level(self, name: str) -> dict[str, float]:
        """By rig, that number of its last `levels`."""
        return {rig: float(data[name]) for rig, data in list(self._levels.items())}

    @property
    def clients(self) -> int:
        return len(self._clients)

    @property
    def dropped(self) -> int:
        """Events that lagging clients lost, since the start."""
        return self._dropped_before + sum(client.dropped for client in self._clients)

    def publish(
        self, kind: str, data: dict[str, Any], samples: npt.NDArray[Any] | None = None
    ) -> Event:
        """Tell everyone, from any thread; returns at once."""
        array = None if samples is None else np.array(samples, dtype=np.float32)
        with self._lock:
            self._seq += 1
            self._counts[kind] += 1
            if kind == "levels" and "rig" in data:
                self._levels[data["rig"]] = data
            event = Event(self._seq, kind, self._now(), data, array)
            if kind not in TRANSIENT:
                self._keep(event)
            loop = self._loop
            if loop is None:
                return event
            self._pending.append(event)
            wake, self._delivering = not self._delivering, True
        if wake:
            try:
                loop.call_soon_threadsafe(self._deliver, loop)
            except RuntimeError:  # the loop closed between the two lines: nobody listens
                self.detach()
        return event

    def _keep(self, event: Event) -> None:
        if len(self._history) == self._history.maxlen:
            self._forgotten += 1
            self._forgotten_seq = self._history[0].seq
        self._history.append(event)

    def _deliver(self, loop: asyncio.AbstractEventLoop) -> None:
        """Begin a round: what waits goes to all clients, `AT_ONCE` in a turn of the loop."""
        with self._lock:
            events = list(self._pending)
            self._pending.clear()
            self._delivering = bool(events)
        if events:
            self._offer(loop, events, list(self._clients))

    def _offer(
        self, loop: asyncio.AbstractEventLoop, events: list[Event], clients: list[Subscription]
    ) -> None:
        for client in clients[:AT_ONCE]:
            for event in events:
                client.offer(event)
        if rest := clients[AT_ONCE:]:
            loop.call_soon(self._offer, loop, events, rest)
        else:
            loop.call_soon(self._deliver, loop)

    def subscribe(
        self, since: int | None = None, kinds: frozenset[str] | None = None
    ) -> Subscription:
        """A new client, on the loop's thread.

        With `since`, it first gets the kept events behind that number; those that had to give
        way meanwhile count as dropped (at most so many they were). Behind 0 it has missed nothing:
        what happened before it came is no loss of its own.
        """
        with self._lock:
            behind = self._seq if since is None else min(since, self._seq)
            kept = [event for event in self._history if event.seq > behind]
            forgotten = min(self._forgotten, self._forgotten_seq - behind)
        client = Subscription(self._limit, kinds, behind)
        client.dropped = max(0, forgotten)
        for event in kept:
            client.offer(event)
        if behind == 0:
            client.dropped = 0
        self._clients.add(client)
        return client

    def unsubscribe(self, client: Subscription) -> None:
        if client in self._clients:
            self._clients.discard(client)
            self._dropped_before += client.dropped
