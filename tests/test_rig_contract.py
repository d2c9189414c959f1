"""The simulated rig keeps the contract of every duplex rig, on either clock."""

import ast
import subprocess
import sys

import numpy as np
import pytest

import simulated_rig
from drivers.protocols import DuplexRig
from drivers.types import OutputLimits, Tone
from simulated_rig import PRESETS, build_rig, seal
from tests.contract import RigContract


class TestVirtualClock(RigContract):
    drive_column = 2
    latency_s = 0.012  # a quantum of 10 ms, and 12 frames of the converter's filter

    def open_rig(self, limits: OutputLimits) -> DuplexRig:
        return build_rig(limits=limits, seed=1)


class TestSealed(TestVirtualClock):
    """Whatever is sealed in it, the rig behaves as a rig."""

    def open_rig(self, limits: OutputLimits) -> DuplexRig:
        return build_rig(limits=limits, seed=3, effects="sealed")


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_every_preset_runs_and_tells_nothing_but_its_name(preset: str) -> None:
    with build_rig(preset, seed=2, noise_db=40.0, effects=seal(1)) as rig:
        rig.start()
        rig.drive(Tone(170.0, 0.5))
        block = rig.read(3000)
        told = " ".join([rig.name, repr(rig.status()), repr(rig.channels)])
    assert np.all(np.isfinite(block.samples))
    assert np.std(block.samples[:, 0]) > 0
    assert "clipped" not in block.flags
    assert "resonance" not in told


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="thesis-two-mode"):
        build_rig("ghost")
    with pytest.raises(ValueError, match="flame_delay"):
        build_rig(effects={"ghost": {}})
    for delay_s in (1e5, -1e-4, float("nan"), "long", True):
        with pytest.raises(ValueError, match=r"delay_s=.* is not a number from 0 to 0\.1"):
            build_rig(effects={"flame_delay": {"delay_s": delay_s}})  # type: ignore[dict-item]
    with pytest.raises(ValueError, match=r"skew_s=0\.1 is not a number from -0\.005"):
        build_rig(effects={"channel_mismatch/skew": {"skew_s": 0.1}})
    with pytest.raises(ValueError, match=r"lowpass_hz=0\.0 is not a number from 20 to"):
        build_rig(effects={"channel_mismatch/lowpass": {"lowpass_hz": 0.0}})
    with pytest.raises(ValueError, match="seed=-1"):
        build_rig(seed=-1)
    with pytest.raises(ValueError, match="effects=3 is not a table"):
        build_rig(effects=3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="clock"):
        build_rig(clock="tomorrow")  # type: ignore[arg-type]


def test_public_names_are_as_declared() -> None:
    assert len(set(simulated_rig.__all__)) == len(simulated_rig.__all__)
    for name in simulated_rig.__all__:
        assert hasattr(simulated_rig, name)


def test_the_rig_knows_nothing_of_identification() -> None:
    """In a process of its own: importing the rig loads neither the library nor the service."""
    program = "import sys, simulated_rig; print({m.split('.')[0] for m in sys.modules})"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    loaded = ast.literal_eval(found.stdout)
    assert "simulated_rig" in loaded
    assert not loaded & {"identify", "daq", "fastapi", "sounddevice", "pyvisa", "matplotlib"}
