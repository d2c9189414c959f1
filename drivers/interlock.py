"""An interlock: a door, a flame guard, a button, watched for as long as a rig may sound.

Fail-safe: only «closed» read just now keeps the output free. Open, unreadable or unanswered, all
stop the rig at once; it then stays stopped until somebody resets it with the interlock closed.
`InterlockWatch` watches one; `InterlockedRig` is a rig with its interlocks, watched while it is
open. A campaign on one may be the somebody (`daq.supervise.InterlockRule`).
"""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from drivers.errors import InterlockOpen
from drivers.protocols import DuplexRig, EmergencyStop
from drivers.wrapped import WrappedRig


class InterlockWatch:
    """Looks at `closed` every `period_s` from a thread of its own; use with `with`.

    `closed` may ask a serial line, a digital input or a file; what it raises counts as open.
    """

    def __init__(
        self, rig: EmergencyStop, name: str, closed: Callable[[], bool], period_s: float = 0.02
    ) -> None:
        self._rig = rig
        self._name = name
        self._closed = closed
        self._period_s = period_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self.reason: str | None = None
        self.tripped: str | None = None  # the last reason, until it is reset

    def look(self) -> str | None:
        """Why the interlock does not count as closed; stops the rig if so."""
        try:
            reason = None if self._closed() else f"interlock open: {self._name}"
        except Exception as error:
            reason = f"interlock {self._name} cannot be read: {error}"
        if reason is not None:
            self._rig.emergency_stop(reason)
            self.tripped = reason
        self.reason = reason
        return reason

    def reset(self) -> None:
        """Free the output again; raises `InterlockOpen` while the interlock is not closed."""
        reason = self.look()
        if reason is not None:
            raise InterlockOpen(f"{reason}; close it, then reset")
        self.tripped = None
        self._rig.reset_stop()

    def _watch(self) -> None:
        while not self._ended.wait(self._period_s):
            self.look()

    def __enter__(self) -> Self:
        self.look()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join()


@dataclass(frozen=True)
class InterlockSettings:
    """An input asked over a serial line: `ask` is answered by ``OK 1`` while it is closed."""

    address: str
    ask: str
    baud: int = 115200
    timeout_s: float = 0.2

    def open(self) -> Callable[[], bool]:
        """Whether the interlock is closed, as a question."""
        from drivers.serial_devices import ask_value
        from drivers.serialport import SerialPort

        port = SerialPort(self.address, self.baud, self.timeout_s)
        return lambda: ask_value(port, self.ask) == 1.0


class InterlockedRig(WrappedRig):
    """`inner` with its interlocks, by name; each is asked whether it is closed."""

    def __init__(
        self, inner: DuplexRig, closed: Mapping[str, Callable[[], bool]], period_s: float = 0.02
    ) -> None:
        super().__init__(inner)
        self._watches = [InterlockWatch(self, name, ask, period_s) for name, ask in closed.items()]
        for watch in self._watches:
            watch.__enter__()

    def interlock_tripped(self) -> str | None:
        """Why the rig was stopped by an interlock and not been reset since; None where it runs."""
        return next((watch.tripped for watch in self._watches if watch.tripped), None)

    def interlock_open(self) -> str | None:
        """Asks all of them now: why one does not count as closed."""
        return next(iter([r for watch in self._watches if (r := watch.look())]), None)

    def reset_interlock(self) -> None:
        """Free the output again; raises `InterlockOpen` while one is not closed."""
        if reason := self.interlock_open():
            raise InterlockOpen(f"{reason}; close it, then reset")
        for watch in self._watches:
            watch.reset()

    def close(self) -> None:
        for watch in self._watches:
            watch.__exit__(None, None, None)
        self.inner.close()
