"""Stands in for the service in tests that kill or stop it: opens the card, sounds, feeds.

usage: python -m tests.emulators.service isolated|inside

Says ``sounding`` and the rig process's id (0 when inside) once the tone is up, then feeds and
reads until ended.
"""

import dataclasses
import functools
import sys

from drivers.isolated import IsolatedRig
from drivers.soundcard import SoundCardRig
from drivers.types import Tone
from tests.emulators.card import LIMITS, SETTINGS


def main() -> None:
    # Short buffers: they are part of the time to silence.
    settings = dataclasses.replace(SETTINGS, latency_s=0.03)
    factory = functools.partial(SoundCardRig, settings, LIMITS)
    rig = IsolatedRig(factory) if sys.argv[1] == "isolated" else factory()
    with rig:
        rig.start()
        rig.drive(Tone(500.0, 1.0))
        block = round(0.02 * rig.sample_rate_hz)
        while rig.status().output_v < 1.0:
            rig.feed()
            rig.read(block)
        print("sounding", getattr(rig, "process_id", 0), flush=True)
        while True:
            rig.feed()
            rig.read(block)


if __name__ == "__main__":
    main()
