"""`diagnose`: what the declared model lacks, with evidence, or an honest «unexplained».

Order: data quality → lack of fit against noise (if there is none, stop) → candidates added,
refitted, compared, validated (`identify.trace`) → what contests them → verdict
(`identify.verdict`). A foreign tone that stands in most runs never touches the harmonics compared;
it is an effect of the sensors found in the spectrum.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from identify import assess, design, drive, start, trace
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
    Whereabouts,
)
from identify.signature import signature
from identify.structure import Structure
from identify.trace import Cancelled, Tried
from identify.trace.tried import best_by_name
from identify.trace.tried import tried as as_tried
from identify.verdict import DOUBTFUL, SLIGHT, Declared, asks_for_shapes, judge

SHOWN = 12  # candidates in the report
REFITTED = 6  # sets of effects that are fitted again where the data's covariances have changed
FEW = 2  # numbers that a law may have without asking whether it stands for one run alone
ALONE = "the declared model explains all runs but this one; record it again"


@one_thread
def diagnose(
    campaign: Campaign,
    *,
    structure: Structure | None = None,
    progress: Progress | None = None,
    cancel: Callable[[], bool] | None = None,
    executor: Executor | None = None,
    catalogue: Sequence[Effect] | None = None,
    within_s: float = np.inf,
) -> Diagnosis:
    """Fit the declared model, trace what it lacks, refit, and say so.

    Parameters
    ----------
    progress : called with (share done, what is being done).
    cancel : asked now and then; True raises `identify.trace.Cancelled`.
    catalogue : effects to consider; by default all of `identify.effects.CANDIDATES`.
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

    run = executor or InProcess()
    report(0.0, "measuring harmonics")
    recorded = prepare(campaign, structure)
    report(0.05, "fitting the declared model")
    fit = start.fit_declared(recorded.structure, recorded.data)
    effects_asked = CANDIDATES if catalogue is None else catalogue
    found = _searched(recorded, fit, effects_asked, run, report, began + within_s)
    end = _Concluding(found, run, report, within_s).conclusion()
    declared, data, chosen = found.declared, found.ready.data, end.chosen
    tones = _tone_effects(found.ready.quality.tones)
    before = declared.assessment
    verdict, explanation = end.verdict, end.explanation
    if tones and verdict in ("no_discrepancy", "traced"):
        verdict = "traced"
        explanation += " A foreign tone stands in the channels of most runs."
    after = before if chosen is None else _after(chosen, data, before.noise_floor)
    before, after = _with_lock_in(before, after, data, run)
    effects = tones
    if chosen is not None and verdict in ("traced", "ambiguous"):
        effects = (*_traced(chosen, end.tried), *tones)
        told = [e.told(chosen.fit.values, data.span_s) for e in chosen.effects]
        explanation += "".join(f" {sentence}" for sentence in told if sentence)
    report(0.99, "choosing the next experiment")
    next_experiment = _next(found.ready, verdict, end.tried, chosen)
    report(1.0, "done")
    return Diagnosis(
        campaign=campaign.identifier or campaign.title,
        declared_model=campaign.declared_model,
        quality=end.flags,
        before=before,
        residual=Residual(
            declared.significant or bool(tones),
            declared.p_value,
            signature(before, declared.scores),
        ),
        candidates=_candidates(end.tried, chosen, declared.fit, verdict),
        verdict=verdict,
        effects=effects,
        after=after,
        next_experiment=next_experiment,
        seconds=time.monotonic() - began,
        explanation=explanation,
        whereabouts=end.whereabouts,
    )


@dataclass(frozen=True)
class _Searched:
    """What the search has come to: the data as they are known in the end, the declared model there,
    all that was tried, and freely shaped pieces where some were fitted that still serve."""

    ready: Prepared
    declared: Declared
    tried: tuple[Tried, ...] = ()
    pieces: tuple[Tried, ...] = ()
    whole: bool = True  # False: ended by its time limit before all had been tried


def _searched(
    recorded: Prepared,
    fit: Fit,
    catalogue: Sequence[Effect],
    run: Executor,
    report: Progress,
    until: float,
) -> _Searched:
    """All candidates against data that the declared model does not explain; `fit` is its fit to the
    data as recorded, and what is known better in the end of the drive's errors is in the answer."""
    data, fit = drive.refitted(fit, recorded.data)
    ready = replace(recorded, data=data)
    catalogue = data.among(catalogue)
    declared = _declared_model(fit, ready, catalogue, run)
    if not declared.significant:
        return _Searched(ready, declared)
    found = trace.search(
        ready.structure,
        data,
        declared.fit,
        executor=run,
        progress=lambda share, text: report(0.15 + 0.8 * share, text),
        catalogue=catalogue,
        scores=declared.scores or None,
        until=until,
    )
    tried, pieces = found.tried, found.pieces
    known = [t for t in tried if t.plausible and t.fit.converged]
    if known and not any(t.adequate for t in tried):
        # the best of them knows better than the declared fit how the drive's errors show
        best = min(known, key=lambda t: t.fit.chi2)
        better, fit = drive.refitted(declared.fit, recorded.data, best.fit)
        if better is not recorded.data:
            ready = replace(ready, data=better)
            declared = _declared_model(fit, ready, catalogue, run)
            laws = [t for t in best_by_name(tried) if t.spread is None]
            tried = tuple(trace.refitted(laws[:REFITTED], better))
            pieces = tuple(trace.refitted(found.pieces, better))
    # what an effect explains, a better start of the declared model may explain without it
    once_more = trace.without_effects(ready.structure, ready.data, tried)
    if once_more is not None and _better(once_more, declared.fit):
        declared = _declared_model(once_more, ready, catalogue, run)
        if not any(t.adequate for t in pieces):  # from the better fit they may come nearer
            pieces = ()
    return _Searched(ready, declared, tried if declared.significant else (), pieces, found.whole)


def _declared_model(
    fit: Fit, ready: Prepared, catalogue: Sequence[Effect], executor: Executor
) -> Declared:
    """The declared model as it is fitted, and whether it leaves more than noise."""
    structure, data = ready.structure, ready.data
    model = as_tried((), fit, data)
    assessment = assess.assess(model.fit, model.counted or data)
    usable = [e for e in catalogue if trace.usable(e, data, structure)] if fit.converged else []
    scores = trace.score_tests(structure, data, fit, usable, executor)
    tests = [model.fit_p, model.validation_p, trace.family_p(list(scores.values()))]
    taken = [p for p in tests if np.isfinite(p)]
    # the least of so many: corrected for that (Bonferroni)
    return Declared(model, assessment, scores, min(1.0, len(taken) * min(taken)))


@dataclass(frozen=True)
class _Conclusion:
    verdict: Verdict
    chosen: Tried | None  # what the verdict rests on
    explanation: str
    tried: Sequence[Tried]
    flags: tuple[QualityFlag, ...]
    whereabouts: Whereabouts | None = None


@dataclass(frozen=True)
class _Concluding:
    """On the way from what was tried to a verdict: what contests a claim, or what says where the
    cause may lie, is asked only where it matters."""

    found: _Searched
    run: Executor
    report: Progress
    within_s: float

    @property
    def data(self) -> Dataset:
        return self.found.ready.data

    @property
    def base(self) -> Fit:
        return self.found.declared.fit

    def conclusion(self) -> _Conclusion:
        found, tried = self.found, self.found.tried
        deviating: list[Tried] = []
        verdict, chosen, explanation = judge(found.declared, tried, self.data)
        if chosen is not None and asks_for_shapes(chosen, self.base):
            # a spread takes up much, and so may laws: not where one does better that nobody knows
            tried = tuple(trace.against_chance(tried, self.pieces))
            if chosen.spread:
                deviating = self.deviating(chosen)
            elif self.base.chi2_per_dof < SLIGHT:
                deviating = self.deviating_runs
            contesting = [*self.pieces, *deviating]
            verdict, chosen, explanation = judge(found.declared, tried, self.data, contesting)
        flags = found.ready.quality.flags
        odd = self.odd_run(verdict, chosen)
        if odd is not None:
            run, chi2_per_dof = odd
            explanation = (
                f"Without run {run} the declared model explains all others (χ²/dof "
                f"{chi2_per_dof:.3g}): one run alone is no evidence of a cause. Look for a fault "
                "of its recording, and record it again; what comes back then is an effect."
            )
            flags = (*flags, QualityFlag(run, "contradicts_alone", ALONE))
            return _Conclusion("unexplained", None, explanation, tried, flags)
        if verdict != "unexplained":
            return _Conclusion(verdict, chosen, explanation, tried, flags)
        asked = [*self.pieces, *deviating]
        if not any(t.adequate and t.fit_p > DOUBTFUL for t in self.pieces):
            asked += trace.remembering(
                found.ready.structure, self.data, self.base, self.run, self.placing
            )
            asked += [] if deviating is self.deviating_runs else self.deviating_runs
            tried, asked = (
                tuple(trace.unrivalled(tried, asked)),
                trace.unrivalled(asked, tried),
            )
            verdict, chosen, explanation = judge(found.declared, tried, self.data, asked)
        if verdict != "unexplained":
            return _Conclusion(verdict, chosen, explanation, tried, flags)
        where = trace.whereabouts(asked, tried, self.base)
        explanation = f"{explanation} {where.words}"
        if not found.whole:
            explanation += (
                f" Not all was tried within {self.within_s:g} s: allow the search longer."
            )
        return _Conclusion(verdict, chosen, explanation, tried, flags, where)

    def placing(self, share: float, text: str) -> None:
        self.report(0.95 + 0.04 * share, text)

    @cached_property
    def pieces(self) -> list[Tried]:
        """Freely shaped pieces at each place of the loop, those of the search where they serve."""
        found = self.found
        return list(found.pieces) or trace.shaped(
            found.ready.structure, self.data, self.base, found.tried, self.run, self.placing
        )

    @cached_property
    def deviating_runs(self) -> list[Tried]:
        """Runs that each deviate at one place."""
        return self.deviating()

    def deviating(self, rivalled: Tried | None = None) -> list[Tried]:
        """The same; as rivals of what explains the data, from where that has ended."""
        self.placing(1.0, "trying runs that deviate at each place")
        return trace.deviating(self.found.ready.structure, self.data, self.base, self.run, rivalled)

    def odd_run(self, verdict: Verdict, chosen: Tried | None) -> tuple[str, float] | None:
        """The one run that alone contradicts the declared model, and χ²/dof of the others; asked
        where nothing explains the data, or what does has much freedom."""
        numbers = 0 if chosen is None else sum(len(e.parameters) for e in chosen.effects)
        free = chosen is not None and (chosen.spread or len(chosen.effects) > 1 or numbers > FEW)
        if not (verdict == "unexplained" or (free and verdict != "no_discrepancy")):
            return None
        structure = self.found.ready.structure
        count = len(structure.parameters)
        thetas = [self.base.theta] + ([] if chosen is None else [chosen.fit.theta[:count]])
        anew = verdict == "unexplained"
        alone = trace.lone_run(structure, self.data, thetas, self.run, anew=anew)
        return None if alone is None else (alone[0], alone[1].chi2_per_dof)


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


def _candidates(
    tried: Sequence[Tried], chosen: Tried | None, base: Fit, verdict: Verdict
) -> tuple[Candidate, ...]:
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
        passed_over = t.explains and t is not chosen and not any(o is chosen for o in alike)
        out.append(
            trace.candidate(t, base, equal, _passed_over(t, chosen, verdict) if passed_over else "")
        )
    return tuple(out)


def _passed_over(t: Tried, chosen: Tried | None, verdict: Verdict) -> str:
    """Why what explains the data is not claimed."""
    if chosen is None or verdict not in ("traced", "ambiguous"):
        return "not the cause by itself"
    if t.spread is not None or chosen.spread is not None:
        return "the first is likelier"
    more = t.fit.theta.size - chosen.fit.theta.size
    numbers = f"{abs(more)} number{'' if abs(more) == 1 else 's'} {'more' if more > 0 else 'less'}"
    change = t.chi2_of_all - chosen.chi2_of_all
    change_words = f"χ² of all runs {change:+.1f}".replace("-", "−")
    return f"the first is likelier: {change_words} with {numbers if more else 'as many numbers'}"


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
