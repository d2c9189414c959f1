"""A campaign of the real service on a sound card, struck while it drives and records.

The card is the audio loop of the drivers' fault matrix, whose witness times the silence. A sine
that another program plays on the loop stands for the limit cycle: taken away once the campaign
forces, it is entrained, and the recording begins.

| what strikes                | who notices                        | silent within |
|-----------------------------|------------------------------------|---------------|
| full disk                   | the run's writer, the campaign     | 500 ms        |
| kill -9 of the service      | the campaign's process (pipe end)  | 200 ms        |
"""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from drivers.types import Channel
from tests.emulators.card import LIMITS, SETTINGS
from tests.emulators.pulse import CHANNELS, MAP, PulseLoop

pytestmark = [pytest.mark.component("PortAudio"), pytest.mark.component("PulseAudio")]

ROOT = Path(__file__).resolve().parents[1]
SINE_HZ, SINE_RATE_HZ = 170.0, 8000
PLAN = {
    "record_s": 2.0,
    "strategy": "step",
    "conditions": [{"frequency_hz": 180.0, "amplitude_v": 1.0}],
}
CARD = {
    **asdict(SETTINGS),
    "channels": [asdict(Channel("p1", "pressure", "Pa", volts_per_unit=0.05, full_scale_v=2.0))],
    "latency_s": 0.03,  # part of the time to silence
    "limits": asdict(LIMITS),
}


@contextmanager
def limit_cycle(loop: PulseLoop) -> Iterator[subprocess.Popen[bytes]]:
    """A sine on the loop's first channel, by another program."""
    wave = np.zeros((60 * SINE_RATE_HZ, CHANNELS), np.float32)
    wave[:, 0] = 0.2 * np.sin(2 * np.pi * SINE_HZ / SINE_RATE_HZ * np.arange(len(wave)))
    path = loop.folder / "sine"
    wave.tofile(path)
    options = ["--raw", "--format=float32le", f"--rate={SINE_RATE_HZ}", f"--channels={CHANNELS}"]
    options += [f"--channel-map={MAP}", "--latency-msec=50", "-d", "rig"]
    command = ["pacat", "-s", f"unix:{loop.socket}", *options, str(path)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as player:
        try:
            yield player
        finally:
            player.kill()


@dataclass
class Service:
    """`entrain serve` in a process of its own."""

    process: subprocess.Popen[str]
    api: httpx.Client

    def family(self) -> set[int]:
        """Every process that descends from it."""
        parents = {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    words = (entry / "stat").read_text().rpartition(")")[2].split()
                except OSError:
                    continue
                if words[0] != "Z":
                    parents[int(entry.name)] = int(words[1])
        found = {self.process.pid}
        while more := {pid for pid, parent in parents.items() if parent in found} - found:
            found |= more
        return found

    def fill_disk(self, full: bool) -> None:
        """A limit on the size of files stands for the full disk: writes fail just the same."""
        most = 0 if full else resource.RLIM_INFINITY
        for pid in self.family():
            with suppress(ProcessLookupError):  # it has ended meanwhile
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))

    def recording(self, loop: PulseLoop) -> str:
        """Start the campaign; returns its job while the forced run is being recorded."""
        with limit_cycle(loop) as player:
            job = self.api.post("/campaigns", json={"rig": "card", "plan": PLAN}).json()["id"]
            self.until(job, "going to 180.00 Hz")
            player.kill()
            self.until(job, "entrained with 1 V")
        return str(job)

    def until(self, job: str, words: str) -> None:
        """Poll the job's log, as a client would."""
        end = time.monotonic() + 40
        while words not in (said := " ".join(self.api.get(f"/jobs/{job}/log").json())):
            state = self.api.get(f"/jobs/{job}").json()
            assert state["state"] in ("queued", "running"), (said, state["error"])
            assert time.monotonic() < end, (said, state)
            time.sleep(0.02)

    def ended(self, job: str) -> dict[str, Any]:
        """The job, once it is over."""
        end = time.monotonic() + 20
        while True:
            state: dict[str, Any] = self.api.get(f"/jobs/{job}").json()
            if state["state"] not in ("queued", "running"):
                return state
            assert time.monotonic() < end, state
            time.sleep(0.05)


@pytest.fixture
def loop() -> Iterator[PulseLoop]:
    with PulseLoop() as loop:
        yield loop


@pytest.fixture
def service(loop: PulseLoop, tmp_path: Path) -> Iterator[Service]:
    rigs = {"card": {"driver": "soundcard", "options": CARD}}
    environment = os.environ | {
        "ENTRAIN_DATA_DIR": str(tmp_path),
        "ENTRAIN_RIGS": json.dumps(rigs),
        "ENTRAIN_SERVER__PORT": "0",
        "ENTRAIN_LOG__LEVEL": "error",
    }
    with subprocess.Popen(
        [sys.executable, "-m", "daq.cli", "serve"],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=environment,
    ) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[3]
        try:
            with httpx.Client(base_url=f"{address}/api/v1", timeout=20, trust_env=False) as api:
                yield Service(process, api)
        finally:
            process.terminate()


def struck(loop: PulseLoop, within_s: float) -> float:
    """How long it still sounded after now, told apart from what goes on for longer."""
    since = loop.heard().shape[0]
    time.sleep(within_s + 0.3)
    return loop.sounded_s(since)


def test_silence_whatever_strikes(loop: PulseLoop, service: Service) -> None:
    job = service.recording(loop)
    # Who asks meanwhile what the card is does not open it a second time.
    assert service.api.get("/rigs/card/facts").json()["type"] == "/problems/running"
    service.fill_disk(True)
    full_s = struck(loop, 0.5)
    service.fill_disk(False)
    print(f"full disk: silent after {1e3 * full_s:.0f} ms")
    ended = service.ended(job)
    assert full_s <= 0.5
    assert ended["state"] == "failed"
    assert "cannot be written" in ended["error"]

    job = service.recording(loop)
    family = service.family()
    os.kill(service.process.pid, signal.SIGKILL)
    killed_s = struck(loop, 0.2)
    service.process.wait(5)
    print(f"kill -9 of the service: silent after {1e3 * killed_s:.0f} ms")
    assert killed_s <= 0.2
    end = time.monotonic() + 10
    while left := [pid for pid in family if Path(f"/proc/{pid}").exists()]:
        assert time.monotonic() < end, f"left behind: {left}"
        time.sleep(0.05)
