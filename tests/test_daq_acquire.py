"""The block reader: nothing lost, nothing joined silently, taps that cannot harm a recording."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from daq.acquire import Acquisition
from daq.errors import CampaignError
from daq.records import RunHeader
from daq.store_file import open_run, read_volts
from daq.store_writer import RunWriter
from drivers.types import Block, Gap
from simulated_rig.build import build_rig
from simulated_rig.rig import SimulatedRig


@pytest.fixture(scope="module")
def rig() -> Iterator[SimulatedRig]:
    with build_rig(seed=3) as rig:
        rig.start()
        yield rig


def test_recording_holds_every_frame_though_a_tap_drops(rig: SimulatedRig, tmp_path: Path) -> None:
    acquisition = Acquisition(rig)
    header = RunHeader("r", "free", rig.sample_rate_hz, tuple(rig.channels))
    with acquisition.tap(depth=3) as lazy, RunWriter(tmp_path / "r.h5", header, "c") as writer:
        stretch = acquisition.read(10_007, writer)
        summary = writer.finish()
        assert summary.samples == 10_007
        assert lazy.dropped == 21 - 3  # 20 blocks of 500 frames and one of 7
        newest = lazy.get()
        assert newest is not None
        assert newest.frames in (500, 7)
    with open_run(tmp_path / "r.h5") as file:
        # volts of a 16-bit converter fit float32 exactly
        np.testing.assert_array_equal(read_volts(file), stretch.samples)
    assert stretch.intact
    assert acquisition.counters.lost_frames == 0


def test_closed_tap_hears_nothing(rig: SimulatedRig) -> None:
    acquisition = Acquisition(rig)
    tap = acquisition.tap()
    tap.close()
    tap.close()
    acquisition.read(10)
    assert tap.get(timeout_s=0.0) is None


def test_blocks_must_be_shorter_than_the_dead_man_time(rig: SimulatedRig) -> None:
    with pytest.raises(CampaignError, match="block_s=2"):
        Acquisition(rig, block_s=2.0)


class LossyRig:
    """The simulated rig, from which a stretch of frames is taken away before it is read."""

    def __init__(self, rig: SimulatedRig, after: int, frames: int) -> None:
        self._rig, self._after, self._frames = rig, after, frames
        self._reads = 0

    def __getattr__(self, name: str) -> object:
        return getattr(self._rig, name)

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        self._reads += 1
        if self._reads == self._after:
            self._rig.read(self._frames)
            block = self._rig.read(frames, timeout_s)
            return Block(block.first_frame, block.samples, block.time_s, frozenset({"gap"}))
        return self._rig.read(frames, timeout_s)


def test_lost_frames_are_counted_and_placed(rig: SimulatedRig, tmp_path: Path) -> None:
    acquisition = Acquisition(LossyRig(rig, after=3, frames=123))  # type: ignore[arg-type]
    header = RunHeader("r", "free", rig.sample_rate_hz, tuple(rig.channels))
    with RunWriter(tmp_path / "r.h5", header, "c") as writer:
        stretch = acquisition.read(2000, writer)
        assert writer.finish().samples == 2123
    assert stretch.gaps == (Gap(stretch.first_frame + 1000, 123),)
    assert not stretch.intact
    assert acquisition.counters.lost_frames == 123
    assert acquisition.counters.flags == {"gap": 1}
