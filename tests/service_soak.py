"""What requests, events and clients leave behind in the service's memory: next to nothing.

The short form of the hour's soak (`benchmarks/service_load.py --seconds 3600`): not the resident
memory, which a minute cannot tell from noise, but what the interpreter still holds after each
thousand of requests, events and clients, everything with a bound being full before.
"""

import gc
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
from websockets.sync.client import connect

from daq.importers import import_folder
from daq.service.settings import JobSettings, LiveSettings, ServerSettings
from tests.service_data import make_folder
from tests.service_live import Running, running

LIMITS = {
    "live": LiveSettings(history=10, queue=4),
    "jobs": JobSettings(keep=10),
    "server": ServerSettings(requests_per_s=1e6, request_burst=10**6),
}
READS = ("/health", "/rigs", "/jobs", "/campaigns", "/runs", "/metrics", "/campaigns/{c}",
         "/campaigns/{c}/runs/{r}/envelope", "/no-such-thing")  # fmt: skip
# An hour of the load that the service is made for: 50 requests and 19 events a second.
REQUESTS, EVENTS = 50 * 3600, 19 * 3600
ROUNDS = 20


def work(server: Running, rounds: int) -> None:
    """A round: each kind of read, a command, 30 events, two live clients of which one reads."""
    address = server.url.replace("http", "ws") + "/api/v1/live/ws"
    with server.client() as client:
        row = client.get("/runs").json()["items"][0]
        for _ in range(rounds):
            for path in READS:
                client.get(path.replace("{c}", row["campaign"]).replace("{r}", row["name"]))
            client.post("/rigs/simulated/lock", json={"takeover": True})
            with connect(address) as reader, connect(address):
                for _ in range(30):
                    server.service.bus.publish("waveform", {"rate_hz": 1.0}, np.zeros((100, 8)))
                reader.recv(10)


def held(server: Running) -> int:
    """Bytes that the interpreter holds once all clients have gone."""
    end = time.monotonic() + 20
    while server.service.bus.clients:
        assert time.monotonic() < end
        time.sleep(0.01)
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def soak(folder: Path) -> float:
    """Bytes that an hour of work leaves. Of two stretches the better one: what is lost for good
    is lost in both."""
    with running(folder / "data", **LIMITS) as server:
        import_folder(make_folder(folder / "sines"), server.service.store)
        work(server, 5)
        tracemalloc.start()
        try:
            work(server, 5)
            marks = [held(server)]
            for _ in range(2):
                work(server, ROUNDS)
                marks.append(held(server))
        finally:
            tracemalloc.stop()
    left = min(np.diff(marks)) / ROUNDS
    return float(left * max(REQUESTS / (len(READS) + 1), EVENTS / 30))


if __name__ == "__main__":
    print(soak(Path(sys.argv[1])))
