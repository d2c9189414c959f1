"""What stands between every caller and every output: limits, ramps, dead-man, heat, stop.

`OutputGuard` keeps the state of the rule (`drivers.guard_rule`) for the one thread that renders,
and hands it what other threads asked for. Those hand-overs are single attribute writes, so no
side ever waits: an audio callback cannot be held up by a caller, nor a stop by an audio callback.

A silence beats every request made before it, even one still on its way in another thread: each
request carries the silence count read at its start, and one that is out of date is dropped.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drivers.errors import InterlockOpen
from drivers.guard_rule import GuardState, Inputs, Request, check, step, why_muted
from drivers.oscillator import Scratch, advance, amplitude_now
from drivers.types import FloatArray, OutputLimits, Tone, require


class OutputGuard:
    """The rule's state, one renderer, and any number of callers; no lock anywhere.

    Parameters
    ----------
    clock : callable
        Seconds on the rig's monotonic scale, as in `Clock.now`.
    max_frames : int
        Largest block that `render` is called with; work arrays are made for it once.
    synthesise : bool
        False for a device that makes the sine itself: `settle` is called instead of `render`,
        `sample_rate_hz` is only the grain of its time, and any frequency may stand above it.

    Examples
    --------
    >>> guard = OutputGuard(OutputLimits(max_amplitude_v=2.0), 48000.0, clock=lambda: 0.0)
    >>> guard.drive(Tone(170.0, 3.0))
    Traceback (most recent call last):
        ...
    drivers.errors.SettingError: amplitude_v=3.0 is not at most the output's limit of 2.0 V; \
lower it, or raise max_amplitude_v in the rig's limits if the speaker allows it
    """

    def __init__(
        self,
        limits: OutputLimits,
        sample_rate_hz: float,
        clock: Callable[[], float],
        max_frames: int = 8192,
        *,
        synthesise: bool = True,
    ) -> None:
        self.limits = limits
        self.sample_rate_hz = sample_rate_hz
        self._clock = clock
        self._synthesise = synthesise
        self._scratch = Scratch(max_frames)
        self._buffer: FloatArray = np.empty(max_frames)
        self._counter = itertools.count(1)
        self._request: Request | None = None
        self._silences = 0
        self._silence_reason: str | None = None
        self._fed_s = -math.inf
        self._stopped: str | None = None
        self._interlock: str | None = None
        self._state = GuardState()

    # -- callers, from any thread ----------------------------------------------------------

    def drive(self, tone: Tone) -> Tone:
        """Ask for `tone` and feed the dead-man timer.

        Raises
        ------
        SettingError
            Outside the limits; the output stays as it was.
        InterlockOpen
            Stopped, interlock open, or coil too hot.
        """
        silences = self._silences
        check(tone, self.limits, self.sample_rate_hz if self._synthesise else math.inf)
        now = self._clock()
        reason = why_muted(self._state, replace(self._inputs(), fed_s=now), self.limits, now)
        if reason is not None:
            raise InterlockOpen(f"no output: {reason}")
        self._fed_s = now
        self._request = Request(tone, silences)
        return tone

    def feed(self) -> None:
        """Tell the dead-man timer that the caller is alive."""
        self._fed_s = self._clock()

    def silence(self, reason: str | None = None) -> None:
        """Ramp to zero from the next rendered block on; a later `drive` may sound again."""
        self._silence_reason = reason
        self._silences = next(self._counter)

    def stop(self, reason: str = "emergency stop") -> None:
        """Silence, and refuse every `drive` until `reset`."""
        self._stopped = reason
        self.silence(reason)

    def reset(self) -> None:
        """Allow output again after `stop`; nothing sounds before the next `drive`."""
        self._stopped = None

    def set_interlock(self, reason: str | None) -> None:
        """Open the interlock (what opened it) or close it (`None`)."""
        self._interlock = reason
        if reason is not None:
            self.silence(f"interlock open: {reason}")

    @property
    def output_v(self) -> float:
        """Amplitude of the next frame, in volts."""
        return amplitude_now(self._state.oscillator, self.sample_rate_hz)

    @property
    def muted(self) -> str | None:
        """Why the output is silent against the caller's wish; `None` when it is not."""
        return self._state.muted

    @property
    def state(self) -> GuardState:
        """The present state, a value."""
        return self._state

    # -- the one thread that renders -------------------------------------------------------

    def render(self, frames: int, out: FloatArray | None = None) -> FloatArray:
        """The next `frames` samples in volts, clamped; shape (frames,).

        Without `out` the result is a view of a buffer that the next call overwrites. Raises
        `SettingError` above the guard's `max_frames`: longer stretches are rendered in parts, so
        that stop and dead-man are looked at in between.
        """
        if frames > self._scratch.frames:
            require(False, "frames", frames, f"at most max_frames={self._scratch.frames}")
        state = self._step(frames)
        samples = self._buffer[:frames] if out is None else out
        oscillator, samples = advance(
            state.oscillator, frames, self.sample_rate_hz, samples, self._scratch
        )
        limit = self.limits.max_amplitude_v
        np.minimum(samples, limit, out=samples)
        np.maximum(samples, -limit, out=samples)
        self._state = replace(state, oscillator=oscillator)
        return samples

    def settle(self, frames: int) -> Tone:
        """The tone after the next `frames` of a device that makes the sine itself."""
        state = self._step(frames)
        oscillator = replace(state.oscillator, frame=state.oscillator.frame + frames)
        self._state = replace(state, oscillator=oscillator)
        return Tone(oscillator.frequency_hz, amplitude_now(oscillator, self.sample_rate_hz))

    def _step(self, frames: int) -> GuardState:
        return step(
            self._state,
            self._inputs(),
            self.limits,
            self.sample_rate_hz,
            self._clock(),
            frames,
        )

    def restart(self) -> None:
        """Begin again from silence, the coil as warm as it was; only while nothing renders."""
        self.silence()
        self._state = GuardState(mean_power_w=self._state.mean_power_w, hot=self._state.hot)

    def _inputs(self) -> Inputs:
        # The silence count is read before the request: a silence that falls between the two
        # makes the request stale at the next block at the latest, never the other way round.
        silences = self._silences
        return Inputs(
            request=self._request,
            silences=silences,
            silence_reason=self._silence_reason,
            fed_s=self._fed_s,
            stopped=self._stopped,
            interlock=self._interlock,
        )
