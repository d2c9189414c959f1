"""The live bus: order, resume, bounded queues, binary frames."""

import asyncio
import json
import struct
import threading

import numpy as np

from daq.service.events import MAGIC, Bus


def test_a_client_sees_everything_in_order_from_any_thread() -> None:
    async def scenario() -> list[int]:
        bus = Bus(history=10, queue=1000)
        bus.attach(asyncio.get_running_loop())
        client = bus.subscribe()

        def publish() -> None:
            for value in range(100):
                bus.publish("level", {"value": value})

        threads = [threading.Thread(target=publish) for _ in range(4)]
        for thread in threads:
            thread.start()
        seen: list[int] = []
        while len(seen) < 400:
            seen += [event.seq for event in await client.next(5)]
        return seen

    assert asyncio.run(scenario()) == list(range(1, 401))


def test_a_lagging_client_loses_the_oldest_and_is_told_how_many() -> None:
    async def scenario() -> tuple[list[int], int, int]:
        bus = Bus(history=100, queue=5)
        bus.attach(asyncio.get_running_loop())
        slow, quick = bus.subscribe(), bus.subscribe()
        got = 0
        for value in range(12):
            bus.publish("level", {"value": value})
            got += len(await quick.next(5))
        return [event.seq for event in await slow.next(5)], slow.dropped, got

    kept, dropped, quick = asyncio.run(scenario())
    assert (kept, dropped, quick) == ([8, 9, 10, 11, 12], 7, 12)


def test_of_pictures_only_the_newest_waits_and_of_a_crowd_nobody_is_left_out() -> None:
    """Fifty clients, more than are served in one turn of the loop, and none of them in a hurry."""

    async def scenario() -> list[tuple[list[int], int]]:
        bus = Bus(history=10, queue=5)
        bus.attach(asyncio.get_running_loop())
        clients = [bus.subscribe() for _ in range(50)]
        for value in range(20):
            bus.publish("levels", {"rig": f"r{value % 2}"})
        bus.publish("log", {})
        last = await clients[-1].next(5)
        while last[-1].kind != "log":
            last += await clients[-1].next(5)
        rest = [([event.seq for event in await c.next(5)], c.dropped) for c in clients[:-1]]
        return [*rest, ([event.seq for event in last], clients[-1].dropped)]

    assert asyncio.run(scenario()) == [([19, 20, 21], 0)] * 50


def test_resume_and_what_is_too_old_counts_as_dropped() -> None:
    async def scenario() -> list[tuple[list[int], int]]:
        bus = Bus(history=10, queue=50)
        bus.attach(asyncio.get_running_loop())
        for value in range(30):
            bus.publish("level", {"value": value})
        out = []
        for since in (25, 5, 0):
            client = bus.subscribe(since=since)
            out.append(([event.seq for event in await client.next(5)], client.dropped))
        return out

    kept = list(range(21, 31))
    # who has seen nothing yet has lost nothing
    assert asyncio.run(scenario()) == [([26, 27, 28, 29, 30], 0), (kept, 15), (kept, 0)]


def test_a_first_visit_finds_more_than_its_queue_holds_and_lags_by_nothing() -> None:
    async def scenario() -> tuple[int, int]:
        bus = Bus(history=100, queue=5)
        bus.attach(asyncio.get_running_loop())
        for value in range(30):
            bus.publish("level", {"value": value})
        return bus.subscribe(since=0).dropped, bus.subscribe(since=1).dropped

    assert asyncio.run(scenario()) == (0, 24)


def test_kinds_filter_and_silence_is_no_error() -> None:
    async def scenario() -> tuple[int, int]:
        bus = Bus(history=10, queue=5)
        bus.attach(asyncio.get_running_loop())
        client = bus.subscribe(kinds=frozenset({"log"}))
        bus.publish("level", {})
        nothing = await client.next(0.05)
        bus.publish("log", {})
        return len(nothing), len(await client.next(5))

    assert asyncio.run(scenario()) == (0, 1)


def test_binary_frame_holds_float32_at_a_multiple_of_four() -> None:
    samples = np.array([[1.5, -2.0], [0.25, 3.0]])
    frame = Bus(10, 10).publish("wave", {"rate_hz": 8.0}, samples).binary
    assert frame[:4] == MAGIC
    (length,) = struct.unpack("<I", frame[4:8])
    head = json.loads(frame[8 : 8 + length])
    assert (8 + length) % 4 == 0
    assert (head["kind"], head["shape"], head["rate_hz"]) == ("wave", [2, 2], 8.0)
    read = np.frombuffer(frame[8 + length :], "<f4").reshape(head["shape"])
    np.testing.assert_array_equal(read, samples)
