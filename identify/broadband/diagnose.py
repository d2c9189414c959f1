"""From a broadband record and a declared model to the effects that it lacks.

Stage by stage: fit by simulation error, score-test the candidates on the whitened residual, refit
with the strongest, keep it if the plain simulation error of the estimation samples falls by more
than `MATERIAL`, else try the next; stop when none does. The test samples are only ever predicted.
Fits minimise the plain mean square, before and after alike; their standard errors are the
sandwich that a coloured residual demands. What is left is compared, band by band, with the noise
that a weakly excited stretch of the same record shows, if one is named.
"""

import time
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.signal import welch

from identify.broadband.candidates import Score, score_test
from identify.broadband.fit import Fit, Whitener, fit
from identify.broadband.lines import Lines
from identify.broadband.model import LINEAR, Excitation, Structure
from identify.chances import f_tail

FloatArray = npt.NDArray[np.float64]
Declared = Literal["linear", "cubic", "cubic_quadratic"]
Verdict = Literal["no_discrepancy", "traced", "ambiguous", "unexplained"]

MATERIAL = 0.005  # least relative fall of the estimation RMS that counts as an effect
SIGNIFICANT = 1e-3
_INTEGRATION = 0.05  # integration error over residual, RMS: half of MATERIAL as a share
_DECLARED: dict[str, tuple[str, ...]] = {
    "linear": LINEAR,
    "cubic": (*LINEAR, "cubic"),
    "cubic_quadratic": (*LINEAR, "cubic", "quadratic"),
}
_STARTS = {"stiffness": -1.0, "damping": -0.1}


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
class Remainder:
    """A residual against noise: RMS of both, worst band, and the corrected p of that band."""

    rms: float
    noise_rms: float | None
    chi2_per_dof: float | None
    p_value: float | None
    worst_band_hz: tuple[float, float] | None

    @property
    def significant(self) -> bool | None:
        return None if self.p_value is None else self.p_value < SIGNIFICANT


@dataclass(frozen=True)
class BroadbandDiagnosis:
    """All stages, the verdict, and what is left."""

    declared: str
    stages: tuple[Stage, ...]
    verdict: Verdict
    remainder: Remainder
    remainders: tuple[Remainder, ...]
    seconds: float
    unit: str = "V"
    title: str = ""
    test_scale: float = 1.0
    notes: tuple[str, ...] = field(default=())

    def to_json(self) -> dict[str, Any]:
        """The `diagnosis/1` object; `stages` and `remainder` go beyond the contract."""
        first, last = self.stages[0], self.stages[-1]
        noise = self.remainder.noise_rms
        return {
            "format": "diagnosis/1",
            "campaign": self.title,
            "declared_model": {"structure": self.declared, "excitation": "broadband"},
            "seconds": self.seconds,
            "quality": [],
            "noise_floor": None if noise is None else noise / self.test_scale,
            "before": _summary(first, self.remainders[0]),
            "residual": {
                "significant": len(self.stages) > 1 or bool(self.remainders[0].significant),
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
                    "effect": s.added.candidate.effect,
                    "location": s.added.candidate.location,
                    "kind": s.added.candidate.kind,
                    "equivalent_to": list(s.added.candidate.equivalent_to),
                    "parameters": {
                        k: v for k, v in last.parameters.items() if k in _new(self.stages, i)
                    },
                }
                for i, s in enumerate(self.stages)
                if s.added is not None
            ],
            "after": _summary(last, self.remainder),
            "next_experiment": self._next(),
            "stages": [
                _summary(s, r)
                | {"added": None if s.added is None else s.added.candidate.effect}
                | {"kind": None if s.added is None else s.added.candidate.kind}
                for s, r in zip(self.stages, self.remainders, strict=True)
            ],
            "remainder": {
                "rms": self.remainder.rms,
                "noise_rms": noise,
                "unit": self.unit,
                "significant": self.remainder.significant,
                "worst_band_hz": self.remainder.worst_band_hz,
            },
            "notes": list(self.notes),
        }

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
) -> BroadbandDiagnosis:
    """Fit the declared oscillator, then find what it lacks.

    Parameters
    ----------
    u, y : one continuous record of input and output, shape (samples,), V. It is simulated whole,
        from rest.
    estimation, test : samples that are fitted, and samples that are only predicted; of the test's
        first `warm_up` samples the initial state is taken, and they do not count.
    lines : whole periods of a periodic excitation within `estimation`, for the split by lines.
    noise : a weakly excited stretch outside both, whose residual is noise.

    Raises
    ------
    ValueError : overlapping slices, an unknown declared model, unusable arrays.
    """
    began = time.perf_counter()
    record = Excitation.of(u, y, sample_rate_hz)
    if declared not in _DECLARED:
        raise ValueError(f"declared={declared!r} is not one of {sorted(_DECLARED)}")
    estimation, test = _checked(record, estimation, test)
    plain = Whitener.plain(estimation)
    start = {name: _STARTS.get(name, 0.0) for name in LINEAR}
    start["input"] = record.scale.input / record.scale.output
    linear = fit(record, Structure(LINEAR), start, plain)
    structure = Structure(_DECLARED[declared])
    current = _refit(record, linear, structure, {}, plain)
    record, current = _resolved(record, current, plain)
    stages = [_stage(record, current, None, estimation, test, lines, warm_up)]
    while True:
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
    remainders = tuple(_remainder(record, s.fit, stages[-1].fit, estimation, noise) for s in stages)
    test_y = record.y[test.start + warm_up : test.stop]
    return BroadbandDiagnosis(
        declared=declared,
        stages=tuple(stages),
        verdict=_verdict(stages, remainders),
        remainder=remainders[-1],
        remainders=remainders,
        seconds=time.perf_counter() - began,
        title=title,
        test_scale=float(np.sqrt(np.mean(test_y**2))),
    )


def _checked(record: Excitation, *parts: slice) -> tuple[slice, slice]:
    whole = [slice(*p.indices(record.samples)[:2]) for p in parts]
    first, second = whole
    if min(p.stop - p.start for p in whole) < 512:
        raise ValueError(f"estimation={first} or test={second} is shorter than 512 samples")
    if max(first.start, second.start) < min(first.stop, second.stop):
        raise ValueError(f"estimation={first} and test={second} overlap: they must be disjoint")
    return first, second


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


def _remainder(
    record: Excitation, fitted: Fit, last: Fit, estimation: slice, noise: slice | None
) -> Remainder:
    """Residual power over noise power in bands: F statistics, the worst Bonferroni-corrected.

    A band of Welch's spectrum with B bins from M half-overlapping Hann segments has about
    2·B·M·0.65/1.5 degrees of freedom (neighbouring bins of a Hann window share half their power).
    """
    residual = fitted.residual[estimation]
    rms = float(np.sqrt(np.mean(residual**2)))
    if noise is None:
        return Remainder(rms, None, None, None, None)
    quiet = last.residual[noise]
    segment = int(2 ** np.floor(np.log2(quiet.size / 6)))
    f, power = welch(residual, record.sample_rate_hz, nperseg=segment, detrend="constant")
    _, floor = welch(quiet, record.sample_rate_hz, nperseg=segment, detrend="constant")
    edges = np.linspace(1, f.size - 1, 17).astype(int)
    ratios, ps = [], []
    for low, high in pairwise(edges.tolist()):
        ratio = float(power[low:high].sum() / floor[low:high].sum())
        dof = [
            max(2.0, 2 * (high - low) * (2 * x.size / segment - 1) * 0.65 / 1.5)
            for x in (residual, quiet)
        ]
        ratios.append(ratio)
        ps.append(f_tail(ratio, *dof))
    worst = int(np.argmin(ps))
    return Remainder(
        rms=rms,
        noise_rms=float(np.sqrt(np.mean((quiet - quiet.mean()) ** 2))),
        chi2_per_dof=float(np.mean(ratios)),
        p_value=min(1.0, min(ps) * len(ps)),
        worst_band_hz=(float(f[edges[worst]]), float(f[edges[worst + 1]])),
    )


def _verdict(stages: list[Stage], remainders: tuple[Remainder, ...]) -> Verdict:
    """Traced: effects were found and what remains is noise. Unexplained: more than noise remains.

    Without a noise stretch the declared model is adequate when nothing could be added, and a
    remainder cannot be judged: the effects found are then reported as traced.
    """
    left = remainders[-1].significant
    if left:
        return "unexplained"
    return "traced" if len(stages) > 1 else "no_discrepancy"


def _new(stages: tuple[Stage, ...], index: int) -> set[str]:
    return set(stages[index].parameters) - set(stages[index - 1].parameters)


def _summary(stage: Stage, remainder: Remainder) -> dict[str, Any]:
    dof = stage.fit.components - stage.fit.theta.size
    return {
        "fit_error": stage.fit_error,
        "validation_error": stage.validation_error,
        "chi2_per_dof": remainder.chi2_per_dof,
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
