"""`diagnose`: what the declared model lacks, with evidence, or an honest «unexplained».

Order: data quality → lack of fit against noise (if there is none, stop) → candidates added,
refitted, compared, validated (`identify.trace`) → verdict. A foreign tone that stands in most
runs never touches the harmonics compared; it is an effect of the sensors found in the spectrum.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from identify import assess, design, drive, start, trace
from identify.chances import rank_correlation
from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects import CANDIDATES
from identify.executor import Executor, InProcess, Progress, one_thread
from identify.fit import Fit
from identify.identification import Prepared, prepare
from identify.parameters import Estimate
from identify.quality import Tone
from identify.record import Campaign
from identify.results import (
    Assessment,
    Candidate,
    Diagnosis,
    QualityFlag,
    Residual,
    TracedEffect,
    Verdict,
)
from identify.structure import Structure
from identify.trace import ALPHA, EVIDENCE, Cancelled, Tried
from identify.trace.tried import LUCK, best_by_name
from identify.trace.tried import tried as as_tried

SHOWN = 12  # candidates in the report
REFITTED = 6  # sets of effects that are fitted again where the data's covariances have changed
FEW = 2  # numbers that a law may have without asking whether it stands for one run alone
ALONE = "the declared model explains all runs but this one; record it again"
DOUBTFUL = 0.05  # probability of a claim's lack of fit below which free shapes contest it
SLIGHT = 10.0  # χ²/dof of the declared model below which they contest every claim


@one_thread
def diagnose(
    campaign: Campaign,
    *,
    structure: Structure | None = None,
    progress: Progress | None = None,
    cancel: Callable[[], bool] | None = None,
    executor: Executor | None = None,
    catalogue: Sequence[Effect] = CANDIDATES,
    within_s: float = np.inf,
) -> Diagnosis:
    """Fit the declared model, trace what it lacks, refit, and say so.

    Parameters
    ----------
    progress : called with (share done, what is being done).
    cancel : asked now and then; True raises `identify.trace.Cancelled`.
    catalogue : effects to consider.
    within_s : seconds after which no further step that seeks an explanation begins; the one under
        way and the question where the misfit lies come on top. `unexplained` says so then.

    Raises
    ------
    ValueError : `within_s` is not above zero.
    What `identify.identification.prepare` raises for data that cannot be used.
    """
    if not within_s > 0:
        raise ValueError(f"within_s={within_s!r} is not a number of seconds > 0")
    began, done = time.monotonic(), 0.0

    def report(share: float, text: str) -> None:
        nonlocal done
        if cancel is not None and cancel():
            raise Cancelled("the diagnosis was cancelled by its caller")
        done = max(done, share)  # a step that comes again is none back
        if progress is not None:
            progress(done, text)

    report(0.0, "measuring harmonics")
    ready = prepare(campaign, structure)
    report(0.05, "fitting the declared model")
    recorded = ready.data
    data, fit = drive.refitted(start.fit_declared(ready.structure, recorded), recorded)
    ready = replace(ready, data=data)
    run = executor or InProcess()
    catalogue = data.among(catalogue)
    declared = _declared(fit, ready, catalogue, run)
    tried: list[Tried] = []
    searched: tuple[Dataset, Fit, Sequence[Tried]] = data, declared.fit, ()
    whole = True
    if declared.significant:
        found = trace.search(
            ready.structure,
            data,
            declared.fit,
            executor=run,
            progress=lambda share, text: report(0.15 + 0.8 * share, text),
            catalogue=catalogue,
            scores=declared.scores or None,
            until=began + within_s,
        )
        whole = found.whole
        tried, searched = list(found.tried), (data, declared.fit, found.pieces)
        known = [t for t in tried if t.plausible and t.fit.converged]
        if known and not any(t.adequate for t in tried):
            # the best of them knows better than the declared fit how the drive's errors show
            best = min(known, key=lambda t: t.fit.chi2)
            better, fit = drive.refitted(declared.fit, recorded, best.fit)
            if better is not recorded:
                data, ready = better, replace(ready, data=better)
                declared = _declared(fit, ready, catalogue, run)
                laws = [t for t in best_by_name(tried) if t.spread is None]
                tried = trace.refitted(laws[:REFITTED], data)
                searched = data, declared.fit, trace.refitted(found.pieces, data)
        # what an effect explains, a better start of the declared model may explain without it
        once_more = trace.without_effects(ready.structure, data, tried)
        if once_more is not None and _better(once_more, declared.fit):
            declared = _declared(once_more, ready, catalogue, run)
    base, before = declared.fit, declared.assessment
    tones = _tone_effects(ready.quality.tones)
    residual = Residual(
        declared.significant or bool(tones), declared.p_value, signature(before, declared.scores)
    )
    if not declared.significant:
        tried = []

    def placing(share: float, text: str) -> None:
        report(0.95 + 0.04 * share, text)

    @cache
    def pieces() -> list[Tried]:
        seen, begun, shapes = searched
        if seen is data and ((begun is base and shapes) or any(t.adequate for t in shapes)):
            return list(shapes)
        return trace.shaped(ready.structure, data, base, tried, run, placing)

    def deviating(rivalled: Tried | None = None) -> list[Tried]:
        placing(1.0, "trying runs that deviate at each place")
        return trace.deviating(ready.structure, data, base, run, rivalled)

    contesting: list[Tried] = []
    verdict, chosen, explanation = _judge(declared, tried, data)
    if chosen is not None and _asks_for_shapes(chosen, base):
        # a spread takes up much, and so may laws: not where one does better that nobody knows
        tried = trace.against_chance(tried, pieces())
        contesting = deviating(chosen) if chosen.spread else []
        verdict, chosen, explanation = _judge(declared, tried, data, [*pieces(), *contesting])
    where, flags = None, ready.quality.flags
    odd = _odd_run(ready, data, base, verdict, chosen, run)
    if odd is not None:
        name, chi2_per_dof = odd
        verdict, chosen = "unexplained", None
        explanation = (
            f"Without run {name} the declared model explains all others (χ²/dof "
            f"{chi2_per_dof:.3g}): one run alone is no evidence of a cause. Look for a fault of "
            "its recording, and record it again; what comes back then is an effect."
        )
        flags = (*flags, QualityFlag(name, "contradicts_alone", ALONE))
    elif verdict == "unexplained":
        asked = [*pieces(), *contesting]
        if not any(t.adequate and t.fit_p > DOUBTFUL for t in pieces()):
            asked += trace.remembering(ready.structure, data, base, run, placing)
            asked += deviating()
            tried, asked = trace.unrivalled(tried, asked), trace.unrivalled(asked, tried)
            verdict, chosen, explanation = _judge(declared, tried, data, asked)
        if verdict == "unexplained":
            where = trace.whereabouts(asked, tried, base)
            explanation = f"{explanation} {where.words}"
            if not whole:
                explanation += f" Not all was tried within {within_s:g} s: allow the search longer."
    if tones and verdict in ("no_discrepancy", "traced"):
        verdict = "traced"
        explanation += " A foreign tone stands in the channels of most runs."
    after = before if chosen is None else _after(chosen, data, before.noise_floor)
    before, after = _with_lock_in(before, after, data, run)
    claimed = verdict in ("traced", "ambiguous") and chosen is not None
    effects = (*_traced(chosen, tried), *tones) if claimed and chosen else tuple(tones)
    if claimed and chosen:
        told = [e.told(chosen.fit.values, data.span_s) for e in chosen.effects]
        explanation += "".join(f" {sentence}" for sentence in told if sentence)
    report(0.99, "choosing the next experiment")
    next_experiment = _next(ready, verdict, tried, chosen)
    report(1.0, "done")
    return Diagnosis(
        campaign=campaign.identifier or campaign.title,
        declared_model=campaign.declared_model,
        quality=flags,
        before=before,
        residual=residual,
        candidates=_candidates(tried, chosen, base),
        verdict=verdict,
        effects=effects,
        after=after,
        next_experiment=next_experiment,
        seconds=time.monotonic() - began,
        explanation=explanation,
        whereabouts=where,
    )


def _odd_run(
    ready: Prepared,
    data: Dataset,
    base: Fit,
    verdict: Verdict,
    chosen: Tried | None,
    run: Executor,
) -> tuple[str, float] | None:
    """The one run that alone contradicts the declared model, and χ²/dof of the others; asked where
    nothing explains the data, or what does has much freedom."""
    numbers = 0 if chosen is None else sum(len(e.parameters) for e in chosen.effects)
    free = chosen is not None and (chosen.spread or len(chosen.effects) > 1 or numbers > FEW)
    if not (verdict == "unexplained" or (free and verdict != "no_discrepancy")):
        return None
    count = len(ready.structure.parameters)
    thetas = [base.theta] + ([] if chosen is None else [chosen.fit.theta[:count]])
    found = trace.lone_run(ready.structure, data, thetas, run, anew=verdict == "unexplained")
    return None if found is None else (found[0], found[1].chi2_per_dof)


def _after(chosen: Tried, data: Dataset, noise_floor: float) -> Assessment:
    """The chosen model against the data; a spread from run to run, and what a correction makes of
    the noise, count with its coefficients' noise, but not with the noise floor."""
    wide = (chosen.counted or data) if chosen.spread is None else chosen.spread.data
    return replace(assess.assess(chosen.fit, wide), noise_floor=noise_floor)


def _better(new: Fit, old: Fit) -> bool:
    """Another minimum rather than the same one reached less tidily."""
    return new.chi2 < (1.0 if new.converged else 0.9) * old.chi2 - 1.0


def _with_lock_in(
    before: Assessment, after: Assessment, data: Dataset, executor: Executor
) -> tuple[Assessment, Assessment]:
    """Both with their lock-in boundaries."""
    fits = [before.fit] if after is before else [before.fit, after.fit]
    found = list(executor.map(assess.lock_in, [(fit, data) for fit in fits]))
    return replace(before, lock_in=found[0]), replace(after, lock_in=found[-1])


@dataclass(frozen=True)
class _Declared:
    """The declared model, fitted, and whether it leaves more than noise."""

    model: Tried
    assessment: Assessment
    scores: dict[str, trace.ScoreTest]
    p_value: float

    @property
    def fit(self) -> Fit:
        return self.model.fit

    @property
    def significant(self) -> bool:
        return self.p_value < ALPHA


def _declared(
    fit: Fit, ready: Prepared, catalogue: Sequence[Effect], executor: Executor
) -> _Declared:
    structure, data = ready.structure, ready.data
    model = as_tried((), fit, data)
    assessment = assess.assess(model.fit, model.counted or data)
    usable = [e for e in catalogue if trace.usable(e, data, structure)] if fit.converged else []
    scores = trace.score_tests(structure, data, fit, usable, executor)
    tests = [model.fit_p, model.validation_p, trace.family_p(list(scores.values()))]
    taken = [p for p in tests if np.isfinite(p)]
    # the least of so many: corrected for that (Bonferroni)
    return _Declared(model, assessment, scores, min(1.0, len(taken) * min(taken)))


def signature(assessment: Assessment, scores: Mapping[str, trace.ScoreTest]) -> dict[str, Any]:
    """What the residual looks like: rms in noise units by harmonic, run, kind and parity, and the
    effects along whose tangents it lies (share of χ² that a small effect would take away)."""
    rows = [c for c in assessment.comparisons if c.role == "fit"]
    size = [np.abs(c.normalised) for c in rows]
    if not rows or not all(np.isfinite(s).all() for s in size):
        return {}
    table = np.stack([s[: min(len(q) for q in size)] for s in size])
    order = np.argsort([c.started_s for c in rows])
    by_run = np.sqrt(np.mean(table**2, axis=1))
    forced = [i for i, c in enumerate(rows) if c.kind == "forced"]
    out: dict[str, Any] = {
        "by_harmonic": [float(x) for x in np.sqrt(np.mean(table**2, axis=0))],
        "by_run": {c.run: float(x) for c, x in zip(rows, by_run, strict=True)},
        "odd": float(np.sqrt(np.mean(table[:, 0::2] ** 2))),
        "even": float(np.sqrt(np.mean(table[:, 1::2] ** 2))) if table.shape[1] > 1 else None,
    }
    for kind in ("forced", "free", "cold"):
        members = [i for i, c in enumerate(rows) if c.kind == kind]
        if members:
            out[kind] = float(np.sqrt(np.mean(table[members] ** 2)))
    if len(forced) >= 4:
        amplitude = [rows[i].amplitude_v for i in forced]
        out["correlation"] = {
            "run_order": _rank_correlation(by_run[order], np.arange(len(order))),
            "amplitude": _rank_correlation(by_run[forced], np.array(amplitude)),
            "frequency": _rank_correlation(
                by_run[forced], np.array([rows[i].frequency_hz for i in forced])
            ),
        }
    total = float(np.sum(assessment.fit.residual**2))
    ranked = sorted(scores.items(), key=lambda item: -item[1].drop)[:8]
    out["tangents"] = {
        key: {"explains": s.drop / total, "unabsorbed": s.share, "p_value": s.p_value}
        for key, s in ranked
    }
    return out


def _rank_correlation(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> float | None:
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    value = rank_correlation(a, b)[0]
    return value if np.isfinite(value) else None


def _not_contradicted(fit: Fit) -> str:
    said, p = "The declared model explains the data to within noise.", fit.theta.size
    if fit.dof >= p:
        return said
    left = f"{fit.dof} degree{'' if fit.dof == 1 else 's'} of freedom beside its {p} parameters"
    return f"{said} That says little: the usable runs leave {left}. Record more of them."


def _judge(
    declared: _Declared,
    tried: Sequence[Tried],
    data: Dataset,
    pieces: Sequence[Tried] = (),
) -> tuple[Verdict, Tried | None, str]:
    """Verdict, the candidate it rests on, and the reason in words; `pieces` are freely shaped, and
    what is far less likely than one of them is not claimed."""
    if not declared.significant:
        return "no_discrepancy", None, _not_contradicted(declared.fit)
    good = [t for t in tried if t.explains and trace.accounts(t, declared.model, tried)]
    good = [t for t in good if not trace.outdone(t, pieces)]
    settled = [t for t in good if t.has_values]  # of these alone one is claimed
    if settled:
        spreads = [t for t in tried if t.spread is not None and not t.explains]
        implausible = [t for t in tried if t.spread is None and t.adequate and not t.plausible]
        best, others = trace.claimed(settled, [*good, *spreads, *implausible])
        words = best.words
        if not others:
            open_ = trace.other_forms(best, good)
            forms = [
                f" Forms of {e.name} that do as well: {', '.join(open_[e.name])}."
                for e in best.effects
                if open_[e.name]
            ]
            said = f"Adding {words} explains the data; no rival does."
            said += "".join(
                f" {t.words} would do as well, but {t.implausibility}."
                for t in trace.but_for_values(best, implausible)
            )
            if best.spread is not None and best.spread.objection:
                said += f" No law comes near: that {best.spread.objection} is put down to luck."
            if best.spread is not None:
                said += (
                    " Single runs lie at random within that spread, and are predicted no better."
                )
            return "traced", best, said + "".join(dict.fromkeys(forms))
        names = ", ".join(t.words for t in others)
        return "ambiguous", best, f"{words} explains the data, and so does: {names}."
    least = declared.fit.chi2  # what leaves more with an effect than without has lost its way
    ranked = sorted(
        (t for t in tried if t.plausible and t.fit.chi2 < least), key=lambda t: t.fit.chi2
    )
    near = _nearly(ranked, least, data.noise_floor(data.validation), pieces)
    if near is not None:
        words = near.words
        return "traced", near, (
            f"Adding {words} takes away all but a trace of the misfit and predicts the validation "
            "runs as well as noise permits, but for bad luck; "
            f"χ²/dof {near.fit.chi2_per_dof:.2g} is left."
        )  # fmt: skip
    chosen = trace.foremost(ranked)
    left = "" if chosen is None else (
        f" The best, {chosen.words}, leaves χ²/dof {chosen.fit.chi2_per_dof:.3g}; "
        "it is reported, not claimed."
    )  # fmt: skip
    near_it = [t for t in tried if t.explains]
    if good:
        nearest = trace.best_form(good)
        said = f"{nearest.words} comes near to the data, with no values: {nearest.fit.reason}."
    elif any(trace.outdone(t, pieces) for t in near_it):
        said = "What comes near to the data is far less likely than a law that nobody here knows."
    elif near_it:
        said = (
            "What comes near to the data takes too little more of the misfit away than what has an "
            "effect less, or predicts the runs that no fit has seen worse."
        )
    else:
        said = "No known effect explains the data to within noise."
    return "unexplained", chosen, said + left


def _asks_for_shapes(chosen: Tried, base: Fit) -> bool:
    """Whether freely shaped pieces contest a claim: where it hardly comes to the noise, where a
    spread or several laws may take up much that is not theirs, and where so little was missing from
    the declared fit `base` that many laws follow it (48030)."""
    if chosen.spread is not None or len(chosen.effects) > 1:
        return True
    return chosen.fit_p < DOUBTFUL or base.chi2_per_dof < SLIGHT


def _nearly(
    ranked: Sequence[Tried], base_chi2: float, floor: float, pieces: Sequence[Tried]
) -> Tried | None:
    """A law alone that leaves a statistically visible but practically empty residual.

    It must take away 99.8 % of the excess misfit, predict held-out runs within 1.5 times the noise
    (`floor`; none without such runs) or no worse than noise and its parameters let expect but for
    bad luck (54135, a saturation extrapolated to five times the free amplitude), and stand ten
    times better than any law or laws without it and far likelier than a spread; nor may a free
    shape be far likelier. An idealisation (a slightly other law of the same effect) may then
    remain, or bad luck; another cause hardly.
    """
    best = next((t for t in ranked if len(t.effects) == 1 and t.spread is None), None)
    if best is None or not best.fit.converged or best.fit.chi2_per_dof > 3.0:
        return None
    excess = max(best.fit.chi2 - best.fit.dof, 0.0)
    empty = excess < 0.002 * (base_chi2 - best.fit.dof)
    if not (empty and (best.validation_error < 1.5 * floor or best.validation_p > LUCK)):
        return None
    others = [t for t in ranked if best.names[0] not in t.names]
    rivalled = any(
        t.fit.chi2 < 10 * best.fit.chi2
        if t.spread is None
        else t.evidence < best.evidence + EVIDENCE
        for t in others
    )
    # unlike for `trace.outdone`, it need not be adequate: the law is not either
    bettered = any(t.evidence < best.evidence - EVIDENCE for t in pieces if t.spread is None)
    return None if rivalled or bettered else best


def _candidates(tried: Sequence[Tried], chosen: Tried | None, base: Fit) -> tuple[Candidate, ...]:
    ordered = trace.best_by_name(tried)
    if chosen is not None:  # what the verdict rests on stands first, its rivals as they are such
        first = [chosen, *trace.rivals(chosen, tried)]
        named = {t.key for t in first}
        ordered = [*first, *(t for t in ordered if t.key not in named)]
    good = [t for t in ordered if t.explains]
    out = []
    for t in ordered[:SHOWN]:
        alike = [o for o in good if t.explains and o is not t and _alike(t, o, chosen)]
        equal = [o.words for o in alike]
        out.append(trace.candidate(t, base, equal))
    return tuple(out)


def _alike(a: Tried, b: Tried, chosen: Tried | None) -> bool:
    """Whether the data do not tell two explanations apart: for the one that the verdict rests on
    as the verdict has it, else each by the other's measure. What merely extends the other is no
    equal of it."""
    if chosen is a or chosen is b:
        return bool(trace.rivals(chosen, [b if chosen is a else a]))
    return bool(trace.rivals(a, [b]) and trace.rivals(b, [a]))


def _traced(chosen: Tried, tried: Sequence[Tried]) -> tuple[TracedEffect, ...]:
    estimates, open_ = chosen.estimates, trace.other_forms(chosen, tried)
    return tuple(
        TracedEffect(
            e.name,
            e.location,
            e.form,
            {q.name: estimates[q.name] for q in e.parameters},
            open_[e.name],
        )
        for e in chosen.effects
    )


def _tone_effects(tones: Sequence[Tone]) -> tuple[TracedEffect, ...]:
    """Foreign tones, as far as they were seen, as the effect `interference`."""
    return tuple(
        TracedEffect(
            "interference",
            "sensor",
            "tone",
            {
                "interference.frequency_hz": Estimate(t.frequency_hz, t.frequency_stderr_hz, "Hz"),
                "interference.amplitude": Estimate(t.amplitude, t.stderr, t.unit),
            },
        )
        for t in tones
        if not t.supposed
    )


def _next(
    ready: Prepared, verdict: Verdict, tried: Sequence[Tried], chosen: Tried | None
) -> Mapping[str, Any] | None:
    """What to measure to tell the rivals apart, or to see the unexplained rest."""
    if chosen is None or verdict not in ("ambiguous", "unexplained"):
        return None
    others = trace.rivals(chosen, tried) if verdict == "ambiguous" else trace.best_by_name(tried)
    group = [chosen, *(t for t in others if t.plausible and t.key != chosen.key)]
    rivals = [design.Rival(t.words, t.fit) for t in group]
    return design.next_experiment(rivals, ready, verdict)
