"""Reads a recording of a self-excited oscillation from text, as laboratories keep them.

A text file holds one row a sample, columns separated by tabs, commas, semicolons or blanks, with
or without a line of names. One column may be the time in seconds; LabVIEW writes seconds since
1 January 1904 as a double of about 3.5e9, whose last bit is 4.8e-7 s: single time steps are
quantised (two or three distinct values), so the sample rate comes from the least-squares slope of
time over row number, whose error from quantisation is below 1e-8 of the rate for thousands of
rows, and never from one difference. Rows missing from the clock are an error, never bridged.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

LABVIEW_EPOCH_TO_UNIX_S = 2_082_844_800.0  # 1904-01-01 to 1970-01-01, 24 107 days
_TIME_NAMES = {"time", "t", "time_s", "seconds"}
# Headerless files: two signals are the light and the pressure, in that order, as in the public
# bluff-body combustor recordings; one signal is the pressure.
_DEFAULT_NAMES: dict[int, tuple[str, ...]] = {1: ("pressure",), 2: ("light", "pressure")}


@dataclass(frozen=True)
class Recording:
    """Named signals of equal length, shape (samples,), in volts unless the file says otherwise."""

    signals: dict[str, FloatArray]
    sample_rate_hz: float
    started_unix_s: float | None = None
    unit: str = "V"

    @property
    def samples(self) -> int:
        return int(next(iter(self.signals.values())).size)


class RecordingError(ValueError):
    """The file is not a readable recording: the message names file, place and remedy."""


def read_text(
    path: str | Path, *, names: Sequence[str] | None = None, sample_rate_hz: float | None = None
) -> Recording:
    """Read a text recording.

    Parameters
    ----------
    path : file of numbers, one row a sample; a first line of names is optional.
    names : names of the signal columns (without the time), overriding the file's.
    sample_rate_hz : required where the file has no time column; refused where it contradicts one.

    Raises
    ------
    RecordingError : unreadable numbers, missing rows, names that do not fit, no sample rate.
    """
    path = Path(path)
    header, table = _table(path)
    time, columns, found = _split_time(table, header)
    labels = tuple(names) if names is not None else found
    if labels is None:
        labels = _DEFAULT_NAMES.get(
            columns.shape[1], tuple(f"channel{i + 1}" for i in range(columns.shape[1]))
        )
    if len(labels) != columns.shape[1] or len(set(labels)) != len(labels):
        raise RecordingError(
            f"{path}: names={list(labels)} are not {columns.shape[1]} different names, one a signal"
            " column: pass names=... without the time column"
        )
    started = None
    if time is not None:
        rate, started = _rate_of(time, path)
        if sample_rate_hz is not None and abs(sample_rate_hz / rate - 1) > 1e-3:
            raise RecordingError(
                f"{path}: sample_rate_hz={sample_rate_hz} is not the time column's {rate:.6g}"
                " within 0.1 %: leave it out, or correct the file"
            )
    elif sample_rate_hz is None:
        raise RecordingError(f"{path}: no time column: pass sample_rate_hz=...")
    else:
        rate = float(sample_rate_hz)
    signals = {name: np.ascontiguousarray(columns[:, i]) for i, name in enumerate(labels)}
    return Recording(signals, rate, started)


def _table(path: Path) -> tuple[list[str] | None, FloatArray]:
    """The optional line of names, and the numbers, shape (rows, columns)."""
    with path.open(encoding="utf-8-sig") as lines:
        first = lines.readline()
    delimiter = next((mark for mark in "\t;," if mark in first), None)
    words = [w.strip().strip('"') for w in (first.split(delimiter) if delimiter else first.split())]
    words = [w for w in words if w]
    has_names = not all(re.fullmatch(r"[-+0-9.eEinfNa]+", word) for word in words)
    try:
        table = np.loadtxt(
            path,
            delimiter=delimiter,
            skiprows=1 if has_names else 0,
            ndmin=2,
            usecols=range(len(words)),
            encoding="utf-8-sig",
        )
    except (ValueError, IndexError) as error:
        raise RecordingError(f"{path}: not a table of numbers: {error}") from error
    if table.shape[0] < 2 or not np.isfinite(table).all():
        raise RecordingError(f"{path}: rows={table.shape[0]}, or a value is not a finite number")
    return (words if has_names else None), table


def _split_time(
    table: FloatArray, header: list[str] | None
) -> tuple[FloatArray | None, FloatArray, tuple[str, ...] | None]:
    """Take the time column off: named so, or headerless, first and strictly growing."""
    names = None if header is None else tuple(header)
    index = None
    if names is not None:
        index = next((i for i, name in enumerate(names) if name.lower() in _TIME_NAMES), None)
    elif table.shape[1] > 1 and bool((np.diff(table[:, 0]) > 0).all()):
        index = 0
    if index is None:
        return None, table, names
    rest = np.delete(table, index, axis=1)
    left = None if names is None else names[:index] + names[index + 1 :]
    return table[:, index], rest, left


def _rate_of(time: FloatArray, path: Path) -> tuple[float, float | None]:
    """Sample rate from the slope of a quantised clock, and the start as Unix time if absolute."""
    elapsed = time - time[0]
    steps = np.diff(elapsed)
    typical = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - typical)))
    if typical <= 0 or abs(steps[worst] - typical) > 0.5 * typical:
        raise RecordingError(
            f"{path}: time step {steps[worst]:.6g} s after row {worst + 1} is not the usual"
            f" {typical:.6g} s: samples are missing or repeated; cut the file there"
        )
    rows = np.arange(time.size) - (time.size - 1) / 2
    slope = float(rows @ elapsed / (rows @ rows))
    absolute = time[0] > LABVIEW_EPOCH_TO_UNIX_S
    return 1 / slope, float(time[0]) - LABVIEW_EPOCH_TO_UNIX_S if absolute else None
