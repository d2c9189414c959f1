"""What a characterisation says, and its JSON (`characterisation/1`)."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from identify.characterise.envelope import Estimate
from identify.characterise.harmonics import Harmonic, Parity
from identify.characterise.stochastic import StochasticMode

FloatArray = npt.NDArray[np.float64]
Regime = Literal["noise", "intermittent", "limit_cycle"]


@dataclass(frozen=True)
class Characterisation:
    """One recording, characterised: channel `signal`. `amplitude` is the fundamental's mean
    amplitude, in `unit`.

    `phase_deg` is each other channel's phase ahead of the signal at the fundamental.
    `kurtosis` is ⟨A⁴⟩/⟨A²⟩² of the envelope: 2 for a noise-driven linear mode, 1 for a pure cycle.
    `mode` is None where the record is too short for stochastic identification.
    """

    regime: Regime
    frequency_hz: Estimate
    amplitude: Estimate
    unit: str
    harmonics: tuple[Harmonic, ...]
    phase_deg: dict[str, Estimate]
    saturation_parity: Parity
    kurtosis: float
    band_share: float
    mode: StochasticMode | None
    sample_rate_hz: float
    samples: int
    notes: tuple[str, ...] = ()
    signal: str = ""

    @property
    def harmonics_db(self) -> list[float]:
        """Harmonic amplitudes relative to the fundamental, dB."""
        first = self.harmonics[0].amplitude.value
        return [
            float(20 * np.log10(max(h.amplitude.value, 1e-300) / first)) for h in self.harmonics
        ]

    def to_json(self) -> dict[str, Any]:
        """The `characterisation/1` object; keys beyond the contract follow it."""
        fundamental = self.harmonics[0].amplitude.value
        growth = noise = saturation = None
        if self.mode is not None:
            growth = _pair(self.mode.growth_rate_per_s)
            noise = _pair(self.mode.noise_intensity) | {"unit": f"{self.unit}^2/s"}
            saturation = _pair(self.mode.saturation) | {"unit": f"1/({self.unit}^2 s)"}
        return {
            "format": "characterisation/1",
            "signal": self.signal,
            "regime": self.regime,
            "frequency_hz": _pair(self.frequency_hz),
            "amplitude": _pair(self.amplitude) | {"unit": self.unit},
            "harmonics_db": [round(level, 2) for level in self.harmonics_db],
            "growth_rate_per_s": growth,
            "phase_deg": {name: _pair(phase) for name, phase in self.phase_deg.items()},
            "harmonics_db_stderr": [
                round(8.686 * h.amplitude.stderr / max(h.amplitude.value, 1e-3 * fundamental), 2)
                for h in self.harmonics
            ],
            "noise_intensity": noise,
            "saturation": saturation,
            "saturation_parity": self.saturation_parity,
            "envelope_kurtosis": self.kurtosis,
            "band_share": self.band_share,
            "notes": list(self.notes),
        }


def _pair(estimate: Estimate) -> dict[str, Any]:
    """value and stderr, null where not finite (JSON knows no infinity)."""
    finite = bool(np.isfinite(estimate.stderr))
    return {"value": estimate.value, "stderr": estimate.stderr if finite else None}
