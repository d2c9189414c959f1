"""The sound card that the tests describe: `PulseLoop`, with the sample counter on its last wire."""

from drivers.audio_settings import SoundCardSettings
from drivers.types import Channel, OutputLimits
from tests.emulators.pulse import CHANNELS

SETTINGS = SoundCardSettings(
    input_device="rig_loop_in",
    output_device="rig_loop",
    host_api="ALSA",
    channels=(
        Channel("drive", "voltage", "V", full_scale_v=2.0),
        Channel("mic", "pressure", "Pa", volts_per_unit=0.05, full_scale_v=2.0),
    ),
    output_full_scale_v=2.0,
    latency_s=0.06,
    counter=(CHANNELS - 1, CHANNELS - 1),
)
LIMITS = OutputLimits(max_amplitude_v=1.0, max_slew_v_per_s=20.0, dead_man_s=0.5)
