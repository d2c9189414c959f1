"""WAV: RIFF chunks, PCM of 16, 24 or 32 bits and IEEE floats of 32 or 64 bits.

The samples are mapped, not read, so that a recording of any length costs no memory. Sizes in the
header are checked against the file's length: a recorder that was cut off leaves a data chunk
that claims more than there is, and that is an error here, not a shorter recording.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from daq.errors import InputError
from daq.importers.recording import Recording

_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE


def read_wav(path: Path, wanted: Sequence[str] = ()) -> Recording:
    """Read a WAV file; `wanted` is never `picked`, since its columns have no names."""
    size = path.stat().st_size
    chunks = _chunks(path, size)
    if "fmt " not in chunks or "data" not in chunks:
        raise InputError(f"{path}: a WAV file without {'fmt' if 'fmt ' not in chunks else 'data'}")
    start, length = chunks["fmt "]
    if length < 16:
        raise InputError(f"{path}: the fmt chunk has {length} bytes, not at least 16")
    with path.open("rb") as file:
        file.seek(start)
        head = file.read(min(length, 40))
    tag, channels, rate, _, frame_bytes, bits = struct.unpack("<HHIIHH", head[:16])
    if tag == _EXTENSIBLE and len(head) >= 26:
        tag = int(struct.unpack("<H", head[24:26])[0])
    start, length = chunks["data"]
    if channels == 0 or rate == 0 or bits % 8 or frame_bytes != channels * bits // 8:
        raise InputError(
            f"{path}: header says {channels} channels, {rate} Hz, {bits} bits, {frame_bytes} "
            "bytes a frame, which do not fit together"
        )
    if length % frame_bytes:
        raise InputError(f"{path}: the data end within a frame: truncated")
    shape = (length // frame_bytes, channels)
    if shape[0] == 0:
        raise InputError(f"{path}: holds no samples")
    if (tag, bits) == (_PCM, 24):
        raw = np.memmap(path, np.uint8, "r", start, (*shape, 3))
        wide = np.zeros((*shape, 4), np.uint8)
        wide[..., 1:] = raw  # left-justified, so that the sign is right
        return Recording(wide.view("<i4")[..., 0] >> 8, float(rate), 2.0**23)
    kinds = {(_PCM, 16): "<i2", (_PCM, 32): "<i4", (_FLOAT, 32): "<f4", (_FLOAT, 64): "<f8"}
    if (tag, bits) not in kinds:
        raise InputError(
            f"{path}: WAV format {tag} with {bits} bits is not PCM of 16, 24 or 32 bits "
            "or floats of 32 or 64"
        )
    scale = 2.0 ** (bits - 1) if tag == _PCM else 1.0
    samples = np.memmap(path, kinds[tag, bits], "r", start, shape)
    return Recording(samples, float(rate), scale)


def _chunks(path: Path, size: int) -> dict[str, tuple[int, int]]:
    """Start and length of each chunk's content."""
    found: dict[str, tuple[int, int]] = {}
    with path.open("rb") as file:
        riff = file.read(12)
        if len(riff) < 12 or riff[:4] != b"RIFF" or riff[8:] != b"WAVE":
            raise InputError(f"{path}: not a WAV file (no RIFF/WAVE header)")
        position = 12
        while position + 8 <= size and len(found) < 64:
            file.seek(position)
            name, length = struct.unpack("<4sI", file.read(8))
            label = name.decode("latin-1")
            if position + 8 + length > size:
                raise InputError(
                    f"{path}: chunk {label!r} claims {length} bytes, {size - position - 8} are "
                    "there: truncated, or never closed by its recorder"
                )
            found.setdefault(label, (position + 8, length))
            position += 8 + length + length % 2
    return found
