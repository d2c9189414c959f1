"""Numbers and findings in plain words, the same in page and terminal.

A value is written with its standard error to two digits of the latter; an error as per cent; a
χ² per degree of freedom with three digits. «Within noise» is said only of what was tested.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from identify.parameters import Estimate
from identify.profile import Z95, Interval
from identify.results import Assessment, Candidate, Diagnosis, Identification, TracedEffect

VERDICTS = {
    "no_discrepancy": "No discrepancy: the declared model explains the data to within noise",
    "traced": "Traced",
    "ambiguous": "Ambiguous: several effects explain the data equally well",
    "unexplained": "Unexplained: a discrepancy remains that no known effect accounts for",
}


@dataclass(frozen=True)
class Heading:
    """A verdict for people: one line, and the sentences that carry its evidence."""

    verdict: str
    headline: str
    evidence: tuple[str, ...]


def scientific(x: float, digits: int = 3) -> str:
    """A number with `digits` digits: 0.0123, 12.3, 1.23e−5, — where there is none."""
    if not math.isfinite(x):
        return "—"
    text = f"{x:.{digits}g}"
    if "e" not in text:
        return text.replace("-", "−")
    mantissa, exponent = text.split("e")
    return f"{mantissa}e{int(exponent)}".replace("-", "−")


def percent(x: float) -> str:
    """A relative error as per cent."""
    return f"{scientific(100 * x)}\u00a0%" if math.isfinite(x) else "—"


def probability(p: float) -> str:
    if not math.isfinite(p):
        return "—"
    return "< 1e−300" if p < 1e-300 else scientific(p, 2)


def p_is(p: float) -> str:
    text = probability(p)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


#: What the p-value is of the question whether anything is missing from the declared model.
LEAST_P = (
    "the least of the fitted runs', the held-out runs' and the candidates' scores', corrected for "
    "so many questions"
)


def unit(name: str) -> str:
    """A unit as it is printed: nothing for 1, m⁻² for m^-2."""
    if name == "1":
        return ""
    base, caret, power = name.partition("^")
    return base + power.translate(_RAISED) if caret else base


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def with_error(e: Estimate) -> tuple[str, str]:
    """(value, standard error) as text, to the digits that the standard error justifies."""
    if not math.isfinite(e.value):
        return "—", "—"
    if not e.determined:
        return scientific(e.value, 4), "not determined"
    if e.stderr <= 0:
        return scientific(e.value, 6), "0"
    size = max(abs(e.value), e.stderr)
    magnitude = math.floor(math.log10(size))
    last = math.floor(math.log10(e.stderr)) - 1  # decimal place of the second digit
    if -4 <= magnitude <= 5:
        places = max(0, -last)
        value, error = f"{e.value:.{places}f}", f"{e.stderr:.{places}f}"
    else:
        places = max(0, magnitude - last)
        scale = 10.0**magnitude
        value = f"{e.value / scale:.{places}f}e{magnitude}"
        error = f"{e.stderr / scale:.{places}f}e{magnitude}"
    return value.replace("-", "−"), error.replace("-", "−")


def estimate(e: Estimate) -> str:
    value, error = with_error(e)
    return f"{value} ± {error} {unit(e.unit)}".rstrip()


def interval(i: Interval, e: Estimate) -> str:
    """Both ends, to the digits that its width justifies."""
    stderr = e.stderr
    if i.lower is not None and i.upper is not None:
        stderr = (i.upper - i.lower) / (2 * Z95)
    low, high = (
        "not bounded" if end is None else with_error(Estimate(end, stderr, e.unit))[0]
        for end in (i.lower, i.upper)
    )
    return f"{low} … {high} {unit(e.unit)}".rstrip()


def listed(parts: Mapping[str, Estimate]) -> str:
    return ", ".join(f"{name} = {estimate(e)}" for name, e in parts.items())


def joined(names: list[str] | tuple[str, ...], last: str = "and") -> str:
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} {last} {names[-1]}"


def label(candidate: Candidate) -> str:
    """Effects with their forms: ``flame_dynamics (pole) + parameter_drift (frequency)``."""
    forms = candidate.forms or ("",) * len(candidate.effects)
    pairs = zip(candidate.effects, forms, strict=True)
    return " + ".join(f"{e} ({f})" if f else e for e, f in pairs)


def heading(result: Diagnosis | Identification) -> Heading:
    """What was found, with its evidence."""
    if isinstance(result, Diagnosis):
        return _diagnosis(result)
    a = result.assessment
    if not a.fit.converged:
        return Heading("unexplained", f"The fit did not converge: {a.fit.reason}", ())
    return Heading(
        "identified",
        "Identified: the declared model fitted to the campaign",
        (_misfit("The declared model", a),),
    )


def _diagnosis(d: Diagnosis) -> Heading:
    evidence = []
    if d.before.fit.converged:
        evidence.append(_misfit("The declared model", d.before))
        evidence.append(
            f"Whether anything is missing from it: {p_is(d.residual.p_value)}, {LEAST_P}."
        )
    else:
        evidence.append(f"The declared model's fit did not converge: {d.before.fit.reason}.")
    headline = VERDICTS[d.verdict]
    if d.verdict == "traced":
        where = joined(tuple(f"{e.effect}{_forms(e)}, {e.location}" for e in d.effects))
        headline = f"Traced: {where}"
        # tone by tone: all of them go by the same names
        parts = "; ".join(listed(e.parameters) for e in d.effects)
        evidence.append(f"Added to the model: {parts}.")
        evidence.append(_misfit("With it the model", d.after))
    elif d.verdict == "ambiguous":
        adequate = [label(c) for c in d.candidates if c.adequate and c.plausible]
        if adequate:
            evidence.append(f"Adequate and plausible: {joined(adequate)}.")
    elif d.verdict == "unexplained" and d.candidates:
        best = d.candidates[0]
        evidence.append(
            f"The best candidate, {label(best)}, is not claimed: with it "
            f"χ²/dof = {scientific(best.chi2_per_dof)} and the validation error is "
            f"{percent(best.validation_error)}."
        )
    if d.explanation:
        evidence.append(d.explanation)
    return Heading(d.verdict, headline, tuple(evidence))


def _forms(e: TracedEffect) -> str:
    """Its form in brackets, with those that do as well."""
    forms = joined((e.form, *e.other_forms), last="or")
    return f" ({forms})" if forms else ""


def _misfit(subject: str, a: Assessment) -> str:
    own = f" ({p_is(a.fit_p)})" if math.isfinite(a.fit_p) else ""
    ratio = a.validation_error / a.noise_floor if a.noise_floor > 0 else math.nan
    expected = (
        f"; noise and the uncertainty of its parameters together let expect "
        f"{percent(a.expected_error)}"
        if math.isfinite(a.expected_error)
        else ""
    )
    return (
        f"{subject} has χ²/dof = {scientific(a.chi2_per_dof)} at {a.dof} degrees of freedom{own}; "
        f"its validation error is {percent(a.validation_error)}, "
        f"{scientific(ratio)} times the noise floor of {percent(a.noise_floor)}{expected}."
    )
