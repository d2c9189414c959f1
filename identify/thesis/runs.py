"""What the thesis's estimators work on: Fourier coefficients of entrained runs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify.dataset import Batch, Dataset

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class EntrainedRuns:
    """Coefficients c_k, k = 1 … K, with y(t) = Re Σ c_k e^{jkωt}; any unit.

    `frequency_hz` (runs,); `velocity` Y and `drive` u_a (runs, K).

    Raises
    ------
    ValueError
        When the shapes do not agree or there are fewer than two harmonics.
    """

    frequency_hz: FloatArray
    velocity: ComplexArray
    drive: ComplexArray

    def __post_init__(self) -> None:
        shape = self.velocity.shape
        if len(shape) != 2 or self.drive.shape != shape or self.frequency_hz.shape != shape[:1]:
            raise ValueError(
                f"velocity{shape}, drive{self.drive.shape} and frequency_hz"
                f"{self.frequency_hz.shape} are not (runs, K), (runs, K) and (runs,)"
            )
        if shape[1] < 2:
            raise ValueError(f"K={shape[1]} harmonics; the balance needs at least two")

    @property
    def s(self) -> ComplexArray:
        """jkω, (runs, K)."""
        k = np.arange(1, self.velocity.shape[1] + 1)
        return np.asarray(2j * np.pi * self.frequency_hz[:, None] * k)

    @property
    def scale_rad(self) -> float:
        """ω₀ that makes s of order one: the mean forcing frequency."""
        return float(2 * np.pi * np.mean(self.frequency_hz))

    @classmethod
    def from_dataset(cls, data: Dataset) -> "EntrainedRuns":
        """The forced runs to fit on, with the flame on."""
        parts = [_forced(b) for b in data.fit if not b.free]
        if not parts:
            raise ValueError("no forced run in the data set; the balance needs entrained runs")
        return cls.joined(parts)

    @classmethod
    def joined(cls, parts: Sequence["EntrainedRuns"]) -> "EntrainedRuns":
        """All runs of `parts`, at the harmonics that all of them have."""
        least = min(p.velocity.shape[1] for p in parts)
        return cls(
            np.concatenate([p.frequency_hz for p in parts]),
            np.concatenate([p.velocity[:, :least] for p in parts]),
            np.concatenate([p.drive[:, :least] for p in parts]),
        )


def _forced(batch: Batch) -> EntrainedRuns:
    lit = ~batch.cold
    K = batch.compared
    return EntrainedRuns(
        batch.at.omega[lit] / (2 * np.pi), batch.measured[lit], batch.at.drive[lit, :K]
    )
