"""A rig around another: everything goes straight through until a subclass says otherwise."""

from collections.abc import Sequence
from types import TracebackType
from typing import Self

from drivers.errors import InterlockOpen
from drivers.protocols import Clock, DuplexRig, EmergencyStop
from drivers.types import Block, Channel, OutputLimits, StreamStatus, Tone


class WrappedRig:
    """A `DuplexRig` that passes all on to `inner`."""

    def __init__(self, inner: DuplexRig) -> None:
        self.inner = inner

    @property
    def name(self) -> str:
        return self.inner.name

    @property
    def clock(self) -> Clock:
        return self.inner.clock

    @property
    def channels(self) -> Sequence[Channel]:
        return self.inner.channels

    @property
    def sample_rate_hz(self) -> float:
        return self.inner.sample_rate_hz

    @property
    def limits(self) -> OutputLimits:
        return self.inner.limits

    def start(self) -> None:
        self.inner.start()

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        return self.inner.read(frames, timeout_s)

    def stop(self) -> None:
        self.inner.stop()

    def status(self) -> StreamStatus:
        return self.inner.status()

    def drive(self, tone: Tone) -> Tone:
        return self.inner.drive(tone)

    def feed(self) -> None:
        self.inner.feed()

    def silence(self) -> None:
        self.inner.silence()

    def emergency_stop(self, reason: str = "emergency stop") -> None:
        """Passed on where the rig has one; silence in any case."""
        self.inner.silence()
        if isinstance(self.inner, EmergencyStop):
            self.inner.emergency_stop(reason)

    def reset_stop(self) -> None:
        """Passed on where the rig has one."""
        if not isinstance(self.inner, EmergencyStop):
            raise InterlockOpen(f"{self.name} has no emergency stop that could be reset")
        self.inner.reset_stop()

    def close(self) -> None:
        self.inner.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
