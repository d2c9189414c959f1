"""`entrain hil`: one plant in real time, with whichever sides are asked for.

Either a sound card or the serial board paces the plant; generator (SCPI over TCP) and amplifier
(serial terminal) may be there with either. `Bench` is the whole as a context manager; `run` keeps
it up until told to stop, until a time is over, or until a fault, and reports.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from drivers.types import require
from simulated_rig.build import build_config
from simulated_rig.config import RigConfig
from simulated_rig.controllers import Law, LinearController
from simulated_rig.hil.amplifier import Amplifier, AmplifierSettings
from simulated_rig.hil.audio import AudioSettings, AudioSide
from simulated_rig.hil.board import Board
from simulated_rig.hil.device import Device
from simulated_rig.hil.generator import Generator
from simulated_rig.hil.ports import LineTerminal, ScpiServer
from simulated_rig.hil.watch import Timing, Watch, WatchSettings

REPORT_S = 1.0
POLL_S = 0.02


@dataclass(frozen=True)
class HilSettings:
    """What to run. `audio` None: the serial board paces the plant at `board_rate_hz`.

    `generator_port`: None without generator, 0 for any free port. `amplifier`: with a serial
    amplifier, muted at first; without one the line goes straight to the loudspeaker.
    """

    config: RigConfig = field(default_factory=build_config)
    audio: AudioSettings | None = None
    board_rate_hz: float = 8000.0
    generator_port: int | None = 0
    amplifier: AmplifierSettings | None = field(default_factory=AmplifierSettings)
    controller: LinearController | Law | None = None
    watch: WatchSettings = field(default_factory=WatchSettings)
    seed: int = 0

    def __post_init__(self) -> None:
        require(
            4000 <= self.board_rate_hz <= 20000, "board_rate_hz", self.board_rate_hz, "4...20 kHz"
        )

    @property
    def rate_hz(self) -> float:
        return self.board_rate_hz if self.audio is None else self.audio.sample_rate_hz


@dataclass(frozen=True)
class HilReport:
    """Where the device is reached, and how it does. `fault` None: all data so far are right."""

    generator: str | None
    amplifier: str | None
    board: str | None
    rate_hz: float
    timing: Timing
    fault: str | None = None
    latency_s: tuple[float, float] | None = None
    unread_packets: int = 0

    def lines(self) -> list[str]:
        """For a terminal."""
        t = self.timing
        latency = ""
        if self.latency_s is not None:
            into, out = (1e3 * seconds for seconds in self.latency_s)
            latency = f", latency {into:.0f} ms in, {out:.0f} ms out"
        where = [
            ("generator", self.generator),
            ("amplifier", self.amplifier),
            ("board", self.board),
        ]
        return [
            *(f"{name:9s} {address}" for name, address in where if address is not None),
            f"{t.frames / self.rate_hz:.1f} s in {t.blocks} blocks "
            f"at {self.rate_hz:.0f} Hz{latency}",
            f"load {100 * t.load:.1f} % (worst block {100 * t.worst_load:.0f} %), "
            f"{t.misses} deadlines missed, {t.xruns} xruns, {t.lost_frames} frames lost",
            "no fault" if self.fault is None else f"FAULT: {self.fault}",
        ]


class Bench:
    """Everything that `settings` name, up from `__enter__` to `__exit__`."""

    def __init__(self, settings: HilSettings) -> None:
        self.settings = settings
        config, rate = settings.config, settings.rate_hz
        self.watch = Watch(settings.watch, rate)
        self.generator: Generator | None = None
        self.server: ScpiServer | None = None
        if settings.generator_port is not None:
            self.generator = Generator(lambda: self.watch.fault)
            self.server = ScpiServer(self.generator, settings.generator_port)
        self.amplifier: Amplifier | None = None
        self.serial: LineTerminal | None = None
        if settings.amplifier is not None:
            self.amplifier = Amplifier(settings.amplifier)
            self.serial = LineTerminal(self.amplifier.answer)
        self.device = Device(
            config,
            rate,
            self.watch,
            settings.controller,
            self.generator,
            self.amplifier,
            settings.seed,
        )
        full = config.converter.full_scale_v
        self.side: Board | AudioSide
        if settings.audio is None:
            self.side = Board(self.device, full)
        else:
            self.side = AudioSide(self.device, settings.audio, full)
        self._stack = contextlib.ExitStack()

    def report(self) -> HilReport:
        board = self.side if isinstance(self.side, Board) else None
        return HilReport(
            generator=None if self.server is None else self.server.address,
            amplifier=None if self.serial is None else self.serial.name,
            board=None if board is None else board.terminal.name,
            rate_hz=self.settings.rate_hz,
            timing=self.watch.timing,
            fault=self.watch.fault,
            latency_s=self.side.latency_s if isinstance(self.side, AudioSide) else None,
            unread_packets=0 if board is None else board.unread_packets,
        )

    def check(self) -> str | None:
        """The fault, if there is one."""
        if isinstance(self.side, AudioSide):
            self.side.check()
        return self.watch.fault

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            for part in (self.server, self.serial):
                if part is not None:
                    stack.enter_context(part)
            self.watch.restart()
            stack.enter_context(self.side)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()


def run(
    settings: HilSettings | None = None,
    duration_s: float | None = None,
    on_report: Callable[[HilReport], None] | None = None,
    stop: threading.Event | None = None,
) -> HilReport:
    """Run the plant in real time and report.

    Parameters
    ----------
    duration_s : how long; None: until `stop` is set or a fault.
    on_report : called once when everything can be reached, then every second.

    Returns
    -------
    The last report; its `fault` says why the run ended early, if it did.
    """
    ended = stop or threading.Event()
    with Bench(settings or HilSettings()) as bench:
        begun = shown = time.monotonic()
        if on_report is not None:
            on_report(bench.report())
        while not ended.wait(POLL_S) and bench.check() is None:
            now = time.monotonic()
            if duration_s is not None and now - begun >= duration_s:
                break
            if on_report is not None and now - shown >= REPORT_S:
                shown = now
                on_report(bench.report())
        report = bench.report()
        if report.fault is not None:
            time.sleep(0.2)  # lets the silence reach the other side
    return report
