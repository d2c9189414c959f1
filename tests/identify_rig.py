"""Synthetic recordings for the tests of `identify`: orbits by a time-stepping program of their own.

The equations of the thesis's two-mode model (Eq. 4.12, Tables 4.1, 4.2, 4.7, with the erratum of
mode 2), stepped by plain Runge–Kutta: neither
`identify` nor the integrator of the simulated rig.
"""

from functools import lru_cache

import numba
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

FREQUENCIES = np.array([168.79, 281.33])
DAMPING = np.array([0.010, 0.050])
PSI_FLAME = np.array([-0.41, -0.24])
D = np.array([-0.16, 0.10])
PSI_SPEAKER = np.array([-0.22, -0.34])
GAIN, POLE = 30.0, 2 * np.pi * 100.0

# Steady states of physics.md §1: frequency, amplitude, then |Y| of three harmonics, phase of Y.
STEADY = (
    (166.0, 1.0e10, (5.80933e6, 2.39248e5, 1.02196e5), -82.779),
    (167.0, 1.0e10, (5.85377e6, 2.35327e5, 1.02107e5), -95.354),
    (170.0, 1.5e10, (6.32136e6, 2.61888e5, 1.20262e5), -126.334),
    (171.0, 2.0e10, (6.78041e6, 3.00329e5, 1.45102e5), -131.679),
)
FREE_HZ, FREE_HARMONICS = 169.713, (2.41447e6, 3.784e4, 6.83e3)


def true_values() -> dict[str, float]:
    """The model's parameters in `identify`'s terms (physics.md §2)."""
    values = {
        "flame.pole_hz": 100.0,
        "nonlinearity.c2": -15000 / 4000**2 / 22.5 * GAIN,
        "nonlinearity.c3": -200 / 4000**3 / 22.5 * GAIN**2,
    }
    for i in range(2):
        values[f"mode{i + 1}.frequency_hz"] = float(FREQUENCIES[i])
        values[f"mode{i + 1}.damping"] = float(DAMPING[i])
        values[f"mode{i + 1}.flame_residue"] = float(GAIN * 22.5 * PSI_FLAME[i] * D[i])
        values[f"mode{i + 1}.speaker_residue"] = float(PSI_SPEAKER[i] * D[i])
    return values


@numba.njit
def _step_through(frequency_hz, amplitude, pole, warm, skip, count, every, h):  # type: ignore[no-untyped-def]
    """Fourth-order Runge–Kutta; every `every`-th velocity after `skip` steps."""
    w2 = (2 * np.pi * FREQUENCIES * warm[0]) ** 2
    loss = 2 * DAMPING * warm[1] * np.sqrt(w2)
    omega = 2 * np.pi * frequency_hz
    x = np.array([0.0, 0.0, 1e6, 0.0, 0.0])
    k = np.zeros((4, 5))
    out = np.empty(count)
    for n in range(skip + count * every):
        if n >= skip and (n - skip) % every == 0:
            out[(n - skip) // every] = D[0] * x[2] + D[1] * x[3]
        for stage in range(4):
            part = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            z = x + part * h * k[max(stage - 1, 0)] if stage else x
            y = D[0] * z[2] + D[1] * z[3]
            q = z[4]
            dq = GAIN * y - pole * q
            flame = (22.5 - 2 * 15000 * q / 4000**2 - 3 * 200 * q**2 / 4000**3) * dq
            drive = amplitude * np.sin(omega * h * (n - skip + part))
            for i in range(2):
                k[stage, i] = z[2 + i]
                force = PSI_FLAME[i] * flame + PSI_SPEAKER[i] * drive
                k[stage, 2 + i] = force - loss[i] * z[2 + i] - w2[i] * z[i]
            k[stage, 4] = dq
        x = x + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
    return out


@lru_cache(maxsize=64)
def velocity(
    frequency_hz: float,
    amplitude: float,
    seconds: float,
    rate: float,
    pole: float = POLE,
    warm: tuple[float, float] = (1.0, 1.0),
) -> FloatArray:
    """Settled velocity under u = F sin ωt, with phase zero at the first sample; `pole` (rad/s) is
    the flame's, `warm` the factors on all frequencies and dampings.

    100 kHz steps: (ωh)⁵ of the third harmonic is 4e-8; five seconds of settling, e^{-5·5.9} of
    the free cycle's own rate, leave 1e-12.
    """
    every = round(100_000 / rate)
    h = 1.0 / (rate * every)
    skip = round(5.0 / h)
    count = round(seconds * rate)
    return np.asarray(_step_through(frequency_hz, amplitude, pole, warm, skip, count, every, h))
