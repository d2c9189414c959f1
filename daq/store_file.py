"""The layout of one run's HDF5 file, NeXus-like, readable without our code.

    /                          @NX_class=NXroot  @format=entrain-run/1  @default=entry
      entry                    NXentry: @title @campaign @kind @role @frequency_hz @amplitude_v
                               @started_s @start_time @exit_status @exit_reason @software
                               @software_version @sha256 @notes (JSON)   @default=data
        instrument             NXinstrument: @name (the rig)
          <channel>            NXdetector, one a channel: @column @quantity @units @volts_per_unit
                               @volts_per_count @full_scale_v @position_m @serial_number @skew_s
        data                   NXdata: @signal=samples
          samples              (frames, channels), the converter's numbers as recorded;
                               @units=count|V  @sample_rate_hz  @channels  @volts_per_count
        quality                NXcollection
          n_valid              frames written for certain (one number)
          gaps                 (n, 2) int64: first frame, frames lost (they are filled in `samples`)
          flags                (n, 3) int64: first frame, frames, bits of @meaning

volts = samples[:, column] * volts_per_count;  value in `units` = volts / volts_per_unit.
Missing numbers (a free run's frequency, an unknown position) are NaN; a missing text is "".
Calibration happens at analysis: `samples` stay raw. `skew_s` > 0: the channel shows a signal common
to all that much later than the first channel does; move it forward by as much.
"""

import json
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from daq.errors import CorruptFile, OtherVersion
from daq.records import RunHeader, RunSummary
from drivers.types import Channel, Gap

FORMAT = "entrain-run/1"
FLAG_BITS = ("overload", "clipped", "xrun", "gap", "repeated", "rate", "muted")
CHUNK_FRAMES = 4096


def write_layout(file: h5py.File, header: RunHeader, campaign: str, version: str) -> None:
    """Create every group, dataset and attribute; afterwards SWMR mode may be switched on."""
    file.attrs.update({"NX_class": "NXroot", "format": FORMAT, "default": "entry"})
    entry = _group(file, "entry", "NXentry")
    entry.attrs.update(
        {
            "default": "data",
            "title": header.name,
            "campaign": campaign,
            "kind": header.kind,
            "role": header.role,
            "frequency_hz": _number(header.frequency_hz),
            "amplitude_v": _number(header.amplitude_v),
            "started_s": header.started_s,
            "start_time": header.started_at,
            "exit_status": "interrupted",
            "exit_reason": "still being written, or the writer was killed",
            "software": "entrain",
            "software_version": version,
            "sha256": "",
            "notes": json.dumps(dict(header.notes)),
        }
    )
    instrument = _group(entry, "instrument", "NXinstrument")
    instrument.attrs["name"] = header.rig
    for column, channel in enumerate(header.channels):
        detector = _group(instrument, channel.name, "NXdetector")
        detector.attrs.update(
            {
                "column": column,
                "quantity": channel.quantity,
                "units": channel.unit,
                "volts_per_unit": channel.volts_per_unit,
                "volts_per_count": header.volts_per_count[column],
                "full_scale_v": channel.full_scale_v,
                "position_m": _number(channel.position_m),
                "serial_number": channel.serial_number or "",
                "skew_s": header.skew_s[column],
            }
        )
    data = _group(entry, "data", "NXdata")
    data.attrs["signal"] = "samples"
    width = len(header.channels)
    samples = data.create_dataset(
        "samples", (0, width), header.dtype, maxshape=(None, width), chunks=(CHUNK_FRAMES, width)
    )
    samples.attrs.update(
        {
            "units": "count" if np.issubdtype(np.dtype(header.dtype), np.integer) else "V",
            "sample_rate_hz": header.sample_rate_hz,
            "volts_per_count": np.asarray(header.volts_per_count),
            "channels": [channel.name for channel in header.channels],
        }
    )
    quality = _group(entry, "quality", "NXcollection")
    quality.create_dataset("n_valid", data=np.int64(0))
    quality.create_dataset("gaps", (0, 2), "int64", maxshape=(None, 2), chunks=(64, 2))
    flags = quality.create_dataset("flags", (0, 3), "int64", maxshape=(None, 3), chunks=(64, 3))
    flags.attrs["meaning"] = list(FLAG_BITS)


def read_header(file: h5py.File) -> RunHeader:
    """The header of an open run file; raises `CorruptFile` for anything that is not one."""
    try:
        found = file.attrs.get("format")
        if str(found).startswith("entrain-run/") and found != FORMAT:
            raise OtherVersion(
                f"{file.filename}: format={found!r} is of another version of entrain, "
                f"this one reads {FORMAT!r}: use that one"
            )
        if found != FORMAT:
            raise CorruptFile(f"{file.filename}: format={found!r} is not {FORMAT!r}")
        entry = file["entry"].attrs
        samples = file["entry/data/samples"]
        detectors = [dict(group.attrs) for group in file["entry/instrument"].values()]
        names = [str(name) for name in file["entry/instrument"]]
        order = np.argsort([int(detector["column"]) for detector in detectors])
        return RunHeader(
            name=str(entry["title"]),
            kind=str(entry["kind"]),  # type: ignore[arg-type]  # checked by RunHeader
            sample_rate_hz=float(samples.attrs["sample_rate_hz"]),
            channels=tuple(_channel(names[i], detectors[i]) for i in order),
            dtype=str(samples.dtype),  # type: ignore[arg-type]
            volts_per_count=tuple(float(v) for v in samples.attrs["volts_per_count"]),
            skew_s=tuple(float(detectors[i]["skew_s"]) for i in order),
            frequency_hz=_optional(entry["frequency_hz"]),
            amplitude_v=_optional(entry["amplitude_v"]),
            started_s=float(entry["started_s"]),
            started_at=str(entry["start_time"]),
            role=str(entry["role"]),  # type: ignore[arg-type]
            rig=str(file["entry/instrument"].attrs["name"]),
            notes=json.loads(str(entry["notes"])),
        )
    except (KeyError, ValueError, OSError, RuntimeError) as error:
        raise CorruptFile(f"{file.filename}: not a readable run file ({error})") from error


def read_summary(path: Path, campaign: str) -> RunSummary:
    """What the catalogue keeps of a finished run file."""
    with open_run(path) as file:
        header = read_header(file)
        entry = file["entry"].attrs
        return summarise(
            header,
            campaign,
            samples=int(file["entry/data/samples"].shape[0]),
            exit_status=str(entry["exit_status"]),
            exit_reason=str(entry["exit_reason"]),
            sha256=str(entry["sha256"]),
            bytes=path.stat().st_size,
        )


def summarise(header: RunHeader, campaign: str, **outcome: Any) -> RunSummary:
    """The catalogue's line for a header and what became of its run."""
    shared = {field.name: getattr(header, field.name) for field in _SHARED}
    return RunSummary(campaign=campaign, **shared, **outcome)


_SHARED = [f for f in fields(RunHeader) if f.name in {g.name for g in fields(RunSummary)}]


def open_run(path: Path, *, live: bool = False) -> h5py.File:
    """Open for reading; `live` also opens a file that is still being written (SWMR)."""
    try:
        return h5py.File(path, "r", swmr=live, libver="latest", locking=False)
    except OSError as error:
        if not path.exists():
            raise CorruptFile(f"{path}: no such run file") from error
        raise CorruptFile(f"{path}: not a readable HDF5 file ({error})") from error


def read_gaps(file: h5py.File) -> tuple[Gap, ...]:
    """The lost frames of an open run file."""
    return tuple(Gap(int(first), int(frames)) for first, frames in file["entry/quality/gaps"][()])


def read_volts(file: h5py.File, start: int = 0, stop: int | None = None) -> npt.NDArray[np.float64]:
    """Samples ``start:stop`` in volts, shape (frames, channels)."""
    dataset = file["entry/data/samples"]
    counts = dataset[start:stop]
    return np.asarray(counts * np.asarray(dataset.attrs["volts_per_count"])[None, :])


def _group(parent: Any, name: str, nx_class: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    return group


def _channel(name: str, attrs: dict[str, Any]) -> Channel:
    return Channel(
        name=name,
        quantity=str(attrs["quantity"]),  # type: ignore[arg-type]
        unit=str(attrs["units"]),
        volts_per_unit=float(attrs["volts_per_unit"]),
        full_scale_v=float(attrs["full_scale_v"]),
        position_m=_optional(attrs["position_m"]),
        serial_number=str(attrs["serial_number"]) or None,
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _optional(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
