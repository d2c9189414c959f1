"""Steps of the search that add laws: each alone, two at once, one more, two of one place.

Each returns what it found, which goes to `UnderWay.tried` without what turned out needless.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from identify.trace.again import started_again
from identify.trace.beside_chance import LITTLE
from identify.trace.chance_steps import scattered
from identify.trace.contests import reformed
from identify.trace.exchange import joins, suits
from identify.trace.fewer import eliminate
from identify.trace.foreseen import foreseen
from identify.trace.pairs import pairs_from_afar
from identify.trace.places import shaped, within_a_place
from identify.trace.restated import as_declared
from identify.trace.scores import ScoreTest
from identify.trace.singles import Alone, by_itself, try_alone
from identify.trace.stages import try_effects
from identify.trace.to_the_end import led_on
from identify.trace.tried import (
    GROSS,
    VISIBLE,
    Tried,
    astray,
    best_by_name,
    best_of_each_form,
    least,
    misfit,
    tried,
)
from identify.trace.under_way import UnderWay, as_a_parent

SHORTENED = 2  # best sets of a level from which the needless is left out even if none explains
PLAINLY = 0.3  # of the declared misfit: what an effect of one number leaves that is grown from too
NOWHERE = 1e-4  # share of a gross misfit: a set that leaves more lacks more than another form


def try_singles(going: UnderWay, scores: Mapping[str, ScoreTest] | None) -> list[Tried]:
    """Every effect by itself, and run-to-run scatter."""
    base = going.base
    far = astray(base)
    work = Alone(going.structure, going.data, base, going.available, scores, going.minima, far)
    singles = try_alone(work, going.run, going.report)
    going.tried += singles
    going.found |= {t.key_of_forms for t in singles if t.explains}
    if base.chi2_per_dof < LITTLE or not going.explained:
        going.report(0.6, "trying run-to-run scatter")
        going.tried += scattered(going, going.structure, base)
    return singles


def try_each_alone(going: UnderWay, scores: Mapping[str, ScoreTest] | None) -> None:
    """Each effect as if it were the only candidate, where nothing explains the data: of all
    together, only those are led to the end that come nearest at coarse noise. From afar too:
    the declared fit has led nowhere, however little it leaves (59285)."""
    modes = {e.name for e in going.available if e.restated(going.structure) is not None}
    names = list(dict.fromkeys(e.name for e in going.available))
    names.sort(key=lambda name: name not in modes)  # which take longest: not to be waited for
    items = [
        Alone(
            going.structure,
            going.data,
            going.base,
            tuple(e for e in going.available if e.name == name),
            scores,
            going.minima,
            far=going.base.chi2_per_dof > VISIBLE,
        )
        for name in names
    ]
    for i, found in enumerate(going.run.map(by_itself, items), start=1):
        going.tried += found
        going.report(0.9 + 0.05 * i / len(names), f"trying {names[i - 1]} by itself")


def try_pairs(going: UnderWay, singles: Sequence[Tried]) -> list[Tried]:
    """Two effects sought at once, unless some together explain the data already, or chance alone:
    gross laws leave no runs that lie at random along the directions that it knows."""
    if going.by_chance or any(t.explains and len(t.effects) > 1 for t in going.tried):
        return []
    pairs = pairs_from_afar(
        going.structure, going.data, going.base, going.apart, singles, going.run,
        lambda share, text: going.report(0.6 + 0.3 * share, text),
    )  # fmt: skip
    pairs += led_on(pairs, going.data, going.run)
    if least(pairs) <= GROSS:
        pairs += _reform(going, pairs)
    going.tried += [eliminate(t, going.data) if t.explains else t for t in pairs]
    return pairs


def grow(going: UnderWay, parents: Sequence[Tried], afar: Sequence[Tried] = ()) -> list[Tried]:
    """One effect more on top of each of `parents`; sets of as many found from `afar` too."""
    grown: list[Tried] = []
    far = astray(going.base) and not going.explained
    for parent in parents:
        going.extended[parent.key_of_forms] = parent.fit.chi2
        rest = [
            e
            for e in (*going.apart, *going.only_fuller)
            if joins(e, parent.effects) and suits(e, going.structure, parent.effects)
        ]
        grown += try_effects(
            parent.fit.structure, going.data, parent.fit, rest, executor=going.run, keep=5,
            far=False, progress=lambda share, text: going.report(0.6 + 0.35 * share, text),
        )  # fmt: skip
    if not grown:
        return list(afar)
    if far and not any(t.adequate for t in grown):
        grown = started_again(grown, going.data, going.run)
    grown += led_on(grown, going.data, going.run)
    # what comes near may have values that only its form makes implausible
    near = min(t.fit.chi2_per_dof for t in (*grown, *afar))
    if near <= max(GROSS, NOWHERE * going.base.chi2_per_dof):
        grown += _reform(going, [*grown, *afar])
    # what leaves a misfit is no better for having less in it; the best are shown without
    best = best_by_name(grown)[:SHORTENED]
    for t in grown:
        shorten = t.adequate or any(t is b for b in best)
        going.tried.append(eliminate(t, going.data) if shorten else t)
    return [*grown, *afar]


def plainest(going: UnderWay, singles: Sequence[Tried]) -> list[Tried]:
    """The best of the effects of one number, where it takes away most of the misfit and has not
    been grown from: those of several follow whatever else there is, and leave less (45205, a
    delay of the speaker and a drift, behind three numbers of a nonlinear loss)."""
    plain = [t for t in singles if len(t.effects[0].parameters) == 1 and t.plausible]
    best = min(plain, key=as_a_parent, default=None)
    if best is None or best.key_of_forms in going.extended:
        return []
    return [best] if misfit(best) < PLAINLY * going.base.chi2 else []


def try_foreseen(going: UnderWay, last: bool = False) -> None:
    """The pairs that promise most beside each effect alone; where nothing is grown any more, at
    `last`, the best of them led on, and in other forms (67315, a speaker that compresses and a
    flame that saturates, both gross)."""
    going.report(0.95, "fitting pairs that the score tests foresee")
    alone = [t for t in going.laws if len(t.effects) == 1 and t.plausible and t.fit.converged]
    known = {t.key_of_forms for t in going.laws if t.plausible}
    singles = best_of_each_form(alone)
    found = foreseen(singles, going.data, going.apart, known, going.run)
    if last:
        found += led_on(found, going.data, going.run)
        found += _reform(going, found)
    going.tried += found


def try_more_modes(going: UnderWay, level: Sequence[Tried]) -> list[Tried]:
    """Several modes more, from the data alone, where they leave less than all of `level`: more
    of them than of other effects may be missing, and no pair comes near then."""
    nearest = min((misfit(t) for t in level), default=np.inf)
    if nearest <= GROSS * going.base.dof:
        return []
    going.report(0.6, "trying several modes more")
    several = [e for e in going.available if e.refines and e.restated(going.structure)]
    fits = going.run.map(as_declared, [(going.structure, going.data, e) for e in several])
    found = [tried(f.structure.effects, f, going.data) for f in fits if np.isfinite(f.chi2)]
    going.tried += found
    return [t for t in found if misfit(t) < nearest]


def _reform(going: UnderWay, found: Sequence[Tried]) -> list[Tried]:
    """Other forms of the best of `found`, if nothing explains the data."""
    if going.by_chance or any(t.explains for t in found) or going.late():
        return []
    going.report(0.6, "trying other forms of the best")
    others = reformed(found, going.data, going.forms, going.run, going.done)
    return [*others, *led_on(others, going.data, going.run)]


def try_one_place(going: UnderWay) -> list[Tried]:
    """Two effects of the place whose freely shaped piece explains the data; the pieces."""

    def report(share: float, text: str) -> None:
        going.report(0.6 + 0.05 * share, text)

    data, run = going.data, going.run
    pieces = shaped(going.structure, data, going.base, going.tried, run, report)
    found = within_a_place(going.structure, data, pieces, going.apart, run, report)
    going.tried += [eliminate(t, data) if t.explains else t for t in found]
    return pieces
