"""The rig's own process: it holds the device, and silences it when the service is gone.

One loop looks, every `LOOK_S`, at the pipe and at the shared numbers. The pipe ends when the
service does, whatever killed it: the kernel closes it. What follows is the same as for every other
way out, the guard's ramp to zero and a closed device. A service that hangs without dying does not
feed, and the guard's dead-man timer, which runs on the device's own thread, does the rest.
"""

import contextlib
import os
import pickle
import signal
import threading
import time
from multiprocessing.connection import Connection

from drivers.errors import DriverError, SettingError
from drivers.isolated_link import Board, Call, Delivery, Factory, Hello, Reply
from drivers.protocols import DuplexRig, EmergencyStop

LOOK_S = 0.005
STATUS_S = 0.02
BLOCK_S = 0.01
PRIORITY = -10
VERBS = ("start", "stop", "drive", "reset_stop", "close")


def serve(factory: Factory, control: Connection, data: Connection, board: Board) -> None:
    """Open the rig, say what it is, and serve it until told to close or until the pipe ends."""
    # The terminal sends its interrupt to every process in front: the service decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(AttributeError, OSError):
        # What feeds a converter goes before what computes; where the system allows it.
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    closing = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: closing.set())
    try:
        rig = factory()
    except Exception as error:
        control.send(portable(error))
        return
    with rig:
        limits = rig.limits
        control.send(Hello(rig.name, tuple(rig.channels), rig.sample_rate_hz, limits))
        with contextlib.suppress(EOFError, OSError):
            _Server(rig, control, data, board, closing).run()
        rig.silence()


def portable(error: Exception) -> Exception:
    """`error` itself where it survives the way to another process, its text otherwise."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return DriverError(f"{type(error).__name__}: {error}")
    return error


class _Server:
    def __init__(
        self,
        rig: DuplexRig,
        control: Connection,
        data: Connection,
        board: Board,
        closing: threading.Event,
    ) -> None:
        self._rig = rig
        self._control = control
        self._data = data
        self._board = board
        self._closing = closing
        self._feeds = self._silences = self._stops = 0
        self._reader: threading.Thread | None = None
        self._reading = threading.Event()

    def run(self) -> None:
        told_s = 0.0
        while not self._closing.is_set():
            if self._control.poll(LOOK_S):
                self._answer(self._control.recv())
            self._look()
            if time.monotonic() - told_s >= STATUS_S:
                told_s = time.monotonic()
                self._control.send(self._rig.status())

    def _look(self) -> None:
        board = self._board
        silences, stops, feeds = board.silences, board.stops, board.feeds
        if stops != self._stops and isinstance(self._rig, EmergencyStop):
            self._rig.emergency_stop(board.reason.decode("utf-8", "replace"))
        if silences != self._silences:
            self._rig.silence()
        if feeds != self._feeds:
            self._rig.feed()
        self._silences, self._stops, self._feeds = silences, stops, feeds

    def _answer(self, call: Call) -> None:
        self._look()
        value, error = None, None
        try:
            value = self._perform(call)
        except Exception as raised:
            error = portable(raised)
        rate_hz = self._rig.sample_rate_hz
        self._control.send(Reply(call.number, value, error, self._rig.status(), rate_hz))

    def _perform(self, call: Call) -> object:
        if call.verb not in VERBS:
            raise SettingError(f"verb={call.verb!r} is not one of {VERBS}")
        if call.verb == "drive" and call.silences != self._board.silences:
            return call.arguments[0]  # overtaken by a silence, as if it had come right after
        if call.verb in ("stop", "close"):
            self._end_reading()
        if call.verb == "close":
            self._closing.set()
        result = getattr(self._rig, call.verb)(*call.arguments)
        if call.verb == "start":
            self._reading.set()
            self._reader = threading.Thread(target=self._read, args=(call.stream,), daemon=True)
            self._reader.start()
        return result

    def _read(self, stream: int) -> None:
        """Pass blocks on; when the service lags the pipe fills, and the rig's own ring counts."""
        frames = max(1, round(BLOCK_S * self._rig.sample_rate_hz))
        while self._reading.is_set():
            try:
                delivery = Delivery(stream, self._rig.read(frames))
            except Exception as error:
                with contextlib.suppress(OSError):
                    self._data.send(Delivery(stream, None, portable(error)))
                return
            try:
                self._data.send(delivery)
            except OSError:
                return  # the service is gone; the other thread has noticed as well

    def _end_reading(self) -> None:
        self._reading.clear()
        # It is in `read`, or held up by a full pipe, which the service empties meanwhile.
        if self._reader is not None:
            self._reader.join()
            self._reader = None
