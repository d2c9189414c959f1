"""Steps of the search that put runs down to chance: a spread alone, beside a law, or within one.

What is found goes to `UnderWay.tried`; the sets come from `beside_chance`, `spreads` and `stages`.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from identify.assess import lack_of_fit_p
from identify.dataset import Dataset
from identify.effects.scatter import Scatter
from identify.fit import Fit
from identify.residual import soften
from identify.start import fit_from_data
from identify.structure import Structure
from identify.trace.beside_chance import (
    LITTLE,
    beside_chance,
    in_the_place_of_chance,
    other_forms_beside_chance,
    simpler_beside_chance,
    without_chance,
    without_law,
)
from identify.trace.claims import NO_CHANCE
from identify.trace.exchange import in_each_form
from identify.trace.spreads import try_scatters
from identify.trace.stages import try_effects
from identify.trace.tried import (
    ALPHA,
    EVIDENCE,
    Tried,
    astray,
    best_by_name,
    best_form,
    best_of_each_form,
    least,
    misfit,
)
from identify.trace.under_way import UnderWay

#: Shares of each coefficient that count as noise, to see what is greatest: chance, or a law.
CHANCE_SOFTENED, LAW_SOFTENED = (0.001, 0.005, 0.02), (0.005, 0.02)
FOREMOST, FORMS = 2, 4  # laws seen there beside which chance is tried, and forms of each …
ALIKE = 1.05  # … that leave no more than so many times the least


def scattered(
    going: UnderWay, structure: Structure, base: Fit, kinds: Sequence[Scatter] | None = None
) -> list[Tried]:
    """Run-to-run scatter, of some kinds or of all, on top of `structure`; beside what explains
    the data already, as far as it is a rival."""
    good = [t.evidence for t in going.tried if t.explains]
    most = min(good, default=np.inf) + EVIDENCE
    asked = going.scatters if kinds is None else kinds
    return try_scatters(structure, going.data, base, asked, going.run, most)


def try_chance(going: UnderWay, parents: Sequence[Tried]) -> None:
    """Run-to-run scatter beside each of `parents`, and effects beside scatter. Where one kind
    of it explains the data alone, the others do beside a law: what deviates in two ways may
    take the one for the other (41069), and what promises most within it is asked."""
    data, run = going.data, going.run
    going.report(0.6, "trying run-to-run scatter beside an effect")
    good = [t for t in going.tried if t.explains]
    by_law = going.by_law
    for parent in parents:
        if by_law and parent.names[0] not in best_form(good).names:
            continue  # no rival: what explains the data does so without it
        if by_law and parent.fit.chi2_per_dof > NO_CHANCE:
            continue  # nor can what takes that much up be chance
        beside_each_chance(going, parent, _others_by_chance(going))
    if not by_law:
        found = beside_chance(going.spreads_alone, data, going.apart, run)
        other = [o for t in found if t.adequate for o in _by_other_chance(going, t)]
        other += simpler_beside_chance(other, data, going.apart, run)
        _add_beside_chance(going, [*found, *other])

    @cache
    def softened(share: float) -> tuple[Dataset, Fit]:
        soft = replace(data, fit=soften(data.fit, share))
        return soft, fit_from_data(going.structure, soft)

    for shares, seek in (
        (CHANCE_SOFTENED, chance_from_softened),
        (LAW_SOFTENED, law_from_softened),
    ):
        for share in shares:
            # a spread always comes near
            if going.seeking() and least(going.laws) > LITTLE:
                going.report(0.6, f"looking at the data to within {share:.1%}")
                soft, base = softened(share)
                if np.isfinite(base.chi2):
                    seek(going, soft, base)
    if going.seeking() and least(going.laws) > NO_CHANCE:
        likely_beside_chance(going, parents)
    if not going.accounted:
        found = other_forms_beside_chance(going.tried, data, going.apart, run)
        _add_beside_chance(going, found)
    if not going.accounted:
        going.tried += in_the_place_of_chance(going.tried, data, going.apart, run)


def beside_each_chance(
    going: UnderWay, law: Tried, kinds: Sequence[Scatter] | None = None
) -> list[Tried]:
    """Run-to-run scatter, of some kinds or all, beside a law in its form and simpler ones."""
    found = scattered(going, law.fit.structure, law.fit, kinds)
    found += simpler_beside_chance(found, going.data, going.apart, going.run)
    _add_beside_chance(going, found)
    return found


def likely_beside_chance(going: UnderWay, parents: Sequence[Tried]) -> None:
    """Chance beside the best single laws whose values can be true, where no set of laws comes
    near: what leaves less than they do may owe that to a mode that is overdamped (54019, a
    delay of the flame while frequencies wander)."""
    likely = [t for t in going.laws if len(t.effects) == 1 and t.plausible]
    others = [t for t in best_by_name(likely) if all(t is not p for p in parents)]
    for t in others[:FOREMOST]:
        beside_each_chance(going, t)


def chance_from_softened(going: UnderWay, soft: Dataset, base: Fit) -> None:
    """An effect and chance that are both gross lead each other astray. Where noise of some
    share of every coefficient hides the lesser of them, the greater is found by itself: chance,
    and a law within it; or (`law_from_softened`) a law, and chance beside it. What scatters
    leads a fit without it astray however little it leaves then."""
    far = lack_of_fit_p(base.chi2, base.dof) < ALPHA
    spreads = try_scatters(going.structure, soft, base, going.scatters, going.run, far=far)
    found = beside_chance(spreads, going.data, going.apart, going.run)
    found += simpler_beside_chance(found, going.data, going.apart, going.run)
    _add_beside_chance(going, found)


def law_from_softened(going: UnderWay, soft: Dataset, base: Fit) -> None:
    """The same where the law is the greater."""
    laws = try_effects(
        going.structure, soft, base, going.apart, executor=going.run, keep=5,
        far=astray(base), progress=lambda done, text: None,
    )  # fmt: skip
    found = []
    for best in best_by_name(laws)[:FOREMOST]:
        alike = [t for t in laws if t.key == best.key]
        alike += in_each_form(best, soft, going.apart, going.run)
        forms = best_of_each_form(alike)
        # what coarse noise does not tell apart, the noise itself may
        most = ALIKE * misfit(forms[0])
        for t in [t for t in forms if misfit(t) < most][:FORMS]:
            found += scattered(going, t.fit.structure, t.fit)
    found += simpler_beside_chance(found, going.data, going.apart, going.run)
    _add_beside_chance(going, found)


def _add_beside_chance(going: UnderWay, found: Sequence[Tried]) -> None:
    """Sets with a spread, and what is left of those that come to the noise without it, and
    without the law: from where they ended, either may not be needed."""
    going.tried += [*found, *without_chance(found, going.data)]
    known = {t.key_of_forms for t in going.tried if t.spread}
    going.tried += without_law(found, known, going.data, going.run)


def _by_other_chance(going: UnderWay, t: Tried) -> list[Tried]:
    """The law of `t` beside the other kinds of chance: it had been found within one that may
    have done for another (46105, a damping that falls while frequencies wander)."""
    kinds = [s for s in going.scatters if s.key != t.effects[-1].key]
    return scattered(going, t.fit.structure, t.fit, kinds)


def within_other_chance(going: UnderWay) -> list[Tried]:
    """The same for the law that explains the data with a spread beside it: other kinds, tried
    from where the law alone had been led to, may have gone astray (54158, frequencies that
    wander beside a voice coil, claimed as a drive that scatters)."""
    best = going.best
    if best is None or best.spread is None or len(best.effects) != 2:
        return []
    return _by_other_chance(going, best)


def _others_by_chance(going: UnderWay) -> list[Scatter]:
    """Kinds of scatter that do not explain the data by themselves."""
    alone = {t.key_of_forms for t in going.spreads_alone if t.explains}
    return [s for s in going.scatters if (s.key,) not in alone]
