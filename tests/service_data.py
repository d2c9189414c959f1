"""A small campaign folder, made of sines, for the tests of service and command line."""

from pathlib import Path

import numpy as np
from scipy.io import wavfile

RATE_HZ = 2000
FRAMES = 2000
FULL_SCALE_V = 10.0

TOML = """format = "campaign-folder/1"
title = "three sines"
sample_rate_hz = 2000.0

[[channels]]
name = "p1"
quantity = "pressure"
unit = "Pa"
volts_per_unit = 0.01
position_m = 0.7
full_scale_v = 10.0

[[channels]]
name = "p2"
quantity = "pressure"
unit = "Pa"
volts_per_unit = 0.01
position_m = 0.8
full_scale_v = 10.0

[[channels]]
name = "drive"
quantity = "voltage"
unit = "V"
volts_per_unit = 1.0
full_scale_v = 10.0

[[runs]]
file = "free.wav"
kind = "free"

[[runs]]
file = "forced-1.wav"
kind = "forced"
frequency_hz = 160.0
amplitude_v = 1.0

[[runs]]
file = "forced-2.wav"
kind = "forced"
frequency_hz = 175.0
amplitude_v = 2.0
role = "validation"
"""


def pressure_pa(frequency_hz: float) -> np.ndarray:
    """What channel p1 holds in a run at that frequency: 200 Pa."""
    time = np.arange(FRAMES) / RATE_HZ
    return 200 * np.sin(2 * np.pi * frequency_hz * time)


def make_folder(folder: Path) -> Path:
    """Write the campaign folder; returns it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "campaign.toml").write_text(TOML, encoding="utf-8")
    time = np.arange(FRAMES) / RATE_HZ
    for name, frequency, drive in (
        ("free", 170.0, 0.0),
        ("forced-1", 160.0, 1.0),
        ("forced-2", 175.0, 2.0),
    ):
        p = pressure_pa(frequency) * 0.01
        u = drive * np.sin(2 * np.pi * frequency * time)
        volts = np.column_stack([p, 0.9 * p, u])
        wavfile.write(
            folder / f"{name}.wav", RATE_HZ, np.round(volts / FULL_SCALE_V * 32767).astype(np.int16)
        )
    return folder
