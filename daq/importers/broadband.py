"""Campaign folders with broadband excitation: one continuous recording and its named stretches.

Beside `format`, `title`, `sample_rate_hz` and `[[channels]]` (one of them named ``drive``, the
other the response) such a `campaign.toml` holds

    [excitation]
    kind = "broadband"
    file = "recording.csv"
    estimation = [40650, 127400]   # samples that are fitted: first, one past the last
    test = [0, 40000]              # samples that are only predicted
    noise = [128400, 131000]       # optional: weakly excited, in neither
    period_samples = 8192          # optional: whole periods within the estimation stretch, which
    period_starts = [40976, 49669] # split the residual into excited, odd and even lines

    [declared_model]
    feedback = "linear"            # "linear", "cubic", "cubic_quadratic"

and no `[[runs]]`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from daq.documents import read_document
from daq.errors import InputError
from daq.importers.folder import ChannelTable, explain, inside, read_columns, read_toml
from daq.tables import Table
from drivers.errors import SettingError

Stretch = Annotated[list[int], Field(min_length=2, max_length=2)]
Feedback = Literal["linear", "cubic", "cubic_quadratic"]


class ExcitationTable(Table):
    """The recording and its stretches, in samples."""

    kind: Literal["broadband"]
    file: str = Field(min_length=1)
    estimation: Stretch
    test: Stretch
    noise: Stretch | None = None
    period_samples: int | None = Field(default=None, ge=16)
    period_starts: list[int] = Field(default=[])


class OscillatorTable(Table):
    """The feedback that the experimenter believes."""

    feedback: Feedback = "linear"


class BroadbandToml(Table):
    """The whole of `campaign.toml`."""

    format: Literal["campaign-folder/1"]
    title: str
    sample_rate_hz: float = Field(gt=0, le=1e9)
    declared_model: OscillatorTable = OscillatorTable()
    channels: list[ChannelTable] = Field(min_length=2, max_length=2)
    excitation: ExcitationTable


@dataclass(frozen=True)
class BroadbandRecord:
    """Drive and response, (samples,), in their channels' units; stretches as slices."""

    title: str
    sample_rate_hz: float
    feedback: Feedback
    drive: npt.NDArray[np.float64]
    response: npt.NDArray[np.float64]
    estimation: slice
    test: slice
    noise: slice | None
    period_samples: int | None
    period_starts: tuple[int, ...]
    units: tuple[str, str]  # of drive and response


def is_broadband(path: str | Path) -> bool:
    """Whether `path` is a campaign folder with an `[excitation]`."""
    description = Path(path).expanduser() / "campaign.toml"
    try:
        return "excitation" in read_document(description)
    except InputError:
        return False  # whoever reads it as an ordinary folder says what is wrong


def read_broadband(path: str | Path) -> BroadbandRecord:
    """Read such a folder.

    Raises
    ------
    InputError : names the file, the key and what is required.
    """
    folder = Path(path).expanduser()
    toml = folder / "campaign.toml"
    try:
        card = BroadbandToml.model_validate(read_toml(toml))
        channels = [c.channel() for c in card.channels]
    except ValidationError as error:
        raise InputError(f"{toml}: {explain(error)}") from error
    except SettingError as error:
        raise InputError(f"{toml}: {error}") from error
    names = [c.name for c in card.channels]
    if names.count("drive") != 1:
        raise InputError(f"{toml}: channels {names}: exactly one must be named 'drive'")
    table = card.excitation
    if table.period_starts and table.period_samples is None:
        raise InputError(f"{toml}: period_starts need period_samples, the length of a period")
    if table.period_samples is not None and not table.period_starts:
        raise InputError(
            f"{toml}: period_samples={table.period_samples} needs period_starts, the first sample "
            "of each whole period"
        )
    recording = read_columns(inside(folder, table.file), card.channels, card.sample_rate_hz)
    samples = recording.samples
    signals = [
        np.asarray(samples[:, i], dtype=float)
        * recording.volts_per_count(c.full_scale_v)
        / c.volts_per_unit
        for i, c in enumerate(channels)
    ]
    for c, values in zip(channels, signals, strict=True):
        if not np.isfinite(values).all():
            raise InputError(f"{folder / table.file}: channel {c.name!r} holds NaN or infinity")
    drive = names.index("drive")
    frames = samples.shape[0]

    def stretch(key: str, ends: list[int]) -> slice:
        if not 0 <= ends[0] < ends[1] <= frames:
            raise InputError(f"{toml}: {key}={ends} is not within the {frames} samples recorded")
        return slice(ends[0], ends[1])

    estimation = stretch("estimation", table.estimation)
    period = table.period_samples or 0
    for start in table.period_starts:
        if not estimation.start <= start <= estimation.stop - period:
            raise InputError(
                f"{toml}: period_starts: the period [{start}, {start + period}] is not within "
                f"estimation={table.estimation}"
            )
    return BroadbandRecord(
        card.title,
        card.sample_rate_hz,
        card.declared_model.feedback,
        signals[drive],
        signals[1 - drive],
        estimation,
        stretch("test", table.test),
        None if table.noise is None else stretch("noise", table.noise),
        table.period_samples,
        tuple(table.period_starts),
        (channels[drive].unit, channels[1 - drive].unit),
    )
