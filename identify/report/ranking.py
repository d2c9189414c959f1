"""Candidates and places ranked: misfit and validation error, with the line that noise draws."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from identify.report import theme
from identify.report.words import label, scientific
from identify.results import PLACES, Candidate, Diagnosis, Whereabouts

FloatArray = npt.NDArray[np.float64]


@theme.styled
def ranking(d: Diagnosis) -> Figure:
    """χ² per degree of freedom and validation error of each candidate beside the declared model."""
    candidates = d.candidates
    # one effect a line: several in a row would leave the bars no room
    names = ["declared model", *(label(c).replace(" + ", " +\n") for c in candidates)]
    chi2 = np.array([d.before.chi2_per_dof, *(c.chi2_per_dof for c in candidates)])
    errors = np.array([d.before.validation_error, *(c.validation_error for c in candidates)])
    colours = [theme.BEFORE, *(_colour(c, d) for c in candidates)]
    y = np.arange(len(names))
    longest = max(len(line) for n in names for line in n.split("\n"))
    row = 0.1 + 0.14 * max(n.count("\n") + 1 for n in names)
    margins = theme.Margins(left=0.3 + 0.062 * longest, across=0.15)
    figure, axes = theme.panels(
        0.75 + row * len(names), 1, 2, margins, widths=(1.4, 1), sharey=True
    )
    left, right = axes[0]
    _bars(left, names, chi2, colours)
    if np.isfinite(d.noise_floor):
        right.axvline(d.noise_floor * 100, color=theme.NOISE, lw=1.0, ls="--")
    for at, value, colour in zip(y, errors, colours, strict=True):
        if np.isfinite(value):
            right.plot(value * 100, at, "o", color=colour)
    _noise(right, d.noise_floor * 100)
    theme.decades(right.xaxis)
    right.set_xlabel("validation error (%)")
    return figure


@theme.styled
def places(found: Whereabouts) -> Figure:
    """χ² per degree of freedom that a free shape, one known effect or, where no law takes it up,
    runs that each deviate leave at each place."""
    deviating = found.likely if found.from_run_to_run else ()
    own = {p: f"{PLACES[p]}, run by run" if p in deviating else PLACES[p] for p in found.left}
    names = ["declared model", *own.values()]
    chi2 = np.array([found.before, *found.left.values()])
    likely = [theme.AFTER if p in found.likely else theme.NOISE for p in found.left]
    margins = theme.Margins(left=0.3 + 0.062 * max(len(n) for n in names))
    figure, axes = theme.panels(0.75 + 0.24 * len(names), 1, 1, margins)
    _bars(axes[0, 0], names, chi2, [theme.BEFORE, *likely])
    return figure


def _bars(ax: Axes, names: Sequence[str], chi2: FloatArray, colours: Sequence[str]) -> None:
    """Bars of χ² per degree of freedom, first on top, each with its value."""
    y = np.arange(len(names))
    finite = chi2[np.isfinite(chi2) & (chi2 > 0)]
    start = min(0.3, float(finite.min()) / 2) if finite.size else 0.3
    length = np.where(np.isfinite(chi2), np.maximum(chi2, start) - start, 0.0)
    ax.barh(y, length, left=start, color=colours, height=0.62)
    for at, value in zip(y, chi2, strict=True):
        if np.isfinite(value):
            ax.annotate(scientific(float(value)), (max(value, start), at), xytext=(3, 0),
                        textcoords="offset points", va="center", fontsize=7,
                        bbox={"fc": theme.PAPER, "ec": "none", "pad": 0.6})  # fmt: skip
        else:
            ax.annotate("not converged", (start, at), xytext=(3, 0),
                        textcoords="offset points", va="center", fontsize=7)  # fmt: skip
    ax.axvline(1.0, color=theme.NOISE, lw=1.0, ls="--")
    _noise(ax, 1.0)
    theme.decades(ax.xaxis)
    ax.set_xlim(start, (float(finite.max()) if finite.size else 1.0) * 6)
    ax.set_yticks(y, names)
    ax.invert_yaxis()
    ax.set_xlabel("χ² per degree of freedom")


def _noise(ax: Axes, x: float) -> None:
    ax.set_xscale("log")
    ax.grid(axis="y", visible=False)
    ax.annotate("noise", (x, 1.0), xycoords=("data", "axes fraction"), xytext=(2, 1),
                textcoords="offset points", fontsize=7, color=theme.MUTED)  # fmt: skip


def _colour(c: Candidate, d: Diagnosis) -> str:
    claimed = sorted(e.effect for e in d.effects if e.effect != "interference")
    if claimed and sorted(c.effects) == claimed:
        return theme.AFTER
    return theme.GOOD if c.adequate and c.plausible else theme.NOISE
