"""The residual of a periodic excitation, split by what each line of its spectrum can hold.

An odd random-phase multisine excites odd lines only. Over whole periods in the steady state

- even lines carry even-order distortion and noise, nothing else;
- odd excited lines carry errors of the linear path and odd-order distortion besides;
- odd lines left out of the excitation carry odd-order distortion and noise alone.

So a term that lowers only one set says which kind it is before any statistics.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_EXCITED = 0.02  # share of the strong lines' median power from which a line counts as excited


@dataclass(frozen=True)
class Lines:
    """Whole periods of `period` samples starting at `starts`, each in its steady state."""

    starts: tuple[int, ...]
    period: int

    def __post_init__(self) -> None:
        if self.period < 8 or not self.starts:
            raise ValueError(
                f"period={self.period}, starts={self.starts}: need a period >= 8 and a start"
            )

    def power(self, x: FloatArray) -> FloatArray:
        """Mean power of each line over the periods, shape (period // 2 + 1,), unit²."""
        blocks = np.array([x[s : s + self.period] for s in self.starts])
        power = np.abs(np.fft.rfft(blocks, axis=1) / self.period) ** 2
        power[:, 1 : (self.period + 1) // 2] *= 2
        return np.asarray(power.mean(axis=0))

    def sets(self, u: FloatArray) -> dict[str, npt.NDArray[np.bool_]]:
        """Masks of the line sets for the input `u` (samples,)."""
        power = self.power(u)
        line = np.arange(power.size)
        strong = np.sort(power[1:])[-max(4, power.size // 8) :]
        excited = power > _EXCITED * np.median(strong)
        excited[0] = False
        top = int(np.flatnonzero(excited).max())
        odd, inside = line % 2 == 1, (line <= top) & (line > 0)
        odd_only = excited[inside & ~odd].mean() < 0.1
        if not odd_only:
            return {"excited": inside & excited, "unexcited": inside & ~excited}
        return {
            "odd_excited": inside & odd & excited,
            "odd_unexcited": inside & odd & ~excited,
            "even": inside & ~odd,
            "odd_above_band": (line > top) & odd,
            "even_above_band": (line > top) & ~odd,
        }

    def split(self, residual: FloatArray, u: FloatArray) -> dict[str, float]:
        """RMS of `residual` in each set that has lines, in its own unit."""
        power = self.power(residual)
        return {
            name: float(np.sqrt(power[mask].sum()))
            for name, mask in self.sets(u).items()
            if mask.any()
        }

    def differences(self, residual: FloatArray, u: FloatArray, alike: float) -> FloatArray:
        """What `residual` (samples,) does not repeat where the input `u` does, scaled to the
        noise's own power: period after period of each excitation that comes back, (samples,).

        Two periods are one excitation where their inputs differ by less than `alike` of their size.
        """
        out: list[FloatArray] = []
        left = list(self.starts)
        while left:
            first = u[left[0] : left[0] + self.period]
            far = alike * np.linalg.norm(first)
            same = [s for s in left if np.linalg.norm(u[s : s + self.period] - first) <= far]
            left = [s for s in left if s not in same]
            if len(same) > 1:
                blocks = np.array([residual[s : s + self.period] for s in same])
                out += list((blocks - blocks.mean(axis=0)) * np.sqrt(len(same) / (len(same) - 1)))
        return np.concatenate(out) if out else np.empty(0)


def realisations(first: int, spacing: float, settle: int, period: int, count: int) -> Lines:
    """Lines of `count` realisations `spacing` samples apart, each settled for `settle` samples."""
    starts: Sequence[int] = [first + round(spacing * i) + settle for i in range(count)]
    return Lines(tuple(starts), period)
