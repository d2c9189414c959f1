"""From a recording without forcing to regime, limit cycle and growth rate.

The strongest hump of the spectrum fixes f₀. A wide band (Gaussian, std f₀/3) about it gives the
amplitude; a narrow one (f₀/8) frequency, harmonics and phases, free of what lives beside the mode.

Growth rate and noise intensity come from the envelope's transitions in the widest band whose
answer does not depend on the lag (τ and 2τ agree within two standard errors): an envelope that
something else modulates, or noise from beside the mode, makes them disagree. The regime:

- ``noise``: a linear, damped mode driven by noise explains the narrow-band envelope;
- ``limit_cycle``: it saturates and stays away from rest, ⟨A⁴⟩/⟨A²⟩² < 1.2 (spread below 0.22);
- ``intermittent``: it saturates, yet wanders between rest and oscillation.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from identify.characterise.envelope import (
    block_mean,
    demodulate,
    dominant_frequency,
    mean_frequency,
)
from identify.characterise.harmonics import coupled_harmonics, parity, relative_phase
from identify.characterise.read import Recording, read_text
from identify.characterise.result import Characterisation, Regime
from identify.characterise.stochastic import SATURATION_LR, StochasticMode, identify_envelope

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

_WIDE, _NARROW = 1 / 3, 1 / 8  # band-pass standard deviation over f₀
_BANDS = (_WIDE, 1 / 5, _NARROW)
_FILTER_RATIO = 0.8  # beyond it the band-pass, not the mode, sets the envelope's memory
_LIMIT_CYCLE_KURTOSIS, _NOISE_KURTOSIS = 1.2, 1.8
_PRIMARY = re.compile(r"(pressure|p|microphone|mic)[_ ]?\d*", re.IGNORECASE)


def characterise(
    signal: npt.ArrayLike,
    sample_rate_hz: float,
    others: Mapping[str, npt.ArrayLike] | None = None,
    *,
    unit: str = "V",
    band_hz: tuple[float, float] | None = None,
    harmonics: int = 5,
) -> Characterisation:
    """Characterise a self-excited oscillation that nothing forces.

    Parameters
    ----------
    signal : shape (samples,), in `unit`; usually the pressure.
    others : further channels of the same length, for their phase to `signal`.
    band_hz : where to look for the fundamental; default 20 Hz (or 8 periods a record) to a fifth
        of the sample rate.

    Raises
    ------
    ValueError : wrong shapes, a constant or non-finite signal, an impossible band.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> t = np.arange(20000) / 5000
    >>> y = np.sin(2 * np.pi * 170 * t) + 0.01 * rng.standard_normal(t.size)
    >>> round(characterise(y, 5000.0).frequency_hz.value, 1)
    170.0
    """
    x = _checked("signal", signal, None)
    channels = {name: _checked(name, y, x.size) for name, y in (others or {}).items()}
    low, high = band_hz or (max(20.0, 8 * sample_rate_hz / x.size), sample_rate_hz / 5)
    if not 0 < low < high < sample_rate_hz / 2:
        raise ValueError(
            f"band_hz=({low:.4g}, {high:.4g}) is not a range within 0…{sample_rate_hz / 2:.4g} Hz"
        )
    step = 1 / sample_rate_hz
    centre = dominant_frequency(x, sample_rate_hz, low, high)
    band = _NARROW * centre
    edge = min(x.size // 8, int(sample_rate_hz / (np.pi * band)) + 1)

    def amplitude_of(y: FloatArray, frequency_hz: float, share: float) -> ComplexArray:
        return demodulate(y, sample_rate_hz, frequency_hz, share * centre)[edge:-edge]

    frequency = mean_frequency(amplitude_of(x, centre, _NARROW), sample_rate_hz, centre)
    z = amplitude_of(x, frequency.value, _NARROW)
    envelopes = {share: np.abs(amplitude_of(x, frequency.value, share)) for share in _BANDS}
    narrow, wide = np.abs(z), envelopes[_WIDE]
    kurtosis = float(np.mean(narrow**4) / np.mean(narrow**2) ** 2)
    mode, saturates, notes = _stochastic(envelopes, step, centre)
    trimmed = x[edge:-edge]
    lines = coupled_harmonics(trimmed, z, sample_rate_hz, frequency.value, band, harmonics)
    return Characterisation(
        regime=_regime(kurtosis, saturates),
        frequency_hz=frequency,
        amplitude=block_mean(wide, step),
        unit=unit,
        harmonics=lines,
        phase_deg={
            name: relative_phase(amplitude_of(y, frequency.value, _NARROW), z, sample_rate_hz)
            for name, y in channels.items()
        },
        saturation_parity=parity(lines),
        kurtosis=kurtosis,
        band_share=float(np.mean(wide**2) / 2 / trimmed.var()),
        mode=mode,
        sample_rate_hz=sample_rate_hz,
        samples=x.size,
        notes=notes,
    )


def primary(recording: Recording, signal: str | None = None) -> str:
    """The name of the signal that is characterised: `signal`, else the first pressure, else the
    strongest: a drive that rests or a channel that hears nothing says nothing.

    Raises ValueError where the recording has no such signal.
    """
    names = list(recording.signals)
    strongest = max(names, key=lambda n: float(np.std(recording.signals[n])))
    chosen = signal or next((n for n in names if _PRIMARY.fullmatch(n)), strongest)
    if chosen not in recording.signals:
        raise ValueError(f"signal={chosen!r} is not one of {names}")
    return chosen


def characterise_recording(recording: Recording, signal: str | None = None) -> Characterisation:
    """Characterise its `primary` signal; phases of all the others."""
    chosen = primary(recording, signal)
    others = {name: y for name, y in recording.signals.items() if name != chosen}
    found = characterise(
        recording.signals[chosen], recording.sample_rate_hz, others, unit=recording.unit
    )
    return replace(found, signal=chosen)


def characterise_file(
    path: str | Path,
    *,
    signal: str | None = None,
    names: Sequence[str] | None = None,
    sample_rate_hz: float | None = None,
) -> Characterisation:
    """Read a text recording (`read_text`) and characterise it."""
    recording = read_text(path, names=names, sample_rate_hz=sample_rate_hz)
    return characterise_recording(recording, signal)


def _checked(name: str, values: npt.ArrayLike, size: int | None) -> FloatArray:
    x = np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or x.size < 256 or (size is not None and x.size != size):
        need = f"({size},)" if size is not None else "(at least 256,)"
        raise ValueError(f"{name}: shape {x.shape} is not {need}: pass one channel")
    if not np.isfinite(x).all() or x.std() == 0:
        raise ValueError(f"{name}: not a varying signal of finite numbers: check the channel")
    return x


def _regime(kurtosis: float, saturates: bool | None) -> Regime:
    """`saturates` is None where the record is too short to test: then the kurtosis alone."""
    if saturates is False or (saturates is None and kurtosis > _NOISE_KURTOSIS):
        return "noise"
    return "limit_cycle" if kurtosis < _LIMIT_CYCLE_KURTOSIS else "intermittent"


def _stochastic(
    envelopes: Mapping[float, FloatArray], step_s: float, centre_hz: float
) -> tuple[StochasticMode | None, bool | None, tuple[str, ...]]:
    """The mode in the widest band with a lag-free answer; whether the narrow band saturates."""
    narrowest: StochasticMode | None = None
    chosen: StochasticMode | None = None
    notes: tuple[str, ...] = ()
    for share, envelope in envelopes.items():
        try:
            once = identify_envelope(envelope, step_s, share * centre_hz)
            if share == _NARROW:
                narrowest = once
            if chosen is None:
                twice = identify_envelope(envelope, step_s, share * centre_hz, lags=6.0)
                chosen = once if _agree(once, twice) else None
        except ValueError as error:
            notes = (str(error),)
    if narrowest is None:
        return chosen, None, notes
    if chosen is None:
        chosen = narrowest
        notes += ("growth rate depends on the lag in every band: the envelope is not Markovian",)
    if not chosen.converged:
        notes += (chosen.message,)
    occupied = chosen.grid[chosen.visits > 0]
    if occupied.min() > 0.5 * occupied.max():
        notes += (
            "the envelope never comes near rest: the growth rate extrapolates the cubic law from"
            f" amplitudes above {occupied.min():.3g}, and how wrong that is nothing here says",
        )
        growth = replace(chosen.growth_rate_per_s, stderr=np.inf)
        chosen = replace(chosen, growth_rate_per_s=growth)
    return chosen, narrowest.saturation_lr > SATURATION_LR, notes


def _agree(once: StochasticMode, twice: StochasticMode) -> bool:
    a, b = once.growth_rate_per_s, twice.growth_rate_per_s
    if not once.converged or once.filter_ratio > _FILTER_RATIO:
        return False
    return abs(a.value - b.value) < 2 * float(np.hypot(a.stderr, b.stderr))
