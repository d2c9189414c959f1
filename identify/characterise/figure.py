"""One figure a recording: signal, spectrum, envelope's distribution, finite-lag drift, phase."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.signal import welch

from identify.characterise.envelope import demodulate
from identify.characterise.result import Characterisation

FloatArray = npt.NDArray[np.float64]


def figure(
    result: Characterisation,
    signal: npt.ArrayLike,
    path: str | Path | None = None,
    *,
    title: str = "",
) -> Figure:
    """Draw `result` beside the `signal` it was made from; written to `path` if given.

    The drift panel shows the measured finite-lag Kramers–Moyal drift against the one that the
    identified model's adjoint Fokker–Planck operator predicts at the same lag: they must agree.
    """
    x = np.asarray(signal, dtype=np.float64)
    drawing = Figure(figsize=(11, 6.5), layout="constrained")
    FigureCanvasAgg(drawing)
    grid = drawing.subplots(2, 2)
    envelope = np.abs(
        demodulate(
            x, result.sample_rate_hz, result.frequency_hz.value, result.frequency_hz.value / 3
        )
    )
    _signal(grid[0, 0], result, x, envelope)
    _spectrum(grid[0, 1], result, x)
    _distribution(grid[1, 0], result, envelope)
    _drift(grid[1, 1], result)
    f, a = result.frequency_hz, result.amplitude
    growth = ""
    if result.mode is not None:
        nu = result.mode.growth_rate_per_s
        growth = f", growth rate {nu.value:.3g} ± {nu.stderr:.2g} 1/s"
    drawing.suptitle(
        f"{title + ': ' if title else ''}{result.regime.replace('_', ' ')},"
        f" {f.value:.2f} ± {f.stderr:.2f} Hz,"
        f" {a.value:.4g} ± {a.stderr:.2g} {result.unit}{growth}"
    )
    if path is not None:
        drawing.savefig(Path(path), dpi=120)
    return drawing


def _signal(axes: Axes, result: Characterisation, x: FloatArray, envelope: FloatArray) -> None:
    t = np.arange(x.size) / result.sample_rate_hz
    axes.plot(t, x - x.mean(), lw=0.3, color="0.5", label="signal")
    axes.plot(t, envelope, lw=0.9, color="C3", label="envelope of the fundamental")
    axes.set(xlabel="time (s)", ylabel=f"signal ({result.unit})")
    axes.legend(loc="upper right", fontsize="small")


def _spectrum(axes: Axes, result: Characterisation, x: FloatArray) -> None:
    f, power = welch(x - x.mean(), result.sample_rate_hz, nperseg=min(8192, x.size))
    axes.semilogy(f, power, lw=0.8)
    for h in result.harmonics:
        axes.axvline(
            h.order * result.frequency_hz.value,
            lw=0.6,
            ls=":" if h.significant else "",
            color="C3",
        )
    axes.set(
        xlim=(0, min(6 * result.frequency_hz.value, f[-1])),
        xlabel="frequency (Hz)",
        ylabel=f"power spectral density ({result.unit}²/Hz)",
    )


def _distribution(axes: Axes, result: Characterisation, envelope: FloatArray) -> None:
    axes.hist(envelope, bins=60, density=True, color="0.8", label="measured")
    mode = result.mode
    if mode is not None:
        a, d = mode.grid, mode.noise_intensity.value
        exponent = (
            0.5 * mode.growth_rate_per_s.value * a**2 - 0.25 * mode.saturation.value * a**4
        ) / d
        density = a * np.exp(exponent - exponent.max())
        axes.plot(a, density / (density.sum() * (a[1] - a[0])), color="C3", label="identified")
    axes.set(xlabel=f"envelope ({result.unit})", ylabel=f"probability density (1/{result.unit})")
    axes.legend(fontsize="small")


def _drift(axes: Axes, result: Characterisation) -> None:
    mode = result.mode
    if mode is None:
        axes.text(0.5, 0.5, "record too short", ha="center", transform=axes.transAxes)
    else:
        weight = np.sqrt(mode.visits / mode.visits.max())
        axes.scatter(mode.grid, mode.measured_drift, s=30 * weight, color="0.4", label="measured")
        axes.plot(mode.grid, mode.model_drift, color="C3", label="adjoint Fokker–Planck")
        axes.axhline(0, lw=0.5, color="k")
        axes.legend(fontsize="small")
        axes.set_title(f"lag {1e3 * mode.lag_s:.1f} ms", fontsize="small")
    axes.set(xlabel=f"envelope ({result.unit})", ylabel=f"finite-lag drift ({result.unit}/s)")
