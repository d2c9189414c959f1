"""From a broadband record and a declared model to the effects that it lacks.

Stage by stage: fit by simulation error, score-test the candidates on the whitened residual, refit
with the strongest, keep it if the plain simulation error of the estimation samples falls by more
than `MATERIAL`, else try the next; stop when none does. Then each is left out again, and only what
accounts for its part is claimed (`claims`). The test samples are only ever predicted. Fits minimise
the plain mean square, before and after alike; their standard errors are the sandwich that a
coloured residual demands. What is left is judged against the noise (`rest`).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from identify.broadband.candidates import Score, score_test
from identify.broadband.claims import Outcome, Step, Weighed, weigh
from identify.broadband.fit import Fit, Whitener, fit
from identify.broadband.lines import Lines
from identify.broadband.model import LINEAR, Excitation, Structure
from identify.broadband.quality import quality, spoilt
from identify.broadband.rest import SIGNIFICANT, Noise, Remainder, noise_of, remainder
from identify.results import QualityFlag

FloatArray = npt.NDArray[np.float64]
Declared = Literal["linear", "cubic", "cubic_quadratic"]
Verdict = Literal["no_discrepancy", "traced", "ambiguous", "unexplained"]

MATERIAL = 0.005  # least relative fall of the estimation RMS that counts as an effect
PART_SAMPLES, NOISE_SAMPLES = 512, 256  # at least
_INTEGRATION = 0.05  # integration error over residual, RMS: half of MATERIAL as a share
_DECLARED: dict[str, tuple[str, ...]] = {
    "linear": LINEAR,
    "cubic": (*LINEAR, "cubic"),
    "cubic_quadratic": (*LINEAR, "cubic", "quadratic"),
}
#: Where the linear oscillator is started from: (ω₀ over the frequency of the largest response)²
#: and damping; from all where the first leaves more than `MUCH` of the response's power.
_STARTS = ((1.0, 0.1), (0.6, 0.1), (1.6, 0.1), (1.0, 0.02), (1.0, 0.5))
MUCH = 0.25


@dataclass(frozen=True)
class Stage:
    """A fitted structure with its errors; `added` is None for the declared model."""

    added: Score | None
    fit: Fit
    parameters: dict[str, dict[str, float | str]]
    fit_rms: float
    test_rms: float
    fit_error: float
    validation_error: float
    lines_rms: dict[str, float]
    scores: tuple[Score, ...] = ()


@dataclass(frozen=True)
class BroadbandDiagnosis:
    """All stages, the final model with what is claimed, the verdict, and what is left.

    `remainders` are those of the stages, `remainder` that of the `final` model.
    """

    declared: str
    stages: tuple[Stage, ...]
    final: Stage
    weighed: tuple[Weighed, ...]
    claims: tuple[Weighed, ...]
    quality: tuple[QualityFlag, ...]
    verdict: Verdict
    remainder: Remainder
    remainders: tuple[Remainder, ...]
    seconds: float
    record: Excitation
    estimation: slice
    test: slice
    noise: Noise | None
    title: str = ""
    warm_up: int = 50

    @property
    def unit(self) -> str:
        """Of the response and of every error."""
        return self.record.scale.output_unit

    @property
    def test_scale(self) -> float:
        """RMS of the response that the test counts."""
        y = self.record.y[self.test][self.warm_up :]
        return float(np.sqrt(np.mean(y**2)))

    def to_json(self) -> dict[str, Any]:
        """The `diagnosis/1` object; `stages` and `remainder` go beyond the contract."""
        first = self.stages[0]
        noise = self.remainder.noise_rms
        return {
            "format": "diagnosis/1",
            "campaign": self.title,
            "declared_model": {"structure": self.declared, "excitation": "broadband"},
            "seconds": self.seconds,
            "quality": [q.to_json() for q in self.quality],
            "noise_floor": None if noise is None else noise / self.test_scale,
            "before": _summary(first, self.remainders[0]),
            "residual": {
                "significant": len(self.stages) > 1 or self.remainders[0].significant,
                "p_value": min(
                    [s.p_value for s in first.scores]
                    + [p for p in (self.remainders[0].p_value,) if p is not None]
                ),
                "signature": {"rms_by_lines": first.lines_rms, "unit": self.unit},
            },
            "candidates": [
                _candidate(score, stage) for stage in self.stages for score in stage.scores[:4]
            ],
            "verdict": self.verdict,
            "effects": [
                {
                    "effect": w.score.candidate.effect,
                    "location": w.score.candidate.location,
                    "kind": w.score.candidate.kind,
                    "equivalent_to": [*w.score.candidate.equivalent_to, *w.rivals],
                    "parameters": self._own(w.score),
                }
                for w in self.claims
            ],
            "after": _summary(self.final, self.remainder),
            "next_experiment": self._next(),
            "stages": [
                _summary(s, r)
                | {"added": None if s.added is None else s.added.candidate.effect}
                | {"kind": None if s.added is None else s.added.candidate.kind}
                | {"claimed": s.added in [w.score for w in self.claims]}
                for s, r in zip(self.stages, self.remainders, strict=True)
            ],
            "remainder": {
                "rms": self.remainder.rms,
                "noise_rms": noise,
                "noise_source": self.remainder.noise_source,
                "follows_motion": self.remainder.follows,
                "unit": self.unit,
                "significant": self.remainder.significant,
                "worst_band_hz": self.remainder.worst_band_hz,
            },
        }

    def _own(self, score: Score) -> dict[str, dict[str, float | str]]:
        """The final values of the parameters that came with this term."""
        at = [s.added for s in self.stages].index(score)
        new = set(self.stages[at].parameters) - set(self.stages[at - 1].parameters)
        return {k: v for k, v in self.final.parameters.items() if k in new}

    def _next(self) -> dict[str, Any] | None:
        if self.verdict not in {"ambiguous", "unexplained"}:
            return None
        band = self.remainder.worst_band_hz
        return {
            "excitation": "odd random-phase multisine, two periods a realisation, at two levels",
            "why": "repeated periods give the noise by line without a model; two levels separate "
            "what grows with amplitude from what does not",
            "band_hz": None if band is None else list(band),
        }


def diagnose_broadband(
    u: npt.ArrayLike,
    y: npt.ArrayLike,
    sample_rate_hz: float,
    *,
    declared: Declared = "cubic",
    estimation: slice,
    test: slice,
    lines: Lines | None = None,
    noise: slice | None = None,
    max_effects: int = 6,
    warm_up: int = 50,
    title: str = "",
    units: tuple[str, str] = ("V", "V"),
    progress: Callable[[float, str], None] | None = None,
) -> BroadbandDiagnosis:
    """Fit the declared oscillator, then find what it lacks.

    Parameters
    ----------
    u, y : one continuous record of input and output, shape (samples,), in `units`. It is
        simulated whole, from rest.
    estimation, test : samples that are fitted, and samples that are only predicted; of the test's
        first `warm_up` samples the initial state is taken, and they do not count.
    lines : whole periods of a periodic excitation within `estimation`, for the split by lines.
    noise : a weakly excited stretch outside both, whose residual is noise.
    progress : called with the share done and what is being done.

    Raises
    ------
    ValueError : stretches that overlap or are short, periods beyond the record, an unknown declared
        model, unusable arrays.
    """
    began = time.perf_counter()
    tell = progress or (lambda share, text: None)
    record = Excitation.of(u, y, sample_rate_hz, units)
    if declared not in _DECLARED:
        raise ValueError(f"declared={declared!r} is not one of {sorted(_DECLARED)}")
    estimation, test = _checked(record, estimation, test, lines, noise)
    plain = Whitener.plain(estimation)
    tell(0.0, "fitting the declared model")
    linear = _linear(record, plain)
    structure = Structure(_DECLARED[declared])
    current = _refit(record, linear, structure, {}, plain)
    record, current = _resolved(record, current, plain)
    stages = [_stage(record, current, None, estimation, test, lines, warm_up)]
    while True:
        tell(0.7 * len(stages) / (max_effects + 2), f"fit {len(stages)}: what it lacks")
        whiten = Whitener.of(stages[-1].fit.residual, estimation)
        scores = tuple(score_test(record, stages[-1].fit, whiten))
        stages[-1] = _with_scores(stages[-1], scores)
        if len(stages) > max_effects:
            break
        following = _best_addition(record, stages[-1], plain)
        if following is None:
            break
        score, found = following
        record, found = _resolved(record, found, plain)
        stages.append(_stage(record, found, score, estimation, test, lines, warm_up))
    known = noise_of(stages[-1].fit, record.u, lines, noise)
    steps = [
        Step(after.added, before.fit, after.fit, before.scores)
        for before, after in pairwise(stages)
        if after.added is not None
    ]
    tell(0.7, "leaving each term out again")
    outcome = weigh(record, steps, stages[0].fit, estimation, known)
    flags = quality(record, stages[0].fit, stages[-1].fit, estimation, lines, title)
    if spoilt(flags):
        outcome = outcome.nothing_claimed(record, stages[0].fit, estimation)
    final = stages[-1]
    if outcome.fit.structure != final.fit.structure:
        final = _stage(record, outcome.fit, None, estimation, test, lines, warm_up)
    tell(1.0, "done")
    return BroadbandDiagnosis(
        declared=declared,
        stages=tuple(stages),
        final=final,
        weighed=outcome.weighed,
        claims=outcome.claims,
        quality=flags,
        verdict=_verdict(outcome),
        remainder=outcome.remainder,
        remainders=tuple(remainder(record, s.fit, estimation, outcome.noise) for s in stages),
        seconds=time.perf_counter() - began,
        record=record,
        estimation=estimation,
        test=test,
        noise=outcome.noise,
        title=title,
        warm_up=warm_up,
    )


def _checked(
    record: Excitation, estimation: slice, test: slice, lines: Lines | None, noise: slice | None
) -> tuple[slice, slice]:
    whole = [slice(*p.indices(record.samples)[:2]) for p in (estimation, test)]
    named = dict(zip(("estimation", "test"), whole, strict=True))
    if noise is not None:
        named["noise"] = slice(*noise.indices(record.samples)[:2])
    for name, part in named.items():
        least = NOISE_SAMPLES if name == "noise" else PART_SAMPLES
        if part.stop - part.start < least:
            raise ValueError(
                f"{name}=[{part.start}, {part.stop}] is shorter than {least} samples; name a "
                "longer stretch"
            )
    first, second = whole
    if max(first.start, second.start) < min(first.stop, second.stop):
        raise ValueError(
            f"estimation=[{first.start}, {first.stop}] and test=[{second.start}, {second.stop}] "
            "overlap: they must be disjoint"
        )
    starts, period = ((), 0) if lines is None else (lines.starts, lines.period)
    for start in starts:
        if not 0 <= start <= record.samples - period:
            raise ValueError(
                f"period_starts: a period of {period} samples from {start} on is not within "
                f"the {record.samples} samples recorded"
            )
    return first, second


def _linear(record: Excitation, plain: Whitener) -> Fit:
    """The linear oscillator, from wherever it leaves least."""
    structure, y = Structure(LINEAR), plain(record.y - record.y.mean())
    fits: list[Fit] = []
    for stiffness, damping in _STARTS:
        start = {"stiffness": -stiffness, "damping": -damping, "input": 1.0, "bias": 0.0}
        theta = np.array([start[name] for name in structure.names])
        one = plain(record.predict(structure, theta, derivatives=False)[0])
        start["input"] = float(one @ y) / float(one @ one)  # of its sign
        fits.append(fit(record, structure, start, plain))
        if fits[-1].chi2 < MUCH * float(y @ y):
            break
    return min(fits, key=lambda f: f.chi2)


def _resolved(record: Excitation, fitted: Fit, plain: Whitener) -> tuple[Excitation, Fit]:
    """Refit with smaller steps where the integrator's error is not far below the residual."""
    residual = fitted.residual[plain.where]
    limit = _INTEGRATION * float(np.sqrt(np.mean(residual**2)))
    finer = record.refined(fitted.structure, fitted.theta, limit)
    if finer.substeps == record.substeps:
        return record, fitted
    return finer, _refit(finer, fitted, fitted.structure, {}, plain)


def _refit(
    record: Excitation, base: Fit, structure: Structure, extra: dict[str, float], plain: Whitener
) -> Fit:
    known = dict(zip(base.structure.names, base.theta, strict=True))
    start = {name: known.get(name, extra.get(name, 0.0)) for name in structure.names}
    return fit(record, structure, start, plain)


def _best_addition(
    record: Excitation, stage: Stage, plain: Whitener, tries: int = 3
) -> tuple[Score, Fit] | None:
    """The strongest candidate whose refit lowers the estimation error by more than `MATERIAL`."""
    for score in stage.scores[:tries]:
        if score.p_value > SIGNIFICANT or score.share < MATERIAL:
            continue
        structure = stage.fit.structure.plus(*score.candidate.names)
        found = _refit(record, stage.fit, structure, dict(score.candidate.starts), plain)
        if found.chi2 < stage.fit.chi2 * (1 - MATERIAL) ** 2:
            return score, found
    return None


def _stage(
    record: Excitation,
    fitted: Fit,
    added: Score | None,
    estimation: slice,
    test: slice,
    lines: Lines | None,
    warm_up: int,
) -> Stage:
    robust = fitted.with_sandwich(Whitener.of(fitted.residual, estimation))
    error = _from_initial_state(record, robust, test, warm_up)
    measured = record.y[test][warm_up:]
    fit_rms = float(np.sqrt(np.mean(fitted.residual[estimation] ** 2)))
    test_rms = float(np.sqrt(np.mean(error**2)))
    return Stage(
        added=added,
        fit=robust,
        parameters=robust.parameters(record),
        fit_rms=fit_rms,
        test_rms=test_rms,
        fit_error=fit_rms / float(np.sqrt(np.mean(record.y[estimation] ** 2))),
        validation_error=test_rms / float(np.sqrt(np.mean(measured**2))),
        lines_rms=lines.split(fitted.residual, record.u) if lines is not None else {},
    )


def _from_initial_state(record: Excitation, fitted: Fit, test: slice, warm_up: int) -> FloatArray:
    """Test residual after `warm_up`, less the decay of the state at the test's start.

    A test stretch that begins in motion owes y₀, y₀' to its past. The linear part's free decay
    e^{−ζω₀t}(a cos ω_d t + b sin ω_d t), a and b from the first `warm_up` samples alone, is taken
    off; where the record is at rest before, a and b come out near zero.
    """
    residual = fitted.residual[test]
    value = fitted.parameters(record)
    w0 = 2 * np.pi * float(value["mode1.frequency_hz"]["value"])
    zeta = float(value["mode1.damping"]["value"])
    t = np.arange(residual.size) / record.sample_rate_hz
    decay = np.exp(-zeta * w0 * t)
    turn = w0 * np.sqrt(max(1 - zeta**2, 1e-12)) * t
    free = np.column_stack([decay * np.cos(turn), decay * np.sin(turn)])
    state = np.linalg.lstsq(free[:warm_up], residual[:warm_up], rcond=None)[0]
    return np.asarray((residual - free @ state)[warm_up:])


def _with_scores(stage: Stage, scores: tuple[Score, ...]) -> Stage:
    return Stage(**{**stage.__dict__, "scores": scores})


def _verdict(outcome: Outcome) -> Verdict:
    """Traced: terms account for the residual and what remains is noise. Ambiguous: others would do
    as well. Unexplained: more than noise remains, whatever accounts for a part of it; or the
    recording is spoilt, and says nothing."""
    if outcome.remainder.significant or outcome.spoilt:
        return "unexplained"
    if any(w.rivals for w in outcome.claims):
        return "ambiguous"
    return "traced" if outcome.claims else "no_discrepancy"


def _summary(stage: Stage, rest: Remainder) -> dict[str, Any]:
    dof = stage.fit.components - stage.fit.theta.size
    return {
        "fit_error": stage.fit_error,
        "validation_error": stage.validation_error,
        "chi2_per_dof": rest.chi2_per_dof,
        "dof": dof,
        "parameters": stage.parameters,
        "fit_rms": stage.fit_rms,
        "test_rms": stage.test_rms,
        "rms_by_lines": stage.lines_rms,
    }


def _candidate(score: Score, stage: Stage) -> dict[str, Any]:
    return {
        "effects": [score.candidate.effect],
        "locations": [score.candidate.location],
        "kind": score.candidate.kind,
        "stage": len(stage.fit.structure.names),
        "share_of_residual": score.share,
        "unabsorbed": score.unabsorbed,
        "chi2_per_dof": None,
        "validation_error": None,
        "p_value": score.p_value,
        "parameters": {},
        "equivalent_to": list(score.candidate.equivalent_to),
        "plausible": score.unabsorbed > 1e-3,
    }
