"""A set of effects refitted: whether it explains the data, and which of several comes first.

Selection is by lack of fit and held-out runs with corrected significance; information criteria
only weigh candidates that are adequate already: χ² + p ln n, within 10 of the best.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from identify import assess, corrected
from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects import CANDIDATES
from identify.effects.scatter import Scatter
from identify.fit import Fit, log_determinant_of
from identify.parameters import Estimate, Parameter
from identify.scatter import Spread

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)

ALPHA = 1e-3  # false-alarm probability of each significance test
GROSS = 300.0  # χ²/dof beyond which a fit is no place to start from alone
MODAL = 0.7  # damping ratio up to which a mode is one
OVERDAMPED = 0.15  # damping ratio of a mode that has strayed: beside a spread, or where there is …
VISIBLE = 10.0  # … a misfit of so much χ²/dof
LEFT_P = 0.03  # chance below which what a spread leaves is more than noise …
LEFT_BESIDE_P = 0.1  # … and with a law beside it: the best of so many laws leaves less by chance
HELD_OUT_P = 0.01  # the same of held-out runs, which no law beside it has been chosen by
EVIDENCE = 10.0  # difference of χ² + p ln n that rules a rival out («very strong»)
DECADES = 4.0  # over which the size of an effect may lie beforehand …
DECADE_WIDTH = float(DECADES * np.log(10.0) / np.sqrt(2 * np.pi))  # … as ln of it, for a Gaussian
TINY = 1e-9  # of a number's scale: no smaller size is told apart
LUCK = 1e-4  # chance below which what speaks against an unrivalled spread is no luck
BEATEN = "a law does better"  # the objection to a spread that is no reproach to its randomness
SEEN = 3.0  # standard errors from nothing of a mode's part that is certainly there
LOST = 1e6  # times its value: a standard error that says nothing of it
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
    counted: Dataset | None = None  # with the noise as its effects correct it, where that matters …
    grown: float = 0.0  # … and by how much ln det of the covariances has grown

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
    def but_for_values(self) -> bool:
        """Whether it would explain the data, if its values could be true."""
        return self.adequate and self.leaves_noise and not self.plausible and not self.objection

    @property
    def leaves_noise(self) -> bool:
        """Whether what is left beside a spread, if there is one, is as probable as it must be: a
        law beside it may have been led to where chance is large enough for it (67029, a drift of a
        quarter of a per cent, claimed as chance beside a loss in a poorer form)."""
        if self.spread is None or self.spread.unrivalled:
            return True
        if len(self.effects) == 1:
            return self.fit_p > LEFT_P
        return self.fit_p > LEFT_BESIDE_P and not self.validation_p < HELD_OUT_P

    @property
    def follows_runs(self) -> bool:
        """Whether it has numbers enough to follow runs that differ at random, one after the other:
        a curve or a cycle in the course of the campaign."""
        return any(e.location == "experiment" and len(e.parameters) > 1 for e in self.effects)

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
        """χ², and what the likelihood pays for noise that is widened."""
        s = self.spread
        return self.fit.chi2 + self.grown + (0.0 if s is None else s.penalty - s.wandering)

    @property
    def evidence(self) -> float:
        """χ² + p ln n: only compared between adequate candidates."""
        more = 0 if self.spread is None else len(self.spread.sizes)
        return self.deviance + (self.fit.theta.size + more) * float(np.log(self.fit.residual.size))

    @cached_property
    def tuned_evidence(self) -> float:
        """−2 ln of the probability of the data, but for what the declared model's own numbers
        share: deviance of all runs, and how finely the effects' own had to be tuned, by Laplace's
        method. Beforehand a size, of an effect or of chance, is as likely in any of `DECADES`
        decades."""
        own = [q for e in self.effects if not isinstance(e, Scatter) for q in e.parameters]
        widths = np.array([_width(q, self.fit.values[q.name]) for q in own])
        beforehand = np.zeros((len(own), self.fit.theta.size))
        at = [self.fit.structure.parameters.index[q.name] for q in own]
        beforehand[range(len(own)), at] = 1.0 / widths
        known = log_determinant_of(np.vstack([self.fit.jacobian, beforehand]))
        known += float(2 * np.log(widths).sum())
        if self.spread is not None:
            known += sum(_tuned(e) for e in self.spread.sizes.values())
        return self.deviance + self.held_out[0] + known

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
        overdamped = [n for n in dampings if not values[n] < most]
        overdamped += [n for e in self.effects for n in e.modal if not values[n] < OVERDAMPED]
        # what the speaker drives and the flame does not may as well lie before the speaker's sound
        # (two notches of an enclosure were claimed as one, and a mode)
        driven = (
            flame
            for e in self.effects
            for flame, speaker in e.residues
            if known[flame].stderr > abs(values[flame])
            and abs(values[speaker]) > SEEN * known[speaker].stderr
        )
        lost = (n for n in open_ if LOST * values[n] < known[n].stderr < np.inf)
        for names, what in (
            (outside, "at the edge of its range"),
            (lost, "not known by any order of magnitude"),
            (unseen, "within its own error of nothing"),
            (overdamped, "no mode's"),
            (driven, "within its own error of nothing, and what only the speaker drives no mode"),
        ):
            name = next(iter(names), None)
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
    own, grown = None, 0.0
    if fit.chi2_per_dof < VISIBLE:  # else it does not matter what noise its corrections leave
        counted, fit = corrected.refitted(fit, data)
        if counted is not data:
            own, grown, data = counted, corrected.growth(counted, data), counted
    fit, held_out = _foreseen(fit, data)
    error = assess.relative_error(held_out) if held_out else float("nan")
    misfit_out = assess.held_out_misfit(held_out, fit.covariance)
    fit_p, p_out = (assess.lack_of_fit_p(*m) for m in ((fit.chi2, fit.dof), misfit_out))
    return Tried(effects, fit, error, fit_p, p_out, held_out=misfit_out, counted=own, grown=grown)


def _foreseen(fit: Fit, data: Dataset) -> tuple[Fit, list[assess.Prediction]]:
    """The fit and what it predicts of the held-out runs; where the fitted runs do not tell between
    several values (`Effect.as_well`), with those that predict best."""
    equal = [fit.values | now for e in fit.structure.effects for now in e.as_well(fit.values)]
    fits = [replace(fit, theta=fit.structure.parameters.unknowns(values)) for values in equal]
    if len(fits) < 2 or not data.validation:
        fits = [fit]
    found = [(f, [assess.predict(f.structure, f.theta, b) for b in data.validation]) for f in fits]
    return min(found, key=lambda item: assess.held_out_misfit(item[1], item[0].covariance)[0])


def _tuned(size: Estimate) -> float:
    """How finely the size of a spread had to be tuned: 2 ln(width beforehand / standard error)."""
    return float(np.log1p((DECADE_WIDTH * size.value / size.stderr) ** 2))


def _width(q: Parameter, value: float) -> float:
    """Standard deviation, in its internal unit, of where a number may lie beforehand."""
    if q.kind == "positive" and np.isfinite(q.upper) and q.lower > 0:
        return float(np.log(q.upper / q.lower) / np.sqrt(2 * np.pi))
    return DECADE_WIDTH * (1.0 if q.kind == "positive" else max(abs(value) / q.scale, TINY))


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


def least(tries: Sequence[Tried]) -> float:
    """χ²/dof of the best of them that may be true; 0 of none."""
    likely = (t.fit.chi2_per_dof for t in tries if t.plausible)
    return min(likely, default=np.inf if tries else 0.0)
