"""Plant and acquisition as two processes over a real PortAudio on a real sound server.

The plant's process is `entrain hil`; the acquisition here is our own sound card
driver. The counter goes all the way round, so that every lost frame would show on both sides.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.audio_devices import rescan
from drivers.audio_settings import SoundCardSettings
from drivers.errors import DeviceNotFound
from drivers.soundcard import SoundCardRig
from drivers.types import Block, OutputLimits, StreamStatus, Tone
from simulated_rig import build_config
from simulated_rig.hil import AudioSettings, HilSettings, lines, run
from simulated_rig.hil.loop import PlantLoop
from simulated_rig.hil.sound_server import CHANNELS, SoundServer

ROOT = Path(__file__).resolve().parents[1]
CONFIG = build_config("thesis-two-mode")
# Buffers that outlast what else runs on a busy machine.
LATENCY_S = 0.15
ACQUISITION = SoundCardSettings(
    input_device="rig_daq_in",
    output_device="rig_daq",
    host_api="ALSA",
    channels=lines(CONFIG),
    latency_s=LATENCY_S,
    counter=(CHANNELS - 1, CHANNELS - 1),
)
LIMITS = OutputLimits(1.0, max_slew_v_per_s=100.0, dead_man_s=30.0)

pytestmark = [pytest.mark.component("PortAudio"), pytest.mark.component("PulseAudio")]


class PlantProcess:
    """The plant, ready; `said` is what it printed until it ended."""

    def __init__(self, *options: str) -> None:
        command = [sys.executable, "-m", "daq.cli", "hil", "--input", "rig_plant_in"]
        command += ["--output", "rig_plant", "--latency", str(LATENCY_S), *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
        assert self.process.stdout is not None
        self.first = self.process.stdout.readline()

    def end(self) -> str:
        self.process.terminate()
        said, _ = self.process.communicate(timeout=20.0)
        return said


@pytest.fixture(scope="module")
def server() -> Iterator[SoundServer]:
    with SoundServer() as server:
        rescan()
        yield server
    rescan()


def measured_once() -> tuple[str, Block, StreamStatus]:
    """What the plant's process said, and 0.5 s of the tube driven at 166 Hz for 1.2 s."""
    plant = PlantProcess()
    try:
        with SoundCardRig(ACQUISITION, LIMITS) as rig:
            rig.start()
            rig.drive(Tone(166.0, 1.0))
            for _ in range(12):
                rig.feed()
                rig.read(4800, 20.0)
            block = rig.read(24000, 20.0)
            status = rig.status()
    finally:
        said = plant.end()
    return said, block, status


def test_the_acquisition_sees_the_entrained_tube(server: SoundServer) -> None:
    """Driven at 166 Hz with 1 V the limit cycle is entrained (physics.md, 166 Hz at 1e10), so that
    all power of the pressure stands in the harmonics of 166 Hz: and what is measured through two
    processes and a sound server is what the plant alone gives, to the noise."""
    for _ in range(3):
        said, block, status = measured_once()
        # On a machine that is busy with other things the plant may state a loss, as it must.
        if "FAULT" not in said and block.flags == frozenset():
            break
    assert "no fault" in said
    assert status.detail["loop_latency_frames"] != "unknown"
    assert block.frames == 24000
    alone = PlantLoop(CONFIG, 48000.0)
    drive = np.sin(2 * np.pi * 166.0 * np.arange(96000) / 48000.0)
    wave = np.exp(-2j * np.pi * 166.0 * np.arange(24000) / 48000.0)
    expected = np.abs(0.002 * alone.process(drive)[-24000:, 0] @ wave) / 12000
    p1, _, voltage = np.abs(block.samples.T @ wave) / 12000
    assert block.flags == frozenset()
    assert voltage == pytest.approx(1.0, rel=1e-3)
    assert p1 == pytest.approx(expected, rel=5e-3)


def test_overload_is_a_stated_fault_and_silence(server: SoundServer) -> None:
    """The plant's process gets no processor for a second, as under overload: it says so and exits
    with 1; the acquisition flags what it got from there on, and hears nothing after the fault."""
    plant = PlantProcess("--seconds", "60")
    flags: set[str] = set()
    try:
        with SoundCardRig(ACQUISITION, LIMITS) as rig:
            rig.start()
            # Healthy for longer than `settle_s` and until the counter has come round.
            while rig.status().frames < 72_000 or (
                rig.status().detail["loop_latency_frames"] == "unknown"
            ):
                rig.read(4800, 20.0)
                assert rig.status().frames < 960_000, "the counter never came round"
            plant.process.send_signal(signal.SIGSTOP)
            for _ in range(10):
                flags |= rig.read(4800, 20.0).flags
            plant.process.send_signal(signal.SIGCONT)
            said, _ = plant.process.communicate(timeout=30.0)
            for _ in range(15):
                block = rig.read(4800, 20.0)
                flags |= block.flags
    finally:
        plant.process.kill()
        plant.process.communicate()
    assert plant.process.returncode == 1
    assert "FAULT: " in said
    assert flags & {"xrun", "gap"}
    assert np.all(block.samples == 0.0)


def test_a_server_that_dies_is_a_stated_fault() -> None:
    with SoundServer() as server:
        rescan()
        reports = []
        settings = HilSettings(CONFIG, server.plant, generator_port=None, amplifier=None)
        killer = threading.Timer(1.0, server.kill)
        killer.start()
        report = run(settings, 20.0, reports.append)
        killer.join()
    rescan()
    assert report.fault is not None
    assert report.timing.frames < 15 * 48000


def test_an_unknown_device_is_named() -> None:
    settings = HilSettings(CONFIG, AudioSettings("nowhere", "rig_plant"), generator_port=None)
    with pytest.raises(DeviceNotFound, match="'nowhere'"):
        run(settings)


def test_environment_is_restored(server: SoundServer) -> None:
    assert os.environ["ALSA_CONFIG_PATH"] == str(server.asound)
