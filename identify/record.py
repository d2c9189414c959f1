"""What identification starts from: recordings in physical units, and what is believed of them.

A `Campaign` is a medium, a declared model and runs; a `Run` is one recording: named signals of
equal length at one sample rate, SI units, with the forcing's nominal frequency and amplitude.
Plain arrays: build one in a notebook, or let `identify.load` read one from the run store.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Kind = Literal["free", "forced", "cold"]
Role = Literal["fit", "validation"]
FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class Medium:
    """The gas in the tube."""

    density_kg_m3: float = 1.2
    sound_speed_m_s: float = 343.0


@dataclass(frozen=True)
class Signal:
    """One channel of a recording: `values` of shape (samples,), in `unit`.

    `full_scale` is the converter's range in the same unit (None: unknown), for the detection of
    clipping; `resolution` one step of the converter in the same unit (None: unknown).
    """

    values: FloatArray
    quantity: str
    unit: str
    position_m: float | None = None
    full_scale: float | None = None
    resolution: float | None = None


@dataclass(frozen=True)
class Run:
    """One recording. The forcing is the signal named ``drive``.

    `frequency_hz` and `amplitude_v` are what was asked of the generator; None for a free run.
    `exit_status` other than ``success`` keeps a run out of every fit.
    """

    name: str
    kind: Kind
    sample_rate_hz: float
    signals: Mapping[str, Signal]
    frequency_hz: float | None = None
    amplitude_v: float | None = None
    started_s: float = 0.0
    role: Role = "fit"
    exit_status: str = "success"
    notes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        return int(next(iter(self.signals.values())).values.size)

    @property
    def duration_s(self) -> float:
        return self.samples / self.sample_rate_hz

    @property
    def operating_point(self) -> str:
        """Name (or number) of the operating point at which it was recorded; empty: the only one."""
        at = self.notes.get("operating_point") or {}
        return str(at.get("name") or at.get("point", ""))


@dataclass(frozen=True)
class DeclaredModel:
    """The model that the experimenter believes (`[declared_model]` of campaign-folder/1)."""

    modes: int = 2
    flame: str = "first_order_lowpass"
    nonlinearity: str = "polynomial"
    nonlinearity_degree: int = 3
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Campaign:
    """Runs on one rig, with the medium and the declared model."""

    title: str
    runs: tuple[Run, ...]
    medium: Medium = Medium()
    declared_model: DeclaredModel = DeclaredModel()
    identifier: str = ""

    @property
    def calibration_remarks(self) -> tuple[str, ...]:
        """What the runs say of their channels' calibration: missing, stale, or not known at all;
        empty where every pressure channel had one in force."""
        said = [text for r in self.runs for text in r.notes.get("calibration") or ()]
        if any("imported_from" in r.notes for r in self.runs):
            said.append(
                "imported: sensitivities are those of the campaign's own files, "
                "no record of a calibration came with them"
            )
        return tuple(dict.fromkeys(said))

    def at_operating_point(self, name: str) -> "Campaign":
        """The runs at one operating point.

        Raises
        ------
        ValueError : no run is there; the message lists the points there are.
        """
        runs = tuple(r for r in self.runs if r.operating_point == name)
        if not runs:
            known = sorted({r.operating_point for r in self.runs} - {""})
            raise ValueError(f"operating_point={name!r} is not one of {known} of this campaign")
        return replace(self, runs=runs)
