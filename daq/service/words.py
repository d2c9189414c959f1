"""The words by which single recordings are described, on the command line and over HTTP."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from daq.documents import require_file
from daq.errors import InputError
from daq.importers import RecordingOptions, read_recording
from daq.importers.text import read_table
from daq.records import Kind
from drivers.types import Channel, Quantity, require_si
from identify.characterise import Recording, RecordingError, read_text

TEXT = frozenset({".csv", ".txt", ".tsv", ".dat", ""})


def recording_options(
    channels: Sequence[str],
    columns: Sequence[str],
    rate_hz: float | None,
    kind: str,
    frequency_hz: float | None,
    amplitude_v: float | None,
) -> RecordingOptions:
    """`RecordingOptions` from words; raises `InputError` naming the one that is wrong."""
    if not channels:
        raise InputError("single recordings need channel=... for each channel")
    if kind not in get_args(Kind):
        raise InputError(f"kind={kind!r} is not one of {', '.join(get_args(Kind))}")
    return RecordingOptions(
        channels=tuple(parse_channel(text) for text in channels),
        columns=tuple(int(c) if c.isdecimal() else c for c in columns),
        sample_rate_hz=rate_hz,
        kind=kind,  # type: ignore[arg-type]  # checked above
        frequency_hz=frequency_hz,
        amplitude_v=amplitude_v,
    )


def read_unforced(path: Path, names: Sequence[str], rate_hz: float | None) -> Recording:
    """A recording of any format as `identify.characterise` takes it; raises `InputError`."""
    require_file(path)
    if path.suffix.lower() in TEXT:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # NumPy's own words on an empty file
                return read_text(path, names=names or None, sample_rate_hz=rate_hz)
        except RecordingError as error:
            read_table(path)  # says which line it is where the table itself is at fault
            raise InputError(str(error)) from error
    found = read_recording(path, names)
    rate = found.sample_rate_hz or rate_hz
    if rate is None:
        raise InputError(f"{path}: the file has no sample rate: give one")
    if rate_hz is not None and abs(rate_hz / rate - 1) > 1e-3:
        raise InputError(
            f"{path}: rate_hz={rate_hz:g} is not the file's own, {rate:g}: leave it out"
        )
    count = found.samples.shape[1]
    labels = tuple(names) or found.names or tuple(f"channel{i + 1}" for i in range(count))
    if len(labels) != count:
        raise InputError(f"{path}: {len(labels)} names for {count} columns")
    # Full scale counts as one: a file alone does not know its volts.
    values = found.samples.astype(np.float64) / (found.counts_full_scale or 1.0)
    unit = "V" if found.counts_full_scale is None else "full scale"
    signals = {label: values[:, i] for i, label in enumerate(labels)}
    return Recording(signals, rate, None, unit)


def parse_channel(text: str) -> Channel:
    """``name:quantity:unit:volts_per_unit[:position_m]`` as a `Channel`."""
    parts = text.split(":")
    if len(parts) not in (4, 5) or parts[1] not in get_args(Quantity):
        raise InputError(
            f"channel={text!r} is not name:quantity:unit:volts_per_unit[:position_m] with a "
            f"quantity of {', '.join(get_args(Quantity))}"
        )
    try:
        position = float(parts[4]) if len(parts) == 5 else None
        return require_si(
            Channel(parts[0], parts[1], parts[2], float(parts[3]), position_m=position)  # type: ignore[arg-type]
        )
    except ValueError as error:
        raise InputError(f"channel={text!r}: {error}") from error
