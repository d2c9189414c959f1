"""Where the two-microphone velocity can be trusted (Eqs. 5.1, 5.2).

The finite difference is good for 0.1π < k·s < 0.8π: below, the channels' mismatch δ costs δ/(k·s);
above, the field bends too much between the microphones. Every harmonic used must lie inside.
"""

import math
from dataclasses import dataclass

LOW, HIGH = 0.1 * math.pi, 0.8 * math.pi


@dataclass(frozen=True)
class Validity:
    """k·s of each harmonic, which are outside, and the spacings that would hold them all."""

    ks: tuple[float, ...]
    outside: tuple[int, ...]
    spacing_m: float
    better_spacing_m: tuple[float, float] | None

    @property
    def remark(self) -> str | None:
        """A sentence for the report; None when all is well."""
        if not self.outside:
            return None
        which = ", ".join(f"k={k} (k·s = {self.ks[k - 1] / math.pi:.3f}π)" for k in self.outside)
        what = f"spacing {self.spacing_m * 1e3:.1f} mm: outside 0.1π…0.8π at {which}"
        if self.better_spacing_m is None:
            return f"{what}; no spacing holds all harmonics: use three or more microphones"
        low, high = self.better_spacing_m
        return f"{what}; {low * 1e3:.0f} to {high * 1e3:.0f} mm would hold all harmonics"


def validity(
    first_m: float,
    second_m: float,
    fundamental_hz: float,
    harmonics: int = 3,
    sound_speed_m_s: float = 343.0,
) -> Validity:
    """Check a pair of positions against the harmonics of a fundamental."""
    spacing = abs(second_m - first_m)
    wavenumbers = [
        2 * math.pi * k * fundamental_hz / sound_speed_m_s for k in range(1, harmonics + 1)
    ]
    ks = tuple(k * spacing for k in wavenumbers)
    outside = tuple(i for i, value in enumerate(ks, start=1) if not LOW < value < HIGH)
    low, high = LOW / wavenumbers[0], HIGH / wavenumbers[-1]
    return Validity(ks, outside, spacing, (low, high) if low < high else None)
