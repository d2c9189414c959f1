"""The plant behind a microcontroller's packets on a serial terminal, paced by the machine's clock.

Speaks what `drivers.microcontroller` reads: INFO, START, STOP from the host; INFO and DATA (int16
codes, numbered by their first frame) from here. The plant runs in real time whether somebody
listens or not. When it falls behind it catches up, which is late but right; beyond `late_s` it
stops with a fault and sends nothing more. What the host does not fetch in time is lost in whole
packets, and the numbering shows it.
"""

import threading
import time
from types import TracebackType
from typing import Self

import numpy as np

from drivers.microcontroller import DATA, INFO, INFO_PAYLOAD, START, STOP
from drivers.packets import Packet, encode, parse
from drivers.types import FloatArray
from simulated_rig.hil.device import Device
from simulated_rig.hil.ports import Terminal

FRAMES = 64  # a packet
CODES = 32768


class Board:
    """Serves `device` on `terminal.name` from `__enter__` to `__exit__`, or until its fault."""

    def __init__(self, device: Device, full_scale_v: float) -> None:
        self.device = device
        self.terminal = Terminal(self._received)
        self._volts_per_code = full_scale_v / CODES
        self._rest = b""
        self._started: bool = False
        self._sequence = 0
        self.unread_packets = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._pace, name="HIL plant", daemon=True)

    def __enter__(self) -> Self:
        self.terminal.__enter__()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join(5.0)
        self.terminal.__exit__(kind, error, trace)

    def _received(self, data: bytes) -> None:
        parsed = parse(self._rest + data)
        self._rest = parsed.rest
        for packet in parsed.packets:
            if packet.kind == INFO:
                rate_mhz = round(self.device.rate_hz * 1000)
                info = INFO_PAYLOAD.pack(rate_mhz, 3, self._volts_per_code)
                self.terminal.send(encode(Packet(INFO, 0, info)))
            elif packet.kind == START:
                self._sequence, self._started = 0, True
            elif packet.kind == STOP:
                self._started = False

    def _pace(self) -> None:
        watch, rate = self.device.watch, self.device.rate_hz
        start, done, silence = time.monotonic(), 0, np.zeros(FRAMES)
        while not self._ended.is_set() and watch.fault is None:
            behind = time.monotonic() - (start + (done + FRAMES) / rate)
            if behind < 0:
                self._ended.wait(-behind)
                continue
            watch.late(behind)
            if watch.fault is None:
                volts = self.device.process(silence)
                done += FRAMES
                self._send(volts / self._volts_per_code)

    def _send(self, codes: FloatArray) -> None:
        if not self._started or self.device.watch.fault is not None:
            return
        clipped = np.clip(np.round(codes), -CODES, CODES - 1).astype("<i2")
        packet = encode(Packet(DATA, self._sequence % 2**32, clipped.tobytes()))
        self._sequence += FRAMES
        if not self.terminal.send(packet) and not self._ended.is_set():
            # The host's gap, told by the numbering; the plant itself is none the worse.
            self.unread_packets += 1
