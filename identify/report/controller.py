"""What the entrainment controller did: suppression of the limit cycle, and the lock-in tongue.

A step is one drive amplitude at one frequency: a mapping with `frequency_hz`, `amplitude_v`,
`suppression_db` (how far the limit-cycle line lies below its free level; None while unknown) and
`entrained`. The tongue's boundary runs between the largest amplitude that did not entrain and the
smallest that did.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from identify.report import theme

Steps = Sequence[Mapping[str, Any]]
REQUIRED_DB = 20.0  # the campaign's requirement on the limit-cycle line
LABEL_PT = (26.0, 8.0)  # a label's room, points


def boundary(steps: Steps) -> list[tuple[float, float, float]]:
    """(frequency, largest amplitude not entrained or 0, smallest entrained) per frequency."""
    rows = []
    for hz in sorted({float(s["frequency_hz"]) for s in steps}):
        here = [s for s in steps if float(s["frequency_hz"]) == hz]
        locked = [float(s["amplitude_v"]) for s in here if s["entrained"]]
        if locked:
            smallest = min(locked)
            free = [float(s["amplitude_v"]) for s in here if not s["entrained"]]
            rows.append((hz, max((a for a in free if a < smallest), default=0.0), smallest))
    return rows


@theme.styled
def controller_steps(steps: Steps, free_hz: float | None = None) -> Figure:
    """Suppression against drive amplitude, and all steps in the plane of the tongue."""
    figure, axes = theme.panels(3.0, 1, 2)
    left, right = axes[0]
    ends: list[tuple[float, float, float]] = []  # frequency, and where its last step stands
    for hz in sorted({float(s["frequency_hz"]) for s in steps}):
        here = [s for s in steps if float(s["frequency_hz"]) == hz]
        known = [s for s in here if s.get("suppression_db") is not None]
        known.sort(key=lambda s: float(s["amplitude_v"]))
        volts = [float(s["amplitude_v"]) for s in known]
        level = [float(s["suppression_db"]) for s in known]
        (line,) = left.plot(volts, level, color=theme.NOISE, lw=0.9, zorder=1)
        for v, db, s in zip(volts, level, known, strict=True):
            _mark(left, v, db, bool(s["entrained"]))
        if volts:
            ends.append((hz, volts[-1], level[-1]))
        line.set_label("")
    left.axhline(REQUIRED_DB, color=theme.BEFORE, lw=0.9, ls="--")
    left.annotate(
        f"required: {REQUIRED_DB:g} dB", (1.0, REQUIRED_DB), xycoords=("axes fraction", "data"),
        xytext=(0, 3), textcoords="offset points", ha="right", fontsize=7, color=theme.BEFORE,
    )  # fmt: skip
    for s in steps:
        _mark(right, float(s["frequency_hz"]), float(s["amplitude_v"]), bool(s["entrained"]))
    edge = boundary(steps)
    if edge:
        at, low, high = np.array(edge).T
        right.fill_between(at, low, high, color=theme.AFTER, alpha=0.15, lw=0)
        right.plot(at, high, color=theme.AFTER, lw=1.0)
    if free_hz is not None:
        right.axvline(free_hz, color=theme.BEFORE, lw=0.9, ls="--", zorder=0)
        right.annotate(
            "limit cycle", (free_hz, 0.98), xycoords=("data", "axes fraction"), rotation=90,
            ha="right", va="top", color=theme.BEFORE, fontsize=7,
        )  # fmt: skip
    right.plot([], [], "o", color=theme.AFTER, label="entrained")
    right.plot([], [], "o", mfc="none", mec=theme.NOISE, label="not entrained")
    right.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, borderaxespad=0.1)
    right.set_ylim(bottom=0)
    left.set_xlim(left=0)
    _label(left, ends)
    theme.name_axes(left, "drive amplitude (V)", "limit cycle below its free level (dB)")
    left.set_title("Steps, by forcing frequency (Hz)")
    theme.name_axes(right, "forcing frequency (Hz)", "drive amplitude (V)")
    return figure


def _label(ax: Any, ends: Sequence[tuple[float, float, float]]) -> None:
    """Frequencies beside the points they belong to, as far as there is room: the tongue beside
    them holds all."""
    at = np.array([ax.transData.transform(end[1:]) for end in ends]) * 72 / ax.figure.dpi
    placed = np.empty((0, 2))
    for i, (hz, volts, level) in enumerate(ends):
        points, labels = np.delete(at, i, axis=0) - at[i], placed - at[i]
        high = np.abs(points[:, 1]) < LABEL_PT[1]
        covers = high & (points[:, 0] > 0) & (points[:, 0] < LABEL_PT[0])
        if covers.any() or (np.abs(labels) < LABEL_PT).all(axis=1).any():
            continue
        placed = np.vstack([placed, at[i]])
        ax.annotate(
            f"{hz:g}", (volts, level), xytext=(4, 0), textcoords="offset points",
            fontsize=6.5, color=theme.MUTED, va="center",
        )  # fmt: skip


def _mark(ax: Any, x: float, y: float, entrained: bool) -> None:
    style = {"color": theme.AFTER} if entrained else {"mfc": "none", "mec": theme.NOISE}
    ax.plot(x, y, "o", ms=4, zorder=3, **style)
