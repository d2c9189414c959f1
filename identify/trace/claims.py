"""What may be claimed: a set of effects that accounts for the misfit, and has no rival.

`claimed` picks the best of the sets that explain the data and names its rivals; `accounts` asks
whether the misfit goes with it, `outdone` whether a shape without a law leaves it far behind.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from identify.chances import chi2_tail, f_tail
from identify.effects import CATALOGUE
from identify.fit import Fit
from identify.results import Candidate
from identify.trace.tried import ALPHA, BEATEN, EVIDENCE, Tried, best_by_name, best_form

WORSE = 1.25  # times the error on held-out runs with fewer effects: as noise alone may have it …
WORSE_P = 0.05  # … and any worse, where noise leaves as much as that by so small a chance
ASTRAY = 3.0  # times the declared model's error on held-out runs, beyond which a spread hides one
MUCH = 30.0  # χ²/dof that a law leaves, or pairs, beyond which they are not near the data
IDLE_P = 0.01  # chance of what an extension gains, above which the data do not ask for it
NO_CHANCE = 300.0  # χ²/dof that no law of a few numbers takes up to the noise by luck


def claimed(good: Sequence[Tried], others: Sequence[Tried]) -> tuple[Tried, list[Tried]]:
    """The best of what explains the data by values, and its rivals among `others`. Which is best
    the fitted runs say; what it extends takes its place where that does as well but for luck
    (68029, a delay claimed as one that is spread), and one that all runs make far likelier."""
    best = best_form(good)
    plainer = [t for t in good if _extends(best, t) and _idle(best, t)]
    best = best_form(plainer or [best])
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
    spread takes these for whatever it widens them to: its fitted runs must speak for it as well,
    and no more for a law of which many numbers were tuned to follow chance than for chance."""
    of_all = t.evidence_of_all - best.evidence_of_all
    if t.spread is None and best.spread is None:
        return of_all
    less = min(of_all, t.evidence - best.evidence)
    return less if best.spread is not None else min(less, _tuned_less(t, best))


def _tuned_less(chance: Tried, law: Tried) -> float:
    """The same for a law, by how finely its numbers and the size of chance had to be tuned."""
    of_all = chance.tuned_evidence - law.tuned_evidence
    return min(of_all, of_all - chance.held_out[0] + law.held_out[0])


def but_for_values(best: Tried, others: Sequence[Tried]) -> list[Tried]:
    """Laws that would be rivals of the law `best`, if their values could be true."""
    near = [
        t
        for t in others
        if best.spread is None
        and t.key != best.key
        and _cannot_be_true(t, best)
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
    """Whether it is far likelier, though its values cannot be true: for a law not known."""
    return _cannot_be_true(t, best) and t.evidence < best.evidence - EVIDENCE


def _cannot_be_true(t: Tried, best: Tried) -> bool:
    """Whether no more effects leave nothing but noise, with values that cannot be true or that the
    data do not tell; chance beside a law, against such a one alone (80206)."""
    like = t.spread is None or best.spread is not None
    return like and t.but_for_values and len(t.effects) <= len(best.effects)


def _chance_rivals(spread: Tried, best: Tried) -> bool:
    if spread.spread is None:
        return False
    if best.spread is not None:
        return spread.plausible and (spread.adequate or len(spread.effects) == 1)
    random = spread.objection in ("", BEATEN)
    less = spread.evidence - best.evidence
    if best.follows_runs:  # its numbers tuned, too (100149, a cycle of three that modulation made)
        less = min(less, _tuned_less(spread, best))
    return spread.adequate and less < (EVIDENCE if random else 0.0)


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


def _idle(t: Tried, plainer: Tried) -> bool:
    """Whether what a law has more than a plainer one gains no more than that would by luck."""
    if t.spread is not None or plainer.spread is not None:
        return False  # their likelihoods decide
    freedom = t.fit.theta.size - plainer.fit.theta.size
    return chi2_tail(plainer.chi2_of_all - t.chi2_of_all, freedom) > IDLE_P


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
    return min(1.0, f_tail(ratio, freedom, count - freedom) * len(CATALOGUE))


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
    either. Near the noise a few runs decide nothing (44014). Not where these runs, each coefficient
    against its own noise, speak against `o` and not against `t`: the error is mostly that of the
    largest coefficients (59024)."""
    if o.validation_p < WORSE_P <= t.validation_p:
        return False
    more = t.validation_error / o.validation_error
    return more > WORSE or (more > 1.0 and t.validation_p < min(WORSE_P, o.validation_p))


def _foretold(t: Tried, error: float) -> bool:
    """Whether held-out runs that a law predicts with that `error` do not scatter as the spread `t`
    has it: they would lie so near to their middle by chance, each along one direction at least."""
    if t.spread is None or not error < t.validation_error < np.inf:
        return False
    runs = sum(b.runs for b in t.spread.data.validation)
    nearer = runs * (error / t.validation_error) ** 2
    return 1.0 - chi2_tail(nearer, runs) < ALPHA


def against_chance(tries: Sequence[Tried], others: Sequence[Tried] = ()) -> list[Tried]:
    """A law that does better than a spread speaks against chance, even one of implausible values,
    or one of `others`: it stands for one that is not known. Not where so many of its numbers were
    tuned to follow the runs that it does not (67196, frequencies that wander, claimed as a cycle
    beside a peak). So does one that comes near and predicts held-out runs far better than they
    would scatter."""
    laws = [t for t in (*tries, *others) if t.spread is None]
    good = [t for t in laws if t.adequate]
    # what misses the fitted runs by far meets a few held-out ones by luck (43096)
    near = [t for t in laws if t.held_out[1] and t.fit.chi2_per_dof < MUCH]
    nearest = min((t.validation_error for t in near), default=np.inf)
    out = []
    for t in tries:
        if t.spread is not None and (_bettered(t, good, by=0.0) or _foretold(t, nearest)):
            spread = replace(t.spread, objection=t.spread.objection or BEATEN, luck=0.0)
            out.append(replace(t, spread=spread))
        else:
            out.append(t)
    return out


def _bettered(t: Tried, others: Sequence[Tried], by: float) -> bool:
    """Whether one of `others` is likelier `by` so much."""
    return any(_likelier(o, t, by) for o in others)


def _likelier(o: Tried, t: Tried, by: float) -> bool:
    """Whether `o` is likelier than `t` `by` so much; a law than chance, with its numbers tuned too,
    and chance than a law by that alone, or however little than one that may follow it."""
    if t.spread is None and o.spread is not None:
        return _tuned_less(o, t) < (0.0 if t.follows_runs else -by)
    tuned = t.spread is not None and o.spread is None
    return o.evidence < t.evidence - by and (not tuned or _tuned_less(t, o) > by)


def unrivalled(tries: Sequence[Tried], pieces: Sequence[Tried]) -> list[Tried]:
    """Spreads are marked where no law comes near the data: none of `tries`, and none of the
    freely shaped `pieces`, which may follow the runs' conditions however they like. Beside a law,
    only that of which no other does as well as to be adequate.

    There is then no law that a spread could hide, and what speaks against it by a small chance
    alone (`tried.LUCK`) is what so many questions bring about now and then.
    """
    laws = [t.fit.chi2_per_dof for t in (*tries, *pieces) if t.spread is None]
    if min(laws, default=0.0) <= NO_CHANCE:
        return list(tries)
    beside = {t.key for t in tries if t.spread is not None and len(t.effects) > 1 and t.adequate}
    return [
        replace(t, spread=replace(t.spread, unrivalled=True))
        if t.spread is not None and (len(t.effects) == 1 or beside == {t.key})
        else t
        for t in tries
    ]


def outdone(t: Tried, pieces: Sequence[Tried]) -> bool:
    """Whether a freely shaped piece, or chance at some place, is far likelier, complexity counted:
    then the cause is one that nobody has named, and `t` only comes near to it."""
    good = [p for p in pieces if (p.adequate if p.spread is None else p.explains)]
    return _bettered(t, good, by=EVIDENCE)


def candidate(t: Tried, declared: Fit, equal: Sequence[str], passed_over: str) -> Candidate:
    """The candidate's line of the report: its gain over the declared model, corrected, and why it
    is `passed_over` if it explains the data."""
    own = {q.name for e in t.effects for q in e.parameters}
    values = {n: e for n, e in t.estimates.items() if n in own}
    if not t.has_values:  # where a fit stopped is no estimate
        values = {n: replace(e, stderr=np.nan) for n, e in values.items()}
    return Candidate(
        effects=t.names,
        forms=tuple(e.form for e in t.effects),
        locations=tuple(e.location for e in t.effects),
        chi2=t.fit.chi2,
        chi2_per_dof=t.fit.chi2_per_dof,
        validation_error=t.validation_error,
        p_value=gain_p(declared.chi2 - t.fit.chi2, t, declared),
        parameters=values,
        equivalent_to=tuple(equal),
        plausible=t.plausible,
        adequate=t.adequate,
        note=_note(t) or passed_over,
    )


def _note(t: Tried) -> str:
    if not t.fit.converged:
        return t.fit.reason
    if not t.plausible:
        return t.implausibility
    if t.spread is None:
        return ""
    return "leaves more than noise" if t.adequate and not t.leaves_noise else ""
