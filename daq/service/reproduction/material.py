"""The thesis's conditions and what the rig answers to them, in the thesis's units."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from identify import dataset
from identify.dataset import Dataset
from identify.harmonics import Harmonics
from identify.record import Medium
from identify.thesis import EntrainedRuns, Feedback
from simulated_rig.campaigns import PlannedRun, simulate_run
from simulated_rig.config import Converter, Microphone, RigConfig
from simulated_rig.orbits import Orbit, forced_orbits
from simulated_rig.plant import Plant
from simulated_rig.presets import thesis_two_mode

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

# Table 4.4: forcing frequency in Hz, amplitude in units of 1e10
TABLE_4_4 = ((166.0, 1.0), (167.0, 1.0), (170.0, 1.5), (171.0, 2.0))
HARMONICS = 16
FLAME_POLE_HZ = 100.0
GAIN = 22.5


@lru_cache(maxsize=8)
def entrained(plant: Plant, conditions: tuple[tuple[float, float], ...]) -> tuple[Orbit, ...]:
    """The stable forced orbit at each condition (the largest one)."""
    return tuple(forced_orbits(plant, f, v, HARMONICS)[-1] for f, v in conditions)


def runs_of(plant: Plant, orbits: Sequence[Orbit]) -> EntrainedRuns:
    """Orbits as the thesis's estimators take them: Y and u_a in the units of its tables."""
    velocity: ComplexArray = np.array([o.velocity[1:] for o in orbits], dtype=np.complex128)
    velocity = velocity / plant.velocity_scale
    drive = np.zeros_like(velocity)
    drive[:, 0] = [-1j * o.volts * plant.actuator.gain for o in orbits]  # sin ωt
    return EntrainedRuns(np.array([o.frequency_hz for o in orbits]), velocity, drive)


@lru_cache(maxsize=1)
def four_runs() -> EntrainedRuns:
    """Table 4.4 on the two-mode model, noise-free."""
    plant = thesis_two_mode()
    return runs_of(plant, entrained(plant, TABLE_4_4))


def feedback(plant: Plant) -> Feedback:
    """What open-loop identification is told of the feedback."""
    modes = plant.modes
    return Feedback.of_modes(
        [m.frequency_hz for m in modes],
        [m.damping for m in modes],
        [m.psi_flame * m.velocity for m in modes],
        flame_gain=plant.flame.gain,
    )


def noisy(runs: EntrainedRuns, noise_db: float | None, rng: np.random.Generator) -> EntrainedRuns:
    """White noise `noise_db` below the first run's velocity, in one second at 10 kHz.

    A coefficient of N samples of noise σ has variance 2σ²/N in each of its parts.
    """
    if noise_db is None:
        return runs
    size = noise_size(runs, noise_db) / np.sqrt(2)
    shape = runs.velocity.shape
    n = size * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    return replace(runs, velocity=runs.velocity + n)


def noise_size(runs: EntrainedRuns, noise_db: float) -> float:
    """√E|n|² of a coefficient."""
    sigma = float(np.abs(runs.velocity[0, 0])) / np.sqrt(2) * 10 ** (-noise_db / 20)
    return float(sigma * np.sqrt(4 / 10000))


def dataset_of(runs: EntrainedRuns, size: float, compared: int) -> Dataset:
    """The same coefficients for the maximum-likelihood fit, each with √E|n|² = `size`; Y in
    1e7 table units (m/s of the preset), u_a in 1e10 (V)."""
    K = compared + 4
    measured = []
    for f, y, u in zip(runs.frequency_hz, runs.velocity, runs.drive, strict=True):
        measured.append(
            Harmonics(
                name=f"{f:g} Hz",
                kind="forced",
                role="fit",
                frequency_hz=float(f),
                frequency_stderr_hz=0.0,
                velocity=y[:K] * 1e-7,
                drive=u[:K] * 1e-10,
                pressure=np.zeros(K, dtype=complex),
                covariance=np.eye(2 * K) * (size * 1e-7) ** 2 / 2,
                side=np.zeros((2, K), dtype=complex),
                pressure_noise=np.zeros(K),
                shared_noise=np.zeros(K, dtype=complex),
                drive_variance=0.0,
                started_s=0.0,
                duration_s=1.0,
                nominal_hz=float(f),
                amplitude_v=float(abs(u[0])) * 1e-10,
            )
        )
    return dataset.build(measured, Medium(), None, compared=compared)


def true_parameters(plant: Plant) -> dict[str, float]:
    """Parameters of the fit's structure, from the tables."""
    flame, shape = plant.flame, plant.characteristic.coefficients
    out = {"flame.pole_hz": flame.pole_hz}
    for i, m in enumerate(plant.modes, start=1):
        out[f"mode{i}.frequency_hz"] = m.frequency_hz
        out[f"mode{i}.damping"] = m.damping
        out[f"mode{i}.flame_residue"] = flame.gain * shape[1] * m.psi_flame * m.velocity
        gain = plant.actuator.gain * plant.velocity_scale
        out[f"mode{i}.speaker_residue"] = gain * m.psi_speaker * m.velocity
    size = flame.gain / plant.velocity_scale  # w = (1/k_f) Yf in m, one scale is free
    out["nonlinearity.c2"] = shape[2] / shape[1] * size
    out["nonlinearity.c3"] = shape[3] / shape[1] * size**2
    return out


@dataclass(frozen=True)
class Recording:
    """One second at 10 kHz: velocity in m/s, pressure in Pa, (10000,)."""

    velocity: FloatArray
    pressure: FloatArray


QUIET = (Microphone(0.6604, noise_pa=0.0), Microphone(0.7112, noise_pa=0.0))


def record(
    plant: Plant,
    condition: tuple[float, float] | None = None,
    settle_s: float = 6.0,
    duration_s: float = 1.0,
) -> Recording:
    """Time stepping: the free response, or that to (Hz, V); no sensor noise."""
    config = RigConfig(plant, microphones=QUIET, converter=Converter(full_scale_v=1e4, bits=32))
    frequency, volts = condition or (None, None)
    run = PlannedRun(
        "forced" if condition else "free",
        frequency,
        volts,
        duration_s=duration_s,
        settle_s=settle_s,
    )
    found = simulate_run(config, run, [1, 0])
    return Recording(found.velocity, found.p1)


def psd_db(x: FloatArray, rate_hz: float = 10000.0) -> tuple[FloatArray, FloatArray]:
    """Frequencies and the power spectrum in dB as MATLAB's ``psd`` scaled it in 2000:
    |FFT of windowed x|²/‖window‖², Hann window over the whole record."""
    window = np.hanning(x.size)
    spectrum = np.abs(np.fft.rfft((x - x.mean()) * window)) ** 2 / np.sum(window**2)
    hz = np.asarray(np.fft.rfftfreq(x.size, 1 / rate_hz), dtype=float)
    return hz, np.asarray(10 * np.log10(spectrum + 1e-30), dtype=float)
