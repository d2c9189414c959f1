"""Run files written in the formats that other programs read; what `daq.importers` reads back.

CSV, NPZ, MAT, HDF5 and TDMS hold volts, exactly as the run store computes them (double precision;
CSV with 17 digits). WAV holds the converter's own numbers where the run has integers, and float32
parts of full scale where it has floats: exact for a full scale that is a power of two, within half
a unit in the last place of float32 otherwise. `export_folder` writes a whole campaign folder.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import numpy.typing as npt
import scipy.io
from scipy.io import wavfile

from daq.errors import InputError, StoreError
from daq.records import CampaignCard, RunHeader
from daq.store import RunStore
from daq.store_file import open_run, read_header, read_volts

FloatArray = npt.NDArray[np.float64]
Format = Literal["wav", "csv", "npz", "mat", "h5", "tdms"]


def export_run(source: Path, target: Path) -> None:
    """Write a run file's samples to `target`; its suffix chooses the format.

    Raises
    ------
    InputError
        An unknown suffix, or a library that is missing.
    """
    kind = target.suffix.lower().lstrip(".")
    if kind not in WRITERS:
        raise InputError(f"{target}: the format {kind!r} is not one of {', '.join(WRITERS)}")
    with open_run(source) as file:
        header = read_header(file)
        counts = np.asarray(file["entry/data/samples"][()])
        volts = read_volts(file)
    try:
        WRITERS[kind](target, header, counts, volts)
    except OSError as error:
        raise StoreError(f"{target}: cannot be written ({error})") from error


def export_folder(store: RunStore, campaign: str, folder: Path, format: Format = "wav") -> Path:
    """A campaign as a campaign folder (`campaign-folder/1`) that `import_folder` reads back."""
    card = store.card(campaign)
    runs = [run for run in store.campaign_runs(campaign) if run.exit_status == "success"]
    if not runs:
        raise InputError(f"campaign {campaign!r} has no run that succeeded")
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    files, headers = [], []
    for run in runs:
        source = store.run_path(run.id)
        name = f"runs/{run.name}.{format}"
        export_run(source, folder / name)
        files.append(name)
        with open_run(source) as file:
            headers.append(read_header(file))
    (folder / "campaign.toml").write_text(_toml(card, headers, files), "utf-8")
    return folder


def _wav(target: Path, header: RunHeader, counts: npt.NDArray[Any], volts: FloatArray) -> None:
    scales = np.array([channel.full_scale_v for channel in header.channels])
    steps = np.asarray(header.volts_per_count)
    bits = {np.dtype(np.int16): 15, np.dtype(np.int32): 31}.get(counts.dtype)
    if bits is not None and np.allclose(steps * 2.0**bits, scales, rtol=1e-12):
        samples = counts
    else:
        samples = (volts / scales).astype(np.float32)
    if not float(header.sample_rate_hz).is_integer():
        raise InputError(f"{target}: WAV cannot say a rate of {header.sample_rate_hz} Hz")
    wavfile.write(target, int(header.sample_rate_hz), samples)


def _csv(target: Path, header: RunHeader, counts: npt.NDArray[Any], volts: FloatArray) -> None:
    names = ",".join(channel.name for channel in header.channels)
    np.savetxt(target, volts, fmt="%.17g", delimiter=",", header=names, comments="")


def _npz(target: Path, header: RunHeader, counts: npt.NDArray[Any], volts: FloatArray) -> None:
    np.savez(target, **_variables(header, volts))


def _mat(target: Path, header: RunHeader, counts: npt.NDArray[Any], volts: FloatArray) -> None:
    scipy.io.savemat(target, _variables(header, volts), do_compression=True)


def _h5(target: Path, header: RunHeader, counts: npt.NDArray[Any], volts: FloatArray) -> None:
    with h5py.File(target, "w") as file:
        file.attrs["sample_rate_hz"] = header.sample_rate_hz
        for column, channel in enumerate(header.channels):
            file.create_dataset(channel.name, data=volts[:, column]).attrs["units"] = "V"


def _tdms(target: Path, header: RunHeader, counts: npt.NDArray[Any], volts: FloatArray) -> None:
    try:
        from nptdms import ChannelObject, TdmsWriter
    except ImportError as error:
        raise InputError(f"{target}: TDMS needs npTDMS: pip install 'entrain[tdms]'") from error
    properties = {"wf_increment": 1.0 / header.sample_rate_hz, "unit_string": "V"}
    with TdmsWriter(str(target)) as writer:
        writer.write_segment(
            [
                ChannelObject(
                    "run", channel.name, np.ascontiguousarray(volts[:, column]), properties
                )
                for column, channel in enumerate(header.channels)
            ]
        )


def _variables(header: RunHeader, volts: FloatArray) -> dict[str, Any]:
    columns: dict[str, Any] = {
        channel.name: volts[:, column] for column, channel in enumerate(header.channels)
    }
    return {**columns, "sample_rate_hz": header.sample_rate_hz}


WRITERS: dict[str, Callable[[Path, RunHeader, npt.NDArray[Any], FloatArray], None]] = {
    "wav": _wav,
    "csv": _csv,
    "npz": _npz,
    "mat": _mat,
    "h5": _h5,
    "tdms": _tdms,
}


def _toml(card: CampaignCard, headers: Sequence[RunHeader], files: Sequence[str]) -> str:
    """The description, in the keys that `campaign-folder/1` knows."""
    lines = [
        'format = "campaign-folder/1"',
        f"title = {_text(card.title)}",
        f"sample_rate_hz = {float(headers[0].sample_rate_hz)!r}",
        "",
        "[medium]",
        *(f"{key} = {float(value)!r}" for key, value in card.medium.items()),
        "",
        "[declared_model]",
        *(f"{key} = {_value(value)}" for key, value in card.declared_model.items()),
    ]
    for channel in headers[0].channels:
        lines += ["", "[[channels]]", f"name = {_text(channel.name)}"]
        lines += [f'quantity = "{channel.quantity}"', f"unit = {_text(channel.unit)}"]
        lines += [f"volts_per_unit = {channel.volts_per_unit!r}"]
        lines += [f"full_scale_v = {channel.full_scale_v!r}"]
        if channel.position_m is not None:
            lines.append(f"position_m = {channel.position_m!r}")
        if channel.serial_number:
            lines.append(f"serial_number = {_text(channel.serial_number)}")
    for header, name in zip(headers, files, strict=True):
        lines += ["", "[[runs]]", f"file = {_text(name)}", f'kind = "{header.kind}"']
        for key in ("frequency_hz", "amplitude_v"):
            value = getattr(header, key)
            if value is not None:
                lines.append(f"{key} = {float(value)!r}")
        lines += [f"started_s = {float(header.started_s)!r}", f'role = "{header.role}"']
    return "\n".join(lines) + "\n"


def _text(value: str) -> str:
    """A TOML basic string."""
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c >= " " else f"\\u{ord(c):04x}" for c in escaped) + '"'


def _value(value: object) -> str:
    return _text(value) if isinstance(value, str) else repr(value)
