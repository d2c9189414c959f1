"""What a run holds, cut to what a client can use: slices, envelopes, spectra, other formats.

Everything here reads run files in pieces of `PIECE` frames, so that memory stays bounded whatever
the run's length, and returns values in each channel's own unit.
"""

import io
import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import numpy.typing as npt

from daq.errors import InputError
from daq.records import RunHeader
from daq.store_file import open_run, read_gaps, read_header, read_volts

FloatArray = npt.NDArray[np.float64]
PIECE = 1 << 16
MOST_SPECTRUM_FRAMES = 1 << 21
Format = Literal["hdf5", "csv", "npz", "mat"]


def metadata(path: Path) -> dict[str, Any]:
    """Header, length, gaps and outcome of a run."""
    with open_run(path) as file:
        header, entry = read_header(file), file["entry"].attrs
        return {
            **asdict(header),
            "samples": int(file["entry/data/samples"].shape[0]),
            "exit_status": str(entry["exit_status"]),
            "exit_reason": str(entry["exit_reason"]),
            "sha256": str(entry["sha256"]),
            "software_version": str(entry["software_version"]),
            "gaps": [asdict(gap) for gap in read_gaps(file)],
            "bytes": path.stat().st_size,
        }


def scales(header: RunHeader) -> FloatArray:
    """Volts per unit, by column."""
    return np.array([channel.volts_per_unit for channel in header.channels])


def bounds(start: int, stop: int | None, frames: int) -> tuple[int, int]:
    """``start:stop`` inside the run; raises `InputError` for an empty slice."""
    end = frames if stop is None else min(stop, frames)
    if not 0 <= start < end:
        raise InputError(f"start={start}, stop={stop} leave nothing of the run's {frames} frames")
    return start, end


def read_slice(path: Path, start: int, stop: int | None, most: int) -> dict[str, Any]:
    """Frames ``start:stop`` of all channels, in their units; more than `most` is refused."""
    with open_run(path) as file:
        header = read_header(file)
        first, last = bounds(start, stop, int(file["entry/data/samples"].shape[0]))
        if last - first > most:
            raise InputError(
                f"start={first}, stop={last} are more than {most} frames: "
                "ask for the envelope, for less, or download the file"
            )
        values = read_volts(file, first, last) / scales(header)
    return {
        "start": first,
        "stop": last,
        "sample_rate_hz": header.sample_rate_hz,
        "channels": {c.name: values[:, i].tolist() for i, c in enumerate(header.channels)},
        "units": {c.name: c.unit for c in header.channels},
    }


def envelope(path: Path, start: int, stop: int | None, points: int) -> dict[str, Any]:
    """Smallest and largest value of each channel in each of at most `points` equal bins."""
    with open_run(path) as file:
        header = read_header(file)
        first, last = bounds(start, stop, int(file["entry/data/samples"].shape[0]))
        width = max(1, math.ceil((last - first) / points))
        count = math.ceil((last - first) / width)
        low, high = (np.full((count, len(header.channels)), s * np.inf) for s in (1, -1))
        step = max(1, PIECE // width) * width
        for at in range(first, last, step):
            values = read_volts(file, at, min(at + step, last)) / scales(header)
            edges = np.arange(0, values.shape[0], width)
            bins = slice((at - first) // width, (at - first) // width + edges.size)
            low[bins] = np.minimum.reduceat(values, edges)
            high[bins] = np.maximum.reduceat(values, edges)
    rate = header.sample_rate_hz
    return {
        "start": first,
        "stop": last,
        "frames_per_bin": width,
        "sample_rate_hz": rate,
        "time_s": ((first + width * np.arange(count)) / rate).tolist(),
        "channels": {
            c.name: {"min": low[:, i].tolist(), "max": high[:, i].tolist()}
            for i, c in enumerate(header.channels)
        },
        "units": {c.name: c.unit for c in header.channels},
    }


def spectrum(
    path: Path, channel: str | None, start: int, stop: int | None, max_hz: float | None, points: int
) -> dict[str, Any]:
    """Amplitude spectrum (peak value of a sine in its bin) under a Hann window.

    The mean is taken off first. Where there are more bins than `points`, each point is the
    largest of its bins, so that no line is lost.
    """
    with open_run(path) as file:
        header = read_header(file)
        names = [c.name for c in header.channels]
        if channel is not None and channel not in names:
            raise InputError(f"channel={channel!r} is not one of {', '.join(names)}")
        first, last = bounds(start, stop, int(file["entry/data/samples"].shape[0]))
        last = min(last, first + MOST_SPECTRUM_FRAMES)
        values = read_volts(file, first, last) / scales(header)
    wanted = [i for i, name in enumerate(names) if channel is None or name == channel]
    rate = header.sample_rate_hz
    frequency, lines = amplitude_spectrum(values[:, wanted], rate)
    inside = frequency <= (max_hz or rate / 2)
    frequency, lines = frequency[inside], lines[inside]
    width = max(1, math.ceil(frequency.size / points))
    edges = np.arange(0, frequency.size, width)
    tops = np.maximum.reduceat(lines, edges)
    return {
        "start": first,
        "stop": last,
        "resolution_hz": rate / (last - first),
        "frequency_hz": frequency[edges].tolist(),
        "channels": {names[i]: tops[:, k].tolist() for k, i in enumerate(wanted)},
        "units": {names[i]: header.channels[i].unit for i in wanted},
        "forcing_hz": header.frequency_hz,
    }


def amplitude_spectrum(values: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies, and amplitudes of shape (bins, channels), of `values` (frames, channels)."""
    frames = values.shape[0]
    window = np.hanning(frames + 1)[:-1] if frames > 3 else np.ones(frames)
    weighted = (values - values.mean(axis=0)) * window[:, None]
    lines = 2 * np.abs(np.fft.rfft(weighted, axis=0)) / window.sum()
    return np.asarray(np.fft.rfftfreq(frames, 1 / rate_hz), np.float64), lines


def exported(path: Path, form: Format) -> tuple[Iterator[bytes], str]:
    """The run in another format, in pieces, and its media type."""
    if form == "hdf5":
        return _whole_file(path), "application/x-hdf5"
    if form == "csv":
        return _csv(path), "text/csv"
    if form == "npz":
        return _npz(path), "application/octet-stream"
    return _mat(path), "application/octet-stream"


def _whole_file(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(1 << 20):
            yield piece


def _pieces(file: h5py.File, header: RunHeader) -> Iterator[FloatArray]:
    frames = int(file["entry/data/samples"].shape[0])
    for start in range(0, frames, PIECE):
        yield read_volts(file, start, min(start + PIECE, frames)) / scales(header)


def _csv(path: Path) -> Iterator[bytes]:
    with open_run(path) as file:
        header = read_header(file)
        titles = ["time_s", *(f"{c.name} ({c.unit})" for c in header.channels)]
        yield (",".join(titles) + "\n").encode()
        at = 0
        for values in _pieces(file, header):
            times = (at + np.arange(len(values))) / header.sample_rate_hz
            at += len(values)
            text = io.StringIO()
            np.savetxt(text, np.column_stack([times, values]), delimiter=",", fmt="%.9g")
            yield text.getvalue().encode()


def _arrays(path: Path) -> dict[str, Any]:
    with open_run(path) as file:
        header = read_header(file)
        frames = int(file["entry/data/samples"].shape[0])
        if frames * len(header.channels) > 5e7:
            raise InputError(
                f"{frames} frames are too many for this format: download hdf5 or csv instead"
            )
        values = np.concatenate(
            list(_pieces(file, header)) or [np.zeros((0, len(header.channels)))]
        )
    arrays: dict[str, Any] = {c.name: values[:, i] for i, c in enumerate(header.channels)}
    return {**arrays, "sample_rate_hz": header.sample_rate_hz}


def _npz(path: Path) -> Iterator[bytes]:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **_arrays(path))
    yield buffer.getvalue()


def _mat(path: Path) -> Iterator[bytes]:
    import scipy.io  # half a second that only this format costs

    buffer = io.BytesIO()
    # The stubs know only paths; files work since SciPy's first days.
    scipy.io.savemat(buffer, _arrays(path), do_compression=True, oned_as="column")  # type: ignore[arg-type]
    yield buffer.getvalue()
