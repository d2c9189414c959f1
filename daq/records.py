"""What the run store keeps beside the samples: a run's header, its outcome, a campaign's card.

Plain frozen dataclasses; `daq.run_file` turns headers into HDF5 attributes and back, `daq.store`
keeps cards as `campaign.json`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from daq.errors import InputError
from drivers.types import Channel

Kind = Literal["free", "forced", "cold"]
Role = Literal["fit", "validation"]
ExitStatus = Literal["success", "not_entrained", "failed", "aborted", "interrupted"]
Verdict = Literal["no_discrepancy", "traced", "ambiguous", "unexplained"]  # as identify's
Dtype = Literal["int16", "int32", "float32", "float64"]


def check(condition: bool, parameter: str, value: object, requirement: str) -> None:
    """Raise `InputError` naming parameter, value and requirement unless `condition` holds."""
    if not condition:
        raise InputError(f"{parameter}={value!r} is not {requirement}")


@dataclass(frozen=True)
class RunHeader:
    """What is known of a run when its recording begins.

    `name` is unique in its campaign and is the file's stem. Samples are kept as `dtype`;
    ``samples[:, j] * volts_per_count[j]`` are volts at the converter, and dividing by
    ``channels[j].volts_per_unit`` gives the channel's unit. `skew_s` is how much later than the
    first each channel shows a common signal (corrected at analysis). `frequency_hz` and
    `amplitude_v` are what was asked of the generator; None for a free run. `started_s` counts from
    the campaign's start on the rig's clock, `started_at` is the calendar's time (ISO 8601, UTC).
    """

    name: str
    kind: Kind
    sample_rate_hz: float
    channels: tuple[Channel, ...]
    dtype: Dtype = "float32"
    volts_per_count: tuple[float, ...] = ()
    skew_s: tuple[float, ...] = ()
    frequency_hz: float | None = None
    amplitude_v: float | None = None
    started_s: float = 0.0
    started_at: str = ""
    role: Role = "fit"
    rig: str = ""
    notes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check(bool(self.name) and "/" not in self.name, "name", self.name, "a file name's stem")
        check(self.kind in get_args(Kind), "kind", self.kind, "free, forced or cold")
        check(self.role in get_args(Role), "role", self.role, "fit or validation")
        rate = self.sample_rate_hz
        check(0 < rate <= 1e9, "sample_rate_hz", rate, "a rate > 0, at most 1e9 Hz")
        check(len(self.channels) > 0, "channels", self.channels, "a list of one or more channels")
        if not self.volts_per_count:
            object.__setattr__(self, "volts_per_count", (1.0,) * len(self.channels))
        if not self.skew_s:
            object.__setattr__(self, "skew_s", (0.0,) * len(self.channels))
        for name in ("volts_per_count", "skew_s"):
            values = getattr(self, name)
            wanted = f"one value for each of the {len(self.channels)} channels"
            check(len(values) == len(self.channels), name, values, wanted)


@dataclass(frozen=True)
class RunSummary:
    """One line of the catalogue: a run's header without channels, and how the run ended."""

    campaign: str
    name: str
    kind: Kind
    role: Role
    frequency_hz: float | None
    amplitude_v: float | None
    started_s: float
    started_at: str
    rig: str
    sample_rate_hz: float
    samples: int
    exit_status: ExitStatus
    exit_reason: str
    sha256: str
    bytes: int

    @property
    def id(self) -> str:
        """The run's id across the store: ``campaign/name``."""
        return f"{self.campaign}/{self.name}"


@dataclass(frozen=True)
class CampaignCard:
    """A campaign's own metadata, `campaign.json` in its folder.

    `medium` has ``density_kg_m3`` and ``sound_speed_m_s``; `declared_model` is what the
    experimenter believes. `verdict` is what the last diagnosis said, None before.
    """

    id: str
    title: str
    rig: str = ""
    created_at: str = ""
    medium: Mapping[str, float] = field(default_factory=dict)
    declared_model: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""
    status: str = "complete"
    verdict: str | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)
