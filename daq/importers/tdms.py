"""TDMS, LabVIEW's recording format (extra `tdms`, npTDMS). Values are volts.

Channels are named ``group/channel`` or, where that is unambiguous, by the channel alone; the
sample rate comes from the waveform property `wf_increment`.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from daq.errors import InputError
from daq.importers.recording import Recording, require_size


def read_tdms(path: Path, wanted: Sequence[str] = ()) -> Recording:
    """Read a TDMS file; raises `InputError` also when npTDMS is not installed."""
    try:
        from nptdms import TdmsFile
    except ImportError as error:
        raise InputError(
            f"{path}: reading TDMS needs npTDMS: pip install 'entrain[tdms]'"
        ) from error
    if path.read_bytes()[:4] != b"TDSm":
        raise InputError(f"{path}: not a TDMS file")
    try:
        with path.open("rb") as raw, TdmsFile.open(raw) as file:
            channels = {
                f"{group.name}/{channel.name}": channel
                for group in file.groups()
                for channel in group.channels()
            }
            chosen = [_find(path, list(channels), name) for name in wanted] or list(channels)
            lengths = {name: len(channels[name]) for name in chosen}
            if len(set(lengths.values())) != 1:
                raise InputError(f"{path}: channels of unequal length: {lengths}")
            require_size(path, "the recording", 8 * sum(lengths.values()))
            columns = [np.asarray(channels[name][:]) for name in chosen]
            steps = {channels[name].properties.get("wf_increment") for name in chosen}
    except InputError:
        raise
    except Exception as error:  # npTDMS raises whatever a damaged byte leads it to
        raise InputError(f"{path}: not a readable TDMS file ({error})") from error
    if any(column.dtype.kind not in "iuf" for column in columns):
        raise InputError(f"{path}: holds channels that are not real numbers")
    step = steps.pop() if len(steps) == 1 else None
    rate = 1.0 / float(step) if step else None
    samples = np.stack(columns, axis=1)
    return Recording(samples, rate, names=tuple(chosen), picked=bool(wanted))


def _find(path: Path, names: list[str], wanted: str) -> str:
    matches = [name for name in names if name == wanted or name.rpartition("/")[2] == wanted]
    if len(matches) != 1:
        raise InputError(
            f"{path}: {len(matches)} channels match {wanted!r}; there are {', '.join(names)}"
        )
    return matches[0]
