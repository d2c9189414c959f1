"""Does the acquisition keep up? Eight channels at 51.2 kHz, one recording, four API clients.

    python benchmarks/acquire_load.py --seconds 600

A source paced by the machine's clock stands for the device: it makes frames at the given rate with
a counter in channel 0 and drops what is not fetched within its buffer, like a driver's ring.

First the rate limit: the rate is doubled until frames are lost, each time for six seconds, without
listeners. Then the recording itself, as the product does it: a job of the service reads, records
and shows the stream live, and four clients read that over WebSocket and ask for pages beside it.
Printed as JSON: frames lost by the stream's own gaps and by the counter in the file, processor
time of each process, answers' times, the rate limit and the headroom to it.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import service_load

from daq.acquire import Acquisition
from daq.records import RunHeader
from daq.service.jobs import Link
from daq.service.observed import observe
from daq.store import RunStore
from daq.store_file import open_run
from drivers.clock import MonotonicClock
from drivers.protocols import DuplexRig
from drivers.types import Block, Channel, OutputLimits, StreamStatus, Tone

CHANNELS, RATE_HZ = 8, 51_200.0
CLIENTS, READS_PER_S = 4, 4.0
COUNTER_STEP_V = 2.0**-23  # exact in float32 up to 2²⁴ frames, then it wraps
STEP_S, STEP_BUFFER_S = 6.0, 0.5
MOST_DOUBLINGS = 8


class PacedSource:
    """A rig that never sounds; its frames exist only once their time came, for `buffer_s`."""

    name = "paced source"
    clock = MonotonicClock()
    limits = OutputLimits(max_amplitude_v=1.0)

    def __init__(self, rate_hz: float, buffer_s: float = 2.0) -> None:
        self.channels: Sequence[Channel] = [
            Channel(f"p{i}", "pressure", "Pa", 0.01) for i in range(CHANNELS)
        ]
        self.sample_rate_hz = rate_hz
        self._buffer_s = buffer_s
        self._next = self._lost = 0
        size = max(1 << 18, round(rate_hz / 4))  # larger than any block that is asked for
        self._noise = np.random.default_rng(1).standard_normal((size, CHANNELS))
        self._begin = time.monotonic()

    def start(self) -> None:
        self._begin = time.monotonic()

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        due = self._begin + (self._next + frames) / self.sample_rate_hz
        self.clock.sleep(due - time.monotonic())
        late = int((time.monotonic() - due - self._buffer_s) * self.sample_rate_hz)
        if late > 0:
            self._next += late
            self._lost += late
        start = self._next % (self._noise.shape[0] - frames)
        samples = self._noise[start : start + frames].copy()
        samples[:, 0] = (np.arange(self._next, self._next + frames) % 2**24) * COUNTER_STEP_V
        block = Block(self._next, samples, self._begin + self._next / self.sample_rate_hz)
        self._next += frames
        return block

    def status(self) -> StreamStatus:
        return StreamStatus(True, self._next, self._lost)

    def drive(self, tone: Tone) -> Tone:
        return tone

    def stop(self) -> None: ...
    def feed(self) -> None: ...
    def silence(self) -> None: ...
    def close(self) -> None: ...


def record(
    rig: DuplexRig, seconds: float, store: RunStore, begun: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """One recording; what was lost, and what it cost this process. `begun`: at the first frames."""
    card = store.create_campaign("load")
    header = RunHeader("000-load", "free", rig.sample_rate_hz, tuple(rig.channels))
    acquisition = Acquisition(rig)
    rig.start()
    wall, busy, most = time.monotonic(), time.process_time(), 0
    with store.write_run(card.id, header) as writer:
        left = round(seconds * rig.sample_rate_hz)
        while left > 0:
            frames = min(left, round(rig.sample_rate_hz / 10))
            acquisition.read(frames, writer)
            most = max(most, writer.queued_bytes)
            left -= frames
            if acquisition.counters.frames == frames:
                begun()
        summary = writer.finish()
    wall, busy = time.monotonic() - wall, time.process_time() - busy
    store.add_run(summary)
    return {
        "frames": summary.samples,
        "channels": len(rig.channels),
        "rate_hz": rig.sample_rate_hz,
        "lost_frames": acquisition.counters.lost_frames,
        "lost_by_counter": _lost_by_counter(store.run_path(summary.id)),
        "longest_queue_mib": most / 2**20,
        "processor_share": busy / wall,
    }


def acquire(link: Link, store: str, seconds: float) -> dict[str, Any]:
    """The job of the service that records and shows what it reads."""
    with observe(PacedSource(RATE_HZ), link.event) as rig:  # type: ignore[arg-type]
        return record(rig, seconds, RunStore(Path(store)), lambda: link.progress(0, "acquiring"))


def rate_limit_hz() -> float:
    """The highest of the doubled rates that is recorded without loss."""
    held = 0.0
    for doubling in range(MOST_DOUBLINGS):
        rate = RATE_HZ * 2**doubling
        source = PacedSource(rate, STEP_BUFFER_S)
        with tempfile.TemporaryDirectory() as folder:
            found = record(source, STEP_S, RunStore(Path(folder)))  # type: ignore[arg-type]
        print(f"{rate:g} Hz: {found['lost_by_counter']} lost", flush=True)
        if found["lost_by_counter"]:
            break
        held = rate
    return held


def _lost_by_counter(path: Path) -> int:
    """Frames of the file that do not hold their own number."""
    lost, at = 0, 0
    with open_run(path) as file:
        column = file["entry/data/samples"]
        for start in range(0, column.shape[0], 1 << 20):
            counts = np.round(column[start : start + (1 << 20), 0] / COUNTER_STEP_V)
            wanted = (np.arange(counts.size) + at) % 2**24
            lost += int(np.sum(counts != wanted))
            at += counts.size
    return lost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    limit = rate_limit_hz()
    seen = service_load.measure(options.seconds, CLIENTS, READS_PER_S, alone=True)
    reads_ms = 1e3 * np.quantile(seen["reads"], (0.5, 0.99))
    report = {
        **seen["acquired"],
        "clients": CLIENTS,
        "live_messages_per_s_each": seen["frames"] / CLIENTS / options.seconds,
        "notices_of_drops": seen["dropped"],
        "clients_closed": seen["gone"],
        "reads_median_ms": reads_ms[0],
        "reads_p99_ms": reads_ms[1],
        "service_processor_share": seen["service_s"] / options.seconds,
        "rate_limit_hz": limit,
        "headroom": limit / RATE_HZ,
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
