"""The report of a broadband record: one self-contained HTML file.

The reader's questions in order: what was found, how large the error was and is, where in frequency
and time the residual sits and whether it is noise, which terms were tried and what they are worth,
and what to measure next.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.signal import welch

from identify.broadband import BroadbandDiagnosis
from identify.broadband.diagnose import Stage
from identify.broadband.model import MONOMIALS
from identify.broadband.quality import spoilt
from identify.broadband.rest import UNPREDICTED
from identify.parameters import Estimate
from identify.report import theme
from identify.report.page import drawing, page, paragraphs, section, table, tag, text
from identify.report.words import VERDICTS, estimate, joined, p_is, percent, scientific

FloatArray = npt.NDArray[np.float64]

SEGMENT = 2048  # samples of a spectrum's windows, at most
PERIODS = 30  # of the resonance, shown in time


def write_broadband_html(path: Path | str, found: BroadbandDiagnosis) -> Path:
    """Write the report and return its path."""
    target = Path(path)
    target.write_text(broadband_html(found), encoding="utf-8")
    return target


def broadband_html(found: BroadbandDiagnosis) -> str:
    """The report as text."""
    return page(
        f"entrain: {found.title}",
        _verdict(found),
        section("Recording", _quality(found)),
        section("Error, term by term", _stages(found), _errors_drawn(found)),
        section("Residual", _spectrum_drawn(found), _motion_drawn(found), _lines(found)),
        section("Terms left out again", _weighed(found)),
        section("Restoring force", _force_drawn(found)),
        section("Parameters", _parameters(found)),
        section("Next experiment", _next(found)),
    )


def headline(found: BroadbandDiagnosis) -> str:
    """The verdict in a line."""
    if found.verdict == "traced":
        return f"Traced: {joined(tuple(_named(found)))}"
    if found.verdict == "unexplained" and found.claims:
        return "Unexplained rest: beside what was found, more than noise remains"
    return VERDICTS[found.verdict]


def evidence(found: BroadbandDiagnosis) -> list[str]:
    """What the verdict rests on, a sentence each."""
    first, last, unit = found.stages[0], found.final, found.unit
    lines = [
        f"The declared model ({found.declared}) leaves {_size(first.fit_rms, unit)} RMS of the "
        f"fitted samples ({percent(first.fit_error)}) and {_size(first.test_rms, unit)} of the "
        f"test ({percent(first.validation_error)})."
    ]
    if found.claims:
        lines.append(
            f"With {joined(tuple(_named(found)))} it leaves {_size(last.fit_rms, unit)} and "
            f"{_size(last.test_rms, unit)} ({percent(last.validation_error)})."
        )
    rest = found.remainder
    if rest.noise_rms is None:
        assert rest.follows is not None
        lines.append(
            f"The noise is unknown. Of what is left, {percent(rest.follows)} of the power follows "
            f"the motion ({p_is(rest.p_value or 0.0)})."
        )
    elif rest.noise_source == UNPREDICTED and not rest.significant:
        lines.append(
            "The noise is unknown: what is left does not follow the motion, and counts as noise."
        )
    else:
        assert rest.chi2_per_dof is not None
        lines.append(
            f"The noise is {_size(rest.noise_rms, unit)} RMS ({rest.noise_source}). What is left "
            f"has {scientific(rest.chi2_per_dof)} times its power ({p_is(rest.p_value or 0.0)})"
            f"{_most(found)}."
        )
    if spoilt(found.quality):
        lines.append("The recording is spoilt (see its flags): nothing is claimed from it.")
    tried = [w.score.candidate.kind for w in found.weighed if w not in found.claims]
    if tried:
        lines.append(f"Tried and not claimed: {joined(tuple(tried))}.")
    rivals = [r for w in found.claims for r in w.rivals]
    if rivals:
        lines.append(f"As well does: {joined(tuple(dict.fromkeys(rivals)))}.")
    return lines


def _most(found: BroadbandDiagnosis) -> str:
    band = found.remainder.worst_band_hz
    if band is None or not found.remainder.significant:
        return ""
    return f", most between {band[0]:.3g} and {band[1]:.3g} Hz"


def _named(found: BroadbandDiagnosis) -> list[str]:
    candidates = [w.score.candidate for w in found.claims]
    return [f"{c.effect} ({c.kind}; {c.location})" for c in candidates]


def _size(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}"


def _verdict(found: BroadbandDiagnosis) -> str:
    over = tag("p", text(f"entrain · broadband record «{found.title}»"), class_="over")
    body = tag("h1", text(headline(found))) + paragraphs(evidence(found))
    return over + tag("div", body, class_=f"verdict {found.verdict}")


def _name(found: BroadbandDiagnosis, stage: Stage) -> str:
    return found.declared if stage.added is None else f"+ {stage.added.candidate.kind}"


def _stages(found: BroadbandDiagnosis) -> str:
    unit, sets = found.unit, list(found.stages[0].lines_rms)
    head = ["model", "parameters", f"fit ({unit})", f"test ({unit})"]
    rows = [
        [_name(found, s), s.fit.theta.size, f"{s.fit_rms:.4g}", f"{s.test_rms:.4g}"]
        for s in found.stages
    ]
    rows.append(
        ["claimed terms alone", found.final.fit.theta.size, f"{found.final.fit_rms:.4g}",
         f"{found.final.test_rms:.4g}"]
    )  # fmt: skip
    head += [name.replace("_", " ") for name in sets]
    for row, s in zip(rows, [*found.stages, found.final], strict=True):
        row += [f"{s.lines_rms[name]:.3g}" for name in sets]
    note = "Simulation error, RMS. The test samples are only predicted."
    if sets:
        note += f" The last columns split the fitted samples' error by lines ({unit})."
    return table(head, rows, note, numeric=range(1, len(head)))


def _quality(found: BroadbandDiagnosis) -> str:
    rows = [[q.flag.replace("_", " "), q.severity, q.detail] for q in found.quality]
    return table(["flag", "consequence", "detail"], rows) if rows else ""


WEIGHED_HEAD = ("effect", "location", "kind", "without it", "claimed", "does as well")


def weighed_rows(found: BroadbandDiagnosis) -> list[list[str]]:
    """Each term that was added, and what it is worth, under `WEIGHED_HEAD`."""
    return [
        [
            w.score.candidate.effect,
            w.score.candidate.location,
            w.score.candidate.kind,
            "all of it" if np.isinf(w.without) else f"{w.without:.3g} times",
            "yes" if w in found.claims else "no",
            ", ".join(w.rivals),
        ]
        for w in found.weighed
    ]


def _weighed(found: BroadbandDiagnosis) -> str:
    if not found.weighed:
        return ""
    note = (
        "What exceeds the noise without the term, as a multiple of what does with it: a term is "
        "claimed where that is more than three and no candidate of another name does as well. "
        "Where the noise is unknown, all that is left counts."
    )
    return table(WEIGHED_HEAD, weighed_rows(found), note, numeric=(3,))


def _parameters(found: BroadbandDiagnosis) -> str:
    before, after = found.stages[0].parameters, found.final.parameters

    def shown(values: dict[str, dict[str, float | str]], name: str) -> str:
        if name not in values:
            return ""
        p = values[name]
        return estimate(Estimate(float(p["value"]), float(p["stderr"]), str(p["unit"])))

    rows = [[n, shown(before, n), shown(after, n)] for n in after]
    return table(["parameter", "declared", "with what is claimed"], rows, numeric=(1, 2))


def _next(found: BroadbandDiagnosis) -> str:
    following = found.to_json()["next_experiment"]
    if following is None:
        return ""
    return paragraphs([f"{following['excitation']}: {following['why']}."])


def _errors_drawn(found: BroadbandDiagnosis) -> str:
    caption = (
        "Simulation error of each model in the order in which terms were added; filled: claimed "
        "or declared."
    )
    return drawing(_errors_figure(found), "broadband-errors", caption)


@theme.styled
def _errors_figure(found: BroadbandDiagnosis) -> Figure:
    figure, axes = theme.panels(0.75 + 0.24 * len(found.stages), margins=theme.Margins(left=1.9))
    ax: Axes = axes[0, 0]
    claimed = [w.score for w in found.claims]
    for row, s in enumerate(found.stages):
        full = "full" if s.added is None or s.added in claimed else "none"
        for value, colour in ((s.fit_rms, theme.BEFORE), (s.test_rms, theme.AFTER)):
            ax.plot(value, row, "o", color=colour, fillstyle=full)
    ax.plot([], [], "o", color=theme.BEFORE, label="fitted samples")
    ax.plot([], [], "o", color=theme.AFTER, label="test samples")
    if found.noise is not None:
        ax.axvline(found.noise.rms, color=theme.NOISE, ls="--", label="noise")
    ax.set_xscale("log")
    theme.decades(ax.xaxis)
    ax.set_yticks(range(len(found.stages)), [_name(found, s) for s in found.stages])
    ax.set_ylim(len(found.stages) - 0.5, -0.5)
    theme.name_axes(ax, f"RMS simulation error ({found.unit})", "")
    theme.legend_above(figure, ax)
    return figure


def _spectrum_drawn(found: BroadbandDiagnosis) -> str:
    caption = (
        "Spectral density of the response and of what the models leave of it, over the fitted "
        "samples. A residual at the noise has nothing left to explain."
    )
    return drawing(_spectrum_figure(found), "broadband-spectrum", caption)


@theme.styled
def _spectrum_figure(found: BroadbandDiagnosis) -> Figure:
    figure, axes = theme.panels(2.7)
    ax: Axes = axes[0, 0]
    y = found.record.y[found.estimation]
    lines = [
        ("measured", y, theme.MEASURED),
        (
            "left by the declared model",
            found.stages[0].fit.residual[found.estimation],
            theme.BEFORE,
        ),
    ]
    if found.claims:
        left = found.final.fit.residual[found.estimation]
        lines.append(("left with what is claimed", left, theme.AFTER))
    if found.noise is not None:
        lines.append(("noise", found.noise.samples, theme.NOISE))
    for label, x, colour in lines:
        segment = min(SEGMENT, int(2 ** np.floor(np.log2(x.size / 4))))
        f, power = welch(x, found.record.sample_rate_hz, nperseg=segment, detrend="constant")
        ax.semilogy(f[1:], np.sqrt(power[1:]), color=colour, lw=0.9, label=label)
    theme.decades(ax.yaxis)
    ax.set_xlim(0, found.record.sample_rate_hz / 2)
    theme.name_axes(ax, "frequency (Hz)", f"{found.unit}/√Hz")
    theme.legend_above(figure, ax)
    return figure


def _motion_drawn(found: BroadbandDiagnosis) -> str:
    caption = (
        "The test's loudest moment: the response, and what the models leave of it. None of these "
        "samples was fitted."
    )
    return drawing(_motion_figure(found), "broadband-motion", caption)


@theme.styled
def _motion_figure(found: BroadbandDiagnosis) -> Figure:
    figure, axes = theme.panels(3.0, 2, 1, theme.Margins(down=0.2), sharex=True)
    top, bottom = axes[0, 0], axes[1, 0]
    rate = found.record.sample_rate_hz
    hz = float(found.final.parameters["mode1.frequency_hz"]["value"])
    count = min(int(PERIODS * rate / hz), found.test.stop - found.test.start)
    y = found.record.y[found.test]
    at = int(np.argmax(np.convolve(y**2, np.ones(count), mode="valid"))) + found.test.start
    shown = slice(at, at + count)
    t = np.arange(shown.start, shown.stop) / rate
    top.plot(t, found.record.y[shown], color=theme.MEASURED, lw=0.9, label="measured")
    for label, stage, colour in (
        ("left by the declared model", found.stages[0], theme.BEFORE),
        ("left with what is claimed", found.final, theme.AFTER),
    ):
        if stage is found.final and not found.claims:
            continue
        bottom.plot(t, stage.fit.residual[shown], color=colour, lw=0.9, label=label)
    theme.name_axes(top, "", f"response ({found.unit})")
    theme.name_axes(bottom, "time (s)", f"residual ({found.unit})")
    theme.legend_above(figure, top, bottom)
    return figure


def _lines(found: BroadbandDiagnosis) -> str:
    if not found.stages[0].lines_rms:
        return ""
    return paragraphs(
        [
            "By lines (table above): even lines carry even-order distortion and noise alone, odd "
            "excited lines errors of the linear path and odd-order distortion besides."
        ]
    )


def _force_drawn(found: BroadbandDiagnosis) -> str:
    bent = [n for n in found.final.fit.structure.names if _powers(n)]
    if not bent:
        return ""
    caption = (
        "The restoring force over the measured range, in units of the linear spring's: its bend is "
        f"what {joined(tuple(bent))} add."
    )
    return drawing(_force_figure(found), "broadband-force", caption)


def _powers(name: str) -> int:
    """The power of y in a term of the restoring force alone, 0 for any other and for the linear."""
    a, b, c = MONOMIALS.get(name, (0, 0, 0))
    return a if a > 1 and b == c == 0 else 0


@theme.styled
def _force_figure(found: BroadbandDiagnosis) -> Figure:
    figure, axes = theme.panels(2.4)
    ax: Axes = axes[0, 0]
    structure, scale = found.final.fit.structure, found.record.scale
    value = dict(zip(structure.names, found.final.fit.theta, strict=True))
    reach = float(np.abs(found.record.y).max())
    y = np.linspace(-reach, reach, 201)
    force = y.copy()
    for name in structure.names:
        if power := _powers(name):
            force += value[name] / value["stiffness"] * scale.output * (y / scale.output) ** power
    ax.plot(y, y, color=theme.BEFORE, ls="--", label="linear")
    ax.plot(y, force, color=theme.AFTER, label="found")
    theme.name_axes(ax, f"response ({found.unit})", f"restoring force ({found.unit})")
    theme.legend_above(figure, ax)
    return figure
