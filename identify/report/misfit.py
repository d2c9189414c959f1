"""Where the residual sits: by harmonic and condition, against frequency, amplitude, run order.

All in noise units: |measured − predicted| over the standard error of that coefficient. Near one,
nothing is left but noise. A pattern tells where to look: all runs alike at one harmonic (sensor),
growth with the drive (actuator), with run order (drift), odd or even harmonics alone
(nonlinearity).
"""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm, to_rgb
from matplotlib.figure import Figure

from identify.report import theme
from identify.report.compared import ordered, run_label
from identify.results import Assessment, Comparison

FloatArray = npt.NDArray[np.float64]
HUE = "#8c2f6b"  # of the heat map: deep enough for white figures, transparent where quiet


def in_noise_units(a: Assessment) -> tuple[list[Comparison], FloatArray]:
    """Runs and their |normalised residual|, (runs, K), NaN where a run has fewer harmonics."""
    rows = ordered(a)
    K = max((c.measured.size for c in rows), default=0)
    out = np.full((len(rows), K), np.nan)
    for line, c in zip(out, rows, strict=True):
        if np.isfinite(c.predicted).all():
            line[: c.measured.size] = np.abs(c.normalised)
    return rows, out


@theme.styled
def heat_map(before: Assessment, after: Assessment | None) -> Figure:
    """Residual by run and harmonic, before and after, on one scale."""
    shown = [("Declared model", before)]
    if after is not None:
        shown.append(("With effects", after))
    maps = [in_noise_units(a) for _, a in shown]
    rows = len(maps[0][0])
    margins = theme.Margins(left=1.05, right=0.95, across=0.12)
    figure, grid = theme.panels(0.75 + 0.24 * rows, 1, len(shown), margins, sharey=True)
    axes = grid[0]
    top = max(10.0, max(float(np.nanmax(m)) for _, m in maps))
    norm = LogNorm(1.0, top)
    rgb = to_rgb(HUE)
    ramp = LinearSegmentedColormap.from_list("quiet", [(*rgb, 0.03), (*rgb, 0.95)])
    image = None
    for ax, (title, _), (runs, sizes) in zip(axes, shown, maps, strict=True):
        image = ax.pcolormesh(sizes, cmap=ramp, norm=norm, edgecolors="none")
        image.set_snap(True)
        for (i, j), size in np.ndenumerate(sizes):
            if np.isfinite(size):
                share = float(np.clip(norm(max(size, 1.0)), 0, 1))
                # white on a deep cell in every theme: the cell stays deep on dark ground too
                colour = "white" if share > 0.55 else theme.MEASURED
                ax.text(j + 0.5, i + 0.5, _short(float(size)), ha="center", va="center",
                        color=colour, fontsize=7)  # fmt: skip
        ax.set_xticks(np.arange(sizes.shape[1]) + 0.5, np.arange(1, sizes.shape[1] + 1))
        labels = [run_label(c) + (" *" if c.role == "validation" else "") for c in runs]
        ax.set_yticks(np.arange(len(runs)) + 0.5, labels)
        ax.grid(visible=False)
        ax.tick_params(length=0)
        for side in ("left", "bottom"):
            ax.spines[side].set_visible(False)
        theme.name_axes(ax, "harmonic", "", title)
    assert image is not None
    axes[0].invert_yaxis()  # all share it
    edge = axes[-1].get_position()
    place = figure.add_axes((edge.x1 + 0.02, edge.y0, 0.018, edge.height))
    bar = figure.colorbar(image, cax=place, label="|residual| (noise units)")
    theme.decades(bar.ax.yaxis)
    bar.outline.set_visible(False)
    return figure


def _short(x: float) -> str:
    return f"{x:.1f}" if x < 9.95 else f"{x:.0f}" if x < 1e4 else f"{x:.0e}".replace("e+0", "e")


@theme.styled
def residual_trends(before: Assessment, after: Assessment | None) -> Figure:
    """Residual of each run against frequency, amplitude and run order; odd and even harmonics."""
    margins = theme.Margins(top=0.3, across=0.2)
    figure, axes = theme.panels(4.5, 2, 2, margins, sharey=True)
    models = [("declared model", before, theme.BEFORE)]
    if after is not None:
        models.append(("with effects", after, theme.AFTER))
    panels: tuple[tuple[Axes, str, Callable[[Comparison], float | None]], ...] = (
        (axes[0, 0], "frequency (Hz)", lambda c: c.frequency_hz),
        (axes[0, 1], "drive amplitude (V)", lambda c: 0.0 if c.kind == "free" else c.amplitude_v),
        (axes[1, 0], "time since the campaign's start (min)", lambda c: c.started_s / 60),
    )
    for label, a, colour in models:
        runs, sizes = in_noise_units(a)
        seen = np.count_nonzero(np.isfinite(sizes), axis=1)
        # where the model has no state for a run, there is nothing to draw
        power = np.where(seen > 0, np.nansum(sizes**2, axis=1) / np.maximum(seen, 1), np.nan)
        rms = np.sqrt(power)
        for ax, _, position in panels:
            _scatter(ax, [position(c) for c in runs], rms, runs, colour, label)
        _by_parity(axes[1, 1], sizes, colour, label)
    for ax, name, _ in panels:
        theme.name_axes(ax, name, "")
    theme.name_axes(axes[1, 1], "harmonic", "")
    for ax in axes.flat:
        ax.set_yscale("log")
        theme.decades(ax.yaxis)
        ax.axhline(1.0, color=theme.NOISE, lw=1.0, ls="--", zorder=0, label="noise alone")
    for ax in axes[:, 0]:
        ax.set_ylabel("r.m.s. residual (noise units)")
    low, high = axes[0, 0].get_ylim()
    axes[0, 0].set_ylim(min(low, 0.4), high)
    theme.legend_above(figure, axes[0, 0])
    return figure


def _scatter(
    ax: Axes,
    x: Sequence[float | None],
    y: FloatArray,
    runs: Sequence[Comparison],
    colour: str,
    label: str,
) -> None:
    for role, fill in (("fit", colour), ("validation", "none")):
        at = [
            (float(u), float(v))
            for u, v, c in zip(x, y, runs, strict=True)
            if c.role == role and u is not None
        ]
        if at:
            name = label + (", validation" if role == "validation" else "")
            across, up = zip(*at, strict=True)
            ax.plot(across, up, "o", label=name, mfc=fill, mec=colour)


def _by_parity(ax: Axes, sizes: FloatArray, colour: str, label: str) -> None:
    k = np.arange(1, sizes.shape[1] + 1)
    rms = np.sqrt(np.nanmean(sizes**2, axis=0))
    ax.plot(k, rms, "-", color=colour, lw=0.8)
    for parity, marker in ((1, "o"), (0, "s")):
        mine = k % 2 == parity
        ax.plot(k[mine], rms[mine], marker, color=colour, mfc=colour if parity else "none")
    ax.set_xticks(k)
    ax.set_title("by harmonic: ● odd, □ even")
