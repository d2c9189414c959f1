"""Single recordings described by options become a campaign: no `campaign.toml` needed.

For files from elsewhere (a spectrum analyser's CSV, a colleague's MATLAB file): channels are
picked by column number or by name, and each file is one run.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from daq.errors import InputError
from daq.importers.checks import require_apart, require_forcing
from daq.importers.folder import encoding, require_match, write_recording
from daq.importers.recording import Recording, read_recording, require_picked
from daq.importers.whole import all_or_nothing, alone
from daq.records import CampaignCard, Kind, RunHeader
from daq.store import RunStore, slug, utc_now
from daq.tables import MAX_TITLE
from drivers.types import Channel


@dataclass(frozen=True)
class RecordingOptions:
    """How to understand a recording.

    `channels` are in the order of `columns` (numbers from 0, or names of columns or variables;
    empty: all columns). `sample_rate_hz` may stay None where the file says it.
    """

    channels: tuple[Channel, ...]
    columns: tuple[int | str, ...] = ()
    sample_rate_hz: float | None = None
    kind: Kind = "free"
    frequency_hz: float | None = None
    amplitude_v: float | None = None
    medium: dict[str, float] = field(default_factory=dict)


def import_recordings(
    files: Sequence[Path], options: RecordingOptions, store: RunStore, title: str = ""
) -> CampaignCard:
    """Bring files into the store as the runs of one new campaign, all understood alike.

    Raises
    ------
    InputError
        Naming the file and what is wrong with it or with the options.
    """
    if not files:
        raise InputError("files=[] is not a list of one or more recordings")
    if len(title) > MAX_TITLE or not all(c.isprintable() for c in title):
        raise InputError(f"title={title[:40]!r} is not one line of at most {MAX_TITLE} characters")
    require_apart("channels", options.channels)
    read = [(path, select(path, options)) for path in files]
    headers = [
        _header(index, path, recording, options) for index, (path, recording) in enumerate(read)
    ]
    title = title or files[0].stem
    with alone(store, slug(title)):  # the id is new: no other import takes it in the same second
        card = store.create_campaign(
            title,
            medium=options.medium,
            source=str(files[0].resolve().parent),
            status="importing",
        )
    with all_or_nothing(store, card.id):
        for (path, recording), header in zip(read, headers, strict=True):
            store.add_run(write_recording(store, card.id, header, recording, str(path)))
    return store.card(card.id)


def _header(index: int, path: Path, recording: Recording, options: RecordingOptions) -> RunHeader:
    """The run's header; raises `InputError` for what the options say that the file cannot be."""
    rate = options.sample_rate_hz
    if rate is None:
        rate = recording.sample_rate_hz
    if rate is None:
        raise InputError(f"{path}: the file does not tell its sample rate: give sample_rate_hz")
    require_match(path, recording, len(options.channels), rate)
    header = RunHeader(
        name=f"{index:03d}-{slug(path.stem)}",
        kind=options.kind,
        sample_rate_hz=rate,
        channels=options.channels,
        **encoding(recording, [channel.full_scale_v for channel in options.channels]),
        frequency_hz=options.frequency_hz,
        amplitude_v=options.amplitude_v,
        started_at=utc_now(),
        notes={"imported_from": str(path)},
    )
    require_forcing(str(path), options.kind, options.frequency_hz, options.amplitude_v, rate)
    for name in ("frequency_hz", "amplitude_v"):
        value = getattr(options, name)
        if options.kind == "free" and value is not None:
            raise InputError(
                f"{path}: {name}={value} is not for a free run: give kind=forced, or leave it out"
            )
    return header


def select(path: Path, options: RecordingOptions) -> Recording:
    """Read a recording and pick the columns that `options` name."""
    names = [column for column in options.columns if isinstance(column, str)]
    numbers = [column for column in options.columns if isinstance(column, int)]
    if names and numbers:
        raise InputError(f"columns={options.columns} mix numbers and names")
    recording = read_recording(path, names)
    if not numbers:
        require_picked(path, recording, names)
        return recording
    width = recording.samples.shape[1]
    outside = [number for number in numbers if not 0 <= number < width]
    if outside:
        raise InputError(f"{path}: column {outside[0]} is not one of its {width} (from 0)")
    labels = tuple(recording.names[n] for n in numbers) if recording.names else ()
    return replace(recording, samples=recording.samples[:, numbers], names=labels)
