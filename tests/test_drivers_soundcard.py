"""The sound card driver through a real PortAudio on a real sound server, without hardware.

The loop is digital (a null sink's monitor), so what comes back is what was played: the noise is
float32's rounding, 2⁻²⁴ of full scale, and a lost frame would show in the counter channel.
"""

import dataclasses
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.audio_callback import AudioCallback
from drivers.audio_devices import find_audio_device, portaudio, rescan
from drivers.errors import DeviceLost, DeviceNotFound, SettingError
from drivers.soundcard import SoundCardRig
from drivers.types import OutputLimits, Tone
from tests.contract import RigContract
from tests.emulators.card import LIMITS, SETTINGS
from tests.emulators.pulse import PulseLoop

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def loop() -> Iterator[PulseLoop]:
    with PulseLoop() as loop:
        rescan()
        yield loop
    rescan()


@pytest.mark.component("PortAudio")
@pytest.mark.component("PulseAudio")
@pytest.mark.usefixtures("loop")
class TestSoundCardContract(RigContract):
    drive_column = 0
    noise_v = 1e-6
    latency_s = 0.25
    block_s = 0.05

    def open_rig(self, limits: OutputLimits) -> SoundCardRig:
        # Buffers that outlast what other processes do on a busy machine.
        return SoundCardRig(dataclasses.replace(SETTINGS, latency_s=0.1), limits)


@pytest.mark.component("PortAudio")
@pytest.mark.component("PulseAudio")
@pytest.mark.usefixtures("loop")
class TestSelection:
    def test_a_name_is_found_exactly_before_in_part(self) -> None:
        assert find_audio_device("rig_loop", "ALSA", outputs=1).name == "rig_loop"
        assert find_audio_device("loop_in", "ALSA", inputs=1).name == "rig_loop_in"

    def test_unknown_and_ambiguous_names_list_what_is_there(self) -> None:
        with pytest.raises(DeviceNotFound, match=r"'nowhere'.*'rig_loop_in'"):
            find_audio_device("nowhere", "ALSA", inputs=1)
        with pytest.raises(DeviceNotFound, match="fits several"):
            find_audio_device("rig_", "ALSA", outputs=1)
        with pytest.raises(DeviceNotFound, match="host API 'ASIO'; there is: none"):
            find_audio_device("rig_loop", "ASIO", outputs=1)

    def test_more_channels_than_the_card_has_are_refused(self) -> None:
        settings = dataclasses.replace(SETTINGS, speaker=500)
        with pytest.raises(DeviceNotFound, match="501 output channels"):
            SoundCardRig(settings, LIMITS)

    def test_limits_beyond_full_scale_are_refused(self) -> None:
        with pytest.raises(SettingError, match=r"max_amplitude_v=2\.5"):
            SoundCardRig(SETTINGS, OutputLimits(2.5))


@pytest.mark.component("PortAudio")
@pytest.mark.component("PulseAudio")
@pytest.mark.usefixtures("loop")
class TestStart:
    """PortAudio may end an ALSA stream before its first callback; here its first callbacks do."""

    def ending(self, monkeypatch: pytest.MonkeyPatch, times: int) -> list[int]:
        served, ended = AudioCallback.__call__, [0]

        def ends(self: AudioCallback, *given: Any) -> None:
            if ended[0] < times:
                ended[0] += 1
                raise portaudio().CallbackAbort
            served(self, *given)

        monkeypatch.setattr(AudioCallback, "__call__", ends)
        return ended

    def test_a_stream_that_ends_before_its_first_frame_begins_again(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        ended = self.ending(monkeypatch, 2)
        with SoundCardRig(dataclasses.replace(SETTINGS, latency_s=0.1), LIMITS) as rig:
            rig.start()
            assert rig.read(2400).frames == 2400
            assert rig.status().running
        assert ended == [2]

    def test_one_that_always_does_is_lost_and_may_be_started_later(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with SoundCardRig(dataclasses.replace(SETTINGS, latency_s=0.1), LIMITS) as rig:
            with monkeypatch.context() as patch:
                self.ending(patch, 1000)
                with pytest.raises(DeviceLost, match="before its first frame, 5 times"):
                    rig.start()
            assert not rig.status().running
            rig.start()
            assert rig.read(2400).frames == 2400


@pytest.mark.component("PortAudio")
@pytest.mark.component("PulseAudio")
def test_runs_at_192_khz_frame_for_frame() -> None:
    """The sine that comes back at the highest rate is the one that left, to float32's rounding."""
    with PulseLoop(192_000):
        rescan()
        settings = dataclasses.replace(SETTINGS, sample_rate_hz=192_000.0, latency_s=0.1)
        with SoundCardRig(settings, LIMITS) as rig:
            rig.start()
            assert rig.sample_rate_hz == 192_000.0
            rig.drive(Tone(1000.0, 1.0))
            for _ in range(4):
                rig.feed()
                rig.read(19_200)
            block = rig.read(19_200)
            assert block.frames == 19_200
            assert block.flags == frozenset()
            y = block.samples[:, 0]
            error = y[2:] - 2 * np.cos(2 * np.pi * 1000.0 / 192_000.0) * y[1:-1] + y[:-2]
            assert np.max(np.abs(y)) == pytest.approx(1.0, abs=1e-3)
            # Three roundings of at most 2⁻²⁵ of 2 V full scale, weighted 1, 2 and 1.
            assert np.max(np.abs(error)) <= 4 * 2.0 * 2.0**-25
    rescan()


@pytest.mark.parametrize(
    ("change", "parameter"),
    [
        ({"channels": ()}, "channels"),
        ({"sample_rate_hz": 384000.0}, "sample_rate_hz"),
        ({"input_columns": (0,)}, "input_columns"),
        ({"speaker": -1}, "speaker"),
        ({"latency_s": 0.0}, "latency_s"),
    ],
)
def test_bad_settings_name_the_parameter(change: dict[str, Any], parameter: str) -> None:
    with pytest.raises(SettingError, match=parameter):
        dataclasses.replace(SETTINGS, **change)


def test_without_portaudio_the_error_says_what_to_install() -> None:
    """In a fresh interpreter whose loader finds no library of that name."""
    script = (
        "import ctypes.util; ctypes.util.find_library = lambda name: None\n"
        "from drivers.audio_devices import portaudio\n"
        "from drivers.errors import MissingDependency\n"
        "try:\n    portaudio()\n"
        "except MissingDependency as error:\n    print(error)\n"
    )
    said = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert "apt install libportaudio2" in said.stdout
