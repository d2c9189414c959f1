"""One period of a periodic signal: from its harmonics to time samples and back.

What is nonlinear acts on time samples; what is linear, on harmonics. Both ways are small matrices.
"""

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from identify.dual import Dual

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]


@lru_cache(maxsize=32)
def period_matrices(harmonics: int, samples: int | None = None) -> tuple[FloatArray, ComplexArray]:
    """Matrices to and from time samples over one period: (T, 2K) and (K, T)."""
    samples = samples or max(64, 8 * harmonics)
    tau = 2 * np.pi * np.arange(samples) / samples
    angle = np.outer(tau, np.arange(1, harmonics + 1))
    to_time = np.hstack([np.cos(angle), -np.sin(angle)])
    to_harmonics = (2.0 / samples) * np.exp(-1j * angle.T)
    return to_time, to_harmonics


@lru_cache(maxsize=32)
def period_waves(harmonics: int, samples: int | None = None) -> tuple[FloatArray, FloatArray]:
    """cos mτ and sin mτ, m = 0 … 2K, at the same time samples: (T, 2K + 1) each."""
    samples = period_matrices(harmonics, samples)[0].shape[0]
    angle = 2 * np.pi * np.outer(np.arange(samples), np.arange(2 * harmonics + 1)) / samples
    return np.cos(angle), np.sin(angle)


def to_time(c: Any, harmonics: int, samples: int | None = None) -> Any:
    """Time samples (runs, T) over one period of Σ Re c_k e^{jkτ}; `c` an array or a Dual."""
    matrix = period_matrices(harmonics, samples)[0]
    if isinstance(c, Dual):
        stacked = np.concatenate([c.v.real, c.v.imag], axis=1) @ matrix.T
        d = np.broadcast_to(c.d, (*c.v.shape, c.d.shape[-1]))
        both = np.concatenate([d.real, d.imag], axis=1)
        return Dual(stacked, np.einsum("tk,rkp->rtp", matrix, both, optimize=True))
    return np.concatenate([c.real, c.imag], axis=1) @ matrix.T


def to_harmonics(x: Any, harmonics: int, samples: int | None = None) -> Any:
    """Fourier coefficients (runs, K) of time samples over one period; the mean is dropped."""
    matrix = period_matrices(harmonics, samples)[1]
    if isinstance(x, Dual):
        d = np.broadcast_to(x.d, (*x.v.shape, x.d.shape[-1]))
        both = np.concatenate([matrix.real, matrix.imag]) @ d
        return Dual(x.v @ matrix.T, both[:, :harmonics] + 1j * both[:, harmonics:])
    return x @ matrix.T
