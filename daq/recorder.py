"""Recordings of a campaign: a run file with everything known when it begins, anew where frames
were lost."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from daq.acquire import Acquisition
from daq.events import FlameSwitch, SelfDescribing
from daq.plan import integer_bin
from daq.records import ExitStatus, RunHeader, RunSummary
from daq.schedule import Item
from daq.store import RunStore, utc_now
from drivers.types import Channel

ATTEMPTS = 3  # recordings of one item, when frames are lost or doubtful


@dataclass(frozen=True)
class Recorder:
    """Records what the acquisition reads into a campaign of a store.

    `calibration`: channels with what the book knows of them, their skews, and remarks.
    `started_s`: the rig clock's time at which the campaign began. `limit_v`: what may be driven.
    `checkpoint` is called before every attempt, and may raise.
    """

    acquisition: Acquisition
    store: RunStore
    campaign: str
    calibration: tuple[Sequence[Channel], Sequence[float], Sequence[str]]
    started_s: float
    limit_v: float
    checkpoint: Callable[[], None]

    def record(
        self,
        item: Item,
        frequency_hz: float | None,
        amplitude_v: float,
        record_s: float,
        notes: dict[str, Any],
    ) -> RunSummary:
        """Whole forcing periods into one run file; anew, a few times, when frames were lost."""
        rate = self.acquisition.rig.sample_rate_hz
        _, frames = integer_bin(frequency_hz or 1.0, rate, record_s)
        attempt = 1
        while True:
            self.checkpoint()
            header = self.header(item, frequency_hz, amplitude_v, notes)
            with self.store.write_run(self.campaign, header) as writer:
                stretch = self.acquisition.read(frames, writer)
                lost = [f"{gap.frames} frames lost" for gap in stretch.gaps]
                troubles = sorted(stretch.flags) + lost
                status: ExitStatus = "failed" if troubles else "success"
                summary = writer.finish(status, ", ".join(troubles))
            self.store.add_run(summary)
            if summary.exit_status == "success" or attempt == ATTEMPTS:
                return summary
            attempt += 1

    def header(
        self, item: Item, frequency_hz: float | None, amplitude_v: float, notes: dict[str, Any]
    ) -> RunHeader:
        """A name that is free, and everything known when the recording begins."""
        rig = self.acquisition.rig
        where = "" if frequency_hz is None else f"-{frequency_hz:.2f}Hz"
        stem = f"{item.index:03d}-{item.kind}{where}"
        name, number = stem, 2
        folder = self.store.campaign_dir(self.campaign) / "runs"
        while (folder / f"{name}.h5").exists():
            name, number = f"{stem}-{number}", number + 1
        said = rig.run_notes() if isinstance(rig, SelfDescribing) else {}
        channels, skews, remarks = self.calibration
        said = {**said, "calibration": remarks}
        return RunHeader(
            name=name,
            kind=item.kind,
            sample_rate_hz=rig.sample_rate_hz,
            channels=tuple(channels),
            skew_s=tuple(skews),
            frequency_hz=frequency_hz,
            amplitude_v=None if frequency_hz is None else amplitude_v,
            started_s=rig.clock.now() - self.started_s,
            started_at=utc_now(),
            role="fit" if item.condition is None else item.condition.role,
            rig=rig.name,
            notes={"item": item.index, "rig": self.abilities(), **said, **notes},
        )

    def abilities(self) -> dict[str, Any]:
        """What the rig can do, for whoever plans the next experiment from the recordings."""
        rig = self.acquisition.rig
        return {
            "limit_v": self.limit_v,
            "min_frequency_hz": rig.limits.min_frequency_hz,
            "max_frequency_hz": rig.limits.max_frequency_hz,
            "flame_switch": isinstance(rig, FlameSwitch),
        }
