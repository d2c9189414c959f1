"""A set of effects refitted, and how such sets compare: which explain, which is best, which rival.

Selection is by lack of fit and held-out runs with corrected significance; information criteria
only weigh candidates that are adequate already: χ² + p ln n, within 10 of the best.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy import stats

from identify import assess
from identify.chances import chi2_tail
from identify.dataset import Dataset
from identify.effects import CANDIDATES, CATALOGUE
from identify.effects.scatter import Scatter
from identify.fit import Fit, log_determinant_of
from identify.parameters import Estimate, Parameter
from identify.results import Candidate
from identify.scatter import Spread
from identify.structure import Effect

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)

ALPHA = 1e-3  # false-alarm probability of each significance test
GROSS = 300.0  # χ²/dof beyond which a fit is no place to start from alone
MODAL = 0.7  # damping ratio up to which a mode is one
OVERDAMPED = 0.15  # damping ratio of a mode that has strayed: beside a spread, or where there is …
VISIBLE = 10.0  # … a misfit of so much χ²/dof
LEFT_P = 0.03  # chance below which what a spread leaves is more than noise …
LEFT_BESIDE_P = 0.1  # … and with a law beside it: the best of so many laws leaves less by chance
EVIDENCE = 10.0  # difference of χ² + p ln n that rules a rival out («very strong»)
DECADES = 4.0  # over which the size of an effect may lie beforehand
TINY = 1e-9  # of a number's scale: no smaller size is told apart
LUCK = 1e-4  # chance below which what speaks against an unrivalled spread is no luck
BEATEN = "a law does better"  # the objection to a spread that is no reproach to its randomness
LOST = 1e6  # times its value: a standard error that says nothing of it
WORSE = 1.25  # times the error on held-out runs with fewer effects: as noise alone may have it …
WORSE_P = 0.05  # … and any worse, where noise leaves as much as that by so small a chance
ASTRAY = 3.0  # times the declared model's error on held-out runs, beyond which a spread hides one
PREFERENCE = 6.0  # what a form without a law must gain on one of the same effect with a law
USUAL = 3.0  # what a form must gain on one of the same effect that stands before it: more usual


@dataclass(frozen=True)
class Tried:
    """One set of effects, refitted."""

    effects: tuple[Effect, ...]
    fit: Fit
    validation_error: float
    fit_p: float
    validation_p: float
    spread: Spread | None = None
    held_out: tuple[float, int] = (0.0, 0)  # χ² of those runs, and of how many residuals

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.effects)

    @property
    def key(self) -> tuple[str, ...]:
        return tuple(sorted(self.names))

    @property
    def parts(self) -> frozenset[str]:
        """What it consists of, whatever the forms: a law and chance may go by the same name, and
        two laws: the second adds to the first."""
        laws = [e.name for e in self.effects if not isinstance(e, Scatter)]
        again = {f"{name}, once more" for name in laws if laws.count(name) > 1}
        return frozenset({*laws, *again, *(e.key for e in self.effects if isinstance(e, Scatter))})

    def within(self, t: "Tried") -> bool:
        """Whether `t` has all of this and more; where this explains the data, by name too: chance
        then does for the law that goes by the same."""
        named = Counter(self.names) < Counter(t.names)
        return self.parts < t.parts or (named and self.explains)

    @property
    def words(self) -> str:
        """The effects' names; their forms too where two go by the same."""
        twice = len(set(self.names)) < len(self.names)
        return " + ".join(e.key if twice else e.name for e in self.effects)

    @property
    def key_of_forms(self) -> tuple[str, ...]:
        return key_of_forms(self.effects)

    @property
    def adequate(self) -> bool:
        return self.fit_p > ALPHA and not self.validation_p < ALPHA and not self.all_p < ALPHA

    @property
    def all_p(self) -> float:
        """Chance that noise leaves as much of fitted and held-out runs together: two that are both
        hardly noise are not."""
        return assess.lack_of_fit_p(self.chi2_of_all, self.fit.dof + self.held_out[1])

    @property
    def explains(self) -> bool:
        """Adequate, and with values that can be true. A spread must leave nothing but noise: it
        takes away so much of any law's misfit that little is left to betray one."""
        return self.adequate and self.plausible and self.leaves_noise

    @property
    def leaves_noise(self) -> bool:
        """Whether what is left beside a spread, if there is one, is as probable as it must be."""
        if self.spread is None or self.spread.unrivalled:
            return True
        return self.fit_p > (LEFT_P if len(self.effects) == 1 else LEFT_BESIDE_P)

    @property
    def has_values(self) -> bool:
        """Whether its fit came to an end; a spread's values are those of its likelihood."""
        return self.spread is not None or self.fit.ended

    @property
    def objection(self) -> str:
        """What speaks against its spread, if it has one."""
        if self.spread is None or (self.spread.unrivalled and self.spread.luck > LUCK):
            return ""
        return self.spread.objection

    @property
    def deviance(self) -> float:
        """χ², and what a spread's likelihood pays for the noise that it widens."""
        return self.fit.chi2 + (0.0 if self.spread is None else self.spread.penalty)

    @property
    def evidence(self) -> float:
        """χ² + p ln n: only compared between adequate candidates."""
        more = 0 if self.spread is None else len(self.spread.sizes)
        return self.deviance + (self.fit.theta.size + more) * float(np.log(self.fit.residual.size))

    @property
    def tuned_evidence(self) -> float:
        """−2 ln of the probability of the data (of laws), but for what the declared model's own
        numbers share: χ² of all runs, and how finely the effects' own had to be tuned, by Laplace's
        method. Beforehand the size of an effect is as likely in any of `DECADES` decades."""
        own = [q for e in self.effects for q in e.parameters]
        widths = np.array([_width(q, self.fit.values[q.name]) for q in own])
        beforehand = np.zeros((len(own), self.fit.theta.size))
        at = [self.fit.structure.parameters.index[q.name] for q in own]
        beforehand[range(len(own)), at] = 1.0 / widths
        known = log_determinant_of(np.vstack([self.fit.jacobian, beforehand]))
        return float(self.chi2_of_all + known + 2 * np.log(widths).sum())

    @property
    def evidence_of_all(self) -> float:
        """The same as if all runs had been fitted, to first order (of laws)."""
        return self.evidence + self.held_out[0]

    @property
    def chi2_of_all(self) -> float:
        """χ² of fitted and held-out runs: as if all had been fitted."""
        return self.fit.chi2 + self.held_out[0]

    @property
    def excess(self) -> float:
        """What it leaves of all runs beyond noise."""
        return self.chi2_of_all - assess.noise_misfit(self.fit.dof + self.held_out[1])

    @property
    def estimates(self) -> dict[str, Estimate]:
        own = {} if self.spread is None else self.spread.sizes
        return {**self.fit.estimates, **own}

    @property
    def plausible(self) -> bool:
        return not self.implausibility

    @property
    def implausibility(self) -> str:
        """Why it is no explanation however little it leaves, in words; empty: it is one."""
        if self.objection:
            return self.objection
        known = self.estimates
        values = {name: e.value for name, e in known.items()}
        own = [q for e in self.effects for q in e.parameters]
        # where the data do not know it to within a factor, an edge has stopped nothing
        open_ = {
            q.name for q in own if q.kind == "positive" and known[q.name].stderr > values[q.name]
        }
        outside = (q.name for q in own if not (q.plausible(values[q.name]) or q.name in open_))
        # without the flame's part in the mode that sings, nothing makes it sing; where chance alone
        # is gross, its noise hides that
        alone = self.spread is not None and self.spread.unrivalled and len(self.effects) == 1
        sings = [] if alone else ["mode1.flame_residue"]
        located = [*sings, *(n for e in self.effects for n in e.located)]
        unseen = (n for n in located if not known[n].stderr <= abs(values[n]))
        # … which hides what has strayed as well
        most = MODAL if self.spread is None else OVERDAMPED
        dampings = (f"mode{i}.damping" for i in range(1, self.fit.structure.mode_count + 1))
        overdamped = (n for n in dampings if not values[n] < most)
        lost = (n for n in open_ if LOST * values[n] < known[n].stderr < np.inf)
        for names, what in (
            (outside, "at the edge of its range"),
            (lost, "not known by any order of magnitude"),
            (unseen, "within its own error of nothing"),
            (overdamped, "no mode's"),
        ):
            name = next(names, None)
            if name is not None:
                return f"{name} is {what} ({values[name]:.3g})"
        return ""


def astray(fit: Fit) -> bool:
    """Whether a fit is no place to start from alone: for its misfit, or since what it lacks has
    been taken up by a damping that no mode of a tube that sings has."""
    modes = range(1, fit.structure.mode_count + 1)
    damped = max(fit.values[f"mode{i}.damping"] for i in modes)
    return fit.chi2_per_dof > (VISIBLE if damped > OVERDAMPED else GROSS)


def key_of_forms(effects: Sequence[Effect]) -> tuple[str, ...]:
    """What a set of effects in their forms goes by, in whatever order they stand."""
    return tuple(sorted(e.key for e in effects))


def tried(effects: tuple[Effect, ...], fit: Fit, data: Dataset) -> Tried:
    """A refitted candidate with its adequacy on fitted and held-out runs."""
    held_out = [assess.predict(fit.structure, fit.theta, b) for b in data.validation]
    error = assess.relative_error(held_out) if held_out else float("nan")
    misfit_out = assess.held_out_misfit(held_out, fit.covariance)
    fit_p, p_out = (assess.lack_of_fit_p(*m) for m in ((fit.chi2, fit.dof), misfit_out))
    return Tried(effects, fit, error, fit_p, p_out, held_out=misfit_out)


def _width(q: Parameter, value: float) -> float:
    """Standard deviation, in its internal unit, of where a number may lie beforehand."""
    if q.kind == "positive" and np.isfinite(q.upper) and q.lower > 0:
        return float(np.log(q.upper / q.lower) / np.sqrt(2 * np.pi))
    decades = float(DECADES * np.log(10.0) / np.sqrt(2 * np.pi))
    return decades * (1.0 if q.kind == "positive" else max(abs(value) / q.scale, TINY))


def best_by_name(tries: Sequence[Tried]) -> list[Tried]:
    """The best form of each set of effect names, best first."""
    best = first_of_each(sorted(tries, key=_merit), lambda t: t.key)
    return sorted(best.values(), key=misfit)


def best_of_each_form(tries: Sequence[Tried]) -> list[Tried]:
    """The best of each set of effects in their forms, best first."""
    return list(first_of_each(sorted(tries, key=misfit), lambda t: t.key_of_forms).values())


def first_of_each(items: Iterable[T], kind: Callable[[T], K]) -> dict[K, T]:
    """The first item of each kind, in their order."""
    first: dict[K, T] = {}
    for item in items:
        first.setdefault(kind(item), item)
    return first


def few_of_each(items: Iterable[T], kind: Callable[[T], Hashable], most: int) -> list[T]:
    """The first `most` items of each kind, in their order."""
    seen: Counter[Hashable] = Counter()
    out = []
    for item in items:
        seen[kind(item)] += 1
        if seen[kind(item)] <= most:
            out.append(item)
    return out


def misfit(t: Tried) -> float:
    return t.fit.chi2


def best_form(good: Sequence[Tried]) -> Tried:
    """The best of adequate candidates, in its preferred form: of those that do about as well, the
    most usual one, by the candidates' order."""
    best = min(good, key=lambda t: t.evidence)
    forms = [t for t in good if t.key == best.key]
    least = min(_cost(t) for t in forms)
    return min((t for t in forms if _cost(t) < least + USUAL), key=lambda t: (_places(t), _cost(t)))


def _places(t: Tried) -> list[int]:
    """Where its forms stand among the candidates; one that a caller brings, after them."""
    order = {e.key: i for i, e in enumerate(CANDIDATES)}
    return sorted(order.get(e.key, len(order)) for e in t.effects)


def _merit(t: Tried) -> tuple[bool, float]:
    """Adequate ones first, and by evidence: of as little misfit, what needs fewer parameters."""
    return not t.explains, _cost(t)


def _cost(t: Tried) -> float:
    """Its evidence, what has no law behind it handicapped."""
    return t.evidence + (PREFERENCE if any(e.empirical for e in t.effects) else 0.0)


def foremost(tries: Sequence[Tried]) -> Tried | None:
    """The best of sets that may not explain the data: the fewest effects that leave no more than
    three times as much as any do. More of them take up more of whatever there is."""
    least = min((t.fit.chi2 for t in tries), default=np.inf)
    near = [t for t in tries if t.fit.chi2 <= 3 * least]
    return min(near, key=lambda t: (len(t.effects), t.fit.chi2), default=None)


def claimed(good: Sequence[Tried], others: Sequence[Tried]) -> tuple[Tried, list[Tried]]:
    """The best of what explains the data by values, and its rivals among `others`. Which is best
    the fitted runs say; one that all runs make far likelier takes its place."""
    best = best_form(good)
    found = rivals(best, others)
    likelier = [t for t in found if any(t is g for g in good) and _less_likely(t, best) < -EVIDENCE]
    if likelier:
        best = best_form(likelier)
        found = rivals(best, others)
    return best, found


def rivals(best: Tried, others: Sequence[Tried]) -> list[Tried]:
    """Adequate, plausible sets of other effects that the data do not rule out against `best`.

    Laws are weighed by all runs: refitted to them, their evidence hardly differs; one whose numbers
    must be tuned for that to be as likely is none. What only adds an effect to one of them is none
    of its own. Among spreads the likelihood alone decides: how well the wanderings of a few runs
    fit a Gaussian says little of their cause; a law beside one must predict the held-out runs. A
    law may follow what chance did where a spread is about as likely, or likelier though it looks
    not quite random. Each in its best form that is a rival: one that extends `best` must not hide
    another.
    """
    every = [
        t
        for t in others
        if t.key != best.key
        and (t.explains or _chance_rivals(t, best) or _stands_for_another(t, best))
        and _less_likely(t, best) < EVIDENCE
        and not best.within(t)
        and not _extends(t, best)
        and not _must_be_tuned(t, best)
    ]
    found = best_by_name(every)
    return [t for t in found if not any(o.within(t) for o in found)]


def _less_likely(t: Tried, best: Tried) -> float:
    """By how much of χ² + p ln n the data speak for `best`: all of them, the held-out runs too. A
    spread takes these for whatever it widens them to: its fitted runs must speak for it as well."""
    of_all = t.evidence_of_all - best.evidence_of_all
    laws = t.spread is None and best.spread is None
    return of_all if laws else min(of_all, t.evidence - best.evidence)


def but_for_values(best: Tried, others: Sequence[Tried]) -> list[Tried]:
    """Laws of no more effects that would be rivals of the law `best` if their values could be
    true."""
    if best.spread is not None:
        return []
    near = [
        t
        for t in others
        if t.spread is None
        and t.key != best.key
        and t.adequate
        and not t.plausible
        and len(t.effects) <= len(best.effects)
        and _less_likely(t, best) < EVIDENCE
        and not _must_be_tuned(t, best)
    ]
    return best_by_name(near)


def _must_be_tuned(t: Tried, best: Tried) -> bool:
    """Whether one law would follow the data as well as another only with its numbers tuned so
    finely that the other is far likelier: three numbers that make what one does."""
    laws = t.spread is None and best.spread is None
    return laws and t.tuned_evidence - best.tuned_evidence > EVIDENCE


def _stands_for_another(t: Tried, best: Tried) -> bool:
    """Whether a law of no more effects is far likelier, though its values cannot be true, or the
    data do not tell them."""
    if t.spread is not None or t.plausible or len(t.effects) > len(best.effects):
        return False
    return t.adequate and t.evidence < best.evidence - EVIDENCE


def _chance_rivals(spread: Tried, best: Tried) -> bool:
    if spread.spread is None:
        return False
    if best.spread is not None:
        return spread.plausible and (spread.adequate or len(spread.effects) == 1)
    random = spread.objection in ("", BEATEN)
    return spread.adequate and spread.evidence < best.evidence + (EVIDENCE if random else 0.0)


def other_forms(best: Tried, others: Sequence[Tried]) -> dict[str, tuple[str, ...]]:
    """By effect, its other forms that the data do not rule out against those of `best`."""
    out: dict[str, list[str]] = {name: [] for name in best.names}
    for t in others:
        if t.key != best.key or not t.explains:
            continue
        if t.evidence < best.evidence + EVIDENCE:
            for e in t.effects:
                out[e.name].append(e.form)
    own = {(e.name, e.form) for e in best.effects}
    return {
        n: tuple(f for f in dict.fromkeys(forms) if (n, f) not in own) for n, forms in out.items()
    }


def _extends(t: Tried, best: Tried) -> bool:
    """Whether `t` is `best` with an extension that the data do not ask for."""
    general = {n for e in t.effects for n in e.generalises}
    return t.fit.theta.size > best.fit.theta.size and best.parts <= t.parts | general


def gain_p(gain: float, t: Tried, without: Fit) -> float:
    """Chance of a gain in χ² of `t` on a model with fewer effects, corrected for those asked."""
    freedom = max(t.fit.theta.size - without.theta.size, 1)
    return min(1.0, chi2_tail(gain, freedom) * len(CATALOGUE))


def _beside_chance_p(t: Tried, alone: Tried) -> float:
    """The same of what a law gains beside a spread on that spread alone: its σ comes from a few
    runs' deviations, N in all, which so many numbers may follow (45153). By F, which the likelihood
    of a Gaussian of unknown variance has: gain = N ln(1 + k F/(N − k))."""
    assert t.spread is not None
    runs = sum(b.runs for b in t.spread.data.fit if not b.free)
    count, freedom = runs * len(t.spread.sizes), max(t.fit.theta.size - alone.fit.theta.size, 1)
    gain = alone.deviance - t.deviance
    if gain <= 0 or count <= freedom:
        return 1.0
    ratio = float(np.expm1(min(gain / count, 500.0))) * (count - freedom) / freedom
    return min(1.0, float(stats.f.sf(ratio, freedom, count - freedom)) * len(CATALOGUE))


def accounts(t: Tried, declared: Tried, tries: Sequence[Tried]) -> bool:
    """Whether the misfit that is left without one of the effects goes with it: more than chance
    takes away, and two thirds of what exceeds the noise, and the held-out runs are predicted no
    worse than by fewer effects in their best forms. What takes a part of little may leave the cause
    behind, under the threshold. A spread does so by widening the noise: its likelihood is penalised
    for that, and must still gain, on the law beside it and, so that one is claimed, on the spread
    alone, more than the likeliest of all laws does by chance. And chance beside a law does not make
    the prediction many times worse (alone, it does where the declared model had followed it)."""
    fewer = [o for o in tries if o.spread is None and o.parts < t.parts]
    without = min([declared, *fewer], key=lambda o: o.chi2_of_all)
    mostly = t.excess < without.excess / 3
    if t.spread is not None:
        alone = [o for o in tries if o.spread and o.within(t)]
        found = all(_beside_chance_p(t, o) < ALPHA for o in alone)
        least = min([without.evidence, *(o.evidence for o in alone)])
        hidden = t.validation_error > ASTRAY * declared.validation_error
        lost = len(t.effects) > 1 and hidden
        return mostly and found and not lost and t.evidence < least - EVIDENCE
    worse = any(_predicts_worse(t, o) for o in best_by_name(fewer))
    gain = without.chi2_of_all - t.chi2_of_all
    return gain_p(gain, t, without.fit) < ALPHA and mostly and not worse


def _predicts_worse(t: Tried, o: Tried) -> bool:
    """Whether `t` predicts the held-out runs worse than `o`: much, or a little and hardly by chance
    either. Near the noise a few runs decide nothing (44014)."""
    more = t.validation_error / o.validation_error
    return more > WORSE or (more > 1.0 and t.validation_p < min(WORSE_P, o.validation_p))


def foretold(t: Tried, error: float) -> bool:
    """Whether held-out runs that a law predicts with that `error` do not scatter as the spread `t`
    has it: they would lie so near to their middle by chance, each along one direction at least."""
    if t.spread is None or not error < t.validation_error < np.inf:
        return False
    runs = sum(b.runs for b in t.spread.data.validation)
    nearer = runs * (error / t.validation_error) ** 2
    return 1.0 - chi2_tail(nearer, runs) < ALPHA


def outdone(t: Tried, pieces: Sequence[Tried]) -> bool:
    """Whether a freely shaped piece is far likelier, complexity counted: then the cause is one that
    nobody has named, and `t` only comes near to it. Chance at one place is asked so of chance at
    another alone."""
    good = [p for p in pieces if (p.adequate if p.spread is None else p.explains and t.spread)]
    return any(p.evidence < t.evidence - EVIDENCE for p in good)


def candidate(t: Tried, declared: Fit, equal: Sequence[str]) -> Candidate:
    """The candidate's line of the report: its gain over the declared model, corrected."""
    own = {q.name for e in t.effects for q in e.parameters}
    return Candidate(
        effects=t.names,
        forms=tuple(e.form for e in t.effects),
        locations=tuple(e.location for e in t.effects),
        chi2=t.fit.chi2,
        chi2_per_dof=t.fit.chi2_per_dof,
        validation_error=t.validation_error,
        p_value=gain_p(declared.chi2 - t.fit.chi2, t, declared),
        parameters={n: e for n, e in t.estimates.items() if n in own},
        equivalent_to=tuple(equal),
        plausible=t.plausible,
        adequate=t.adequate,
        note=_note(t),
    )


def _note(t: Tried) -> str:
    if not t.fit.converged:
        return t.fit.reason
    if not t.plausible:
        return t.implausibility
    if t.spread is None:
        return ""
    return "leaves more than noise" if t.adequate and not t.leaves_noise else ""
