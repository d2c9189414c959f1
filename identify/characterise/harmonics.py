"""Harmonics that belong to the oscillation, phase to another channel, parity of the saturation.

The k-th harmonic is what stays in step with the fundamental: with zₖ the complex amplitude about
k·f₀ and z₁ = |z₁| e^{jφ}, the coupled amplitude is hₖ = |⟨zₖ e^{−jkφ}⟩|. Phase drift of the
oscillation cancels, noise at k·f₀ averages out, and the standard error is that of the mean.

A symmetric (odd) saturation makes odd harmonics only; an even part makes even ones. Parity is
read off the second against the third harmonic where they exceed three standard errors.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from identify.characterise.envelope import Estimate, block_mean, demodulate

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
Parity = Literal["odd", "even", "mixed", "undetermined"]

_CLEAR_DB = 6.0  # one parity is called dominant when it is twice the other in amplitude


@dataclass(frozen=True)
class Harmonic:
    """Amplitude hₖ of harmonic `order`, same unit as the signal."""

    order: int
    amplitude: Estimate

    @property
    def significant(self) -> bool:
        return self.amplitude.value > 3 * self.amplitude.stderr


def coupled_harmonics(
    signal: FloatArray,
    fundamental: ComplexArray,
    sample_rate_hz: float,
    frequency_hz: float,
    bandwidth_hz: float,
    count: int,
) -> tuple[Harmonic, ...]:
    """Harmonics 1…count (as far as the sample rate allows) coupled to `fundamental` (samples,)."""
    unit = fundamental / np.maximum(np.abs(fundamental), np.finfo(float).tiny)
    found = []
    for order in range(1, count + 1):
        if (order * frequency_hz + 3 * bandwidth_hz) > sample_rate_hz / 2:
            break
        z = demodulate(signal, sample_rate_hz, order * frequency_hz, bandwidth_hz)
        found.append(Harmonic(order, _magnitude(z * np.conj(unit) ** order, sample_rate_hz)))
    return tuple(found)


def _magnitude(coupled: ComplexArray, sample_rate_hz: float) -> Estimate:
    """|mean| with the error along the mean's own direction."""
    mean = complex(coupled.mean())
    along = np.real(coupled * np.exp(-1j * np.angle(mean)))
    return Estimate(abs(mean), block_mean(along, 1 / sample_rate_hz).stderr)


def relative_phase(other: ComplexArray, reference: ComplexArray, sample_rate_hz: float) -> Estimate:
    """Phase of `other` ahead of `reference` in degrees, weighted by their product.

    The error is the cross product's part across its mean over the mean (small-angle).
    """
    cross = other * np.conj(reference)
    mean = complex(cross.mean())
    across = np.imag(cross * np.exp(-1j * np.angle(mean)))
    error = block_mean(across, 1 / sample_rate_hz).stderr
    angle = float(np.degrees(np.angle(mean)))
    return Estimate(angle, float(min(180.0, np.degrees(error / max(abs(mean), 1e-300)))))


def parity(harmonics: tuple[Harmonic, ...]) -> Parity:
    """Parity of the saturation from harmonics 2 and 3."""
    table = {h.order: h for h in harmonics}
    if 2 not in table or 3 not in table:
        return "undetermined"
    second, third = table[2], table[3]
    if not (second.significant or third.significant):
        return "undetermined"
    ratio = 20 * np.log10(
        max(second.amplitude.value, second.amplitude.stderr)
        / max(third.amplitude.value, third.amplitude.stderr)
    )
    if ratio > _CLEAR_DB:
        return "even"
    return "odd" if ratio < -_CLEAR_DB else "mixed"
