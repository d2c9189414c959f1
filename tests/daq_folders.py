"""Builds small campaign folders on disk, as another program would write them."""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

RATE_HZ = 2000.0

CHANNELS = """
[[channels]]
name = "p1"
quantity = "pressure"
volts_per_unit = 0.002
unit = "Pa"
position_m = 0.66
full_scale_v = 10.0

[[channels]]
name = "p2"
quantity = "pressure"
volts_per_unit = 0.004
unit = "Pa"
position_m = 0.71
full_scale_v = 5.0

[[channels]]
name = "drive"
quantity = "voltage"
volts_per_unit = 1.0
unit = "V"
full_scale_v = 10.0
"""


def tones(frequency_hz: float, drive_v: float, samples: int = 1000) -> npt.NDArray[np.float64]:
    """Volts of p1, p2 and drive, shape (samples, 3)."""
    phase = 2 * np.pi * frequency_hz * np.arange(samples) / RATE_HZ
    return np.stack([np.sin(phase), 0.5 * np.cos(phase), drive_v * np.sin(phase)], axis=1)


def write_wav(
    path: Path, samples: npt.NDArray[Any], rate_hz: float = RATE_HZ, *, tag: int = 1
) -> None:
    """Samples (frames, channels) of the file's own type as a plain WAV file."""
    data = np.ascontiguousarray(samples).tobytes()
    channels, size = samples.shape[1], samples.dtype.itemsize
    head = struct.pack(
        "<HHIIHH", tag, channels, int(rate_hz), int(rate_hz) * channels * size, channels * size,
        8 * size,
    )  # fmt: skip
    body = b"WAVEfmt " + struct.pack("<I", len(head)) + head + b"data"
    body += struct.pack("<I", len(data)) + data
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)


def int16(volts: npt.NDArray[np.float64]) -> npt.NDArray[np.int16]:
    """The converter's numbers for the three channels of `CHANNELS`."""
    return np.round(volts / np.array([10.0, 5.0, 10.0]) * 32768).astype(np.int16)


def write_folder(
    folder: Path,
    *,
    head: Mapping[str, Any] | None = None,
    runs: str | None = None,
    channels: str = CHANNELS,
    extra: str = "",
) -> Path:
    """A free, two forced and a validation run as int16 WAV, with a `campaign.toml`."""
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    write_wav(folder / "runs/free.wav", int16(tones(170.0, 0.0)))
    for name, frequency in (("f166", 166.0), ("f172", 172.0), ("v168", 168.0)):
        write_wav(folder / f"runs/{name}.wav", int16(tones(frequency, 1.5)))
    default = """
[[runs]]
file = "runs/free.wav"
kind = "free"

[[runs]]
file = "runs/f166.wav"
kind = "forced"
frequency_hz = 166.0
amplitude_v = 1.5
started_s = 60

[[runs]]
file = "runs/f172.wav"
kind = "forced"
frequency_hz = 172.0
amplitude_v = 1.5
started_s = 120

[[runs]]
file = "runs/v168.wav"
kind = "forced"
frequency_hz = 168.0
amplitude_v = 1.5
started_s = 180
role = "validation"
"""
    keys = {"format": "campaign-folder/1", "title": "small tube", "sample_rate_hz": RATE_HZ}
    keys.update(head or {})
    lines = [f"{key} = {value!r}".replace("'", '"') for key, value in keys.items()]
    text = "\n".join(lines) + "\n" + extra + channels + (default if runs is None else runs)
    (folder / "campaign.toml").write_text(text, "utf-8")
    return folder
