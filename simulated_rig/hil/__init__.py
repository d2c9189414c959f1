"""Hardware in the loop: the plant in real time, as a device that other programs plug into."""

from simulated_rig.hil.amplifier import Amplifier, AmplifierSettings
from simulated_rig.hil.audio import AudioSettings
from simulated_rig.hil.bench import Bench, HilReport, HilSettings, run
from simulated_rig.hil.device import Device, lines
from simulated_rig.hil.generator import Generator
from simulated_rig.hil.loop import PlantLoop
from simulated_rig.hil.suppression import SuppressionMap, Tracked, suppression_map, track
from simulated_rig.hil.watch import Timing, Watch, WatchSettings

__all__ = [
    "Amplifier",
    "AmplifierSettings",
    "AudioSettings",
    "Bench",
    "Device",
    "Generator",
    "HilReport",
    "HilSettings",
    "PlantLoop",
    "SuppressionMap",
    "Timing",
    "Tracked",
    "Watch",
    "WatchSettings",
    "lines",
    "run",
    "suppression_map",
    "track",
]
