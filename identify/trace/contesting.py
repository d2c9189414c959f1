"""What contests the best of a search before it is claimed, and what it may have lacked.

Other forms, others in the place of each and of all, the same law beside other chance; then, where
what is left follows another law or deviates by chance beyond doubt, one effect more.
"""

from identify.effects.scatter import Scatter
from identify.trace.beside_chance import beside_the_same_chance
from identify.trace.chance_steps import beside_each_chance, within_other_chance
from identify.trace.contests import (
    at_the_same_place,
    in_finer_forms,
    in_their_places,
    of_the_dismissed,
    reformed,
    runners_up,
    varied,
)
from identify.trace.exchange import in_each_form, in_other_forms, joins
from identify.trace.fewer import eliminate
from identify.trace.law_steps import grow
from identify.trace.scores import chance_test, family_p, score_tests
from identify.trace.to_the_end import settled
from identify.trace.tried import Tried, best_form, foremost
from identify.trace.under_way import UnderWay

MISSING = 1e-6  # chance of the scores beside a law below which it lacks another, or chance …
DOUBT = 0.05  # … and of what it leaves, below which either is tried whatever the scores


def contest(going: UnderWay) -> None:
    """What might do as well as the best is tried before it is claimed, and, where nothing can
    be, or a law beside chance alone, the foremost of what does not explain the data in other forms
    (100254, a side resonator beside a flame that saturates, of which other forms left thousands of
    times the noise: a drive that scatters had stood for it)."""
    for seek in (reformed, varied):
        if going.seeking():
            going.tried += seek(going.laws, going.data, going.forms, going.run, going.done)
    _contest_once(going)
    first = foremost([t for t in going.laws if t.plausible])
    sure = going.accounted and (going.by_law or going.by_chance)
    if going.explained and not sure and first is not None and not first.explains:
        going.report(0.95, "trying other forms of the foremost")
        others = reformed([first], going.data, going.forms, going.run, going.done)
        going.tried += others
        if any(t.explains for t in others):
            _contest_once(going)


def _contest_once(going: UnderWay) -> None:
    data, run = going.data, going.run
    going.tried += runners_up(going.tried, data, going.forms, run, going.done)
    several = [t for t in going.laws if len(t.effects) > 1]
    if any(t.explains for t in several):
        going.tried += in_other_forms(several, data, going.forms, run)
    near = at_the_same_place(several, data, going.available, run)
    going.tried += [eliminate(t, data) if t.explains else t for t in near]
    contest_alone(going)
    going.tried += in_their_places(
        going.tried, data, going.apart, run, going.extended, going.report
    )
    contest_alone(going)
    going.tried += beside_the_same_chance(going.tried, data, going.apart, run, going.report)
    going.tried += within_other_chance(going)
    going.tried += in_finer_forms(going.tried, data, going.forms, run)
    going.tried += of_the_dismissed(going.tried, data, going.forms, run)
    going.tried += settled(going.tried, data, run)


def contest_alone(going: UnderWay) -> None:
    """Other effects in the place of one that explains the data alone and was not found so: what
    it stood beside was not needed, or it was the only candidate. Nothing has contested it."""
    singles = [t for t in going.laws if len(t.effects) == 1 and t.explains]
    best = best_form(singles).key_of_forms if singles else None
    if best is None or best in going.found:
        return
    going.found.add(best)
    near = at_the_same_place(singles, going.data, going.available, going.run)
    going.tried += [eliminate(t, going.data) if t.explains else t for t in near]


def one_more(going: UnderWay, depth: int) -> bool:
    """Whether a claim has lacked one effect more: any, beside what hardly leaves noise, or a
    law, as the score tests beside it say beyond doubt. The lesser of two may stay under the
    threshold of what must be explained, and a law whose shape is unknown has no score test. Of
    several, one in another form may be all that is lacking."""
    best = going.best_law
    if best is None or len(best.effects) >= depth:
        return False
    lacking = _lacks_a_law(going, best)
    if lacking and len(best.effects) > 1 and not going.late():
        known = {t.key_of_forms for t in going.tried}
        going.tried += in_each_form(
            best, going.data, going.available, going.run, known, richer=True
        )
        better = going.best_law
        if better is not None and better is not best:
            best, lacking = better, _lacks_a_law(going, better)
    found: list[Tried] = []
    deviating = [
        kind
        for kind in going.scatters
        if best.fit_p < DOUBT or _deviates(going, best, kind) < MISSING
    ]
    if deviating and not going.late():
        found += beside_each_chance(going, best, deviating)
    if lacking and not going.late():
        found += grow(going, [best])
    return any(t.explains and best.parts < t.parts for t in found)


def _lacks_a_law(going: UnderWay, best: Tried) -> bool:
    """Whether it hardly leaves noise, or what it leaves follows another law beyond doubt; no
    more, where it has been grown from."""
    if best.key_of_forms in going.extended:
        return False
    if best.fit_p < DOUBT:
        return True
    more = [e for e in going.apart if joins(e, best.effects)]
    scores = score_tests(best.fit.structure, going.data, best.fit, more, going.run)
    return family_p(list(scores.values())) < MISSING


def _deviates(going: UnderWay, law: Tried, kind: Scatter) -> float:
    """Chance that noise alone makes the runs deviate so from a law as from this kind of it."""
    test = chance_test(law.fit.structure, going.data, law.fit, kind)
    return 1.0 if test is None else test.p_value
