"""How much forcing entrains: the Stuart–Landau law, in measurable quantities.

Near its onset a limit cycle of amplitude A0 and frequency ω0, forced at ω = ω0 − Δω, obeys in the
forcing's frame (amplitudes in units of A0)

    ż = [ν g + j (Δω + B g)] z + ε,     g = 1 − |z|²,     ε = κ · drive

with growth rate ν and twist B (how far the small-amplitude frequency lies above ω0). With a forced
part a and a free part b, each tone sees the other's saturation twice:

    forced:  ε = a · |ν g + j (Δω + B g)|,   g = 1 − a² − 2b²
    free:    growth = ν (1 − b² − 2a²)

Entrained means that a fixed point with b = 0 is stable: its trace 2ν(1 − 2a²) is negative, and
ε(a) grows with a (no saddle). The edge of the tongue is the smallest such ε. Away from ω0 the
trace decides: the free mode dies when a reaches 1/√2 (van der Pol; thesis Eq. 2.13), at
ε = sqrt((ν²/4 + (Δω + B/2)²)/2). Within about ν/2 the saddle decides: the phase locks, for B = 0
at ε ≈ |Δω|. B makes the tongue asymmetric. ν and B come from one disturbance: with the drive off,
1/|z|² − 1 dies as e^{−2νt}, and the phase bends by (B/2ν) ln |z|². κ comes from one probe.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
SUPPRESSED = math.sqrt(0.5)  # forced amplitude at which the free mode dies, cubic saturation
_AMPLITUDES = SUPPRESSED * np.exp(np.arange(0.0, 1.8, 0.002))  # where the trace is negative


@dataclass(frozen=True)
class Law:
    """ν and B (both 1/s) with the relative standard error of ν; zeros while unknown."""

    growth_rate_per_s: float = 0.0
    twist_per_s: float = 0.0
    growth_rate_relative_sigma: float = math.inf

    @property
    def known(self) -> bool:
        return self.growth_rate_per_s > 0

    def faster(self, factor: float) -> "Law":
        """The same cycle with ν that many times as great."""
        return replace(self, growth_rate_per_s=factor * self.growth_rate_per_s)

    def near(self, detuning_rad_s: float) -> bool:
        """Whether the edge of the tongue is phase locking rather than suppression."""
        return self.known and abs(detuning_rad_s) <= self.growth_rate_per_s / 2

    def threshold(self, detuning_rad_s: float) -> float:
        """The smallest ε that entrains at a detuning Δω = ω0 − ω."""
        forcing = self._forcing(_AMPLITUDES, detuning_rad_s)
        rising = np.diff(forcing) > 0
        return float(np.min(forcing[:-1][rising]))

    def suppressing(self, detuning_rad_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Every stable forced state: its amplitude a, ε(a), and the rate λ(a) < 0 at which the
        slowest disturbance beside it changes; evenly spaced in ln a, empty while ν is unknown.

            λ = Re M + Re sqrt(|N|² − (Im M)²),  M = ν(1 − 2a²) + j(Δω + B(1 − 2a²)),
            N = −a²(ν + jB)
        """
        a, forcing = _AMPLITUDES, self._forcing(_AMPLITUDES, detuning_rad_s)
        gain = 1 - 2 * a**2
        turning = detuning_rad_s + self.twist_per_s * gain
        size = a**2 * math.hypot(self.growth_rate_per_s, self.twist_per_s)
        rate = self.growth_rate_per_s * gain + np.sqrt(np.maximum(size**2 - turning**2, 0.0))
        stable = rate < 0
        return a[stable], forcing[stable], rate[stable]

    def _forcing(self, amplitudes: FloatArray, detuning_rad_s: float) -> FloatArray:
        """ε(a) where no free line is left."""
        gain = 1 - amplitudes**2
        return np.asarray(
            amplitudes
            * np.hypot(self.growth_rate_per_s * gain, detuning_rad_s + self.twist_per_s * gain)
        )

    def forcing(self, forced: float, free: float, detuning_rad_s: float) -> float:
        """ε from the relative amplitudes of the forced and the free line."""
        gain = 1 - forced**2 - 2 * free**2
        return forced * math.hypot(
            self.growth_rate_per_s * gain, detuning_rad_s + self.twist_per_s * gain
        )


def lock_from_drift(drive_v: float, detuning_rad_s: float, drift_rad_s: float) -> float | None:
    """The drive that locks, from one probe whose phase still drifts at Ω (near the limit cycle):
    D_lock = D |Δω| / sqrt(Δω² − Ω²). None where the drift is not slower than the detuning.
    """
    slowed = detuning_rad_s**2 - drift_rad_s**2
    return drive_v * abs(detuning_rad_s) / math.sqrt(slowed) if slowed > 0 else None


def law_from_relaxation(z: ComplexArray, step_s: float, amplitude: float) -> Law | None:
    """ν and B from the free cycle's return to its amplitude after a disturbance.

    Parameters
    ----------
    z : (n,) complex amplitude in the frame of the free frequency, drive off
    amplitude : the free amplitude A0, in the same unit

    Returns
    -------
    Law or None
        None when the disturbance is too small beside the noise.
    """
    size = np.abs(z) / amplitude
    tail = size[-max(4, size.size // 4) :]
    noise = float(np.std(np.diff(tail))) / math.sqrt(2.0)
    departure = 1 / size**2 - 1 - (1 / float(np.mean(tail)) ** 2 - 1)
    floor = max(6 * 2 * noise, 0.02)
    # the stretch from the start for which the departure stands out of the noise
    clear = np.abs(departure) > floor
    last = int(np.argmin(clear)) if not clear.all() else clear.size
    if last < 5 or abs(departure[0]) < 4 * floor:
        return None
    t = step_s * np.arange(last)
    heights = np.log(np.abs(departure[:last]))
    weights = np.abs(departure[:last])  # σ(ln y) = σ/y
    design = np.stack([np.ones(last), t], axis=1)
    solved, covariance = _weighted(design, heights, weights)
    rate = -float(solved[1]) / 2
    if rate <= 0:
        return None
    bend = np.stack([np.ones(z.size), step_s * np.arange(z.size), np.log(size**2)], axis=1)
    phase, _ = _weighted(bend, np.unwrap(np.angle(z)), np.ones(z.size))
    return Law(rate, 2 * rate * float(phase[2]), math.sqrt(covariance[1, 1]) / 2 / rate)


def _weighted(
    design: FloatArray, values: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Weighted least squares and the covariance that the residual implies."""
    scaled = design * weights[:, None]
    solved = np.linalg.lstsq(scaled, values * weights, rcond=None)[0]
    rest = values * weights - scaled @ solved
    variance = float(rest @ rest) / max(1, values.size - design.shape[1])
    return np.asarray(solved), np.asarray(variance * np.linalg.inv(scaled.T @ scaled))
