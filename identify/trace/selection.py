"""The search: singles, run-to-run scatter, pairs and triples, and what contests them."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np

from identify.assess import lack_of_fit_p
from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects import CANDIDATES
from identify.effects.scatter import Scatter
from identify.executor import Executor, InProcess, Progress
from identify.fit import Fit, fit_orbits
from identify.residual import soften
from identify.start import fit_from_data, other_minima
from identify.structure import Structure
from identify.trace.beside_chance import (
    LITTLE,
    beside_chance,
    beside_the_same_chance,
    in_the_place_of_chance,
    other_forms_beside_chance,
    simpler_beside_chance,
    without_chance,
    without_law,
)
from identify.trace.claims import MUCH, NO_CHANCE, accounts, against_chance
from identify.trace.contests import (
    BEHIND,
    at_the_same_place,
    in_finer_forms,
    in_their_places,
    reformed,
    runners_up,
    varied,
)
from identify.trace.exchange import in_each_form, in_other_forms, joins, suits
from identify.trace.fewer import eliminate, with_fewer
from identify.trace.foreseen import foreseen
from identify.trace.pairs import pairs_from_afar
from identify.trace.places import shaped, within_a_place
from identify.trace.scores import ScoreTest, chance_test, family_p, score_tests
from identify.trace.singles import Alone, by_itself, try_alone
from identify.trace.stages import (
    as_declared,
    started_again,
    try_effects,
    try_scatters,
    usable,
)
from identify.trace.to_the_end import led_on, settled
from identify.trace.tried import (
    ALPHA,
    EVIDENCE,
    GROSS,
    VISIBLE,
    Tried,
    astray,
    best_by_name,
    best_form,
    best_of_each_form,
    foremost,
    misfit,
    tried,
)

#: Shares of each coefficient that count as noise, to see what is greatest: chance, or a law.
CHANCE_SOFTENED, LAW_SOFTENED = (0.001, 0.005, 0.02), (0.005, 0.02)
FOREMOST, FORMS = 2, 4  # laws seen there beside which chance is tried, and forms of each …
ALIKE = 1.05  # … that leave no more than so many times the least
SHORTENED = 2  # best sets of a level from which the needless is left out even if none explains
PLAINLY = 0.3  # of the declared misfit: what an effect of one number leaves that is grown from too
NOWHERE = 1e-4  # share of a gross misfit: a set that leaves more lacks more than another form
STANDS_OUT = 30.0  # times less misfit than with any other effect
MINIMA = 2  # of the declared model, beside the deepest, from which effects are sought
MISSING = 1e-6  # chance of the scores beside a law below which it lacks another, or chance …
DOUBT = 0.05  # … and of what it leaves, below which either is tried whatever the scores


class Cancelled(Exception):
    """The search was cancelled by its caller."""


@dataclass(frozen=True)
class Search:
    """All that was tried, best first, and what it was tried against."""

    tried: tuple[Tried, ...]
    singles: tuple[Tried, ...]
    pieces: tuple[Tried, ...] = ()  # freely shaped, where they were asked, best first
    whole: bool = True  # False: ended by its time limit before all had been tried


def search(
    structure: Structure,
    data: Dataset,
    base: Fit,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
    catalogue: Sequence[Effect] = CANDIDATES,
    depth: int = 3,
    scores: Mapping[str, ScoreTest] | None = None,
    until: float = np.inf,
) -> Search:
    """Forward selection of up to `depth` effects with backward elimination.

    `scores` are the candidates' tests at the base fit, where they are known already. No step that
    seeks an explanation begins after `until` (`time.monotonic`); what has been found by then is
    contested all the same.
    """
    going = _Searching(
        structure,
        data,
        base,
        executor or InProcess(),
        progress or (lambda share, text: None),
        tuple(e for e in catalogue if usable(e, data, structure)),
        _fuller(catalogue, data, structure),
        tuple(e for e in catalogue if isinstance(e, Scatter)),
        until,
    )
    singles = going.alone(scores)
    level = best_by_name(singles)
    pieces = [] if going.explained or depth < 2 else going.in_one_place()
    places = {t.effects[0].location for t in pieces if t.adequate}
    if places:  # three effects would stand for one that nobody has named …
        depth = min(depth, 2)
    if len(places) == 1 and _least(singles) > GROSS:  # … and so would two, with none that is near
        depth = 1
    for size in range(2, depth + 1):
        # a spread alone does not end the search: a pair may explain the same without chance
        explaining = [t for t in going.tried if t.explains]
        enough = any(t.spread is None or len(t.effects) > 1 or size > 2 for t in explaining)
        if enough or going.late():
            break
        parents = sorted(level, key=_as_a_parent)[:2]
        if size > 2:  # one of two effects may leave much; two of three hardly more than others do
            parents = [t for t in parents if misfit(t) <= BEHIND * misfit(parents[0])]
        if size == 2:
            going.foreseen()
        nowhere = size == 2 and not (places or _a_place_to_grow_from(singles, base))
        found = going.pairs(singles) if nowhere and not going.by_law else []
        if not (going.by_law or (nowhere and going.explained)):
            found = going.grown(parents, found)
        if size == 2 and going.seeking():
            found = going.grown(going.plainest(singles), found)
        if size == 2 and not going.late():
            going.with_chance(parents)
            # what was grown from may have been no part of the matter
            lost = not going.explained or _least(found) > MUCH
            if lost and base.chi2_per_dof > GROSS and not (nowhere or places):
                found += going.pairs(singles)
        level = best_by_name(found)
        if size == 2 and going.seeking():
            level = [*going.of_more_modes(level), *level]
    if going.seeking():
        going.each_alone(scores)
        if depth > 1 and going.seeking():
            going.foreseen()
    going.contest()
    if going.one_more(depth):
        going.contest()
    everything = against_chance(going.tried)
    ranked = tuple(sorted(everything, key=lambda t: (not t.adequate, t.fit.chi2)))
    return Search(ranked, tuple(singles), tuple(pieces), whole=not going.left_out)


@dataclass
class _Searching:
    """A search under way: what it works on, and all that has been tried so far."""

    structure: Structure
    data: Dataset
    base: Fit
    run: Executor
    report: Progress
    available: tuple[Effect, ...]
    fuller: tuple[Effect, ...]  # forms for more modes, beside an effect that brings them
    scatters: tuple[Scatter, ...]
    until: float = np.inf
    left_out: bool = False  # a step, for want of time
    tried: list[Tried] = field(default_factory=list)
    extended: dict[tuple[str, ...], float] = field(default_factory=dict)  # grown from, χ² there …
    done: set[tuple[str, ...]] = field(default_factory=set)  # … and seen to in other forms
    found: set[tuple[str, ...]] = field(default_factory=set)  # alone, and contested

    def late(self) -> bool:
        """Whether no more than what has been found is to be looked at; asked before each step that
        seeks an explanation, which is left out then."""
        if time.monotonic() > self.until:
            self.left_out = True
        return self.left_out

    def seeking(self) -> bool:
        """Whether nothing explains the data yet, and there is time to go on."""
        return not (self.explained or self.late())

    @property
    def apart(self) -> list[Effect]:
        """The forms that need no other to start from."""
        return [e for e in self.available if not e.refines]

    @property
    def forms(self) -> tuple[Effect, ...]:
        """All forms, beside whatever they may stand."""
        return (*self.available, *self.fuller)

    @property
    def explained(self) -> bool:
        return any(t.explains for t in against_chance(self.tried))

    @property
    def accounted(self) -> bool:
        """Whether something explains the data that the misfit goes with, so that it may be said."""
        good = [t for t in against_chance(self.tried) if t.explains]
        return any(accounts(t, self.declared, self.tried) for t in good)

    @cached_property
    def declared(self) -> Tried:
        return tried((), self.base, self.data)

    @cached_property
    def minima(self) -> tuple[Fit, ...]:
        """Other minima of the declared model, where it is near enough to the data to have some."""
        if astray(self.base):
            return ()
        return tuple(other_minima(self.structure, self.data, self.base, BEHIND)[:MINIMA])

    @property
    def by_chance(self) -> bool:
        """Whether a spread explains the data by itself: what else is in them is within it."""
        return any(t.explains for t in self.spreads_alone)

    @property
    def by_law(self) -> bool:
        """Whether laws explain the data without chance."""
        return any(t.explains for t in self.laws)

    @property
    def laws(self) -> list[Tried]:
        return [t for t in self.tried if t.spread is None]

    @property
    def spreads_alone(self) -> list[Tried]:
        return [t for t in self.tried if t.spread is not None and len(t.effects) == 1]

    def alone(self, scores: Mapping[str, ScoreTest] | None) -> list[Tried]:
        """Every effect by itself, and run-to-run scatter."""
        base = self.base
        far = astray(base)
        work = Alone(self.structure, self.data, base, self.available, scores, self.minima, far)
        singles = try_alone(work, self.run, self.report)
        self.tried += singles
        self.found |= {t.key_of_forms for t in singles if t.explains}
        if base.chi2_per_dof < LITTLE or not self.explained:
            self.report(0.6, "trying run-to-run scatter")
            self.tried += self._scattered(self.structure, base)
        return singles

    def contest_alone(self) -> None:
        """Other effects in the place of one that explains the data alone and was not found so: what
        it stood beside was not needed, or it was the only candidate. Nothing has contested it."""
        singles = [t for t in self.laws if len(t.effects) == 1 and t.explains]
        best = best_form(singles).key_of_forms if singles else None
        if best is None or best in self.found:
            return
        self.found.add(best)
        near = at_the_same_place(singles, self.data, self.available, self.run)
        self.tried += [eliminate(t, self.data) if t.explains else t for t in near]

    def each_alone(self, scores: Mapping[str, ScoreTest] | None) -> None:
        """Each effect as if it were the only candidate, where nothing explains the data: of all
        together, only those are led to the end that come nearest at coarse noise. From afar too:
        the declared fit has led nowhere, however little it leaves (59285)."""
        modes = {e.name for e in self.available if e.restated(self.structure) is not None}
        names = list(dict.fromkeys(e.name for e in self.available))
        names.sort(key=lambda name: name not in modes)  # which take longest: not to be waited for
        items = [
            Alone(
                self.structure,
                self.data,
                self.base,
                tuple(e for e in self.available if e.name == name),
                scores,
                self.minima,
                far=self.base.chi2_per_dof > VISIBLE,
            )
            for name in names
        ]
        for i, found in enumerate(self.run.map(by_itself, items), start=1):
            self.tried += found
            self.report(0.9 + 0.05 * i / len(names), f"trying {names[i - 1]} by itself")

    def pairs(self, singles: Sequence[Tried]) -> list[Tried]:
        """Two effects sought at once, unless some together explain the data already."""
        if any(t.explains and len(t.effects) > 1 for t in self.tried):
            return []
        pairs = pairs_from_afar(
            self.structure, self.data, self.base, self.apart, singles, self.run,
            lambda share, text: self.report(0.6 + 0.3 * share, text),
        )  # fmt: skip
        pairs += led_on(pairs, self.data, self.run)
        if _least(pairs) <= GROSS:
            pairs += self._in_other_forms(pairs)
        self.tried += [eliminate(t, self.data) if t.explains else t for t in pairs]
        return pairs

    def grown(self, parents: Sequence[Tried], afar: Sequence[Tried] = ()) -> list[Tried]:
        """One effect more on top of each of `parents`; sets of as many found from `afar` too."""
        grown: list[Tried] = []
        far = astray(self.base) and not self.explained
        for parent in parents:
            self.extended[parent.key_of_forms] = parent.fit.chi2
            rest = [
                e
                for e in (*self.apart, *self.fuller)
                if joins(e, parent.effects) and suits(e, self.structure, parent.effects)
            ]
            grown += try_effects(
                parent.fit.structure, self.data, parent.fit, rest, executor=self.run, keep=5,
                far=False, progress=lambda share, text: self.report(0.6 + 0.35 * share, text),
            )  # fmt: skip
        if not grown:
            return list(afar)
        if far and not any(t.adequate for t in grown):
            grown = started_again(grown, self.data, self.run)
        grown += led_on(grown, self.data, self.run)
        # what comes near may have values that only its form makes implausible
        near = min(t.fit.chi2_per_dof for t in (*grown, *afar))
        if near <= max(GROSS, NOWHERE * self.base.chi2_per_dof):
            grown += self._in_other_forms([*grown, *afar])
        # what leaves a misfit is no better for having less in it; the best are shown without
        best = best_by_name(grown)[:SHORTENED]
        for t in grown:
            shorten = t.adequate or any(t is b for b in best)
            self.tried.append(eliminate(t, self.data) if shorten else t)
        return [*grown, *afar]

    def plainest(self, singles: Sequence[Tried]) -> list[Tried]:
        """The best of the effects of one number, where it takes away most of the misfit and has not
        been grown from: those of several follow whatever else there is, and leave less (45205, a
        delay of the speaker and a drift, behind three numbers of a nonlinear loss)."""
        plain = [t for t in singles if len(t.effects[0].parameters) == 1 and t.plausible]
        best = min(plain, key=_as_a_parent, default=None)
        if best is None or best.key_of_forms in self.extended:
            return []
        return [best] if misfit(best) < PLAINLY * self.base.chi2 else []

    def foreseen(self) -> None:
        """The pairs that promise most beside each effect alone."""
        self.report(0.95, "fitting pairs that the score tests foresee")
        alone = [t for t in self.laws if len(t.effects) == 1 and t.plausible and t.fit.converged]
        known = {t.key_of_forms for t in self.laws if t.plausible}
        singles = best_of_each_form(alone)
        self.tried += foreseen(singles, self.data, self.apart, known, self.run)

    def one_more(self, depth: int) -> bool:
        """Whether a claim has lacked one effect more: any, beside what hardly leaves noise, or a
        law, as the score tests beside it say beyond doubt. The lesser of two may stay under the
        threshold of what must be explained, and a law whose shape is unknown has no score test. Of
        several, one in another form may be all that is lacking."""
        best = self._best_law
        if best is None or len(best.effects) >= depth:
            return False
        lacking = self._lacks_a_law(best)
        if lacking and len(best.effects) > 1 and not self.late():
            known = {t.key_of_forms for t in self.tried}
            self.tried += in_each_form(
                best, self.data, self.available, self.run, known, richer=True
            )
            better = self._best_law
            if better is not None and better is not best:
                best, lacking = better, self._lacks_a_law(better)
        found: list[Tried] = []
        deviating = [
            kind
            for kind in self.scatters
            if best.fit_p < DOUBT or self._deviates(best, kind) < MISSING
        ]
        if deviating and not self.late():
            found += self._beside_each_chance(best, deviating)
        if lacking and not self.late():
            found += self.grown([best])
        return any(t.explains and best.parts < t.parts for t in found)

    @property
    def _best_law(self) -> Tried | None:
        """What would be claimed, if that is without chance."""
        good = [t for t in against_chance(self.tried) if t.explains]
        best = best_form(good) if good else None
        return None if best is None or best.spread is not None else best

    def _lacks_a_law(self, best: Tried) -> bool:
        """Whether it hardly leaves noise, or what it leaves follows another law beyond doubt; no
        more, where it has been grown from."""
        if best.key_of_forms in self.extended:
            return False
        if best.fit_p < DOUBT:
            return True
        more = [e for e in self.apart if joins(e, best.effects)]
        scores = score_tests(best.fit.structure, self.data, best.fit, more, self.run)
        return family_p(list(scores.values())) < MISSING

    def _deviates(self, law: Tried, kind: Scatter) -> float:
        """Chance that noise alone makes the runs deviate so from a law as from this kind of it."""
        test = chance_test(law.fit.structure, self.data, law.fit, kind)
        return 1.0 if test is None else test.p_value

    def of_more_modes(self, level: Sequence[Tried]) -> list[Tried]:
        """Several modes more, from the data alone, where they leave less than all of `level`: more
        of them than of other effects may be missing, and no pair comes near then."""
        least = min((misfit(t) for t in level), default=np.inf)
        if least <= GROSS * self.base.dof:
            return []
        self.report(0.6, "trying several modes more")
        several = [e for e in self.available if e.refines and e.restated(self.structure)]
        fits = self.run.map(as_declared, [(self.structure, self.data, e) for e in several])
        found = [tried(f.structure.effects, f, self.data) for f in fits if np.isfinite(f.chi2)]
        self.tried += found
        return [t for t in found if misfit(t) < least]

    def _in_other_forms(self, found: Sequence[Tried]) -> list[Tried]:
        """Other forms of the best of `found`, if nothing explains the data."""
        if self.by_chance or any(t.explains for t in found) or self.late():
            return []
        self.report(0.6, "trying other forms of the best")
        others = reformed(found, self.data, self.forms, self.run, self.done)
        return [*others, *led_on(others, self.data, self.run)]

    def with_chance(self, parents: Sequence[Tried]) -> None:
        """Run-to-run scatter beside each of `parents`, and effects beside scatter. Where one kind
        of it explains the data alone, the others do beside a law: what deviates in two ways may
        take the one for the other (41069), and what promises most within it is asked."""
        data, run = self.data, self.run
        self.report(0.6, "trying run-to-run scatter beside an effect")
        good = [t for t in self.tried if t.explains]
        by_law = self.by_law
        for parent in parents:
            if by_law and parent.names[0] not in best_form(good).names:
                continue  # no rival: what explains the data does so without it
            if by_law and parent.fit.chi2_per_dof > NO_CHANCE:
                continue  # nor can what takes that much up be chance
            self._beside_each_chance(parent, self._others_by_chance)
        if not by_law:
            found = beside_chance(self.spreads_alone, data, self.apart, run)
            other = [o for t in found if t.adequate for o in self._by_other_chance(t)]
            other += simpler_beside_chance(other, data, self.apart, run)
            self._add_beside_chance([*found, *other])

        @cache
        def softened(share: float) -> tuple[Dataset, Fit]:
            soft = replace(data, fit=soften(data.fit, share))
            return soft, fit_from_data(self.structure, soft)

        for shares, seek in (
            (CHANCE_SOFTENED, self._chance_from_softened),
            (LAW_SOFTENED, self._law_from_softened),
        ):
            for share in shares:
                # a spread always comes near
                if self.seeking() and _least(self.laws) > LITTLE:
                    self.report(0.6, f"looking at the data to within {share:.1%}")
                    soft, base = softened(share)
                    if np.isfinite(base.chi2):
                        seek(soft, base)
        if self.seeking() and _least(self.laws) > NO_CHANCE:
            self._likely_beside_chance(parents)
        if not self.accounted:
            found = other_forms_beside_chance(self.tried, data, self.apart, run)
            self._add_beside_chance(found)
        if not self.accounted:
            self.tried += in_the_place_of_chance(self.tried, data, self.apart, run)

    def _beside_each_chance(
        self, law: Tried, kinds: Sequence[Scatter] | None = None
    ) -> list[Tried]:
        """Run-to-run scatter, of some kinds or all, beside a law in its form and simpler ones."""
        found = self._scattered(law.fit.structure, law.fit, kinds)
        found += simpler_beside_chance(found, self.data, self.apart, self.run)
        self._add_beside_chance(found)
        return found

    def _likely_beside_chance(self, parents: Sequence[Tried]) -> None:
        """Chance beside the best single laws whose values can be true, where no set of laws comes
        near: what leaves less than they do may owe that to a mode that is overdamped (54019, a
        delay of the flame while frequencies wander)."""
        likely = [t for t in self.laws if len(t.effects) == 1 and t.plausible]
        others = [t for t in best_by_name(likely) if all(t is not p for p in parents)]
        for t in others[:FOREMOST]:
            self._beside_each_chance(t)

    def _chance_from_softened(self, soft: Dataset, base: Fit) -> None:
        """An effect and chance that are both gross lead each other astray. Where noise of some
        share of every coefficient hides the lesser of them, the greater is found by itself: chance,
        and a law within it; or (`_law_from_softened`) a law, and chance beside it. What scatters
        leads a fit without it astray however little it leaves then."""
        far = lack_of_fit_p(base.chi2, base.dof) < ALPHA
        spreads = try_scatters(self.structure, soft, base, self.scatters, self.run, far=far)
        found = beside_chance(spreads, self.data, self.apart, self.run)
        found += simpler_beside_chance(found, self.data, self.apart, self.run)
        self._add_beside_chance(found)

    def _law_from_softened(self, soft: Dataset, base: Fit) -> None:
        """The same where the law is the greater."""
        laws = try_effects(
            self.structure, soft, base, self.apart, executor=self.run, keep=5,
            far=astray(base), progress=lambda done, text: None,
        )  # fmt: skip
        found = []
        for best in best_by_name(laws)[:FOREMOST]:
            alike = [t for t in laws if t.key == best.key]
            alike += in_each_form(best, soft, self.apart, self.run)
            forms = best_of_each_form(alike)
            # what coarse noise does not tell apart, the noise itself may
            most = ALIKE * misfit(forms[0])
            for t in [t for t in forms if misfit(t) < most][:FORMS]:
                found += self._scattered(t.fit.structure, t.fit)
        found += simpler_beside_chance(found, self.data, self.apart, self.run)
        self._add_beside_chance(found)

    def _add_beside_chance(self, found: Sequence[Tried]) -> None:
        """Sets with a spread, and what is left of those that come to the noise without it, and
        without the law: from where they ended, either may not be needed."""
        self.tried += [*found, *without_chance(found, self.data)]
        known = {t.key_of_forms for t in self.tried if t.spread}
        self.tried += without_law(found, known, self.data, self.run)

    def _by_other_chance(self, t: Tried) -> list[Tried]:
        """The law of `t` beside the other kinds of chance: it had been found within one that may
        have done for another (46105, a damping that falls while frequencies wander)."""
        kinds = [s for s in self.scatters if s.key != t.effects[-1].key]
        return self._scattered(t.fit.structure, t.fit, kinds)

    def _beside_other_chance(self) -> list[Tried]:
        """The same for the law that explains the data with a spread beside it: other kinds, tried
        from where the law alone had been led to, may have gone astray (54158, frequencies that
        wander beside a voice coil, claimed as a drive that scatters)."""
        good = [t for t in against_chance(self.tried) if t.explains]
        best = best_form(good) if good else None
        if best is None or best.spread is None or len(best.effects) != 2:
            return []
        return self._by_other_chance(best)

    @property
    def _others_by_chance(self) -> list[Scatter]:
        """Kinds of scatter that do not explain the data by themselves."""
        alone = {t.key_of_forms for t in self.spreads_alone if t.explains}
        return [s for s in self.scatters if (s.key,) not in alone]

    def _scattered(
        self, structure: Structure, base: Fit, kinds: Sequence[Scatter] | None = None
    ) -> list[Tried]:
        """Run-to-run scatter, of some kinds or of all, on top of `structure`; beside what explains
        the data already, as far as it is a rival."""
        good = [t.evidence for t in self.tried if t.explains]
        most = min(good, default=np.inf) + EVIDENCE
        asked = self.scatters if kinds is None else kinds
        return try_scatters(structure, self.data, base, asked, self.run, most)

    def in_one_place(self) -> list[Tried]:
        """Two effects of the place whose freely shaped piece explains the data; the pieces."""

        def report(share: float, text: str) -> None:
            self.report(0.6 + 0.05 * share, text)

        data, run = self.data, self.run
        pieces = shaped(self.structure, data, self.base, self.tried, run, report)
        found = within_a_place(self.structure, data, pieces, self.apart, run, report)
        self.tried += [eliminate(t, data) if t.explains else t for t in found]
        return pieces

    def contest(self) -> None:
        """What might do as well as the best is tried before it is claimed, and, where nothing can
        be, the foremost of what does not explain the data in other forms."""
        for seek in (reformed, varied):
            if self.seeking():
                self.tried += seek(self.laws, self.data, self.forms, self.run, self.done)
        self._contest()
        first = foremost([t for t in self.laws if t.plausible])
        if self.explained and not self.accounted and first is not None and not first.explains:
            self.report(0.95, "trying other forms of the foremost")
            others = reformed([first], self.data, self.forms, self.run, self.done)
            self.tried += others
            if any(t.explains for t in others):
                self._contest()

    def _contest(self) -> None:
        data, run = self.data, self.run
        self.tried += runners_up(self.tried, data, self.forms, run, self.done)
        several = [t for t in self.laws if len(t.effects) > 1]
        if any(t.explains for t in several):
            self.tried += in_other_forms(several, data, self.forms, run)
        near = at_the_same_place(several, data, self.available, run)
        self.tried += [eliminate(t, data) if t.explains else t for t in near]
        self.contest_alone()
        self.tried += in_their_places(self.tried, data, self.apart, run, self.extended, self.report)
        self.contest_alone()
        self.tried += beside_the_same_chance(self.tried, data, self.apart, run, self.report)
        self.tried += self._beside_other_chance()
        self.tried += in_finer_forms(self.tried, data, self.forms, run)
        self.tried += settled(self.tried, data, run)


def _a_place_to_grow_from(singles: Sequence[Tried], base: Fit) -> bool:
    """Whether the best single leaves little, or so much less than any other, or than there is
    without it, that it is surely part of the matter."""
    best = [t.fit.chi2_per_dof for t in best_by_name(singles)]
    if not best:
        return False
    others = min([*best[1:], np.inf])
    return best[0] <= GROSS or STANDS_OUT * best[0] < max(others, base.chi2_per_dof / STANDS_OUT)


def _as_a_parent(t: Tried) -> float:
    """Misfit; what has not converged may be at no place to grow from."""
    return misfit(t) * (1.0 if t.fit.converged else BEHIND)


def _least(tries: Sequence[Tried]) -> float:
    """χ²/dof of the best of them that may be true; 0 of none."""
    likely = (t.fit.chi2_per_dof for t in tries if t.plausible)
    return min(likely, default=np.inf if tries else 0.0)


def without_effects(structure: Structure, data: Dataset, tries: Sequence[Tried]) -> Fit | None:
    """The declared model fitted from where the best of `tries` ended, their effects left out, and
    from what would be claimed.

    None where nothing finite comes of it. Several effects that do equally well are often a sign
    that the declared fit itself had ended in the wrong minimum.
    """
    count = len(structure.parameters)
    best = sorted((t for t in tries if np.isfinite(t.fit.chi2)), key=misfit)[:4]
    if not best:
        return None
    good = [t for t in tries if t.explains]
    claimed = [best_form(good)] if good else []
    thetas = np.stack([t.fit.theta[:count] for t in (*best, *claimed)])
    fits = [fit_orbits(structure, data, thetas, continuation=(0.003, 0.0))]
    # a mode may be one of the declared ones, of which one then stands for nothing
    one_more = [t for t in claimed if any(e.restated(structure) for e in t.effects)]
    fits += [with_fewer(t, structure.effects, data) for t in one_more]
    fit = min(fits, key=lambda f: f.chi2)
    return fit if np.isfinite(fit.chi2) else None


def refitted(tries: Sequence[Tried], data: Dataset) -> list[Tried]:
    """Laws fitted to `data`, whose covariances have changed, from where they ended; best first."""
    fits = [fit_orbits(t.fit.structure, data, t.fit.theta, continuation=(0.0,)) for t in tries]
    found = [tried(f.structure.effects, f, data) for f in fits if np.isfinite(f.chi2)]
    return sorted(found, key=misfit)


def _fuller(catalogue: Sequence[Effect], data: Dataset, structure: Structure) -> tuple[Effect, ...]:
    """Forms for one mode or two more than declared that are not there for the declared ones."""
    known = {e.key for e in catalogue if usable(e, data, structure)}
    out: list[Effect] = []
    for added in (1, 2):
        more = replace(structure, mode_count=structure.mode_count + added)
        found = (e for e in catalogue if e.mode_count is not None and usable(e, data, more))
        out += [e for e in found if e.key not in known and not e.refines]
    return tuple(out)
