"""Real time as a rig's `Clock`."""

import time


class MonotonicClock:
    """The machine's monotonic clock, common to all its processes."""

    def now(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(max(0.0, seconds))
