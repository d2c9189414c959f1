"""A speaker output whose device makes the sine itself and is told of every change.

Signal generators and programmable amplifiers accept «amplitude» as a setting, so ramps are made
of steps, one a tick. The rule (`drivers.guard_rule`) decides each step and a thread of its own
sends it; callers only leave their wish, so `silence()` waits for nobody. Whether the device keeps
its phase over a change of frequency is the device's affair: the campaign waits for lock anyway.

A device that fails while it sounds is told to be silent as often as it takes, and the failure is
kept in `fault` for the status and raised at the next `drive`.
"""

import contextlib
import threading
import time
from dataclasses import replace
from typing import Protocol

from drivers.errors import DeviceFault, DriverError
from drivers.guard import OutputGuard
from drivers.types import OutputLimits, Tone

GRAIN_HZ = 1000.0  # the guard counts in milliseconds
TICK_S = 0.02
GIVE_UP_S = 1.0  # after which `close` leaves a device that does not confirm silence


class ToneDevice(Protocol):
    """What a device of this kind offers; each call may take as long as its wire does."""

    def set_frequency(self, frequency_hz: float) -> float:
        """Set and read back, in Hz."""

    def set_amplitude(self, amplitude_v: float) -> float:
        """Set and read back, in volts peak; zero opens the output."""

    def close(self) -> None: ...


class SteppedOutput:
    """`SpeakerOutput` and `EmergencyStop` over a `ToneDevice`."""

    def __init__(self, device: ToneDevice, limits: OutputLimits, tolerance: float = 0.02) -> None:
        self._device = device
        self._tolerance = tolerance
        self.guard = OutputGuard(limits, GRAIN_HZ, time.monotonic, 1, synthesise=False)
        self._wake = threading.Event()
        self._give_up_s: float | None = None  # when, once it is being closed
        self._sent_v = 0.0
        self._certain = True
        self.fault: str | None = None
        self._device.set_amplitude(0.0)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def limits(self) -> OutputLimits:
        return self.guard.limits

    @property
    def output_v(self) -> float:
        """The amplitude that the device was told last, confirmed or not."""
        return self._sent_v

    @property
    def muted(self) -> str | None:
        return self.guard.muted

    def drive(self, tone: Tone) -> Tone:
        """As the protocol says; the frequency is set, and read back, before this returns.

        Raises `DeviceFault` when the device set something else than was asked.
        """
        if self.fault is not None:
            fault, self.fault = self.fault, None
            raise DeviceFault(f"the output failed and was silenced: {fault}")
        before = self.guard.state.served
        self.guard.drive(tone)
        reached = self._set_frequency(tone, before.tone if before is not None else None)
        self._wake.set()
        return replace(tone, frequency_hz=reached)

    def _set_frequency(self, tone: Tone, before: Tone | None) -> float:
        if before is not None and before.frequency_hz == tone.frequency_hz:
            return tone.frequency_hz
        try:
            reached = self._device.set_frequency(tone.frequency_hz)
        except DriverError as error:
            self._failed(error)
            raise
        if abs(reached - tone.frequency_hz) > 1e-3 * tone.frequency_hz:
            fault = DeviceFault(f"frequency_hz={tone.frequency_hz} was set as {reached}")
            self._failed(fault)
            raise fault
        return reached

    def feed(self) -> None:
        self.guard.feed()

    def silence(self) -> None:
        self.guard.silence()
        self._wake.set()

    def emergency_stop(self, reason: str = "emergency stop") -> None:
        self.guard.stop(reason)
        self._wake.set()

    def reset_stop(self) -> None:
        self.guard.reset()

    def settle(self, timeout_s: float = 1.0) -> bool:
        """Wait until the device has confirmed silence; whether it has in time."""
        deadline = time.monotonic() + timeout_s
        while not (self._sent_v == 0.0 and self._certain):
            if time.monotonic() > deadline or not self._thread.is_alive():
                return False
            time.sleep(TICK_S / 4)
        return True

    def close(self) -> None:
        """Silence, wait for it, release; harmless twice."""
        if self._give_up_s is not None:
            return
        self.silence()
        self._give_up_s = time.monotonic() + GIVE_UP_S
        self._wake.set()
        self._thread.join()
        self._device.close()

    # -- the one thread that talks amplitudes ----------------------------------------------

    def _run(self) -> None:
        last_s = time.monotonic()
        while True:
            self._wake.wait(TICK_S)
            self._wake.clear()
            now_s = time.monotonic()
            grains = min(round((now_s - last_s) * GRAIN_HZ), round(2 * TICK_S * GRAIN_HZ))
            if grains > 0:
                last_s = now_s
                self._send(self.guard.settle(grains).amplitude_v)
            quiet = self._sent_v == 0.0 and self._certain
            if self._give_up_s is not None and (quiet or time.monotonic() > self._give_up_s):
                return

    def _send(self, amplitude_v: float) -> None:
        if amplitude_v == self._sent_v and self._certain:
            return
        # What falls to silence goes there at once: a step of the ramp costs a round trip.
        silent = self.guard.state.served is None
        try:
            self._tell(0.0 if silent else amplitude_v)
        except DriverError as error:
            self._failed(error)

    def _tell(self, amplitude_v: float) -> None:
        """Until the device has confirmed, the louder of old and new counts as what sounds."""
        self._certain = False
        self._sent_v = max(self._sent_v, amplitude_v)
        reached = self._device.set_amplitude(amplitude_v)
        self._sent_v, self._certain = amplitude_v, True
        if abs(reached - amplitude_v) > self._tolerance * self.limits.max_amplitude_v:
            raise DeviceFault(f"amplitude_v={amplitude_v} was set as {reached}")

    def _failed(self, error: DriverError) -> None:
        self.fault = str(error)
        self.guard.silence(f"device fault: {error}")
        with contextlib.suppress(DriverError):
            self._tell(0.0)
