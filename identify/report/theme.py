"""How figures look: one palette, one size of type, and SVG that follows the page's colours.

Figures are drawn with matplotlib's objects on an Agg canvas, never through pyplot, so that a
service can draw in any thread. For the page they become inline SVG: every colour of `INK` is
replaced by the style sheet's variable of the same name, so that one drawing is readable on light
and on dark ground and in print; identifiers get the figure's name in front, because a page holds
many. One colour a thing, in every figure: measured, declared model (before), with effects (after).
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from io import BytesIO, StringIO
from threading import RLock
from typing import Any, Literal, ParamSpec, TypeVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

P = ParamSpec("P")
T = TypeVar("T")

# name of the style sheet's variable -> colour on light ground; no two alike, since the SVG's
# colours are found again by their value
INK = {
    "ink": "#1b1f24",
    "muted": "#6a737d",
    "grid": "#dfe3e8",
    "paper": "#fffffe",
    "before": "#c4560f",
    "after": "#1f6fb5",
    "third": "#7d4fb3",
    "good": "#26804a",
    "noise": "#8f98a1",
}
DARK = {
    "ink": "#e6e9ec",
    "muted": "#9aa4ae",
    "grid": "#343a41",
    "paper": "#15181c",
    "before": "#f08a46",
    "after": "#62aef0",
    "third": "#b795e6",
    "good": "#5cc58a",
    "noise": "#7c8690",
}
MEASURED, BEFORE, AFTER = INK["ink"], INK["before"], INK["after"]
MUTED, GRID, THIRD, GOOD, NOISE = (INK[n] for n in ("muted", "grid", "third", "good", "noise"))
PAPER = INK["paper"]

WIDTH_IN = 7.2  # the text width of an A4 page with 14 mm margins

_LOCK = RLock()  # matplotlib's settings belong to the process
_SETTINGS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.titley": 1.0,  # fixed: searching for a free height costs a drawing
    "axes.titlelocation": "left",
    "axes.labelsize": 8,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MEASURED,
    "axes.titlecolor": MEASURED,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": MEASURED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": MEASURED,
    "ytick.labelcolor": MEASURED,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "lines.linewidth": 1.3,
    "lines.markersize": 4.5,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    "path.simplify": True,
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": True,
}


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """A drawing function under this module's settings."""

    @wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> T:
        with _LOCK, mpl.rc_context(_SETTINGS):
            return draw(*args, **kwargs)

    return inside


@dataclass(frozen=True)
class Margins:
    """Space around and between panels, in inches.

    Fixed instead of measured: automatic layout draws every figure three times, which costs
    seconds a report.
    """

    left: float = 0.62
    right: float = 0.08
    top: float = 0.26
    bottom: float = 0.44
    across: float = 0.55
    down: float = 0.6


def panels(
    height_in: float,
    rows: int = 1,
    columns: int = 1,
    margins: Margins = Margins(),
    widths: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
    sharex: bool | Literal["none", "all", "row", "col"] = False,
    sharey: bool | Literal["none", "all", "row", "col"] = False,
) -> tuple[Figure, Any]:
    """A figure of `height_in` with its axes, an object array (rows, columns)."""
    m = margins
    figure = Figure(figsize=(WIDTH_IN, height_in))
    FigureCanvasAgg(figure)
    wide = (WIDTH_IN - m.left - m.right - (columns - 1) * m.across) / columns
    high = (height_in - m.top - m.bottom - (rows - 1) * m.down) / rows
    figure.subplots_adjust(
        left=m.left / WIDTH_IN,
        right=1 - m.right / WIDTH_IN,
        bottom=m.bottom / height_in,
        top=1 - m.top / height_in,
        wspace=m.across / wide,
        hspace=m.down / high,
    )
    axes = figure.subplots(
        rows, columns, squeeze=False, width_ratios=widths, height_ratios=heights,
        sharex=sharex, sharey=sharey,
    )  # fmt: skip
    return figure, axes


def name_axes(ax: Axes, x: str, y: str, title: str = "") -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    if title:
        ax.set_title(title)


class _Few(LogLocator):
    """Decades; parts of them where the axis spans little, as many as there is room for."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        span = vmax / vmin
        parts = (1, 1.5, 2, 3, 5, 7) if span < 5 else (1, 2, 5) if span < 30 else (1,)
        self.set_params(subs=parts)
        return super().tick_values(vmin, vmax)


def decades(axis: Axis) -> None:
    """Plain labels on a logarithmic axis: 0.01, 1, 100, 10⁻⁵; few, and no lesser ticks."""
    axis.set_major_locator(_Few(base=10, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda x, _: power_of_ten(x)))
    axis.set_minor_locator(NullLocator())


def power_of_ten(x: float) -> str:
    if not x > 0:
        return ""
    exponent = math.floor(math.log10(x) + 1e-9)
    if -3 <= exponent <= 4:
        return f"{x:.6g}"
    mantissa = round(x / 10.0**exponent)
    power = f"10{str(exponent).translate(_RAISED)}"
    return power if mantissa == 1 else f"{mantissa}·{power}"


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def legend_above(figure: Figure, ax: Axes, more: Axes | None = None) -> None:
    """One legend for the whole figure, in its top margin."""
    handles, labels = ax.get_legend_handles_labels()
    if more is not None:
        h, lab = more.get_legend_handles_labels()
        handles, labels = handles + h, labels + lab
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(
        unique.values(), unique.keys(), loc="upper center", ncols=len(unique), borderaxespad=0.1
    )


def to_svg(figure: Figure, name: str, themed: bool = True) -> str:
    """The figure as one ``<svg>`` element.

    Parameters
    ----------
    name : goes in front of every identifier; letters, digits and hyphens.
    themed : colours by the page's style sheet (``var(--ink)`` …); False keeps the light palette,
        for a file of its own.
    """
    out = StringIO()
    with _LOCK, mpl.rc_context({**_SETTINGS, "svg.hashsalt": name}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r' id="(?:figure|axes|patch|text|line2d|legend)_?[^"]*"', "", text)
    text = re.sub(r' id="', f' id="{name}-', text)
    text = re.sub(r'(href="|url\()#', rf"\1#{name}-", text)
    if themed:
        for key, colour in INK.items():
            text = re.sub(colour, f"var(--{key})", text, flags=re.IGNORECASE)
        text = text.replace("#000000", "var(--ink)")
    return text


def to_file(figure: Figure, path: str, kind: Literal["png", "svg", "pdf"] = "png") -> None:
    """The figure as a file of its own, on white."""
    with _LOCK, mpl.rc_context(_SETTINGS):
        figure.savefig(path, format=kind, dpi=160, facecolor=PAPER)


def to_png(figure: Figure) -> bytes:
    """The figure as PNG on white."""
    out = BytesIO()
    with _LOCK, mpl.rc_context(_SETTINGS):
        figure.savefig(out, format="png", dpi=160, facecolor=PAPER)
    return out.getvalue()
