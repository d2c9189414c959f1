"""Formats of named arrays: NumPy `.npz`, MATLAB `.mat` (5 and 7.3) and HDF5. Values are volts.

Channels come from the variables named, each one-dimensional, or from one two-dimensional variable
that holds a column a channel. A scalar named like a sample rate is taken as one. Sizes are read
from the headers first; a member that declares more than `MAX_BYTES` is never unpacked, and
pickled objects are never loaded.
"""

import math
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import scipy.io

from daq.errors import InputError
from daq.importers.recording import Recording, as_columns, require_size

_RATES = ("sample_rate_hz", "sample_rate", "fs", "Fs", "sample_freq", "samplerate", "SampleRate")


def read_npz(path: Path, wanted: Sequence[str] = ()) -> Recording:
    """Read a NumPy archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            require_size(path, "the archive", sum(member.file_size for member in members))
            shapes: dict[str, tuple[int, ...]] = {}
            for member in members:
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as file:
                    shape, dtype = _npy_header(file)
                if math.prod(shape) * dtype.itemsize > member.file_size:
                    raise InputError(
                        f"{path}: {name!r} declares shape {shape}, more than its "
                        f"{member.file_size} bytes hold"
                    )
                shapes[name] = shape
        with np.load(path, allow_pickle=False) as arrays:
            return _assemble(path, shapes, lambda name: arrays[name], wanted)
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a readable NumPy archive ({error})") from error


def read_mat(path: Path, wanted: Sequence[str] = ()) -> Recording:
    """Read a MATLAB file: version 5 by SciPy, version 7.3 as the HDF5 file that it is."""
    with path.open("rb") as file:
        head = file.read(128)
    if h5py.is_hdf5(path):
        return read_hdf5(path, wanted)
    if len(head) < 128 or not head.startswith(b"MATLAB 5.0"):
        raise InputError(f"{path}: not a MATLAB file of version 5 or 7.3")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            listed = scipy.io.whosmat(path)
            shapes = {name: tuple(int(n) for n in shape) for name, shape, _ in listed}
            for name, shape in shapes.items():
                require_size(path, f"variable {name!r}", 8 * math.prod(shape))
            return _assemble(
                path,
                shapes,
                lambda name: scipy.io.loadmat(path, variable_names=[name])[name],
                wanted,
            )
    except InputError:
        raise
    except Exception as error:  # SciPy raises whatever a damaged byte leads it to
        raise InputError(f"{path}: not a readable MATLAB file ({error})") from error


def read_hdf5(path: Path, wanted: Sequence[str] = ()) -> Recording:
    """Read datasets of an HDF5 file; names may be paths (``group/dataset``)."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            shapes: dict[str, tuple[int, ...]] = {}
            rates: list[float] = []

            def visit(name: str, item: Any) -> None:
                rates.extend(_rate_of(item.attrs))
                if isinstance(item, h5py.Dataset) and item.dtype.kind in "iufb":
                    shapes[name] = tuple(item.shape)

            file.visititems(visit)
            rates.extend(_rate_of(file.attrs))

            def load(name: str) -> npt.NDArray[Any]:
                dataset = file[name]
                if dataset.external or dataset.is_virtual:
                    raise InputError(f"{path}: {name!r} keeps its samples in another file")
                require_size(path, repr(name), dataset.size * dataset.dtype.itemsize)
                return np.asarray(dataset[()])

            recording = _assemble(path, shapes, load, wanted)
            if recording.sample_rate_hz is None and rates:
                return replace(recording, sample_rate_hz=rates[0])
            return recording
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a readable HDF5 file ({error})") from error


def _assemble(
    path: Path,
    shapes: Mapping[str, tuple[int, ...]],
    load: Callable[[str], npt.NDArray[Any]],
    wanted: Sequence[str],
) -> Recording:
    """Columns from the variables wanted, or from the only array that can be meant."""
    missing = [name for name in wanted if name not in shapes]
    chosen = list(dict.fromkeys(wanted))
    if missing:
        tables = [name for name, shape in shapes.items() if _is_table(shape)]
        if len(missing) < len(wanted) or len(tables) != 1:
            raise InputError(
                f"{path}: no variable {missing[0]!r}; there are {', '.join(sorted(shapes)) or '—'}"
            )
        chosen = tables
    if not chosen:
        tables = [name for name, shape in shapes.items() if _is_table(shape)]
        chosen = tables if len(tables) == 1 else [n for n, s in shapes.items() if math.prod(s) > 1]
    if not chosen:
        raise InputError(f"{path}: holds no array of numbers")
    columns = [as_columns(path, load(name), f"variable {name!r}") for name in chosen]
    lengths = {name: len(column) for name, column in zip(chosen, columns, strict=True)}
    if len(set(lengths.values())) > 1:
        raise InputError(f"{path}: variables of unequal length: {lengths}")
    rates = [
        float(np.asarray(load(name)).reshape(-1)[0])
        for name in _RATES
        if name in shapes and math.prod(shapes[name]) == 1
    ]
    names = tuple(chosen) if all(column.shape[1] == 1 for column in columns) else ()
    samples = columns[0] if len(columns) == 1 else np.concatenate(columns, axis=1)
    rate = rates[0] if rates else None
    return Recording(samples, rate, names=names, picked=bool(wanted) and not missing)


def _is_table(shape: tuple[int, ...]) -> bool:
    return len(shape) == 2 and min(shape) > 1


def _rate_of(attrs: Mapping[str, Any]) -> list[float]:
    return [float(attrs[name]) for name in _RATES if name in attrs]


def _npy_header(file: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(file)
    reader = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = reader(file)
    if dtype.hasobject:
        raise ValueError("pickled objects are not loaded")
    return tuple(shape), dtype
