"""What could be measured next: runs within a rig's limits, and the rig time that each costs.

A campaign says what its rig can do. The limits stand in the run store's notes, with the smallest
drive that entrained each condition (`threshold_v`); recordings made elsewhere show what was driven
and locked. Near the limit cycle the threshold grows in proportion to the detuning, so that one
number of volts a hertz, for each side of the tongue, says what locks where:

    D_lock(f) ≈ κ |f − f0|,    κ from the thresholds found, else the smallest D/|f − f0| recorded.

The grid of possible runs lies between a margin above that and the limit.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from identify.harmonics import Harmonics
from identify.record import Campaign, Kind, Run

MARGIN = 1.4  # over the threshold, so that it locks for certain and the limit cycle is well away
BEYOND = 1.3  # how much farther from the free frequency than any run so far
OFFSETS = 7  # frequencies on each side
LEVELS = 4  # amplitudes at each
NEAR: Mapping[Kind, float] = {"forced": 0.004, "cold": 0.05, "free": 0.0}  # of a spoilt run
COLD_SPAN = (0.6, 2.4)  # flame off: any frequency; those that say something, over the free one


@dataclass(frozen=True)
class Option:
    """One run that could be made; `record_s` is the length of its recording.

    `exchanged`: with the two microphones in each other's place, which takes somebody's hands.
    """

    kind: Kind
    record_s: float
    frequency_hz: float | None = None
    amplitude_v: float | None = None
    exchanged: bool = False

    def words(self) -> str:
        """As a person would say it."""
        if self.kind == "free":
            return f"a free run of {self.record_s:g} s"
        flame = ", flame off" if self.kind == "cold" else ""
        swapped = ", microphones exchanged" if self.exchanged else ""
        return f"{self.frequency_hz:g} Hz at {self.amplitude_v:.3g} V{flame}{swapped}"


@dataclass(frozen=True)
class Cost:
    """Seconds of rig time beside the recording itself, by kind of run."""

    free_s: float = 3.0  # silence, two looks at the limit cycle
    forced_s: float = 6.0  # probe, drive, check, settling
    cold_s: float = 4.5  # settling, and the flame lit again

    def seconds(self, option: Option) -> float:
        own = {"free": self.free_s, "forced": self.forced_s, "cold": self.cold_s}
        return option.record_s + own[option.kind]


@dataclass(frozen=True)
class Reach:
    """What a rig can do.

    `detuning_hz`: how far below and above the free frequency conditions may lie; `per_hz_v`: κ on
    the two sides; `drive_hz`: the speaker's range; `cold`: whether the flame can be put out;
    `spoilt`: kind and frequency of runs that could not be used, near which none is proposed again.
    """

    free_hz: float
    limit_v: float
    least_v: float
    detuning_hz: tuple[float, float]
    per_hz_v: tuple[float, float]
    drive_hz: tuple[float, float]
    cold: bool
    record_s: float
    spoilt: tuple[tuple[Kind, float], ...] = ()
    cost: Cost = Cost()

    def lock_v(self, frequency_hz: float) -> float:
        """The smallest drive that surely entrains at a frequency."""
        offset = frequency_hz - self.free_hz
        return max(MARGIN * self.per_hz_v[int(offset > 0)] * abs(offset), self.least_v)

    def options(self, record_s: float) -> tuple[Option, ...]:
        """Every run of that length that is possible: forced, and cold where it can be."""
        below, above = self.detuning_hz
        share = np.arange(1, OFFSETS + 1) / OFFSETS
        offsets = [*(-below * share[::-1]), *(above * share)]
        out = []
        for f in (_on_bin(self.free_hz + d, record_s) for d in offsets):
            low = self.lock_v(f)
            if low > self.limit_v or not self.drive_hz[0] <= f <= self.drive_hz[1]:
                continue
            levels = np.geomspace(low, self.limit_v, LEVELS)
            out += [Option("forced", record_s, f, self._volts(float(v))) for v in levels]
        if self.cold:
            low, high = (
                max(COLD_SPAN[0] * self.free_hz, self.drive_hz[0]),
                min(COLD_SPAN[1] * self.free_hz, self.drive_hz[1]),
            )
            for f in np.geomspace(low, high, 2 * OFFSETS):
                place = _on_bin(float(f), record_s)
                out += [
                    Option("cold", record_s, place, self._volts(share * self.limit_v))
                    for share in (0.25, 0.7)
                ]
        return tuple(o for o in dict.fromkeys(out) if not self._was_spoilt(o))

    def _was_spoilt(self, option: Option) -> bool:
        near = NEAR[option.kind]
        places = (f for kind, f in self.spoilt if kind == option.kind)
        return any(abs((option.frequency_hz or 0.0) / f - 1) < near for f in places)

    def _volts(self, amplitude_v: float) -> float:
        """Rounded as people set it, never above the limit."""
        return min(float(f"{amplitude_v:.3g}"), self.limit_v)

    def free(self, record_s: float) -> Option:
        """The free run that every campaign begins with."""
        return Option("free", record_s)


def exchanged(options: Sequence[Option]) -> tuple[Option, ...]:
    """The same forced runs with the microphones exchanged."""
    return tuple(replace(o, exchanged=True) for o in options if o.kind == "forced")


def reach_of(
    campaign: Campaign,
    measured: Sequence[Harmonics],
    free_hz: float,
    excluded: Collection[str] = (),
) -> Reach:
    """What the rig of a campaign can do, as far as its recordings and their notes tell.

    Without notes of the rig's limits, nothing is proposed beyond the largest drive recorded, and
    cold runs only where there are some already. `excluded`: names of runs that were no use.
    """
    runs = [r for r in campaign.runs if r.exit_status == "success"]
    forced = [h for h in measured if h.kind == "forced"]
    driven = [h for h in measured if h.kind != "free"]
    notes: Mapping[str, Any] = next((r.notes["rig"] for r in runs if "rig" in r.notes), {})
    used = [float(np.abs(h.drive[0])) for h in forced]
    places = np.array([h.frequency_hz for h in driven])
    offsets = np.array([h.frequency_hz - free_hz for h in forced])
    sides = (offsets < 0, offsets > 0)
    widest = float(np.max(np.abs(offsets)))
    below, above = (float(np.max(np.abs(offsets[s]), initial=0.3 * widest)) for s in sides)
    return Reach(
        free_hz=free_hz,
        limit_v=float(notes.get("limit_v", max(used))),
        least_v=0.8 * min(used),
        detuning_hz=(BEYOND * below, BEYOND * above),
        per_hz_v=_thresholds(runs, forced, free_hz),
        drive_hz=(
            float(notes.get("min_frequency_hz", 0.8 * places.min())),
            float(notes.get("max_frequency_hz", max(2 * free_hz, 1.2 * places.max()))),
        ),
        cold=bool(notes.get("flame_switch", any(h.kind == "cold" for h in measured))),
        record_s=float(np.median([h.duration_s for h in measured])),
        spoilt=tuple(
            (r.kind, r.frequency_hz)
            for r in campaign.runs
            if r.frequency_hz is not None and (r.exit_status != "success" or r.name in excluded)
        ),
    )


def _thresholds(
    runs: Sequence[Run], forced: Sequence[Harmonics], free_hz: float
) -> tuple[float, float]:
    """κ below and above the free frequency; a side without any run takes the other's."""
    found: tuple[list[float], list[float]] = ([], [])
    recorded: tuple[list[float], list[float]] = ([], [])
    known = {r.name: r.notes.get("threshold_v") for r in runs}
    for h in forced:
        offset = h.frequency_hz - free_hz
        if abs(offset) < 0.1:
            continue
        side = int(offset > 0)
        recorded[side].append(float(np.abs(h.drive[0])) / abs(offset))
        threshold = known.get(h.name)
        if isinstance(threshold, (int, float)):
            found[side].append(float(threshold) / abs(offset))
    sides = [
        float(np.median(f)) if f else (MARGIN**-1 * min(r) if r else None)
        for f, r in zip(found, recorded, strict=True)
    ]
    low, high = (s if s is not None else o for s, o in zip(sides, sides[::-1], strict=True))
    return float(low or 0.0), float(high or 0.0)


def _on_bin(frequency_hz: float, record_s: float) -> float:
    """The nearest frequency with a whole number of periods in the record."""
    return round(frequency_hz * record_s) / record_s
