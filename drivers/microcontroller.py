"""Data acquisition by a microcontroller on a serial port, in packets (`drivers.packets`).

Host to device: INFO, START, STOP, without payload. Device to host: INFO (rate in mHz u32,
channels u8, volts per code f32), and DATA: frames of one int16 a channel, whose sequence number
is the index of the first frame since START (mod 2³²). What is missing between two packets is
therefore known to the frame, whether the wire lost it or the CRC refused it.

The device converts all channels of a frame at once or says so in its own documentation; skew is
measured, not assumed (`entrain check`).
"""

import struct
import threading
import time

import numpy as np

from drivers.blocks import enough, take
from drivers.errors import DeviceFault, DeviceLost, DeviceTimeout, DriverError, SettingError
from drivers.packets import Packet, encode, parse
from drivers.ring import Ring
from drivers.serialport import SerialPort
from drivers.types import Block, Channel, Flag, Gap, StreamStatus, require

INFO, START, STOP, DATA = range(1, 5)
INFO_PAYLOAD = struct.Struct("<IBf")
WRAP = 2**32
RAIL = 32767
POLL_S = 0.002
SILENT_S = 1.0  # a started device that sends nothing for so long is lost


class MicrocontrollerInput:
    """`PressureInput` on a serial port.

    Raises `DeviceTimeout` when the device does not answer INFO in `timeout_s`, `SettingError`
    when it has another number of channels than told here.
    """

    def __init__(
        self,
        port: SerialPort,
        channels: tuple[Channel, ...],
        timeout_s: float = 1.0,
        ring_s: float = 10.0,
    ) -> None:
        self._port = port
        self._timeout_s = timeout_s
        self._channels = channels
        self._rest = b""
        self._damaged = 0
        rate_mhz, count, self._volts_per_code = self._ask_info(timeout_s)
        require(
            count == len(channels),
            "channels",
            len(channels),
            f"the number of channels of {port.address}, which has {count}",
        )
        require(rate_mhz > 0, f"{port.address}: rate in mHz", rate_mhz, "> 0")
        self._rate_hz = rate_mhz / 1000.0
        self._ring_s = ring_s
        self._running = False
        self._reset()

    def _reset(self) -> None:
        self._ring = Ring(round(self._ring_s * self._rate_hz), len(self._channels))
        self._pending: list[Block] = []
        self._gaps: list[Gap] = []
        self._next = 0
        self._damaged = 0
        self._failed: DriverError | None = None
        self._started_s = time.monotonic()

    def _ask_info(self, timeout_s: float) -> tuple[int, int, float]:
        # A device that still streams for an earlier host is stopped first.
        self._port.write(encode(Packet(STOP, 0, b"")) + encode(Packet(INFO, 0, b"")))
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            for packet in self._packets(0.05):
                if packet.kind == INFO and len(packet.payload) == INFO_PAYLOAD.size:
                    rate_mhz, count, volts = INFO_PAYLOAD.unpack(packet.payload)
                    return int(rate_mhz), int(count), float(volts)
        raise DeviceTimeout(f"{self._port.address}: INFO not answered within {timeout_s} s")

    def _packets(self, timeout_s: float) -> tuple[Packet, ...]:
        parsed = parse(self._rest + self._port.read(timeout_s))
        self._rest = parsed.rest
        self._damaged += parsed.damaged
        return parsed.packets

    @property
    def channels(self) -> tuple[Channel, ...]:
        return self._channels

    @property
    def sample_rate_hz(self) -> float:
        return self._rate_hz

    def start(self) -> None:
        if self._running:
            raise SettingError(f"{self._port.address}: start() while running; stop() first")
        # The answer to INFO comes behind whatever is still under way from an earlier stream.
        self._ask_info(self._timeout_s)
        self._reset()
        self._port.write(encode(Packet(START, 0, b"")))
        self._running = True
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        heard_s = time.monotonic()
        try:
            while self._running:
                for packet in self._packets(0.05):
                    if packet.kind == DATA:
                        self._store(packet)
                        heard_s = time.monotonic()
                if time.monotonic() - heard_s > SILENT_S:
                    raise DeviceLost(f"{self._port.address}: device lost: silent for {SILENT_S} s")
        except DriverError as error:
            self._failed = error

    def _store(self, packet: Packet) -> None:
        width = 2 * len(self._channels)
        if len(packet.payload) % width:
            raise DeviceFault(
                f"{self._port.address}: {len(packet.payload)} bytes are no whole frames of {width}"
            )
        missing = (packet.sequence - self._next) % WRAP
        if missing >= WRAP // 2:
            return  # sent twice, or of before START
        if missing:
            self._ring.lose(missing)
        codes = np.frombuffer(packet.payload, "<i2").reshape(-1, len(self._channels))
        self._ring.write(codes.astype(np.float32))
        self._next = (packet.sequence + len(codes)) % WRAP

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        """Next `frames` frames in volts; fewer only right before lost ones."""
        require(frames >= 1, "frames", frames, ">= 1")
        if not self._running:
            raise SettingError(f"{self._port.address}: read() while not running; start() it")
        deadline = time.monotonic() + timeout_s
        while not enough(self._pending, frames):
            missing = frames - sum(block.frames for block in self._pending)
            self._await(missing, deadline, timeout_s)
            self._pending.append(self._taken(missing))
        return take(self._pending, frames, self._rate_hz)

    def _await(self, frames: int, deadline: float, timeout_s: float) -> None:
        while self._ring.available < frames:
            if self._failed is not None:
                raise self._failed
            if time.monotonic() > deadline:
                raise DeviceTimeout(
                    f"{self._port.address}: {self._ring.available} of {frames} frames "
                    f"within {timeout_s} s"
                )
            time.sleep(POLL_S)
        if self._ring.overfull:
            raise DeviceFault(f"{self._port.address}: frames are lost too often to be counted")

    def _taken(self, frames: int) -> Block:
        span = self._ring.take(frames)
        flags: set[Flag] = set()
        if np.any(np.abs(span.samples) >= RAIL):
            flags.add("clipped")
        if span.gap is not None:
            self._gaps.append(span.gap)
            flags.add("gap")
        volts = span.samples.astype(np.float64) * self._volts_per_code
        time_s = self._started_s + span.first_frame / self._rate_hz
        return Block(span.first_frame, volts, time_s, frozenset(flags))

    def stop(self) -> None:
        """Harmless when not running, and when the device is gone."""
        if not self._running:
            return
        self._running = False
        self._thread.join()
        if self._failed is None:
            try:
                self._port.write(encode(Packet(STOP, 0, b"")))
            except DriverError as error:
                self._failed = error

    def status(self) -> StreamStatus:
        return StreamStatus(
            running=self._running and self._failed is None,
            frames=self._ring.frames,
            lost_frames=self._ring.lost_frames,
            gaps=tuple(self._gaps),
            fault=None if self._failed is None else str(self._failed),
            detail={"address": self._port.address, "damaged_packets": str(self._damaged)},
        )

    def close(self) -> None:
        self.stop()
        self._port.close()
