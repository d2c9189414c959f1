"""Figures of the fitted loop with 95 % bands: frequency responses, Nyquist, characteristic, poles.

A band is what the parameters' covariance makes of the curve; where χ² per degree of freedom is far
above one the model is wrong and its band too narrow. Shaded columns are the frequencies at which
harmonics were measured: elsewhere the curve is the model's extrapolation.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from identify.report import theme
from identify.report.responses import (
    Response,
    characteristic,
    closed_loop_poles,
    describing_function,
    largest_input,
    limit_cycle_input,
    responses,
)
from identify.results import Assessment

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
Models = Sequence[tuple[str, Assessment, str]]

Z95 = 1.96
POINTS = 160
WIDEST = np.log(10.0)  # a band is drawn to a factor of ten at most: beyond, nothing is known


def models(before: Assessment, after: Assessment | None) -> Models:
    """(label, assessment, colour) of those that converged."""
    named = [("declared model", before, theme.BEFORE)]
    if after is not None:
        named.append(("with effects", after, theme.AFTER))
    return [m for m in named if m[1].fit.converged]


def measured_bands(a: Assessment) -> list[tuple[float, float]]:
    """Spans of frequency (Hz) at which each harmonic was measured."""
    f = np.array([c.frequency_hz for c in a.comparisons])
    K = min(c.measured.size for c in a.comparisons)
    return [(float(k * f.min()), float(k * f.max())) for k in range(1, K + 1)]


def grid(a: Assessment) -> FloatArray:
    """Frequencies from a fifth of the fundamental to beyond the highest harmonic, dense near the
    modes, whose peaks are narrow."""
    bands = measured_bands(a)
    base = np.geomspace(bands[0][0] / 5, bands[-1][1] * 1.15, POINTS)
    modes = [v for n, v in a.fit.values.items() if n.endswith("frequency_hz")]
    dampings = [v for n, v in a.fit.values.items() if n.endswith("damping")]
    # a resonance's circle is traced evenly at offsets of its half-width times the tangent
    offsets = np.tan(np.linspace(-1.53, 1.53, 61))
    near = [f * (1 + z * offsets) for f, z in zip(modes, dampings, strict=True)]
    inside = np.concatenate([base, *near])
    return np.unique(inside[(inside >= base[0]) & (inside <= base[-1])])


@theme.styled
def frequency_responses(before: Assessment, after: Assessment | None) -> Figure:
    """Magnitude and phase of drive → velocity, flame output → velocity, and the open loop."""
    shown = models(before, after)
    figure, axes = theme.panels(
        4.4, 2, 3, theme.Margins(top=0.45, down=0.16, across=0.42), sharex=True
    )
    names = ("drive → velocity (m/s per V)", "flame output → velocity (1/s)", "open loop L (1)")
    previous: list[FloatArray | None] = [None] * 3
    for label, a, colour in shown:
        f = grid(a)
        r = responses(a.fit, f)
        for column, part in enumerate((r.from_drive, r.from_flame, r.loop)):
            phase = np.unwrap(np.angle(part.value))
            earlier = previous[column]
            if earlier is not None:  # the same branch as the other model, at the first frequency
                phase -= 2 * np.pi * np.round((phase[0] - earlier[0]) / (2 * np.pi))
            previous[column] = phase
            _bode(axes[0, column], axes[1, column], f, part, phase, colour, label)
    for column in range(3):
        top, bottom = axes[:, column]
        for ax in (top, bottom):
            for low, high in measured_bands(shown[0][1]):
                ax.axvspan(low, high, color=theme.NOISE, alpha=0.16, lw=0, zorder=0)
        top.set_yscale("log")
        theme.decades(top.yaxis)
        bottom.set_xscale("log")
        theme.decades(bottom.xaxis)
        theme.name_axes(top, "", "magnitude" if column == 0 else "", names[column])
        theme.name_axes(bottom, "frequency (Hz)", "phase (°)" if column == 0 else "")
    axes[0, 2].axhline(1.0, color=theme.NOISE, lw=0.9, ls="--")
    theme.legend_above(figure, axes[0, 0])
    return figure


def _bode(
    top: Axes,
    bottom: Axes,
    f: FloatArray,
    r: Response,
    phase_rad: FloatArray,
    colour: str,
    label: str,
) -> None:
    size = np.abs(r.value)
    spread = np.minimum(Z95 * r.log_magnitude_stderr, WIDEST)
    phase = np.degrees(phase_rad)
    turn = np.degrees(np.minimum(Z95 * r.phase_stderr, np.pi))
    top.plot(f, size, color=colour, lw=1.1, label=label)
    top.fill_between(
        f, size * np.exp(-spread), size * np.exp(spread), color=colour, alpha=0.25, lw=0
    )
    bottom.plot(f, phase, color=colour, lw=1.1)
    bottom.fill_between(f, phase - turn, phase + turn, color=colour, alpha=0.25, lw=0)


@theme.styled
def nyquist_and_poles(before: Assessment, after: Assessment | None) -> Figure:
    """Open loop in the complex plane with 1/N(a), and the closed loop's poles."""
    figure, axes = theme.panels(3.6, 1, 2, theme.Margins(top=0.45, across=0.65))
    left, right = axes[0]
    shown = models(before, after)
    for label, a, colour in shown:
        _nyquist(left, a, colour, label)
        _poles(right, a, colour)
    left.axhline(0, color=theme.GRID, lw=0.8, zorder=0)
    left.axvline(0, color=theme.GRID, lw=0.8, zorder=0)
    left.plot(1, 0, "+", color=theme.MEASURED, ms=8, mew=1.2)
    left.plot([], [], color=theme.NOISE, lw=2.4, alpha=0.5, label="1/N(a)")
    left.set_aspect("equal", adjustable="box")
    _frame(left, shown)
    theme.name_axes(left, "Re L", "Im L", "Nyquist; × limit cycle, + critical point 1")
    right.axvline(0, color=theme.BEFORE, lw=0.9, ls="--", zorder=0)
    theme.name_axes(
        right, "growth Re λ (1/s)", "Im λ / 2π (Hz)", "Poles: × small oscillation, ○ on the cycle"
    )
    theme.legend_above(figure, left)
    return figure


def _nyquist(ax: Axes, a: Assessment, colour: str, label: str) -> None:
    f = grid(a)
    L = responses(a.fit, f).loop
    ax.plot(L.value.real, L.value.imag, color=colour, lw=1.1, label=label)
    _regions(ax, L.value[::3], L.covariance[::3], colour)
    reach = largest_input(a)
    amplitude = np.linspace(reach / 200, reach, 60)
    gain = describing_function(a.fit, amplitude).y
    positive = gain > 0.2  # beyond, the locus runs off to infinity
    ax.plot(1 / gain[positive], np.zeros(positive.sum()), color=colour, lw=2.4, alpha=0.35,
            solid_capstyle="butt")  # fmt: skip
    at = limit_cycle_input(a)
    if at is not None:
        here = float(describing_function(a.fit, np.array([at])).y[0])
        ax.plot(1 / here, 0, "x", color=colour, ms=5, mew=1.4, zorder=4)


def _frame(ax: Axes, shown: Models) -> None:
    """Limits around the last model's loop: an earlier, wrong one may reach far beyond."""
    a = shown[-1][1]
    L = responses(a.fit, grid(a)).loop.value
    at = limit_cycle_input(a)
    gain = 1.0 if at is None else float(describing_function(a.fit, np.array([at])).y[0])
    right = max(float(L.real.max()), 1.0, 1 / gain if gain > 0.1 else 1.0)
    span = 1.1 * max(right - float(L.real.min()), float(np.ptp(L.imag)))
    x, y = 0.5 * (right + float(L.real.min())), 0.5 * float(L.imag.max() + L.imag.min())
    ax.set_xlim(x - span / 2, x + span / 2)
    ax.set_ylim(y - span / 2, y + span / 2)


def _poles(ax: Axes, a: Assessment, colour: str) -> None:
    small = closed_loop_poles(a.fit)
    scale = np.array([1.0, 1 / (2 * np.pi)])
    shown = small.value.real + 1j * small.value.imag * scale[1]
    ax.plot(shown.real, shown.imag, "x", color=colour, ms=5.5, mew=1.3)
    _regions(ax, shown, small.covariance * np.outer(scale, scale), colour)
    at = limit_cycle_input(a)
    if at is not None:
        gain = float(describing_function(a.fit, np.array([at])).y[0])
        on_cycle = closed_loop_poles(a.fit, gain).value
        ax.plot(on_cycle.real, on_cycle.imag / (2 * np.pi), "o", mfc="none", mec=colour, ms=5)


def _regions(ax: Axes, centre: ComplexArray, covariance: FloatArray, colour: str) -> None:
    """95 % regions of complex values: ellipses of √χ²₂(0.95) = 2.448 standard deviations.

    Those thinner than the line that they would lie under are left out.
    """
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)), dtype=bool)
    size, axis = np.linalg.eigh(np.where(known[:, None, None], covariance, 0.0))
    radius = 2.448 * np.sqrt(np.maximum(size, 0.0))
    shown = known & (radius[:, 1] > 5e-4 * np.abs(centre))
    tau = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    circle = np.stack([np.cos(tau), np.sin(tau)])
    outline = np.swapaxes(axis @ (radius[:, :, None] * circle), 1, 2)
    outline = outline + np.stack([centre.real, centre.imag], axis=1)[:, None]
    ax.add_collection(
        PolyCollection(list(outline[shown]), facecolors=colour, edgecolors="none", alpha=0.3),
        autolim=False,
    )


@theme.styled
def nonlinearity(before: Assessment, after: Assessment | None) -> Figure:
    """N(w) and its describing function over the amplitudes that were measured."""
    figure, axes = theme.panels(2.9, 1, 2, theme.Margins(top=0.45, left=0.75, across=0.7))
    left, right = axes[0]
    shown = models(before, after)
    for label, a, colour in shown:
        reach = largest_input(a)
        curve = characteristic(a.fit, np.linspace(-reach, reach, 161))
        left.plot(curve.x * 1e6, curve.y * 1e6, color=colour, lw=1.2, label=label)
        band = Z95 * curve.stderr
        left.fill_between(curve.x * 1e6, (curve.y - band) * 1e6, (curve.y + band) * 1e6,
                          color=colour, alpha=0.25, lw=0)  # fmt: skip
        gain = describing_function(a.fit, np.linspace(reach / 100, reach, 80))
        band = Z95 * gain.stderr
        right.plot(gain.x * 1e6, gain.y, color=colour, lw=1.2)
        right.fill_between(gain.x * 1e6, gain.y - band, gain.y + band,
                           color=colour, alpha=0.25, lw=0)  # fmt: skip
        at = limit_cycle_input(a)
        if at is not None:
            here = float(describing_function(a.fit, np.array([at])).y[0])
            right.plot(at * 1e6, here, "x", color=colour, ms=6, mew=1.5)
    low, high = left.get_xlim()
    left.plot([low, high], [low, high], color=theme.NOISE, lw=0.9, ls="--", label="slope one")
    left.set_xlim(low, high)
    theme.name_axes(left, "flame input w (µm)", "flame output N(w) (µm)", "Nonlinearity")
    theme.name_axes(
        right, "amplitude a of w (µm)", "gain N(a)", "Describing function; × free limit cycle"
    )
    theme.legend_above(figure, left)
    return figure
