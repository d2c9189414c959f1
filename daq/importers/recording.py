"""One recording as it lies in a file of any format, before it becomes a run.

Every reader is a function ``read(path, wanted) -> Recording``; the format is chosen by the file
name's suffix. Readers trust nothing that a file says of itself: declared sizes are compared with
the file's own size and with `MAX_BYTES` before anything is allocated.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from daq.documents import require_file
from daq.errors import InputError

MAX_BYTES = 2 * 2**30  # largest recording that a format without streaming may unpack to


@dataclass(frozen=True)
class Recording:
    """What a file holds.

    `samples` has shape (frames, channels), in the file's own numbers. `counts_full_scale` is the
    number that stands for the converter's full scale (32768 for int16 WAV, 1 for float WAV); None:
    the samples are volts. `sample_rate_hz` is None where the format does not say. `names` are the
    columns' names where the file has any. `picked`: the columns are those that were wanted by name,
    in that order; otherwise all of the file's, in its own.
    """

    samples: npt.NDArray[Any]
    sample_rate_hz: float | None = None
    counts_full_scale: float | None = None
    names: tuple[str, ...] = ()
    picked: bool = False

    def volts_per_count(self, full_scale_v: float) -> float:
        """The factor from the file's numbers to volts."""
        return 1.0 if self.counts_full_scale is None else full_scale_v / self.counts_full_scale


Reader = Callable[[Path, Sequence[str]], Recording]
# Suffix to module and function, imported when first needed: a WAV campaign loads no MATLAB reader.
READERS = {
    ".wav": ("wav", "read_wav"),
    ".csv": ("text", "read_text"),
    ".txt": ("text", "read_text"),
    ".tsv": ("text", "read_text"),
    ".dat": ("text", "read_text"),
    ".npz": ("arrays", "read_npz"),
    ".mat": ("arrays", "read_mat"),
    ".h5": ("arrays", "read_hdf5"),
    ".hdf5": ("arrays", "read_hdf5"),
    ".tdms": ("tdms", "read_tdms"),
}


def read_recording(path: Path, wanted: Sequence[str] = ()) -> Recording:
    """Read a file by its suffix.

    Parameters
    ----------
    wanted
        For formats with named columns or variables, those in column order; empty: the one
        two-dimensional array, or all one-dimensional ones of equal length in the file's order.
        Text, WAV and the one two-dimensional array are read whole where they lack the names:
        `require_picked` refuses that.

    Raises
    ------
    InputError
        For a missing, damaged, empty or oversized file and for an unknown format; it names the
        file and what is wrong.
    """
    if path.suffix.lower() not in READERS:
        raise InputError(
            f"{path}: the format {path.suffix!r} is not one of {', '.join(sorted(READERS))}"
        )
    module, function = READERS[path.suffix.lower()]
    try:
        require_file(path)
        reader: Reader = getattr(import_module(f"daq.importers.{module}"), function)
        recording = reader(path, wanted)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    if recording.samples.shape[0] == 0 or recording.samples.shape[1] == 0:
        raise InputError(f"{path}: holds no samples")
    return recording


def require_picked(path: Path, recording: Recording, wanted: Sequence[str]) -> None:
    """Refuse a recording without the columns wanted by name; raises `InputError`."""
    if recording.picked:
        return
    for name in wanted:
        if not recording.names:
            raise InputError(
                f"{path}: no column {name!r}: its columns have no names: give numbers from 0"
            )
        if name not in recording.names:
            raise InputError(f"{path}: no column {name!r}; there are {', '.join(recording.names)}")
        if (count := recording.names.count(name)) > 1:
            raise InputError(f"{path}: {count} columns are named {name!r}: rename them")


def require_size(path: Path, what: str, size: int) -> None:
    """Refuse what would not fit into bounded memory."""
    if size > MAX_BYTES:
        raise InputError(
            f"{path}: {what} declares {size / 2**30:.1f} GiB, more than the "
            f"{MAX_BYTES / 2**30:.0f} GiB allowed; split it, or use WAV (streamed)"
        )


def as_columns(path: Path, array: npt.NDArray[Any], what: str) -> npt.NDArray[Any]:
    """A numeric array as (frames, columns); the longer axis is time. Complex or text is refused."""
    array = np.asarray(array)
    if array.dtype.kind not in "iufb" or array.ndim > 2 or array.size == 0:
        raise InputError(
            f"{path}: {what} has type {array.dtype} and shape {array.shape}, "
            "not real numbers in one or two dimensions"
        )
    if array.ndim < 2:
        return array.reshape(-1, 1)
    return array.T if array.shape[0] < array.shape[1] else array
