"""The report's tables and sentences, section by section. A section without material is empty."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from identify.parameters import Estimate
from identify.record import Campaign
from identify.report import words
from identify.report.equations import equations
from identify.report.gallery import Result, assessments
from identify.report.page import paragraphs, table, tag, text
from identify.report.words import percent, probability, scientific, with_error
from identify.results import Assessment, Diagnosis, Identification, LimitCycle
from identify.trace import ALPHA

INADEQUATE = 2.0  # χ²/dof above which formal standard errors are called too small


def verdict(result: Result) -> str:
    found = words.heading(result)
    body = tag("h1", text(found.headline)) + paragraphs(found.evidence)
    over = tag("p", text(f"entrain · campaign «{result.campaign}»"), class_="over")
    return over + tag("div", body, class_=f"verdict {found.verdict}")


def columns(result: Result) -> list[tuple[str, Assessment]]:
    """The assessments side by side, with their headings."""
    before, after = assessments(result)
    if after is None:
        return [("declared model", before)]
    claimed = not isinstance(result, Diagnosis) or result.verdict != "unexplained"
    return [("before", before), ("after" if claimed else "best, not claimed", after)]


def error_rows(result: Result) -> list[list[str]]:
    """«error before / after, fit and validation, noise floor», one row a quantity."""
    shown = [a for _, a in columns(result)]
    crossed = " (cross-validated)" if shown[0].cross_validated else ""
    ratio = [a.validation_error / a.noise_floor if a.noise_floor > 0 else math.nan for a in shown]
    rows = [
        ["fit error", *(percent(a.fit_error) for a in shown)],
        [f"validation error{crossed}", *(percent(a.validation_error) for a in shown)],
        ["noise floor", *(percent(a.noise_floor) for a in shown)],
        ["noise and parameters' uncertainty", *(percent(a.expected_error) for a in shown)],
        ["validation error / noise floor", *(scientific(r) for r in ratio)],
        ["χ² per degree of freedom", *(scientific(a.chi2_per_dof) for a in shown)],
        ["p of that χ²", *(probability(a.fit_p) for a in shown)],
        ["degrees of freedom", *(str(a.dof) for a in shown)],
        ["parameters", *(str(len(a.structure.parameters)) for a in shown)],
        ["fit", *("converged" if a.fit.converged else "not converged" for a in shown)],
    ]
    if isinstance(result, Diagnosis):
        blank = [""] * (len(shown) - 1)
        rows.append(["p of anything missing", probability(result.residual.p_value), *blank])
    return rows


def errors_title(result: Result) -> str:
    return "Error before and after" if len(columns(result)) > 1 else "Error"


def errors(result: Result) -> str:
    heads = [name for name, _ in columns(result)]
    numeric = range(1, len(heads) + 1)
    note = (
        "Relative errors of the velocity's Fourier coefficients, the model's own steady state "
        "against the measured one. Noise floor: the validation error that noise alone would cause; "
        "below it, what noise and the uncertainty of the fitted parameters would cause together. "
        f"p of anything missing: {words.LEAST_P}."
    )
    return table(["", *heads], error_rows(result), note, tuple(numeric))


CYCLE_HEAD = [
    "free limit cycle",
    "frequency (Hz)",
    "amplitude (m/s)",
    "harmonics 2, 3, … (dB)",
    "stability",
]


def cycle_rows(result: Result) -> list[list[str]]:
    """Free limit cycle, measured and modelled."""
    shown = columns(result)
    cycles = [("measured", next((a.measured_cycle for _, a in shown), None))]
    cycles += [(f"model, {name}", a.model_cycle) for name, a in shown]
    return [_cycle(name, c) for name, c in cycles if c is not None]


def _cycle(name: str, c: LimitCycle) -> list[str]:
    def value(x: float, stderr: float | None, digits: int) -> str:
        if stderr is None:
            return f"{x:.{digits}g}"
        return words.estimate(Estimate(x, stderr, "1"))

    stable = {True: "stable", False: "unstable", None: ""}[c.stable]
    spread = c.harmonics_stderr or (0.0,) * len(c.harmonics)
    pairs = zip(c.harmonics[1:], spread[1:], strict=True)  # the first is the fundamental
    content = ", ".join(_decibel(h, e) for h, e in pairs if h > 0)
    return [
        name,
        value(c.frequency_hz, c.frequency_stderr_hz, 7),
        value(c.amplitude, c.amplitude_stderr, 5),
        content,
        stable,
    ]


def _decibel(ratio: float, stderr: float) -> str:
    level = 20 * math.log10(ratio)
    if stderr > ratio / 2:
        return "≤ noise"
    if not stderr > 0:
        return f"{level:.1f}".replace("-", "−")
    return words.estimate(Estimate(level, 20 / math.log(10) * stderr / ratio, "1"))


LOCK_IN_HEAD = ["run", "frequency (Hz)", "drive (V)", "boundary (V)", "drive/boundary", "lost by"]
LOST_BY = {"fold": "phase slip", "torus": "free cycle"}


def lock_in_rows(a: Assessment) -> list[list[str]]:
    """The model's lock-in boundary at each forced condition."""
    return [
        [
            b.run,
            f"{b.frequency_hz:.6g}",
            f"{b.measured_v:.4g}",
            words.estimate(Estimate(b.boundary_v, b.stderr_v, "1")),
            f"{b.measured_v / b.boundary_v:.3g}",
            LOST_BY[b.kind],
        ]
        for b in a.lock_in
    ]


RESIDUAL_TEST_HEAD = ["residual test", "asks", "standard deviations", "p"]
RESIDUAL_TESTS = {
    "run_order": "whiteness over the order of recording",
    "harmonics": "independence of a run's harmonics",
    "amplitude": "independence of the drive's amplitude",
    "frequency": "independence of the forcing frequency",
    "outlier": "the largest single residual",
}


def residual_test_rows(a: Assessment) -> list[list[str]]:
    """Whiteness and independence of what the fit leaves."""
    return [
        [t.name.replace("_", " "), RESIDUAL_TESTS[t.name], f"{t.statistic:.2f}".replace("-", "−"),
         probability(t.p_value)]
        for t in a.residual_tests
    ]  # fmt: skip


PREDICTION_HEAD = ["validation run", "error (%)", "predicted s.e. (%)", "noise (%)", "ratio"]


def prediction_rows(a: Assessment) -> list[list[str]]:
    """Each validation run: |Ŷ − Y|, the prediction's own standard error and the noise, as shares
    of |Y| over all harmonics; the ratio of the first to both others together is about one."""
    rows = []
    for c in a.comparisons:
        if c.role != "validation" or c.predicted_stderr is None:
            continue
        size = float(sum(abs(c.measured) ** 2)) ** 0.5
        error, own, noise = (
            float(sum(abs(x) ** 2)) ** 0.5 / size
            for x in (c.predicted - c.measured, c.predicted_stderr, c.stderr)
        )
        if math.isfinite(error):
            shares = [scientific(100 * x) for x in (error, own, noise)]
            rows.append([c.run, *shares, scientific(error / math.hypot(own, noise), 2)])
    return rows


def validation(result: Result) -> str:
    """What the final model says of conditions that it was not fitted to."""
    before, after = assessments(result)
    final = before if after is None else after
    if not final.fit.converged:
        return ""
    out = ""
    if rows := lock_in_rows(final):
        note = (
            "The model's own lock-in boundary at the measured frequencies, with the standard error "
            "that its parameters give it. A drive/boundary below one at an entrained run "
            "contradicts the model."
        )
        out += table(LOCK_IN_HEAD, rows, note, (1, 2, 3, 4))
    if rows := prediction_rows(final):
        note = (
            "Ratio: the error over what noise and the parameters' uncertainty together let expect."
        )
        out += table(PREDICTION_HEAD, rows, note, (1, 2, 3, 4))
    if rows := residual_test_rows(final):
        note = (
            "Of the fitted runs' whitened residuals; each null distribution is simulated with the "
            "fitted parameters projected off, so that p < 0.05 happens by chance in 5 %."
        )
        out += table(RESIDUAL_TEST_HEAD, rows, note, (2, 3))
    return out


def interval_notes(result: Result) -> list[str]:
    """Parameters whose 95 % interval is not value ± 1.96 s.e."""
    if not isinstance(result, Identification):
        return []
    estimates = result.assessment.parameters
    out = [
        f"{name}: {words.interval(i, estimates[name])}"
        for name, i in result.intervals.items()
        if i.method == "profile"
    ]
    if not out:
        return []
    return [
        f"95 % intervals by profile likelihood, where the Gaussian ones fail: {'; '.join(out)}."
    ]


def limit_cycle(result: Result) -> str:
    rows = cycle_rows(result)
    if not rows:
        return ""
    return table(CYCLE_HEAD, rows, "", (1, 2))


def quality(result: Result) -> str:
    if not result.quality:
        return tag("p", text("Quality of the recordings: nothing was flagged."))
    rows = [(q.run, q.flag, q.severity.replace("_", "-"), q.detail) for q in result.quality]
    return table(["run", "flag", "consequence", "detail"], rows)


def calibration(campaign: Campaign | None) -> str:
    """What is missing or stale; that nothing is, is said as well."""
    if campaign is None:
        return ""
    known = all("calibration" in r.notes for r in campaign.runs)
    none = "every pressure channel had one in force" if known else "nothing is known of it"
    said = campaign.calibration_remarks or (none,)
    return paragraphs(f"Calibration: {text}" for text in said)


def parameter_rows(result: Result) -> list[list[str]]:
    """(name, unit, then value and standard error of each assessment)."""
    shown = [a for _, a in columns(result)]
    names: dict[str, str] = {}
    for a in shown:
        names.update({n: e.unit for n, e in a.parameters.items()})
    rows = []
    for name, unit in names.items():
        cells: list[str] = []
        for a in shown:
            e = a.parameters.get(name) if a.fit.converged else None
            cells += list(with_error(e)) if e is not None else ["", ""]
        rows.append([name, words.unit(unit), *cells])
    return rows


def model(result: Result) -> str:
    """The final model's equations."""
    before, after = assessments(result)
    return equations(before if after is None else after)


def parameters(result: Result) -> str:
    heads: list[str] = []
    for name, _ in columns(result):
        heads += [name, "s.e."]
    numeric = tuple(range(2, 2 + len(heads)))
    out = table(["parameter", "unit", *heads], parameter_rows(result), "", numeric)
    doubtful = [
        f"{name}: χ²/dof = {scientific(a.chi2_per_dof)}, so that its standard errors, which "
        "assume the model to be right, are too small."
        for name, a in columns(result)
        if a.fit.converged and a.chi2_per_dof > INADEQUATE
    ]
    failed = [
        f"{name}: not converged ({a.fit.reason}); its parameters are no answer and not shown."
        for name, a in columns(result)
        if not a.fit.converged
    ]
    bounds = interval_notes(result)
    undetermined = (
        [f"Not determined by these data: {words.joined(result.undetermined)}."]
        if isinstance(result, Identification) and result.undetermined
        else []
    )
    return out + paragraphs(doubtful + failed + bounds + undetermined)


def residual(result: Result) -> str:
    if not isinstance(result, Diagnosis):
        return ""
    r = result.residual
    within = r.p_value >= ALPHA
    said = "is within the noise" if within else "exceeds the noise"
    tones = ", beside the foreign tones" if within and r.significant else ""
    lead = f"The declared model's residual {said} ({words.p_is(r.p_value)}){tones}."
    return tag("p", text(lead)) + signature(r.signature)


def signature(values: Mapping[str, Any]) -> str:
    """A signature as tables: single values and lists together, mappings of mappings apart.

    `by_run` is left to the heat map.
    """
    single: list[Sequence[str]] = []
    apart = ""
    for key, value in values.items():
        if key == "by_run" or value is None:
            continue
        if isinstance(value, Mapping) and value and all(_is_row(v) for v in value.values()):
            heads = list(dict.fromkeys(k for row in value.values() for k in row))
            rows = [[name, *(_named(h, row.get(h)) for h in heads)] for name, row in value.items()]
            numeric = tuple(range(1, 1 + len(heads)))
            apart += table([_plain(key), *(_plain(h) for h in heads)], rows, "", numeric)
        else:
            single += [(_plain(n.replace(".", ": ")), x) for n, x in flat({key: value}, digits=3)]
    first = table(["signature", ""], single) if single else ""
    return first + apart + (tag("p", text(SIGNATURE_NOTE), class_="note") if values else "")


SIGNATURE_NOTE = (
    "By harmonic, parity and kind of run: root mean square in noise units. Correlation: "
    "Spearman's of the size of a run's residual with run order, drive amplitude and frequency. "
    "Tangents: the "
    "share of χ² that a small effect of that kind would take away, and the share of its signature "
    "that the fitted parameters cannot absorb."
)


def _named(key: str, value: object) -> str:
    return probability(value) if key == "p_value" and isinstance(value, float) else _cell(value, 3)


def _is_row(value: object) -> bool:
    return isinstance(value, Mapping)


def _plain(key: str) -> str:
    return key.replace("_", " ")


CANDIDATE_HEAD = ["effects", "location", "χ²/dof", "validation error", "p", "adequate",
                  "plausible", "equivalent to", "remark"]  # fmt: skip
DETAILED = 6  # candidates whose parameters are listed


def candidate_rows(d: Diagnosis) -> list[list[str]]:
    return [
        [
            words.label(c),
            " + ".join(c.locations),
            scientific(c.chi2_per_dof),
            percent(c.validation_error),
            probability(c.p_value),
            "yes" if c.adequate else "no",
            "yes" if c.plausible else "no",
            ", ".join(c.equivalent_to),
            c.note,
        ]
        for c in d.candidates
    ]


def candidates(result: Result) -> str:
    if not isinstance(result, Diagnosis) or not result.candidates:
        return ""
    note = (
        "p: of the gain in χ² over the declared model, corrected for the number of candidates "
        "tried. Equivalent: predictions that these data cannot tell apart."
    )
    details = [[words.label(c), words.listed(c.parameters)] for c in result.candidates[:DETAILED]]
    return table(CANDIDATE_HEAD, candidate_rows(result), note, (2, 3, 4)) + table(
        ["effects", "parameters"], details
    )


CAPTIONS = {
    "pairs": "How much more χ² the wrong one of two is expected to leave with these runs.",
    "conditions": "The runs to record after a free one.",
}


def told(plan: Mapping[str, Any]) -> dict[str, Any]:
    """What people are told of a next experiment: all but what is for machines, or empty."""
    return {k: v for k, v in plan.items() if k != "plan" and v is not None}


def next_experiment(result: Result) -> str:
    if not isinstance(result, Diagnosis) or not result.next_experiment:
        return ""
    plan = told(result.next_experiment)
    out = ""
    for key in ("reason", "why", "text"):
        if isinstance(plan.get(key), str):
            out += tag("p", text(plan.pop(key)))
    for key, value in list(plan.items()):
        if _is_table(value):
            heads = list(dict.fromkeys(k for row in value for k in row))
            rows = [[_cell(row.get(h, "")) for h in heads] for row in value]
            out += table([_plain(h) for h in heads], rows, CAPTIONS.get(key, _plain(key)))
            del plan[key]
    left = list(flat(plan))
    return out + (table(["", ""], left) if left else "")


def truth(sealed: Mapping[str, Any] | None) -> str:
    if not sealed:
        return ""
    lead = "What the simulated rig carried; nothing above has read it."
    return tag("p", text(lead)) + table(["", ""], list(flat(sealed)))


def _is_table(value: object) -> bool:
    return (
        isinstance(value, (list, tuple))
        and len(value) > 0
        and all(isinstance(row, Mapping) for row in value)
    )


def flat(values: Mapping[str, Any], before: str = "", digits: int = 6) -> Iterable[Sequence[str]]:
    """Nested mappings as rows of dotted name and text."""
    for key, value in values.items():
        name = f"{before}{key}"
        if isinstance(value, Mapping):
            yield from flat(value, f"{name}.", digits)
        elif _is_table(value):
            for i, row in enumerate(value, start=1):
                yield from flat(row, f"{name}.{i}.", digits)
        else:
            yield name, _cell(value, digits)


def _cell(value: object, digits: int = 6) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return scientific(value, digits)
    if isinstance(value, (list, tuple)):
        return ", ".join(_cell(v, digits) for v in value)
    return "" if value is None else str(value)
