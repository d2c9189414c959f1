"""Keeping watch over a rig's stream: what breaks in, and waiting until it is over.

Every block passes `Vigil.guard`: limits on channels, and interlocks that have opened. The drive is
silent by then; who called waits here until all is well for long enough on end, or gives up.
"""

from collections.abc import Callable

from daq.acquire import Acquisition
from daq.events import Control
from daq.supervise import InterlockRule, InterlockTripped, LimitExceeded, Supervisor
from drivers.errors import InterlockOpen
from drivers.protocols import DuplexRig, Interlocked
from drivers.types import Block


class Vigil:
    """`control` is called while waiting, and may raise to break off."""

    def __init__(
        self, rig: DuplexRig, supervisor: Supervisor, rule: InterlockRule, control: Control | None
    ) -> None:
        self._rig = rig
        self._supervisor = supervisor
        self._rule = rule
        self._control = control
        self.acquisition = Acquisition(rig, guard=self.guard)

    def guard(self, block: Block) -> None:
        """Raises `InterlockTripped` or `LimitExceeded`."""
        if isinstance(self._rig, Interlocked) and (reason := self._rig.interlock_tripped()):
            raise InterlockTripped(reason)
        self._supervisor.check(block)

    def tripped(self) -> str | None:
        """Why an interlock holds the rig; None where none does."""
        return self._rig.interlock_tripped() if isinstance(self._rig, Interlocked) else None

    def until_clear(self, exceeded: LimitExceeded) -> None:
        """Wait until every channel is inside its limits for long enough.

        Raises `LimitExceeded` again when the limit says ``end``, or when waiting takes too long.
        """
        limit = exceeded.limit
        ends = limit.action == "end"
        if ends or not self._wait(self._supervisor.clear, limit.clear_s, limit.wait_s):
            raise exceeded

    def until_closed(self, opened: InterlockTripped | InterlockOpen) -> None:
        """Wait until all interlocks have been closed for long enough, then reset the stop.

        An emergency stop that no interlock gave goes up: only people reset that one.
        """
        rig, rule, reason = self._rig, self._rule, self.tripped()
        if reason is None or not isinstance(rig, Interlocked):
            raise opened
        ends = rule.action == "end"
        if ends or not self._wait(
            lambda block: rig.interlock_open() is None, rule.clear_s, rule.wait_s
        ):
            raise InterlockTripped(reason)
        rig.reset_interlock()

    def _wait(self, clear: Callable[[Block], bool], clear_s: float, wait_s: float) -> bool:
        """Read on unguarded until `clear` has held for `clear_s` on end; False after `wait_s`."""
        self.acquisition.guard = None
        clear_since: float | None = None
        try:
            begun = now = self._rig.clock.now()
            while clear_since is None or now - clear_since < clear_s:
                if now - begun > wait_s:
                    return False
                if self._control is not None:
                    self._control()
                block = self.acquisition.read_block()
                now = self._rig.clock.now()
                if not clear(block):
                    clear_since = None
                elif clear_since is None:
                    clear_since = now
        finally:
            self.acquisition.guard = self.guard
        return True
