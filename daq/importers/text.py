"""CSV and other text tables: numbers in columns, with or without a line of names.

The separator (comma, semicolon, tab or blanks) is found from the first lines; a separator at the
end of every line is tolerated; with semicolons or tabs a comma may be the decimal sign. A first
column named time gives the sample rate and is not a channel. Values are volts.
"""

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from daq.errors import InputError
from daq.importers.recording import MAX_BYTES, Recording

_TIME = re.compile(r"^(t|time|zeit|temps)\b[\s_]*(\(?\[?s\]?\)?|seconds?)?$", re.IGNORECASE)
_NUMBER = re.compile(r"^[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?$|^[+-]?(nan|inf)$", re.I)
_UNIFORM = 0.05  # largest departure of a time step from the mean that still counts as uniform
_MAX_LINE = 1 << 16


def read_text(path: Path, wanted: Sequence[str] = ()) -> Recording:
    """Read a recording; `wanted` picks columns where the line of names has each of them once."""
    table, names = read_table(path)
    return _pick(path, table, names, wanted)


def read_table(path: Path) -> tuple[npt.NDArray[np.float64], tuple[str, ...]]:
    """The numbers, (rows, columns), and the columns' names where there is a line of them.

    Raises
    ------
    InputError
        Naming the line that is no part of a table, how many columns it has, and what to do.
    """
    size = path.stat().st_size
    if size > MAX_BYTES // 8:
        raise InputError(
            f"{path}: {size / 2**20:.0f} MiB of text is more than the {MAX_BYTES // 8 / 2**20:.0f} "
            "MiB allowed; use a binary format"
        )
    content = path.read_bytes()
    if b"\x00" in content[:4096]:
        raise InputError(f"{path}: binary content in a text table")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    head, names, separator = _layout(path, text)
    body = text[head:]
    if separator in (";", "\t") and "," in body[:4096]:
        body = body.replace(",", ".")
    table = _parse(path, body, separator, first_line=text.count("\n", 0, head) + 1)
    if names and len(names) != table.shape[1]:
        raise InputError(f"{path}: {len(names)} names for {table.shape[1]} columns")
    return table, names


def _layout(path: Path, text: str) -> tuple[int, tuple[str, ...], str | None]:
    """Where the numbers begin, the columns' names, and the separator (None: blanks)."""
    position = 0
    names: tuple[str, ...] = ()
    for line in io.StringIO(text):
        if len(line) > _MAX_LINE:
            raise InputError(f"{path}: a line longer than {_MAX_LINE} characters is no table")
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            separator = _separator(stripped)
            fields = _fields(stripped, separator)
            if all(_NUMBER.match(field) for field in fields):
                return position, names, separator
            if names:
                raise InputError(f"{path}: neither names nor numbers: {stripped[:60]!r}")
            names = tuple(field.strip("\"' ") for field in fields)
        position += len(line)
    what = "no line of numbers" if text.strip() else "no line of numbers, the file is empty"
    raise InputError(
        f"{path}: {what}; a table has one sample a line and one column a channel: export it again"
    )


def _separator(line: str) -> str | None:
    for candidate in (";", "\t", ","):
        if candidate in line:
            return candidate
    return None


def _fields(line: str, separator: str | None) -> list[str]:
    fields = [field.strip() for field in line.split(separator)]
    return fields[:-1] if fields[-1] == "" else fields


def _parse(
    path: Path, body: str, separator: str | None, first_line: int
) -> npt.NDArray[np.float64]:
    first = next(line for line in io.StringIO(body) if line.strip() and line.strip()[0] != "#")
    if separator is not None and first.strip(" \r\n").endswith(separator):
        body = re.sub(rf"(?<=[^\n]){separator}[ \r]*$", "", body, flags=re.MULTILINE)
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=separator, ndmin=2)
    except ValueError as error:
        columns = len(_fields(first.strip(), separator))
        fault = _fault(body, separator, columns, first_line) or f"not a table of numbers ({error})"
        raise InputError(f"{path}: {fault}") from error
    return np.asarray(table, dtype=np.float64)


def _fault(body: str, separator: str | None, columns: int, first_line: int) -> str | None:
    """What is wrong with the first line that does not fit into the table, and what to do."""
    for number, line in enumerate(io.StringIO(body), start=first_line):
        content = line.partition("#")[0].strip()
        fields = [field.strip() for field in content.split(separator)]
        if content and len(fields) != columns:
            return (
                f"line {number} has {len(fields)} columns where {columns} were expected, as in the "
                "first line of numbers; give every line as many, or cut the file there"
            )
        for field in fields if content else ():
            try:
                float(field)
            except ValueError:
                return (
                    f"line {number}: {field!r} is not a number; correct it, or cut the file there"
                )
    return None


def _pick(
    path: Path,
    table: npt.NDArray[np.float64],
    names: tuple[str, ...],
    wanted: Sequence[str],
) -> Recording:
    rate = None
    if names and _TIME.match(names[0]) and table.shape[1] > 1:
        rate = _rate(path, table[:, 0])
        table, names = table[:, 1:], names[1:]
    picked = bool(wanted) and all(names.count(name) == 1 for name in wanted)
    if picked:
        table = table[:, [names.index(name) for name in wanted]]
        names = tuple(wanted)
    return Recording(np.ascontiguousarray(table), rate, names=names, picked=picked)


def _rate(path: Path, time: npt.NDArray[np.float64]) -> float | None:
    steps = np.diff(time)
    if steps.size == 0:
        return None
    mean = float((time[-1] - time[0]) / steps.size)
    if not mean > 0 or float(np.max(np.abs(steps - mean))) > _UNIFORM * mean:
        where = int(np.argmax(np.abs(steps - mean)))
        raise InputError(
            f"{path}: the time column is not uniform (step {steps[where]:g} s after row {where}, "
            f"mean {mean:g} s)"
        )
    return 1.0 / mean
