"""Campaign folders (`campaign-folder/1`): a `campaign.toml` and one recording a run.

The whole folder is read and checked before it becomes visible in the store: an error leaves
nothing behind. The imported campaign's id carries a digest of all contents, so the same folder
imported again is found, and a changed one becomes another campaign.
"""

import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from daq.documents import read_document, require_file
from daq.errors import InputError
from daq.importers.checks import SampleCheck, require_apart, require_forcing
from daq.importers.recording import Recording, read_recording, require_picked
from daq.importers.whole import all_or_nothing, alone
from daq.records import CampaignCard, Kind, Role, RunHeader, RunSummary
from daq.store import RunStore, slug, utc_now
from daq.tables import Table, Title
from drivers.errors import SettingError
from drivers.types import Channel, Quantity, require_si

FORMAT = "campaign-folder/1"
SLICE_FRAMES = 1 << 18


# What `identify` takes for a flame and, without nodes, for a nonlinearity; a test keeps them alike.
Flame = Literal[
    "none",
    "none_with_delay",
    "first_order_lowpass",
    "first_order_lowpass_with_delay",
    "second_order_lowpass",
    "second_order_lowpass_with_delay",
]
Nonlinearity = Literal["polynomial", "saturation", "linear"]


class MediumTable(Table):
    """The gas in the tube."""

    density_kg_m3: float = Field(default=1.2, gt=0, le=1e4)
    sound_speed_m_s: float = Field(default=343.0, gt=0, le=1e4)


class DeclaredModelTable(Table):
    """The model that the experimenter believes."""

    modes: int = Field(default=2, ge=1, le=20)
    flame: Flame = "first_order_lowpass"
    nonlinearity: Nonlinearity = "polynomial"
    nonlinearity_degree: int = Field(default=3, ge=1, le=15)


class ChannelTable(Table):
    """One column of every recording; `variable` names it in files whose columns have names."""

    name: str = Field(min_length=1, pattern=r"^[^/\x00]+$")
    quantity: Quantity
    unit: str
    volts_per_unit: float = 1.0
    position_m: float | None = None
    full_scale_v: float = Field(default=10.0, gt=0)
    variable: str | None = None
    serial_number: str | None = None

    def channel(self) -> Channel:
        """As the store keeps it; raises `SettingError` for what `Channel` refuses, and for a unit
        that is not SI."""
        return require_si(
            Channel(
                self.name,
                self.quantity,
                self.unit,
                self.volts_per_unit,
                self.full_scale_v,
                self.position_m,
                self.serial_number,
            )
        )


class RunTable(Table):
    """One recording."""

    file: str = Field(min_length=1)
    kind: Kind
    frequency_hz: float | None = Field(default=None, gt=0)
    amplitude_v: float | None = Field(default=None, ge=0)
    started_s: float = Field(default=0.0, ge=-1e9, le=1e9)
    role: Role = "fit"


class CampaignToml(Table):
    """The whole of `campaign.toml`."""

    format: Literal["campaign-folder/1"]
    title: Title
    sample_rate_hz: float = Field(gt=0, le=1e9)
    medium: MediumTable = MediumTable()
    declared_model: DeclaredModelTable = DeclaredModelTable()
    channels: list[ChannelTable] = Field(min_length=1, max_length=256)
    runs: list[RunTable] = Field(min_length=1, max_length=100_000)


def import_folder(folder: Path, store: RunStore) -> CampaignCard:
    """Bring a campaign folder into the store; a folder already there is found, not copied.

    Raises
    ------
    InputError
        Naming the file, the run and the key, value or sample that is not usable.
    StoreError
        Another process is still importing the same folder, or the store cannot be written.
    """
    folder = folder.expanduser()
    description = read_description(folder / "campaign.toml")
    files = [inside(folder, run.file) for run in description.runs]
    identifier = f"{slug(folder.resolve().name)}-{_digest([folder / 'campaign.toml', *files])}"
    existing = store.campaigns_dir / identifier
    with alone(store, identifier):
        if existing.exists():
            if (existing / "campaign.json").exists():
                card = store.card(identifier)
                if card.status == "complete":
                    return card
            shutil.rmtree(existing)  # an import that was killed half way: nobody works on it now
        return _import(folder, description, files, identifier, store)


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a `campaign.toml` of our format; raises `InputError`."""
    content = read_document(path, "; a campaign folder holds a campaign.toml")
    if content.get("format") != FORMAT:
        raise InputError(f"{path}: format={content.get('format')!r} is not {FORMAT!r}")
    return content


def read_description(path: Path) -> CampaignToml:
    """Parse and check a `campaign.toml`; raises `InputError`."""
    content = read_toml(path)
    if "excitation" in content:
        raise InputError(
            f"{path}: only `entrain diagnose` takes a folder with [excitation] (one broadband "
            "recording); everything else needs [[runs]]"
        )
    try:
        description = CampaignToml.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error)}") from error
    _require_consistent(path, description)
    return description


def explain(error: ValidationError) -> str:
    """Pydantic's findings in one line: key, value, requirement."""
    findings = []
    for item in error.errors():
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in item["loc"])
        key = key.lstrip(".")
        if item["type"] == "extra_forbidden":
            findings.append(f"unknown key {key}={item['input']!r}")
        elif item["type"] == "missing":
            findings.append(f"key {key} is missing")
        else:
            findings.append(f"{key}={item['input']!r}: {item['msg']}")
    return "; ".join(findings[:8])


def _require_consistent(path: Path, description: CampaignToml) -> None:
    names = [channel.name for channel in description.channels]
    double = {name for name in names if names.count(name) > 1}
    if double:
        raise InputError(f"{path}: channels named twice: {', '.join(sorted(double))}")
    for channel in description.channels:
        try:
            channel.channel()
        except SettingError as error:
            raise InputError(f"{path}: {error}") from error
    require_apart(str(path), [channel.channel() for channel in description.channels])
    stems = [Path(run.file).stem for run in description.runs]
    forced = 0
    for index, run in enumerate(description.runs):
        where = f"{path}: runs[{index}] ({run.file})"
        if stems.count(Path(run.file).stem) > 1:
            raise InputError(f"{where}: two runs of the name {Path(run.file).stem!r}")
        if run.kind == "forced":
            forced += 1
        require_forcing(
            where, run.kind, run.frequency_hz, run.amplitude_v, description.sample_rate_hz
        )
    if forced == 0:
        raise InputError(f"{path}: no forced run: identification needs at least one")
    if "drive" not in names:
        raise InputError(f"{path}: no channel named 'drive': the forcing must be recorded")


def _import(
    folder: Path,
    description: CampaignToml,
    files: list[Path],
    identifier: str,
    store: RunStore,
) -> CampaignCard:
    card = store.create_campaign(
        description.title,
        id=identifier,
        medium=description.medium.model_dump(),
        declared_model=description.declared_model.model_dump(),
        source=str(folder.resolve()),
        status="importing",
    )
    with all_or_nothing(store, card.id):
        summaries = []
        for index, (run, path) in enumerate(zip(description.runs, files, strict=True)):
            recording = read_columns(path, description.channels, description.sample_rate_hz)
            header = RunHeader(
                name=f"{index:03d}-{slug(path.stem)}",
                kind=run.kind,
                sample_rate_hz=description.sample_rate_hz,
                channels=tuple(channel.channel() for channel in description.channels),
                **encoding(recording, [c.full_scale_v for c in description.channels]),
                frequency_hz=None if run.kind == "free" else run.frequency_hz,
                amplitude_v=None if run.kind == "free" else run.amplitude_v,
                started_s=run.started_s,
                started_at=utc_now(),
                role=run.role,
                notes={"imported_from": run.file},
            )
            summaries.append(write_recording(store, identifier, header, recording, str(path)))
        store.catalogue.add_runs(summaries)
    return store.card(card.id)


def write_recording(
    store: RunStore, campaign: str, header: RunHeader, recording: Recording, where: str
) -> RunSummary:
    """Check and write one recording slice by slice; returns the run's summary."""
    check = SampleCheck(where, header.kind, header.channels, header.sample_rate_hz)
    writer = store.write_run(campaign, header, durable=False)
    try:
        for start in range(0, len(recording.samples), SLICE_FRAMES):
            part = recording.samples[start : start + SLICE_FRAMES].astype(header.dtype, copy=False)
            check.see(part)
            writer.append(part, patient=True)
        check.conclude()
    except BaseException:
        writer.discard()
        raise
    return writer.finish()


def read_columns(path: Path, channels: Sequence[ChannelTable], rate_hz: float) -> Recording:
    """A recording with a column a channel in the channels' order, sampled at `rate_hz`.

    Where the file's columns have names, a declared `variable` must be among them; channels that
    only have a name of their own are otherwise taken in the file's order.
    """
    wanted = [channel.variable or channel.name for channel in channels]
    recording = read_recording(path, wanted)
    if recording.names and any(channel.variable for channel in channels):
        require_picked(path, recording, wanted)
    require_match(path, recording, len(channels), rate_hz)
    return recording


def require_match(path: Path, recording: Recording, columns: int, rate_hz: float) -> None:
    """The recording has as many columns as there are channels, and the rate declared."""
    if recording.samples.shape[1] != columns:
        raise InputError(
            f"{path}: {recording.samples.shape[1]} columns for {columns} declared channels"
        )
    found = recording.sample_rate_hz
    if found is not None and abs(found - rate_hz) > 1e-4 * rate_hz:
        raise InputError(
            f"{path}: sampled at {found:g} Hz, but sample_rate_hz={rate_hz:g} is declared"
        )


def encoding(recording: Recording, full_scales_v: list[float]) -> dict[str, Any]:
    """`dtype` and `volts_per_count` of a header for a recording as it lies in its file."""
    kinds = {"i2": "int16", "i4": "int32", "f4": "float32"}
    dtype = recording.samples.dtype
    return {
        "dtype": kinds.get(f"{dtype.kind}{dtype.itemsize}", "float64"),
        "volts_per_count": tuple(recording.volts_per_count(v) for v in full_scales_v),
    }


def inside(folder: Path, name: str) -> Path:
    """The file of a run; refused when it lies outside the folder, by any path or link."""
    try:
        path = (folder / name).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # a link to itself, a NUL
        raise InputError(f"{folder}: run file {name!r}: {error}") from error
    if not path.is_relative_to(folder.resolve()):
        raise InputError(f"{folder}: run file {name!r} lies outside the campaign folder")
    require_file(path, "; a run names its recording")
    return path


def _digest(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:10]
