"""Devices at the far end of a real pseudo-terminal: a microcontroller, and things of lines.

The near end's name is what a driver opens. The emulator keeps its own copy of the near end open,
or it would be told that the line is dead whenever a driver closes it. `unplug` closes both ends.
"""

import os
import pty
import select
import struct
import threading
import time
import tty
from types import TracebackType
from typing import Self

import numpy as np

from drivers.microcontroller import DATA, INFO, START, STOP
from drivers.packets import Packet, encode, parse


class Terminal:
    """A pty pair and a thread that calls `handle` with what came, or with nothing every 2 ms."""

    def __init__(self) -> None:
        self._far, self._near = pty.openpty()
        tty.setraw(self._far)
        tty.setraw(self._near)
        self.name = os.ttyname(self._near)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def handle(self, data: bytes) -> None:
        raise NotImplementedError

    def send(self, data: bytes) -> None:
        while data and not self._ended.is_set():
            # A driver that does not read must not block the emulator's end.
            if select.select([], [self._far], [], 0.05)[1]:
                data = data[os.write(self._far, data) :]

    def _run(self) -> None:
        while not self._ended.is_set():
            ready = select.select([self._far], [], [], 0.002)[0]
            self.handle(os.read(self._far, 4096) if ready else b"")

    def unplug(self) -> None:
        """Harmless twice."""
        if not self._ended.is_set():
            self._ended.set()
            self._thread.join()
            os.close(self._near)
            os.close(self._far)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.unplug()


class Lines(Terminal):
    """Answers each line by `answer`; `mute` swallows them."""

    end = b"\n"

    def __init__(self) -> None:
        super().__init__()
        self._rest = b""
        self.mute = False
        self.asked: list[str] = []

    def handle(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(self.end)
        for line in lines:
            self.asked.append(line.decode("ascii"))
            if not self.mute:
                self.send(self.answer(self.asked[-1]).encode("ascii") + self.end)

    def answer(self, line: str) -> str:
        raise NotImplementedError


class LineTone(Lines):
    """Generator and amplifier in one: keeps what it is told, within its own limits."""

    def __init__(self) -> None:
        super().__init__()
        self.values = {"FREQ": 100.0, "AMPL": 1.0, "GAIN": 0.0, "MUTE": 0.0, "TEMP": 41.5}

    def answer(self, line: str) -> str:
        word, _, value = line.partition(" ")
        if word == "OFF":
            self.values["AMPL"] = 0.0
            return "OK"
        if word not in self.values:
            return "ERR unknown command"
        if value:
            if word == "FREQ" and float(value) > 5000.0:
                return "ERR out of range"
            self.values[word] = float(value)
        return f"OK {self.values[word]:.3f}"


class Alicat(Lines):
    """Unit A, which follows its set point exactly."""

    end = b"\r"

    def __init__(self) -> None:
        super().__init__()
        self.slpm = 0.0
        self.garbled = False

    def answer(self, line: str) -> str:
        if line.startswith("AS"):
            self.slpm = min(float(line[2:]), 20.0)
        if self.garbled:
            return "A +014.70 +0x5.00"
        return f"A +014.70 +025.00 {self.slpm:+07.3f} {self.slpm:+07.3f} {self.slpm:07.3f} Air"


class Board(Terminal):
    """Two channels at 8 kHz, 64 frames a packet; channel 1 counts frames, channel 2 is a sine."""

    rate_hz = 8000
    volts_per_code = 1e-4
    frames = 64

    def __init__(self) -> None:
        super().__init__()
        self._rest = b""
        self._started_s: float | None = None
        self._next = 0
        self.first_frame = 0  # where the sequence number starts, to test its wrap
        self.drop_packets = 0  # so many packets are not sent
        self.corrupt_packets = 0  # so many are sent with a flipped bit
        self.noise = b""  # sent between two packets, once
        self.frozen = False

    def handle(self, data: bytes) -> None:
        parsed = parse(self._rest + data)
        self._rest = parsed.rest
        for packet in parsed.packets:
            if packet.kind == INFO:
                info = struct.pack("<IBf", self.rate_hz * 1000, 2, self.volts_per_code)
                self.send(encode(Packet(INFO, 0, info)))
            elif packet.kind == START:
                self._started_s, self._next = time.monotonic(), 0
            elif packet.kind == STOP:
                self._started_s = None
        while self._started_s is not None and not self.frozen and self._due(self._started_s):
            self._emit()

    def _due(self, started_s: float) -> bool:
        elapsed = (time.monotonic() - started_s) * self.rate_hz
        return self._next + self.frames <= elapsed and not self._ended.is_set()

    def _emit(self) -> None:
        n = self._next + np.arange(self.frames)
        sine = np.round(10_000 * np.sin(2 * np.pi * 100.0 * n / self.rate_hz))
        codes = np.column_stack([n % 30_000, sine]).astype("<i2")
        packet = encode(Packet(DATA, self._next % 2**32, codes.tobytes()))
        self._next += self.frames
        if self.drop_packets:
            self.drop_packets -= 1
            return
        if self.corrupt_packets:
            self.corrupt_packets -= 1
            packet = packet[:40] + bytes([packet[40] ^ 0x10]) + packet[41:]
        if self.noise:
            packet, self.noise = self.noise + packet, b""
        self.send(packet)
