"""The sound card driver over JACK: another host API, another server, the same frames.

The stream's outputs are wired to its own inputs; a lost or repeated frame shows in the sample
counter on the second wire.
"""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest

from drivers.audio_devices import audio_devices, rescan
from drivers.audio_settings import SoundCardSettings
from drivers.soundcard import SoundCardRig
from drivers.types import Channel, OutputLimits, Tone
from tests.emulators.jack import HOST_API, RATE_HZ, jack_server, wired_to_itself

pytestmark = [pytest.mark.component("PortAudio"), pytest.mark.component("JACK")]

PERIOD = 256
SETTINGS = SoundCardSettings(
    input_device="system",
    output_device="system",
    host_api=HOST_API,
    channels=(Channel("drive", "voltage", "V", full_scale_v=2.0),),
    output_full_scale_v=2.0,
    latency_s=1.0,
    counter=(1, 1),
    ring_s=60.0,  # many times what comes while a read is being prepared
    check_clock=False,
)
LIMITS = OutputLimits(max_amplitude_v=1.0, max_slew_v_per_s=20.0, dead_man_s=2.0)
TONE_HZ = 1000.0


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[SoundCardRig]:
    with jack_server(PERIOD) as env:
        for name in ("JACK_DEFAULT_SERVER", "JACK_NO_START_SERVER", "JACK_NO_AUDIO_RESERVATION"):
            monkeypatch.setenv(name, env[name])
        rescan()
        with SoundCardRig(SETTINGS, LIMITS) as rig:
            yield rig
        monkeypatch.undo()
        rescan()  # PortAudio must have let go of the server before it ends


def amplitude(y: npt.NDArray[np.float64]) -> float:
    """Of the tone, in the first of its periods in `y`."""
    one = np.arange(round(RATE_HZ / TONE_HZ))
    return float(abs(2 * np.mean(y[one] * np.exp(-2j * np.pi * TONE_HZ / RATE_HZ * one))))


def test_what_leaves_over_jack_comes_back_frame_for_frame(rig: SoundCardRig) -> None:
    assert {device.host_api for device in audio_devices() if device.name == "system"} == {HOST_API}
    rig.start()
    assert rig.sample_rate_hz == RATE_HZ
    with wired_to_itself("PortAudio"):
        rig.drive(Tone(TONE_HZ, 1.0))
        while amplitude(y := rig.read(RATE_HZ // 10).samples[:, 0]) < 1.0 - 1e-6:
            rig.feed()
        error = y[2:] - 2 * np.cos(2 * np.pi * TONE_HZ / RATE_HZ) * y[1:-1] + y[:-2]
        # Three roundings of at most 2⁻²⁵ of 2 V full scale, weighted 1, 2 and 1.
        assert np.max(np.abs(error)) <= 4 * 2.0 * 2.0**-25
        # The counter came back by a whole number of periods, so it is wired and counts.
        lag = int(rig.status().detail["loop_latency_frames"])
        assert lag > 0
        assert lag % PERIOD == 0
        rig.silence()
        while np.any(rig.read(RATE_HZ // 10).samples):
            rig.feed()
