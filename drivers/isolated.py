"""Any rig in a process of its own: what happens to the service cannot keep a tone sounding.

A service that crashes, is killed or hangs in a long computation leaves the rig's process alone;
that one notices (see `drivers.isolated_process`) and silences. It also keeps the device's thread
away from the service's interpreter lock, under which callbacks come late.
"""

import contextlib
import itertools
import queue
import threading
import time
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

from drivers.blocks import enough, take
from drivers.clock import MonotonicClock
from drivers.errors import DeviceLost, DeviceTimeout, DriverError, SettingError
from drivers.isolated_link import (
    Call,
    Delivery,
    Factory,
    Hello,
    Reply,
    new_board,
    rig_context,
    rig_process,
)
from drivers.isolated_process import serve
from drivers.types import Block, Channel, OutputLimits, StreamStatus, Tone, require

OPEN_S = 20.0  # a fresh interpreter with NumPy and a vendor's library
CALL_S = 5.0
QUEUE = 1000  # blocks of 10 ms that may wait here for a reader; after that they wait over there


class IsolatedRig:
    """`DuplexRig` and `EmergencyStop` for the rig that `factory` opens in another process.

    `factory` must be picklable: a module's function or a `functools.partial` of one. What it
    raises on opening is raised here; `DeviceLost` when its process dies.
    """

    def __init__(self, factory: Factory) -> None:
        context = rig_context()
        self._control, control = context.Pipe()
        self._data, data = context.Pipe(duplex=False)
        self._board = new_board()
        self._process = rig_process(serve, factory, control, data, self._board)
        self._process.start()
        # This side's copies, or the pipe would not end with the process.
        control.close()
        data.close()
        self._silences = itertools.count(1)
        self._stops = itertools.count(1)
        self._deliveries: queue.Queue[Delivery] = queue.Queue(QUEUE)
        self._call_lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._replies: queue.SimpleQueue[Reply | None] = queue.SimpleQueue()
        self._status = StreamStatus(running=False)
        self._seen_frames = 0
        self._pending: list[Block] = []
        self._stream = 0
        self._running = self._closed = False
        self._clock = MonotonicClock()
        hello = self._greeting()
        self._hello = hello
        self._rate_hz = hello.sample_rate_hz
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._listen, self._receive)
        ]
        for thread in self._threads:
            thread.start()

    def _greeting(self) -> Hello:
        greeting: object = None
        with contextlib.suppress(EOFError, OSError):
            if self._control.poll(OPEN_S):
                greeting = self._control.recv()
        if isinstance(greeting, Hello):
            return greeting
        self._process.kill()
        self._process.join()
        if isinstance(greeting, Exception):
            raise greeting
        raise DeviceLost(f"the rig's process did not open its device within {OPEN_S} s")

    def _listen(self) -> None:
        try:
            while True:
                message: Reply | StreamStatus = self._control.recv()
                if isinstance(message, Reply):
                    self._status = message.status
                    self._replies.put(message)
                else:
                    self._status = message
        except (EOFError, OSError):
            self._note_end()
            self._replies.put(None)

    def _note_end(self) -> None:
        """Either pipe ended; no fault where the rig itself was told to close."""
        fault = None if self._closed else "device lost: the rig's process ended"
        self._status = replace(self._status, running=False, output_v=0.0, fault=fault)

    def _receive(self) -> None:
        """Keep the pipe flowing: what is of an older stream, or not asked for, is let go."""
        try:
            while True:
                self._enqueue(self._data.recv())
        except (EOFError, OSError):
            self._note_end()
            self._enqueue(Delivery(self._stream, None, self._gone()))

    def _enqueue(self, delivery: Delivery) -> None:
        while self._running and delivery.stream == self._stream:
            with contextlib.suppress(queue.Full):
                self._deliveries.put(delivery, timeout=0.05)
                return

    def _gone(self) -> DeviceLost:
        return DeviceLost(f"{self.name}: device lost: the rig's process ended")

    def _call(self, verb: str, *arguments: Any) -> Any:
        number = next(self._numbers)
        call = Call(verb, arguments, self._board.silences, self._stream, number)
        with self._call_lock:
            try:
                self._control.send(call)
            except OSError as error:
                raise self._gone() from error
            reply = self._answer(call, time.monotonic() + CALL_S)
        self._rate_hz = reply.sample_rate_hz
        if reply.error is not None:
            raise reply.error
        return reply.value

    def _answer(self, call: Call, deadline: float) -> Reply:
        """The reply to `call`; late ones to calls that were given up are passed over."""
        while True:
            try:
                reply = self._replies.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise DeviceTimeout(f"{self.name}: no answer to {call.verb} in time") from None
            if reply is None:
                self._replies.put(None)  # for the next call
                raise self._gone()
            if reply.number == call.number:
                return reply

    # -- description -----------------------------------------------------------------------

    @property
    def name(self) -> str:
        return self._hello.name

    @property
    def clock(self) -> MonotonicClock:
        return self._clock

    @property
    def channels(self) -> tuple[Channel, ...]:
        return self._hello.channels

    @property
    def sample_rate_hz(self) -> float:
        return self._rate_hz

    @property
    def limits(self) -> OutputLimits:
        return self._hello.limits

    @property
    def process_id(self) -> int:
        """The rig process's id, for supervision."""
        return int(self._process.pid or 0)

    # -- input -----------------------------------------------------------------------------

    def start(self) -> None:
        """Begin; raises what the rig's own `start` raises."""
        if self._closed:
            raise SettingError(f"{self.name}: start() after close(); open the rig again")
        if self._running:
            raise SettingError(f"{self.name}: start() while running; stop() first")
        self._stream += 1
        self._pending = []
        self._seen_frames = 0
        self._deliveries = queue.Queue(QUEUE)
        self._running = True
        try:
            self._call("start")
        except BaseException:
            self._running = False
            raise

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        """Next `frames` frames; fewer only right before lost ones."""
        require(frames >= 1, "frames", frames, ">= 1")
        if not self._running:
            raise SettingError(f"{self.name}: read() of a stream that is not running; start() it")
        deadline = time.monotonic() + timeout_s
        while not enough(self._pending, frames):
            self._next(frames, deadline, timeout_s)
        block = take(self._pending, frames, self._rate_hz)
        self._seen_frames = block.end_frame
        return block

    def _next(self, frames: int, deadline: float, timeout_s: float) -> None:
        try:
            delivery = self._deliveries.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            have = sum(block.frames for block in self._pending)
            raise DeviceTimeout(
                f"{self.name}: {have} of {frames} frames within {timeout_s} s"
            ) from None
        if delivery.block is None:
            raise delivery.error or self._gone()
        self._pending.append(delivery.block)

    # -- output ----------------------------------------------------------------------------

    def drive(self, tone: Tone) -> Tone:
        reached: Tone = self._call("drive", tone)
        return reached

    def feed(self) -> None:
        # Two threads at once may count as one feeding, which is as good.
        self._board.feeds += 1

    def silence(self) -> None:
        # Each call writes a number that was never there before, so none goes unseen.
        self._board.silences = next(self._silences)

    def emergency_stop(self, reason: str = "emergency stop") -> None:
        self._board.reason = reason.encode()[:199]
        self._board.stops = next(self._stops)
        self.silence()

    def reset_stop(self) -> None:
        self._call("reset_stop")

    # -- life ------------------------------------------------------------------------------

    def status(self) -> StreamStatus:
        status = self._status
        return replace(status, frames=max(status.frames, self._seen_frames))

    def stop(self) -> None:
        if not self._running:
            return
        self.silence()
        self._running = False
        with contextlib.suppress(DeviceLost):
            self._call("stop")

    def close(self) -> None:
        if self._closed:
            return
        self.silence()
        self._running = False
        self._closed = True
        with contextlib.suppress(DriverError):
            self._call("close")
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        for thread in self._threads:
            thread.join()
        self._control.close()
        self._data.close()
        self._process.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
