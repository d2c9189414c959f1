"""Fourier coefficients of the thesis's model without recordings: steady states plus noise.

The steady states come from `identify.balance` itself (which is tested against the thesis's own):
for tests of statistics, not of physics.
"""

from dataclasses import replace

import numpy as np

from identify import balance, dataset
from identify.dataset import Dataset, whitener
from identify.fit import Fit, fit_orbits
from identify.harmonics import VARIANCE_DOF, Harmonics
from identify.record import Medium
from identify.structure import Structure
from tests.test_identify_balance import forced_conditions, theta

STRUCTURE = Structure()
WIDE = ((162.0, 2.2e10), (165.0, 1.2e10), (167.0, 1.0e10), (171.0, 0.8e10), (173.0, 1.5e10),
        (175.0, 1.2e10), (178.0, 2.0e10))  # fmt: skip


def clean(conditions: tuple[tuple[float, float], ...], noise: float) -> Dataset:
    """Forced runs at the model's own steady states in table units, six harmonics compared, noise
    of that share of 2.4e6 on each coefficient."""
    K, compared, n = 12, 6, len(conditions)
    drive = np.zeros((n, K), dtype=complex)
    drive[:, 0] = [-1j * a for _, a in conditions]
    start = np.zeros_like(drive)
    start[:, 0] = 5e6 * np.exp(-2j)
    at = replace(forced_conditions(), omega=2 * np.pi * np.array([f for f, _ in conditions]),
                 drive=drive, pressure=np.zeros_like(drive), velocity=start,
                 time=np.linspace(0, 1, n), flame_on=np.ones(n), identity=np.arange(n),
                 free=np.zeros(n, dtype=bool), spacing_m=np.full(n, 0.0508))  # fmt: skip
    orbits = balance.solve(STRUCTURE, theta(STRUCTURE), at)
    assert orbits.converged.all()
    size = noise * 2.4e6
    measured = [
        Harmonics(
            name=f"{f:g}", kind="forced", role="fit", frequency_hz=f, frequency_stderr_hz=0.0,
            velocity=y, drive=u, pressure=np.zeros(K, dtype=complex),
            covariance=np.eye(2 * K) * size**2 / 2, side=np.zeros((2, K), dtype=complex),
            pressure_noise=np.zeros(K), shared_noise=np.zeros(K, dtype=complex), drive_variance=0.0,
            started_s=60.0 * (3 * i % n),
            duration_s=1.0, nominal_hz=f, amplitude_v=a,
        )
        for i, ((f, a), y, u) in enumerate(zip(conditions, orbits.velocity, drive, strict=True))
    ]  # fmt: skip
    return dataset.build(measured, Medium(), None, compared=compared)


def exact(data: Dataset) -> Fit:
    """The fit of noise-free data: it ends where it starts, at the truth."""
    fit = fit_orbits(STRUCTURE, data, theta(STRUCTURE), continuation=(0.0,))
    assert fit.converged
    return fit


def drawn(data: Dataset, rng: np.random.Generator, drift: float = 0.0) -> Dataset:
    """Noise added, its variance «estimated» from 40 bins; a drift turns the later runs."""
    (b,) = data.fit
    sigma = np.sqrt(b.covariance[:, 0, 0])[:, None]
    n = rng.standard_normal((2, *b.measured.shape)) * sigma
    turn = np.exp(1j * drift * (b.started_s / b.started_s.max() - 0.5))[:, None]
    estimated = b.noise * rng.chisquare(VARIANCE_DOF, b.noise.shape) / VARIANCE_DOF
    covariance = np.stack([np.diag(np.r_[v, v]) / 2 for v in estimated])
    return replace(data, fit=(replace(
        b, measured=b.measured * turn + n[0] + 1j * n[1], noise=estimated, covariance=covariance,
        whitener=np.stack([whitener(c) for c in covariance]),
    ),))  # fmt: skip
