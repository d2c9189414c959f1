"""Lock-in: what was measured in the plane of frequency and drive, and the model's own boundary.

The boundary was never fitted: below it the fitted equations lose the entrained state. Every
entrained condition should lie above it, every one that failed to lock below.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from identify.lockin import LockIn
from identify.record import Campaign
from identify.report import theme
from identify.report.response_figures import models
from identify.results import Assessment, QualityFlag


@theme.styled
def lock_in_boundary(
    before: Assessment,
    after: Assessment | None,
    campaign: Campaign | None = None,
    quality: Sequence[QualityFlag] = (),
) -> Figure:
    """Forcing levels, entrained or not, and each model's boundary with its 95 % band."""
    figure, axes = theme.panels(3.1, margins=theme.Margins(top=0.45))
    ax = axes[0, 0]
    for label, a, colour in models(before, after):
        points = curve(a)
        if not points:
            continue
        f, low, middle, high = np.array(points).T
        ax.plot(f, middle, color=colour, lw=1.1, marker=".", ms=4, label=f"boundary, {label}")
        ax.fill_between(f, low, high, color=colour, alpha=0.25, lw=0)
    shown = [c for c in before.comparisons if c.kind == "forced"]
    held = [c for c in shown if c.role == "validation"]
    for rows, marker, text in (
        ([c for c in shown if c.role != "validation"], "o", "entrained"),
        (held, "s", "entrained, validation"),
    ):
        if rows:
            ax.plot([c.frequency_hz for c in rows], [c.amplitude_v or 0.0 for c in rows], marker,
                    color=theme.MEASURED, ms=4, label=text, lw=0)  # fmt: skip
    lost = {q.run for q in quality if q.flag == "not_entrained"}
    failed = [] if campaign is None else [r for r in campaign.runs if r.name in lost]
    if failed:
        ax.plot([r.frequency_hz or np.nan for r in failed], [r.amplitude_v or 0.0 for r in failed],
                "o", mfc="none", mec=theme.NOISE, ms=4.5, label="not entrained", lw=0)  # fmt: skip
    cycle = before.measured_cycle or before.model_cycle
    if cycle is not None:
        ax.axvline(cycle.frequency_hz, color=theme.NOISE, lw=0.9, ls="--", zorder=0)
    ax.set_ylim(bottom=0)
    theme.name_axes(ax, "forcing frequency (Hz)", "drive amplitude (V)")
    theme.legend_above(figure, ax)
    return figure


def curve(a: Assessment) -> list[tuple[float, float, float, float]]:
    """(frequency, lower, boundary, upper) by frequency, through 0 V at the model's own cycle.

    Of several runs at one frequency the one nearest its boundary counts: in the others the
    drive's harmonics, which scale with it here, were further from what they would be there.
    """
    best: dict[float, LockIn] = {}
    for row in a.lock_in:
        key = round(row.frequency_hz, 3)
        if key not in best or row.measured_v < best[key].measured_v:
            best[key] = row
    points = [(f, row.interval_v[0], row.boundary_v, row.interval_v[1]) for f, row in best.items()]
    if points and a.model_cycle is not None:
        points.append((a.model_cycle.frequency_hz, 0.0, 0.0, 0.0))
    return sorted(points)
