"""Measured against modelled harmonics, run by run: amplitude, phase, and error with its noise.

Runs stand side by side in the order of their frequency, the free run first. Error bars are 1.96
standard errors; on good recordings they vanish behind the marker, so the third row shows the
error on a logarithmic axis with the noise that it is judged against.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from identify.report import theme
from identify.results import Assessment, Comparison

FloatArray = npt.NDArray[np.float64]
ORDER = {"free": 0, "cold": 1, "forced": 2}


def ordered(a: Assessment) -> list[Comparison]:
    return sorted(
        a.comparisons, key=lambda c: (ORDER.get(c.kind, 3), c.frequency_hz, c.amplitude_v or 0.0)
    )


def run_label(c: Comparison) -> str:
    if c.kind == "free":
        return "free"
    volts = "" if c.amplitude_v is None else f" {c.amplitude_v:.3g} V"
    cold = "cold " if c.kind == "cold" else ""
    return f"{cold}{c.frequency_hz:.5g} Hz{volts}"


@theme.styled
def harmonics_figure(
    before: Assessment, after: Assessment | None, orders: Sequence[int] = (1, 2, 3)
) -> Figure:
    """One column a harmonic of `orders`; rows: amplitude, phase, error against noise."""
    rows = ordered(before)
    models = [("declared model", before, theme.BEFORE, -0.17)]
    if after is not None:
        models.append(("with effects", after, theme.AFTER, 0.17))
    margins = theme.Margins(top=0.45, bottom=1.15, down=0.16)
    figure, axes = theme.panels(
        6.0, 3, max(len(orders), 2), margins, heights=(1.2, 1, 1.1), sharex=True
    )
    for ax in axes[:, len(orders) :].flat:
        ax.set_visible(False)
    x = np.arange(len(rows))
    for column, k in enumerate(orders):
        top, middle, bottom = axes[:, column]
        y = np.array([c.measured[k - 1] for c in rows])
        noise = np.array([c.stderr[k - 1] for c in rows])
        bars = 1.96 * noise / np.sqrt(2)  # stderr is of the complex value, a bar of one direction
        style = {"color": theme.MEASURED, "ms": 6.5, "mfc": "none", "mew": 0.9, "elinewidth": 0.9}
        top.errorbar(x, np.abs(y), bars, fmt="o", label="measured ± 1.96 s.e.", **style)
        degrees = np.degrees(np.angle(y))
        spread = np.minimum(np.degrees(bars / np.abs(y)), 180.0)  # beyond, the phase is unknown
        middle.errorbar(x, degrees, spread, fmt="o", **style)
        bottom.fill_between(
            np.r_[-0.5, x, x[-1] + 0.5],
            _padded(noise / np.abs(y)) * 100,
            1e-12,
            color=theme.NOISE,
            alpha=0.25,
            lw=0,
            step="mid",
            label="noise",
        )
        lowest = noise / np.abs(y) * 100
        highest = lowest
        for label, a, colour, shift in models:
            predicted = _predicted(a, rows, k)
            top.plot(x + shift, np.abs(predicted), "_", color=colour, ms=7, mew=1.8, label=label)
            turned = degrees + np.degrees(np.angle(predicted / y))
            middle.plot(x + shift, turned, "_", color=colour, ms=7, mew=1.8)
            error = np.abs(predicted - y) / np.abs(y) * 100
            bottom.plot(x + shift, error, "o", color=colour, ms=3.5)
            highest = np.fmax(highest, error)
        low = max(float(np.nanmin(lowest)) / 10, 1e-6)
        bottom.set_yscale("log")
        theme.decades(bottom.yaxis)
        bottom.set_ylim(low, float(np.nanmax(highest)) * 3)
        top.set_title(f"Harmonic {k}")
        top.set_ylim(bottom=0)
        bottom.set_xticks(x, [_marked(c) for c in rows], rotation=90)
        bottom.set_xlabel("run (* validation)")
        for ax in (top, middle, bottom):
            ax.grid(axis="x", visible=False)
            ax.set_xlim(-0.6, len(rows) - 0.4)
    axes[0, 0].set_ylabel("amplitude (m/s)")
    axes[1, 0].set_ylabel("phase (°)")
    axes[2, 0].set_ylabel("error (% of the harmonic)")
    theme.legend_above(figure, axes[0, 0], axes[2, 0])
    return figure


def _marked(c: Comparison) -> str:
    return run_label(c) + (" *" if c.role == "validation" else "")


def _padded(x: FloatArray) -> FloatArray:
    return np.concatenate([x[:1], x, x[-1:]])


def _predicted(a: Assessment, rows: Sequence[Comparison], k: int) -> npt.NDArray[np.complex128]:
    known = {c.run: c for c in a.comparisons}
    missing = complex(np.nan, np.nan)
    y = np.array(
        [known[c.run].predicted[k - 1] if c.run in known else missing for c in rows], dtype=complex
    )
    return np.where(np.isfinite(y), y, missing)
