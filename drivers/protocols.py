"""The verbs that a device must offer, in small protocols that compose.

`PressureInput` samples; `SpeakerOutput` sounds; a `DuplexRig` does both on one clock. Every
implementation, simulated or real, passes the contract suite in `tests/contract.py`.

Silence is part of the contract: `silence()` never raises, needs no lock, and may be called from
any thread at any time, also twice, also after `close()`; leaving a `with` block, an exception on
the way, a lost device and a caller that stops calling `feed()` all end in silence.
"""

from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from drivers.types import Block, Channel, OutputLimits, StreamStatus, Tone


@runtime_checkable
class Clock(Protocol):
    """Time as the rig knows it; injected, so that a simulated rig may run faster than real time."""

    def now(self) -> float:
        """Seconds on a monotonic scale."""

    def sleep(self, seconds: float) -> None:
        """Let that much of this clock's time pass."""


@runtime_checkable
class PressureInput(Protocol):
    """Simultaneously sampled channels."""

    @property
    def channels(self) -> Sequence[Channel]: ...

    @property
    def sample_rate_hz(self) -> float:
        """The rate that the device actually runs at, not the one asked for."""

    def start(self) -> None:
        """Begin sampling; frame numbers count from here."""

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        """Next `frames` frames, in order; fewer only right before lost ones.

        Lost frames show as a jump of `first_frame` and the flag ``gap``, never as
        silently joined data. Raises `DeviceTimeout`, `DeviceLost`, or `SettingError` for
        ``frames < 1`` and for a stream that is not started.
        """

    def stop(self) -> None:
        """End sampling and silence any output of the same device; harmless when not started."""


@runtime_checkable
class SpeakerOutput(Protocol):
    """A loudspeaker's drive with hard limits below the caller."""

    @property
    def limits(self) -> OutputLimits: ...

    def drive(self, tone: Tone) -> Tone:
        """Ramp to `tone`, phase-continuously, and feed the dead-man timer.

        Returns the tone that the device will reach (settings read back). Raises `SettingError`
        beyond the limits (the output then stays as it was) and `InterlockOpen`.
        """

    def feed(self) -> None:
        """Tell the dead-man timer that the caller is alive."""

    def silence(self) -> None:
        """Ramp to zero at once; never raises, never waits, callable from any thread."""


@runtime_checkable
class EmergencyStop(Protocol):
    """A stop that holds until it is reset; needs no lock and no queue, from any thread."""

    def emergency_stop(self, reason: str = "emergency stop") -> None:
        """Silence, and let every `drive` raise `InterlockOpen` until `reset_stop`."""

    def reset_stop(self) -> None:
        """Allow output again; nothing sounds before the next `drive`."""


@runtime_checkable
class Interlocked(Protocol):
    """A rig that interlocks stop: it then stays stopped until it is reset, all of them closed."""

    def interlock_tripped(self) -> str | None:
        """Why an interlock stopped the rig, until it is reset; never blocks."""

    def interlock_open(self) -> str | None:
        """Asks the interlocks now: why one does not count as closed."""

    def reset_interlock(self) -> None:
        """Free the output again; raises `InterlockOpen` while one is not closed."""


@runtime_checkable
class Operable(Protocol):
    """A rig whose operating point can be set: flows, a mixture, by name."""

    def operating_ranges(self) -> Mapping[str, tuple[float, float]]:
        """What can be set: least and greatest value of each quantity, in the unit of its name."""

    def operate(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Set these quantities, leave others as they are; what the rig reads back.

        Raises `SettingError` for an unknown quantity or a value outside its range.
        """


def operating_ranges(rig: object) -> Mapping[str, tuple[float, float]]:
    """What of a rig's operating point can be set; empty where nothing can."""
    return rig.operating_ranges() if isinstance(rig, Operable) else {}


@runtime_checkable
class DuplexRig(PressureInput, SpeakerOutput, Protocol):
    """Input and output on one clock: what a campaign runs on."""

    @property
    def name(self) -> str: ...

    @property
    def clock(self) -> Clock: ...

    def status(self) -> StreamStatus:
        """A snapshot; never blocks."""

    def close(self) -> None:
        """Silence, stop, release; harmless twice."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...
