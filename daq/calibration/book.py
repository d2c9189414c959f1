"""Calibrations as files: one JSON document each, never changed, the newest in force.

A calibration belongs to a serial number where the channel has one (a microphone keeps its
calibration when it moves to another input), otherwise to the channel's name.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

from daq.errors import CorruptFile
from daq.records import check
from daq.store import slug, utc_now, write_json
from drivers.types import Channel, is_number

FORMAT = "calibration/1"
Method = Literal["pistonphone", "exchange", "skew", "response"]


# The unit of each method's value, and the sizes that a measurement can have. A skew lies far below
# a period of any oscillation: more is a slip, or another recording.
RANGES: dict[str, tuple[str, float, float]] = {
    "pistonphone": ("V/Pa", 1e-9, 1e3),
    "exchange": ("1", 1e-3, 1e3),
    "skew": ("s", -1e-3, 1e-3),
    "response": ("Pa/V", 1e-9, 1e9),
}
MULTIPLES = {  # of those units, which would be taken for them
    "V/Pa": {"mV/Pa": 1e-3, "µV/Pa": 1e-6, "uV/Pa": 1e-6, "V/kPa": 1e-3, "mV/kPa": 1e-6},
    "s": {"ms": 1e-3, "µs": 1e-6, "us": 1e-6, "ns": 1e-9},
    "1": {"%": 1e-2},
    "Pa/V": {"kPa/V": 1e3, "mPa/V": 1e-3, "Pa/mV": 1e3},
}


@dataclass(frozen=True)
class Calibration:
    """One result, with its relative (or for times absolute) standard uncertainty.

    `subject` is a serial number or a channel's name. `value` and `unit` are those of `RANGES`:
    V/Pa, for an exchange or response the mean gain; curves lie in `data`. `reference` names
    what it was measured against. `valid_days`: after that it is stale.
    """

    subject: str
    method: Method
    value: float
    uncertainty: float
    unit: str
    at: str = ""
    reference: str = ""
    valid_days: float = 365.0
    data: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        named = self.subject.isprintable() and self.subject[:1] not in ("", " ", ".", "/")
        asked = "a serial number or a channel's name: printable, and no path"
        check(named, "subject", self.subject, asked)
        check(self.method in RANGES, "method", self.method, f"one of {', '.join(RANGES)}")
        unit, low, high = RANGES[self.method]
        wanted = repr(unit)
        if scale := MULTIPLES[unit].get(self.unit):
            wanted += f"; give unit {unit!r} and value={self.value * scale:.9g}"
        check(self.unit == unit, "unit", self.unit, wanted)
        plausible = is_number(self.value) and low <= self.value <= high
        check(plausible, "value", self.value, f"a {self.method}'s {low:g} to {high:g} {unit}")
        uncertain = is_number(self.uncertainty) and 0 <= self.uncertainty <= 1
        check(uncertain, "uncertainty", self.uncertainty, "a number from 0 to 1")
        if not self.at:
            object.__setattr__(self, "at", utc_now())
        lasting = 0 < self.valid_days <= 1e8
        check(lasting, "valid_days", self.valid_days, "a number of days > 0, at most 1e8")
        check(_zoned(self.at), "at", self.at, "a time with its zone, as 2026-01-31T12:00:00Z")

    def stale(self, now: datetime) -> bool:
        """Whether it is older than `valid_days`."""
        return now - datetime.fromisoformat(self.at) > timedelta(days=self.valid_days)


def _zoned(text: str) -> bool:
    try:
        return datetime.fromisoformat(text).tzinfo is not None
    except ValueError:
        return False


class CalibrationBook:
    """The calibrations in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, calibration: Calibration) -> Path:
        """Keep it; returns its file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        stem = f"{slug(calibration.subject)}-{calibration.method}-{calibration.at.replace(':', '')}"
        path, number = self.folder / f"{stem}.json", 2
        while path.exists():
            path, number = self.folder / f"{stem}-{number}.json", number + 1
        write_json(path, {"format": FORMAT, **asdict(calibration)})
        return path

    def named(self) -> dict[str, Calibration]:
        """Every calibration by its file's name, oldest first; raises `CorruptFile`."""
        read = {path.stem: read_calibration(path) for path in self._files()}
        return dict(sorted(read.items(), key=lambda item: datetime.fromisoformat(item[1].at)))

    def all(self) -> list[Calibration]:
        """Every calibration, oldest first; raises `CorruptFile`."""
        return list(self.named().values())

    def newest(self, subject: str, method: Method) -> Calibration | None:
        """The one in force."""
        matching = [c for c in self.all() if c.subject == subject and c.method == method]
        return matching[-1] if matching else None

    def in_force(self, channels: Sequence[Channel]) -> list[dict[Method, str]]:
        """For each channel, the names of the newest calibrations that apply to it, by method.

        A level belongs to the microphone, a skew to the channel that it is plugged into.
        """
        newest = {(c.subject, c.method): name for name, c in self.named().items()}
        wanted: list[list[tuple[str, Method]]] = [
            [(channel.name, "skew")]
            if channel.quantity != "pressure"
            else [(channel.serial_number or channel.name, "pistonphone"), (channel.name, "skew")]
            for channel in channels
        ]
        return [{key[1]: newest[key] for key in keys if key in newest} for keys in wanted]

    def apply(
        self, channels: Sequence[Channel], now: datetime | None = None
    ) -> tuple[tuple[Channel, ...], tuple[float, ...], list[str]]:
        """Channels with their calibrated sensitivity, skews in seconds, and what is amiss.

        Only pressure channels are expected to have a calibration; a stale one is used and named.
        """
        now = now or datetime.now(UTC)
        named = self.named()
        applied: list[Channel] = []
        skews: list[float] = []
        remarks: list[str] = []
        for channel, names in zip(channels, self.in_force(channels), strict=True):
            used = {method: named[name] for method, name in names.items()}
            if "pistonphone" in used:
                value, nominal = used["pistonphone"].value, abs(channel.volts_per_unit)
                if not 0.1 <= value / nominal <= 10:
                    remarks.append(
                        f"{channel.name}: calibrated at {value:g} V/Pa, "
                        f"{value / nominal:.3g} times the nominal {nominal:g}: see that it is "
                        "this microphone's"
                    )
                channel = replace(channel, volts_per_unit=value)
            elif channel.quantity == "pressure":
                subject = channel.serial_number or channel.name
                remarks.append(f"{channel.name}: no calibration of {subject!r}, nominal value used")
            remarks += [
                f"{channel.name}: {one.method} of {one.at[:10]} is stale"
                for one in used.values()
                if one.stale(now)
            ]
            applied.append(channel)
            skews.append(used["skew"].value if "skew" in used else 0.0)
        return tuple(applied), tuple(skews), remarks

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("*.json")) if self.folder.is_dir() else []


def read_calibration(path: Path) -> Calibration:
    """One file; raises `CorruptFile`."""
    try:
        content = json.loads(path.read_text("utf-8"))
        if content.pop("format") != FORMAT:
            raise ValueError(f"format is not {FORMAT!r}")
        return Calibration(**content)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise CorruptFile(f"{path}: not a calibration ({error})") from error
