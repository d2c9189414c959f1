"""Rig time: real, or as fast as the processor goes."""

import threading
import time
from collections.abc import Callable


class RealClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)


class VirtualClock:
    """Time that passes only when somebody waits for it.

    Whoever must act as time passes (a rig that samples) subscribes a function of the new time;
    it is called before `sleep` returns.

    Examples
    --------
    >>> clock = VirtualClock()
    >>> clock.sleep(600.0)
    >>> clock.now()
    600.0
    """

    def __init__(self, start_s: float = 0.0) -> None:
        self._now = start_s
        self._lock = threading.RLock()
        self._subscribers: list[Callable[[float], None]] = []

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        if seconds <= 0:
            return
        with self._lock:
            until = self._now + seconds
            for act in list(self._subscribers):
                act(until)
            self._now = max(self._now, until)

    def set(self, now_s: float) -> None:
        """Move on to `now_s` from within a subscriber; never backwards."""
        self._now = max(self._now, now_s)

    def subscribe(self, act: Callable[[float], None]) -> None:
        """Call `act(time)` whenever time passes."""
        self._subscribers.append(act)

    def unsubscribe(self, act: Callable[[float], None]) -> None:
        if act in self._subscribers:
            self._subscribers.remove(act)
