"""Which of the terms that were added account for what the declared model leaves.

A term may lower the residual and yet not be its cause: beside an effect that no candidate names,
every flexible term takes up a part. So each is left out again. It accounts for its part where
without it three times as much exceeds the noise, and it is the cause where no candidate of another
name does as well in its place. What does not account is dropped, and reported as tried only; so are
all where together they leave more than a third of what exceeds the noise without them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from identify.broadband.candidates import Score
from identify.broadband.fit import Fit, Whitener, fit
from identify.broadband.model import Excitation, Structure
from identify.broadband.rest import UNPREDICTED, Noise, Remainder, remainder

ACCOUNTS = 3.0  # times the excess over noise that must be left without a term
NEAR = 0.5  # share of a term's own score from which another candidate is fitted in its place


@dataclass(frozen=True)
class Weighed:
    """A term that was added: what exceeds the noise `without` it, as a multiple of what does with
    it (infinite where nothing does), and the `rivals` of another name that do as well."""

    score: Score
    without: float
    rivals: tuple[str, ...] = ()

    @property
    def accounts(self) -> bool:
        return self.without > ACCOUNTS


@dataclass(frozen=True)
class Outcome:
    """The declared model with the terms that account for the residual, all terms that were tried,
    what is known of the noise, and what the model leaves."""

    fit: Fit
    weighed: tuple[Weighed, ...]
    noise: Noise | None
    remainder: Remainder
    spoilt: bool = False

    @property
    def claims(self) -> tuple[Weighed, ...]:
        """The terms to be claimed: beside more than noise, only those without rival; of a spoilt
        recording none."""
        if self.spoilt:
            return ()
        sure = (w for w in self.weighed if w.accounts)
        return tuple(w for w in sure if not (w.rivals and self.remainder.significant))

    def nothing_claimed(self, record: Excitation, declared: Fit, estimation: slice) -> "Outcome":
        """The same with every term dropped, whatever it accounts for."""
        rest = remainder(record, declared, estimation, self.noise)
        return replace(self, fit=declared, remainder=rest, spoilt=True)


@dataclass(frozen=True)
class Step:
    """A term that was added: the fits before and after, and the scores of all at the first."""

    score: Score
    before: Fit
    after: Fit
    scores: tuple[Score, ...]


@dataclass(frozen=True)
class _Judge:
    record: Excitation
    declared: Fit
    estimation: slice
    noise: Noise | None

    def excess(self, fitted: Fit) -> float:
        """Mean square of a fit's residual beyond the noise."""
        rms = float(np.sqrt(np.mean(fitted.residual[self.estimation] ** 2)))
        return Remainder(rms, None if self.noise is None else self.noise.rms).excess()

    def ratio(self, without: Fit, best: Fit) -> float:
        with_it = self.excess(best)
        return self.excess(without) / with_it if with_it > 0 else np.inf

    def rest(self, fitted: Fit) -> Remainder:
        return remainder(self.record, fitted, self.estimation, self.noise)

    def with_only(self, base: Fit, added: Sequence[Score]) -> Fit:
        """The declared model with these terms, from their values in `base`; where no motion exists
        there, from the declared model and the terms' starting values."""
        names = [*self.declared.structure.names, *(n for s in added for n in s.candidate.names)]
        own = {name: value for s in added for name, value in s.candidate.starts}
        plain = Whitener.plain(self.estimation)
        for begin in (base, self.declared):
            known = own | dict(zip(begin.structure.names, begin.theta, strict=True))
            found = fit(self.record, Structure(tuple(names)), {n: known[n] for n in names}, plain)
            if np.isfinite(found.chi2):
                break
        return found

    def rivals(self, step: Step, others: Sequence[Score], best: Fit) -> tuple[str, ...]:
        """Candidates of another name that do as well as the term of `step` in its place, there
        and beside the `others` that the `best` model holds."""
        term = step.score.candidate
        out = []
        for s in step.scores:
            same = s.candidate.effect in (term.effect, *term.equivalent_to)
            if same or s.share < NEAR * step.score.share:
                continue
            before = [o for o in others if o.candidate.names[0] in step.before.structure]
            there = self.with_only(step.before, [*before, s])
            if self.as_good(there, step.after) and (
                not set(others) - set(before)
                or self.as_good(self.with_only(best, [*others, s]), best)
            ):
                out.append(s.candidate.effect)
        return tuple(dict.fromkeys(out))

    def as_good(self, other: Fit, best: Fit) -> bool:
        """Whether a model leaves no more than noise, as the best does, or hardly more than that."""
        near = self.excess(other) <= ACCOUNTS * self.excess(best)
        return near or not (self.rest(best).significant or self.rest(other).significant)


def weigh(
    record: Excitation, steps: Sequence[Step], declared: Fit, estimation: slice, noise: Noise | None
) -> Outcome:
    """Each of the terms that led from the `declared` fit to the last one: what took away most of
    what was left when it came, and what, left out again, leaves far more."""
    best = steps[-1].after if steps else declared
    rest = remainder(record, best, estimation, noise)
    if noise is None and not rest.significant:
        noise = Noise(best.residual[estimation], UNPREDICTED)
    judge = _Judge(record, declared, estimation, noise)
    weighed = [Weighed(s.score, judge.ratio(s.before, s.after)) for s in steps]
    most = [w.accounts for w in weighed]  # of what was left when it came
    kept = list(range(len(steps)))
    while True:
        for i in kept:
            if not most[i]:
                fewer = judge.with_only(best, [steps[o].score for o in kept if o != i])
                # a fit of fewer terms yet may have come further down
                found = [fewer, *(s.before for s in steps if _within(s.before, fewer))]
                without = min(found, key=judge.excess)
                weighed[i] = Weighed(steps[i].score, judge.ratio(without, best))
        strong = [i for i in kept if weighed[i].accounts]
        if strong == kept:
            break
        kept = strong  # … which leave more without the others, and are weighed again
        best = judge.with_only(best, [steps[i].score for i in kept]) if kept else declared
    together = judge.ratio(declared, best)
    if kept and together <= ACCOUNTS:
        weighed = [replace(w, without=min(w.without, together)) for w in weighed]
        kept, best = [], declared
    for i in kept:
        others = [steps[o].score for o in kept if o != i]
        weighed[i] = replace(weighed[i], rivals=judge.rivals(steps[i], others, best))
    return Outcome(best, tuple(weighed), noise, judge.rest(best))


def _within(small: Fit, large: Fit) -> bool:
    return set(small.structure.names) <= set(large.structure.names)
