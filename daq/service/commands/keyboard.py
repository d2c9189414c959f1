"""Keys that steer a campaign in a terminal: p pauses and goes on, s skips, q (or Ctrl-C) ends.

A key takes effect at the campaign's next window; a pause silences the speaker first. Where the
input is no terminal, or the system has no termios, only Ctrl-C is left.
"""

import contextlib
import os
import select
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from daq.supervise import SkipRequested, StopRequested
from drivers.protocols import DuplexRig

HELP = "keys: p pause and go on, s skip the condition, q end (`resume` goes on later)"
LOOK_S = 0.1
RAMPED_S = 0.05  # beyond the ramp to silence


class Keyboard:
    """What was typed at `descriptor`, as a campaign's `control`; `interrupted` lists signals."""

    def __init__(self, rig: DuplexRig, descriptor: int | None, interrupted: list[int]) -> None:
        self._rig = rig
        self._descriptor = descriptor
        self._interrupted = interrupted

    def heed(self) -> None:
        """Raises `StopRequested` or `SkipRequested` when asked for; blocks while paused."""
        paused = False
        while True:
            for key in self._typed(LOOK_S if paused else 0.0):
                if key == "q":
                    raise StopRequested("ended at the keyboard")
                if key == "s":
                    raise SkipRequested
                if key == "p":
                    paused = not paused
                    self._rig.silence()
                    # Also a pause that is taken back at once must be seen: by the silence.
                    self._rig.clock.sleep(self._rig.limits.silence_ramp_s + RAMPED_S)
            if self._interrupted:
                raise StopRequested(why_ended(self._interrupted))
            if not paused:
                return

    def _typed(self, wait_s: float) -> str:
        if self._descriptor is None or not select.select([self._descriptor], [], [], wait_s)[0]:
            return ""
        return os.read(self._descriptor, 64).decode("ascii", "ignore").lower()


def why_ended(signals: list[int]) -> str:
    """What the first of the signals that ask for an end says of it."""
    if signals[0] == signal.SIGINT:
        return "interrupted at the keyboard"
    return f"ended by {signal.Signals(signals[0]).name}"


@contextmanager
def single_keys() -> Iterator[int | None]:
    """Standard input, key by key and without echo; None where that is not a terminal."""
    try:
        import termios
        import tty
    except ImportError:
        yield None
        return
    if not sys.stdin.isatty():
        yield None
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor)
    try:
        yield descriptor
    finally:
        with contextlib.suppress(termios.error):  # the terminal is gone
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
