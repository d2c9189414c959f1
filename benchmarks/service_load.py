"""Load on the service: live clients and requests beside an acquisition and running fits.

    python benchmarks/service_load.py --seconds 30

One process serves. In it a job acquires 8 channels at 51.2 kHz from a source that runs in real
time, through the product's own acquisition, live pictures and run writer, and analyses run one
after the other in the analysis lane. Another process holds the live clients (WebSocket), asks for
pages at a fixed rate, and starts a second rig and presses its emergency stop, again and again.
Printed: lost samples, times of answers and of the stop (and how many of these answers brought the
rig's own word that it is silent), events dropped, processor time, and the service's memory and
open files at the start and their medians in each quarter of the time (a soak is the same with
``--seconds 3600``).
"""

import argparse
import asyncio
import json
import os
import selectors
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
CASE = str(ROOT / "tests" / "data" / "b-flame-delay")
TEXT, BINARY, PING, PONG = 1, 2, 9, 10  # codes of WebSocket frames
READS = ("/health", "/rigs", "/jobs", "/campaigns", "/runs", "/campaigns/{c}", "{r}/envelope")


def serve(folder: Path, seconds: float, case: str, fit: bool) -> None:
    """The service's process: prints its address, later the acquisition's result.

    Meanwhile, with `fit`, identifications run one after the other.
    """
    from daq.importers import import_folder
    from daq.service import server as serving
    from daq.service.settings import RigSettings, ServerSettings, Settings

    rigs = {"simulated": RigSettings(options={"clock": "realtime"})}
    limits = ServerSettings(port=0, requests_per_s=1e5, request_burst=10**5)
    server = serving.make_server(Settings(data_dir=folder, rigs=rigs, server=limits))
    service = server.service
    import_folder(Path(case), service.store)
    (row,) = service.store.campaigns()
    job = service.jobs.submit(
        "acquire",
        "8 channels",
        "acquire_load:acquire",
        {"store": str(service.settings.store_dir), "seconds": seconds},
        lane="rig:source",
        about={"rig": "source"},
    )

    def keep_fitting() -> None:
        while job.state in ("queued", "running"):
            busy = [j for j in service.jobs.all() if j.lane == "analysis" and not j.finished]
            if fit and not busy:
                httpx.post(f"{address}/api/v1/campaigns/{row.id}/identifications", timeout=30)
            time.sleep(0.2)
        print(json.dumps(job.result), flush=True)

    with serving.listen("127.0.0.1", 0) as sock:
        address = f"http://127.0.0.1:{sock.getsockname()[1]}"
        print(json.dumps({"address": address, "campaign": row.id}), flush=True)
        threading.Thread(target=keep_fitting, daemon=True).start()
        server.run(sockets=[sock])


class LiveClient:
    """A WebSocket client that costs next to nothing: it reads frames and answers pings."""

    def __init__(self, url: str) -> None:
        address = httpx.URL(url)
        self.sock = socket.create_connection((address.host, address.port or 80), timeout=30)
        self.sock.sendall(
            b"GET /api/v1/live/ws HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
            b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        head, _, self._rest = self.sock.recv(4096).partition(b"\r\n\r\n")
        assert b" 101 " in head
        self.sock.setblocking(False)
        self._skip = 0  # what is still to come of the present frame

    def read(self, counts: dict[str, int]) -> bool:
        """What has come; false once the service has closed."""
        data = self.sock.recv(1 << 20)
        counts["bytes"] += len(data)
        at, data = 0, self._rest + data if self._rest else data
        at, self._skip = min(self._skip, len(data)), max(0, self._skip - len(data))
        while len(data) - at >= 14 or (len(data) - at >= 2 and data[at + 1] <= 11):
            code, length, begin = data[at] & 15, data[at + 1], at + 2
            if length >= 126:
                begin += 2 if length == 126 else 8
                length = int.from_bytes(data[at + 2 : begin])
            body = data[begin : begin + min(length, 20)]
            if code == PING:
                if len(body) < length:
                    break
                self.sock.sendall(bytes([0x80 | PONG, 0x80 | length, 0, 0, 0, 0]) + body)
            counts["dropped"] += body.startswith(b'{"kind":"dropped"')
            counts["frames"] += code in (TEXT, BINARY)
            at = begin + length
        if at > len(data):
            at, self._skip = len(data), at - len(data)
        self._rest = data[at:]
        return bool(data)


def drain(clients: list[LiveClient], until: float, counts: dict[str, int]) -> None:
    """Read what comes, until the time is over."""
    with selectors.DefaultSelector() as selector:
        for client in clients:
            selector.register(client.sock, selectors.EVENT_READ, client)
        while time.monotonic() < until:
            for key, _ in selector.select(0.1):
                if not key.data.read(counts):
                    counts["gone"] += 1
                    selector.unregister(key.fileobj)
            time.sleep(0.05)  # a browser paints sixty times a second at most


async def reader(
    url: str, campaign: str, rate: float, until: float, times: list[float], unanswered: list[str]
) -> None:
    async with httpx.AsyncClient(base_url=f"{url}/api/v1", timeout=30, trust_env=False) as client:
        detail = (await client.get(f"/campaigns/{campaign}")).json()
        run = f"/campaigns/{campaign}/runs/{detail['runs'][0]['name']}"
        pending: set[asyncio.Task[None]] = set()

        async def one(path: str) -> None:
            begun = time.perf_counter()
            try:
                answer = await client.get(path)
            except httpx.TransportError as error:  # such as a kept connection closed meanwhile
                unanswered.append(f"{path}: {error!r}")
                return
            times.append(time.perf_counter() - begun)
            assert answer.status_code == 200, answer.text

        number, begun = 0, time.monotonic()
        while time.monotonic() < until:
            path = READS[number % len(READS)].replace("{c}", campaign).replace("{r}", run)
            task = asyncio.create_task(one(path))
            pending.add(task)
            task.add_done_callback(pending.discard)
            number += 1
            await asyncio.sleep(begun + number / rate - time.monotonic())
        await asyncio.gather(*pending)


async def stopper(url: str, until: float, times: list[float], silent: list[bool]) -> None:
    """Stop a rig that runs (in real time, in a process of its own), and start it again."""
    rig = "/rigs/simulated"
    fresh = httpx.Limits(max_keepalive_connections=0)  # a kept one may be closed as it is used
    async with httpx.AsyncClient(
        base_url=f"{url}/api/v1", timeout=30, trust_env=False, limits=fresh
    ) as client:
        while time.monotonic() < until:
            watch = await client.post(f"{rig}/watch", json={"seconds": 3600})
            job = f"/jobs/{watch.json()['id']}"
            while (await client.get(job)).json()["message"] != "watching":
                await asyncio.sleep(0.1)
            begun = time.perf_counter()
            answer = await client.post(f"{rig}/emergency-stop")
            times.append(time.perf_counter() - begun)
            silent.append(answer.json()["confirmed"]["simulated"])
            while (await client.get(job)).json()["state"] == "running":
                await asyncio.sleep(0.1)
            await client.post(f"{rig}/reset")
            await asyncio.sleep(0.5)


async def load(
    url: str, campaign: str, clients: int, rate: float, seconds: float, stop: bool
) -> dict[str, Any]:
    """The clients' side; with `stop` a second rig is started and stopped meanwhile."""
    counts = {"bytes": 0, "frames": 0, "dropped": 0, "gone": 0}
    live = await asyncio.to_thread(lambda: [LiveClient(url) for _ in range(clients)])
    until = time.monotonic() + seconds
    reads: list[float] = []
    unanswered: list[str] = []
    stops: list[float] = []
    silent: list[bool] = []
    await asyncio.gather(
        reader(url, campaign, rate, until, reads, unanswered),
        *([stopper(url, until, stops, silent)] if stop else []),
        asyncio.to_thread(drain, live, until, counts),
    )
    for client in live:
        client.sock.close()
    told = {"reads": reads, "unanswered": unanswered, "stops": stops, "silent": silent}
    return told | counts


def wait_for(address: str) -> None:
    """Until the acquisition runs: its process imports first."""
    while True:
        jobs = httpx.get(f"{address}/api/v1/jobs").json()["items"]  # the newest first
        (job,) = (job for job in jobs if job["kind"] == "acquire")
        if job["message"] == "acquiring":
            return
        if job["error"]:
            raise RuntimeError(f"the acquisition failed: {job['error']}")
        time.sleep(0.1)


def memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    text = Path(f"/proc/{pid}/status").read_text()
    line = next(line for line in text.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


def open_files(pid: int) -> int:
    """Files and sockets that a process has open."""
    return len(os.listdir(f"/proc/{pid}/fd"))


def watch(pid: int, held: list[tuple[float, int]], over: threading.Event) -> None:
    """Note memory and open files every half second."""
    while not over.wait(0.5):
        held.append((memory_mb(pid), open_files(pid)))


def processor_s(pid: int) -> float:
    """Processor time that a process has had."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def quantiles(seconds: list[float]) -> str:
    ms = 1e3 * np.array(seconds)
    p50, p99 = np.quantile(ms, (0.5, 0.99))
    return f"n {ms.size}, median {p50:.1f} ms, p99 {p99:.1f} ms, worst {ms.max():.1f} ms"


def measure(
    seconds: float, clients: int, rate: float, case: str = CASE, alone: bool = False
) -> dict[str, Any]:
    """Serve under load and tell what came of it; `alone` leaves out fits and stops.

    Keys: `acquired` (what `acquire_load.acquire` returns), `reads`, `stops` (s),
    `silent`, `bytes`, `frames`, `dropped`, `gone`, `service_s` and `clients_s` (processor time),
    `held` (memory in MB and open files, every half second).
    """
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, str(ROOT / "benchmarks" / "service_load.py"), "--serve", folder]
        words += ["--seconds", str(seconds), "--case", case, *(["--alone"] if alone else [])]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)
        assert server.stdout is not None
        try:
            hello = json.loads(server.stdout.readline())
            address, campaign = hello["address"], hello["campaign"]
            wait_for(address)
            busy = processor_s(server.pid)
            held = [(memory_mb(server.pid), open_files(server.pid))]
            mine = time.process_time()
            over = threading.Event()
            watching = threading.Thread(target=watch, args=(server.pid, held, over))
            watching.start()
            try:
                seen = asyncio.run(load(address, campaign, clients, rate, seconds, not alone))
            finally:
                over.set()
                watching.join()
            busy = processor_s(server.pid) - busy
            mine = time.process_time() - mine
            acquired = json.loads(server.stdout.readline())
        finally:
            server.terminate()
            server.wait(30)
    return {**seen, "acquired": acquired, "service_s": busy, "clients_s": mine, "held": held}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--rate", type=float, default=50.0, help="requests a second")
    parser.add_argument("--case", default=CASE)
    parser.add_argument("--alone", action="store_true", help="without fits and stops")
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(Path(options.serve), options.seconds + 10, options.case, not options.alone)
        return
    seconds = options.seconds
    seen = measure(seconds, options.clients, options.rate, options.case, options.alone)
    got = seen["acquired"]
    print(f"{options.clients} live clients, {options.rate:g} requests/s, {seconds:g} s")
    print(f"acquisition     {got['frames']} frames of {got['channels']} channels at "
          f"{got['rate_hz']:g} Hz, {got['lost_frames']} lost, "
          f"{got['lost_by_counter']} by the counter in the file")  # fmt: skip
    print(f"reads           {quantiles(seen['reads'])}, {len(seen['unanswered'])} unanswered")
    if seen["stops"]:
        print(f"emergency stop  {quantiles(seen['stops'])}, "
              f"silence confirmed in {sum(seen['silent'])}")  # fmt: skip
    print(f"live            {seen['bytes'] / seconds / 1e6:.2f} MB/s in all, "
          f"{seen['frames'] / options.clients / seconds:.1f} messages/s each, "
          f"{seen['dropped']} notices of drops, {seen['gone']} closed")  # fmt: skip
    print(f"processor       the service {100 * seen['service_s'] / seconds:.0f} % of a core, "
          f"the acquisition {100 * got['processor_share']:.0f} %, "
          f"the clients {100 * seen['clients_s'] / seconds:.0f} %")  # fmt: skip
    for name, unit, row in (("memory", " MB", 0), ("open files", "", 1)):
        values = [h[row] for h in seen["held"]]
        quarters = [f"{np.median(part):.0f}{unit}" for part in np.array_split(values, 4)]
        print(f"{name:<15} {values[0]:.0f}{unit} at first, {', '.join(quarters)} in the quarters")


if __name__ == "__main__":
    main()
