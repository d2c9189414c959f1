"""A rig in a process of its own: the same contract, and what happens when either side dies."""

import functools
import os
import signal
import time

import pytest

from drivers.errors import DeviceLost, DriverError, SettingError
from drivers.isolated import IsolatedRig
from drivers.types import OutputLimits, Tone
from tests.contract import LIMITS, RigContract
from tests.emulators.looprig import LoopRig


class TestIsolatedContract(RigContract):
    drive_column = 0
    noise_v = 1e-9
    latency_s = 0.1

    def open_rig(self, limits: OutputLimits) -> IsolatedRig:
        return IsolatedRig(functools.partial(LoopRig, limits))


def refuse() -> LoopRig:
    raise SettingError("port=7 is not a port")


def test_what_the_factory_raises_is_raised_here() -> None:
    with pytest.raises(SettingError, match="port=7"):
        IsolatedRig(refuse)


def test_a_lost_device_reaches_the_reader() -> None:
    with IsolatedRig(functools.partial(LoopRig, LIMITS, fail_after_s=0.05)) as rig:
        rig.start()
        with pytest.raises(DeviceLost, match="told to fail"):
            rig.read(8000)
        assert rig.status().output_v == 0.0


def test_a_killed_process_is_a_lost_device_at_once() -> None:
    with IsolatedRig(functools.partial(LoopRig, LIMITS)) as rig:
        rig.start()
        rig.drive(Tone(170.0, 1.0))
        rig.read(800)
        os.kill(rig.process_id, signal.SIGKILL)
        began = time.monotonic()
        with pytest.raises(DeviceLost, match="process ended"):
            rig.read(80_000)
        assert time.monotonic() - began < 1.0
        with pytest.raises(DriverError):
            rig.drive(Tone(170.0, 1.0))
        rig.silence()
        status = rig.status()
        assert (status.running, status.output_v) == (False, 0.0)
        assert "process ended" in str(status.fault)
