"""Modes from a tube's geometry (thesis Eqs. 4.2–4.13).

The pressure modes of a uniform tube of length L, x from the end x = 0, are

    closed–open    ψ ∝ cos kx,  k = (2n − 1) π/(2L)     (Eq. 4.2, i = 2n − 1)
    closed–closed  ψ ∝ cos kx,  k = n π/L
    open–open      ψ ∝ sin kx,  k = n π/L

with ω = c k and, in the tables' normalisation, ψ(x) = 1.77 cos(kx)/k for pressure and
D(x) = −0.72 sin(kx)/k for velocity (what Tables 4.1 and 4.7 follow to their two digits). The speed
of sound is that of dry air, c = √(γ R T/M). The tube's area enters through sources only: a volume
source in a tube of area S excites a mode in proportion to 1/S.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from simulated_rig.plant import Actuator, Mode, Plant

Ends = Literal["closed-open", "closed-closed", "open-open"]
PSI_NORM = 1.77
VELOCITY_NORM = 0.72
GAMMA = 1.4
GAS_CONSTANT = 287.05  # J/(kg K), dry air
THESIS_AREA_M2 = np.pi * 0.1016**2 / 4  # a 4-inch tube: the area that the gain 1e10 is for


def sound_speed(temperature_k: float) -> float:
    """c of dry air, m/s.

    Raises
    ------
    ValueError
        For a temperature that is not above zero.

    Examples
    --------
    >>> round(sound_speed(293.15), 1)
    343.2
    """
    if not temperature_k > 0:
        raise ValueError(f"temperature_k={temperature_k!r} is not a temperature above 0 K")
    return float(np.sqrt(GAMMA * GAS_CONSTANT * temperature_k))


@dataclass(frozen=True)
class Tube:
    """A uniform tube and what is mounted on it; positions from the end x = 0."""

    length_m: float = 1.524
    ends: Ends = "closed-open"
    area_m2: float = float(THESIS_AREA_M2)
    temperature_k: float = 292.78  # 343 m/s
    flame_m: float = 0.762
    speaker_m: float = 0.635
    pressure_excess: float = 3.6

    def __post_init__(self) -> None:
        for name in ("length_m", "area_m2"):
            value = getattr(self, name)
            if not value > 0:
                raise ValueError(f"{name}={value!r} is not a size > 0")
        for name in ("flame_m", "speaker_m"):
            value = getattr(self, name)
            if not 0 <= value <= self.length_m:
                raise ValueError(f"{name}={value!r} is not within the tube, 0…{self.length_m} m")

    def wavenumber(self, index: int) -> float:
        """k of the mode number `index` = 1, 2, …, rad/m."""
        if self.ends == "closed-open":
            return float((2 * index - 1) * np.pi / (2 * self.length_m))
        return float(index * np.pi / self.length_m)

    def mode(self, index: int, damping: float) -> Mode:
        """Mode number `index` = 1, 2, … with that damping ratio."""
        if index < 1:
            raise ValueError(f"index={index!r} is not an integer >= 1")
        k = self.wavenumber(index)
        phase = -np.pi / 2 if self.ends == "open-open" else 0.0
        at_flame, at_speaker = k * self.flame_m + phase, k * self.speaker_m + phase
        # The common pressure that momentum demands is ∫ D dx = 0.72 cos(kx + phase)/k².
        return Mode(
            frequency_hz=sound_speed(self.temperature_k) * k / (2 * np.pi),
            damping=damping,
            psi_flame=float(PSI_NORM * np.cos(at_flame) / k),
            velocity=float(-VELOCITY_NORM * np.sin(at_flame) / k),
            psi_speaker=float(PSI_NORM * np.cos(at_speaker) / k),
            wavenumber=k,
            pressure=float(self.pressure_excess * VELOCITY_NORM * np.cos(at_flame) / k**2),
            phase=float(phase),
        )


def tube_plant(tube: Tube, dampings: Sequence[float], first: int = 2, **changes: object) -> Plant:
    """A plant with one mode a damping ratio, from mode number `first` on.

    The thesis leaves the closed-open tube's lowest mode out (i = 3, 5, …): ``first=2``. `changes`
    are further fields of `Plant`.
    """
    modes = tuple(tube.mode(first + i, zeta) for i, zeta in enumerate(dampings))
    gain = 1e10 * THESIS_AREA_M2 / tube.area_m2
    values: dict[str, object] = {
        "modes": modes,
        "actuator": Actuator(gain=float(gain)),
        "flame_position_m": tube.flame_m,
        "sound_speed_m_s": sound_speed(tube.temperature_k),
    }
    return Plant(**(values | changes))  # type: ignore[arg-type]
