"""Free and forced spectra of the velocity, as in the thesis' Fig. 5.3.

Left, the free run and one forced run up to the harmonics that were compared; right, the
neighbourhood of the limit cycle with all forced runs. Entrainment shows as one line a run, at the
forcing frequency, and nothing left at the free limit cycle's.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from identify.harmonics import estimate_frequency, microphones
from identify.record import Campaign, Medium, Run
from identify.report import theme

FloatArray = npt.NDArray[np.float64]

LOWEST_HZ = 20.0  # below, the pressure difference over jω is noise alone


@dataclass(frozen=True)
class Spectrum:
    """Amplitude spectrum of one run's velocity: `frequency_hz` and `amplitude` (m/s), (F,)."""

    run: str
    kind: str
    forcing_hz: float | None
    amplitude_v: float | None
    frequency_hz: FloatArray
    amplitude: FloatArray


def velocity_spectrum(run: Run, medium: Medium) -> Spectrum:
    """Hann-windowed amplitude spectrum: a line's peak is its amplitude to within 15 % (scalloping).

    The two-microphone velocity is formed bin by bin, û = −(p̂₂ − p̂₁)/(ρ Δx jω) (Eq. 5.2).
    """
    mics = microphones(run)
    n = run.samples
    window = np.hanning(n)
    scale = 2.0 / window.sum()
    f = np.asarray(np.fft.rfftfreq(n, 1.0 / run.sample_rate_hz), dtype=float)
    keep = f >= LOWEST_HZ

    def transform(x: FloatArray) -> npt.NDArray[np.complex128]:
        return np.asarray(scale * np.fft.rfft((x - x.mean()) * window))

    if mics is None:
        velocity = next(s for s in run.signals.values() if s.quantity == "velocity")
        size = np.asarray(np.abs(transform(velocity.values))[keep], dtype=float)
    else:
        rise = transform(run.signals[mics.upper].values - run.signals[mics.lower].values)[keep]
        omega = 2 * np.pi * f[keep]
        size = np.asarray(np.abs(rise) / (medium.density_kg_m3 * mics.spacing_m * omega))
    return Spectrum(
        run.name,
        run.kind,
        run.frequency_hz,
        run.amplitude_v,
        f[keep],
        np.asarray(size, dtype=float),
    )


def free_frequency(campaign: Campaign, excluded: Collection[str] = ()) -> float | None:
    """The free limit cycle's frequency (Hz) from the first free run that is not excluded, None
    without one."""
    for run in campaign.runs:
        if run.kind == "free" and run.name not in excluded:
            signal = next(s for s in run.signals.values() if s.quantity in ("pressure", "velocity"))
            return estimate_frequency(np.asarray(signal.values, dtype=float), run.sample_rate_hz)
    return None


@theme.styled
def spectra(
    campaign: Campaign, harmonics: int = 3, excluded: Collection[str] = ()
) -> Figure | None:
    """Fig. 5.3: free and forced spectra, broad and near the limit cycle; of runs that are not
    `excluded`. None where there is none."""
    runs = [r for r in campaign.runs if r.kind != "cold" and r.name not in excluded]
    spectrum = [velocity_spectrum(r, campaign.medium) for r in runs]
    free = next((s for s in spectrum if s.kind == "free"), None)
    forced = sorted((s for s in spectrum if s.forcing_hz), key=lambda s: s.forcing_hz or 0.0)
    free_hz = free_frequency(campaign, excluded)
    if free_hz is None and not forced:
        return None
    centre = free_hz if free_hz is not None else float(np.median([s.forcing_hz for s in forced]))
    figure, axes = theme.panels(
        3.1, 1, 2, theme.Margins(across=0.2), widths=(1.15, 1.0), sharey=True
    )
    broad, near = axes[0]
    top = (harmonics + 0.6) * centre
    if free is not None:
        _line(broad, free, (LOWEST_HZ, top), theme.NOISE, f"free run, {free_hz:.2f} Hz")
    if forced:
        shown = max(forced, key=lambda s: abs((s.forcing_hz or 0.0) - centre))
        _line(broad, shown, (LOWEST_HZ, top), theme.AFTER, _condition(shown))
    reach = max([abs((s.forcing_hz or centre) - centre) for s in forced], default=5.0) * 1.25 + 1
    band = (centre - reach, centre + reach)
    if free is not None:
        _line(near, free, band, theme.NOISE, "free run", 1.6)
    for i, s in enumerate(forced):
        _line(near, s, band, theme.AFTER, "forced runs" if i == 0 else "")
        assert s.forcing_hz is not None
        near.plot(s.forcing_hz, _peak(s), "v", color=theme.AFTER, ms=3.5, clip_on=False)
    for ax in (broad, near):
        if free_hz is not None:
            ax.axvline(free_hz, color=theme.BEFORE, lw=0.9, ls="--", zorder=0)
        ax.set_yscale("log")
        theme.decades(ax.yaxis)
    if free_hz is not None:
        near.annotate(
            "limit cycle", (free_hz, 0.985), xycoords=("data", "axes fraction"), rotation=90,
            ha="right", va="top", color=theme.BEFORE, fontsize=7,
        )  # fmt: skip
    floor = np.median(np.concatenate([s.amplitude[s.frequency_hz < top] for s in spectrum]))
    peak = max(float(s.amplitude.max()) for s in spectrum)
    broad.set_ylim(floor / 8, peak * 25)
    broad.set_xlim(0, top)
    near.set_xlim(*band)
    for ax in (broad, near):
        ax.legend(loc="upper right", ncols=1)
    theme.name_axes(broad, "frequency (Hz)", "velocity amplitude (m/s)", "a  Free and forced")
    theme.name_axes(near, "frequency (Hz)", "", "b  Near the limit cycle, all forced runs")
    return figure


def _line(
    ax: Axes, s: Spectrum, band: tuple[float, float], colour: str, label: str, width: float = 0.8
) -> None:
    inside = (s.frequency_hz >= band[0]) & (s.frequency_hz <= band[1])
    ax.plot(s.frequency_hz[inside], s.amplitude[inside], color=colour, lw=width, label=label)


def _peak(s: Spectrum) -> float:
    assert s.forcing_hz is not None
    return float(s.amplitude[int(np.argmin(np.abs(s.frequency_hz - s.forcing_hz)))])


def _condition(s: Spectrum) -> str:
    volts = "" if s.amplitude_v is None else f", {s.amplitude_v:g} V"
    return f"forced, {s.forcing_hz:g} Hz{volts}"
