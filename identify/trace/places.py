"""Where in the loop lies what no known effect explains.

A freely shaped piece (`identify.effects.shaped`) is put at each place of the loop in turn and
fitted like an effect, from the declared fit and from what the best effects make of the declared
model. The place whose piece takes up most of the misfit, clearly more than any other, is where it
lies; a place whose piece takes up little is where it is not. A known effect that leaves less than
the piece of its place speaks for that place: not every law is as smooth as the pieces are. Where no
piece explains the data, a memory is asked, and chance: runs that each deviate by themselves.
"""

from collections.abc import Sequence

import numpy as np

from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects.shaped import CHANCES, PIECES, Setting, Shaped, ShapedMemory
from identify.executor import Executor, Progress
from identify.fit import Fit, fit_orbits, no_better
from identify.results import PARTLY, Whereabouts
from identify.start import CoarseStart, candidates, coarse, physical_starts, polish
from identify.structure import Structure
from identify.trace.exchange import joins
from identify.trace.fewer import part_of
from identify.trace.restated import renamed
from identify.trace.sizes import ROUGH, known_sizes, shares_of
from identify.trace.spreads import try_scatters
from identify.trace.stages import try_effects
from identify.trace.tried import EVIDENCE, Tried, best_by_name, first_of_each, misfit
from identify.trace.tried import tried as as_tried
from identify.trace.usable import knows_pressure, usable

CLEARLY = 3.0  # times the χ² of the best place: what leaves more is ruled out
TAKEN = 0.3  # share of the excess over noise that the best place may leave …
LITTLE = 0.6  # … and any that is not ruled out
FAR_LESS = 10.0  # times less χ² than any one place leaves: two places then
STARTS, AFAR = 3, 4  # that are led on, of each kind; that are looked at from afar
PLACES, PARENTS = 2, 2  # of which two effects are sought together, and from how many first ones


def _place(t: Tried) -> str:
    return t.effects[0].location


def _likely(places: Sequence[Tried], before: float) -> tuple[str, ...]:
    """Those not ruled out: by a third of the χ², by how little they take up, or, where the best
    explains the data, by the evidence; none where even the best leaves much of the misfit."""
    if not places:
        return ()
    best = places[0]
    if not best.fit.chi2_per_dof - 1.0 < TAKEN * (before - 1.0):
        return ()
    limit = min(CLEARLY * max(best.fit.chi2_per_dof, 1.0), 1.0 + LITTLE * (before - 1.0))
    return tuple(
        _place(t)
        for t in places
        if t.fit.chi2_per_dof <= limit
        and not (best.adequate and t.evidence > best.evidence + EVIDENCE)
    )


def shaped(
    structure: Structure,
    data: Dataset,
    base: Fit,
    tried: Sequence[Tried],
    executor: Executor,
    progress: Progress,
    shapes: Sequence[type[Shaped]] = PIECES,
) -> list[Tried]:
    """The pieces of each place, started from the declared fit and from what the best of `tried`
    make of the declared model; best first."""
    setting = Setting(
        data.free_hz,
        structure.mode_count,
        known_sizes(data, base).velocity_amplitude,
        knows_pressure(data),
        structure.highest_power,
    )
    every = (piece(setting) for piece in shapes)
    differing = first_of_each(every, lambda p: p.parameters)  # of one mode two are the same
    pieces = [p for p in differing.values() if usable(p, data, structure)]
    best = sorted((t for t in tried if t.plausible), key=lambda t: t.fit.chi2)[:2]
    bases = [base, *(part_of(t, (), data) for t in best)]
    found = []
    for i, fit in enumerate(executor.map(_shape, [(structure, data, p, bases) for p in pieces])):
        progress((i + 1) / len(pieces), f"shaping the {pieces[i].location} freely")
        if fit is not None and np.isfinite(fit.chi2):
            found.append(as_tried(fit.structure.effects, fit, data))
    return sorted(found, key=misfit)


def remembering(
    structure: Structure,
    data: Dataset,
    base: Fit,
    executor: Executor,
    progress: Progress,
) -> list[Tried]:
    """A memory, which takes longer: for where none of `shaped` explains the data. From the declared
    fit alone: what stands for a memory, no other place's law comes near."""
    return shaped(structure, data, base, (), executor, progress, (ShapedMemory,))


def deviating(
    structure: Structure,
    data: Dataset,
    base: Fit,
    executor: Executor,
    rivalled: Tried | None = None,
) -> list[Tried]:
    """Runs that each deviate by themselves, at each place where they may; as rivals of what
    explains the data, from where that has ended and no less likely."""
    if rivalled is None:
        return try_scatters(structure, data, base, CHANCES, executor)
    begun = part_of(rivalled, (), data)  # as loud as `rivalled`: not sought from afar
    return try_scatters(structure, data, begun, CHANCES, executor, rivalled.evidence)


def within_a_place(
    structure: Structure,
    data: Dataset,
    pieces: Sequence[Tried],
    available: Sequence[Effect],
    executor: Executor,
    progress: Progress,
) -> list[Tried]:
    """One effect or two of the same place, where its freely shaped piece explains the data.

    From what the piece makes of the declared model: two that both distort what the declared fit
    makes of the rest lead each other astray, and neither leads to the other alone.
    """

    def grown(base: Fit, effects: Sequence[Effect]) -> list[Tried]:
        return try_effects(
            base.structure, data, base, effects,
            executor=executor, keep=len(effects), far=False, progress=progress, scores={},
        )  # fmt: skip

    out: list[Tried] = []
    adequate = first_of_each([t for t in pieces if t.adequate], _place)
    for piece in list(adequate.values())[:PLACES]:
        own = [e for e in available if e.location == _place(piece)]
        start = part_of(piece, (), data).theta
        base = fit_orbits(structure, data, start, continuation=(0.0,), iterations=0)
        if not own or not np.isfinite(base.chi2):
            continue
        first = grown(base, own)
        out += first
        for parent in best_by_name(first)[:PARENTS]:
            rest = [e for e in own if joins(e, parent.effects)]
            out += grown(parent.fit, rest) if rest else []
        if any(t.explains for t in out):
            break
    return out


def whereabouts(pieces: Sequence[Tried], tries: Sequence[Tried], base: Fit) -> Whereabouts:
    """Where a misfit lies, from what the pieces (`shaped`, `remembering`, `deviating`) and single
    effects among `tries` leave of that of the fit `base`."""
    every = [*pieces, *(t for t in tries if len(t.effects) == 1 and t.plausible)]
    laws = sorted((t for t in every if t.spread is None), key=misfit)
    places = first_of_each(laws, _place)
    left = {place: t.fit.chi2_per_dof for place, t in places.items()}
    deviations = _deviations([t for t in every if t.spread is not None], laws)
    if deviations:
        own = {place: t.fit.chi2_per_dof for place, t in deviations.items()}
        left = own | {place: other for place, other in left.items() if place not in own}
        return Whereabouts(tuple(own), left, base.chi2_per_dof, from_run_to_run=True)
    likely = _likely(list(places.values()), base.chi2_per_dof)
    several = _several(tries)
    if several is not None and places:
        together, best = several.fit.chi2_per_dof, next(iter(left.values()))
        if together < best / FAR_LESS:
            both = tuple(dict.fromkeys(e.location for e in several.effects))
            if together <= PARTLY:
                return Whereabouts(both, left, base.chi2_per_dof, together=together)
            # what leaves so much is not what is missing, and rules no place out
            likely = tuple(dict.fromkeys((*likely, *both)))
    if pieces and likely and not places[likely[0]].adequate:  # no shape there says nothing of it
        likely += tuple(dict.fromkeys(p.location for p in PIECES if p.location not in left))
    return Whereabouts(likely, left, base.chi2_per_dof)


def _several(tries: Sequence[Tried]) -> Tried | None:
    """The fewest effects of different places that leave nearly as little as any number of them."""
    laws = [t for t in tries if t.plausible and t.spread is None and t.fit.converged]
    least = min((t.fit.chi2_per_dof for t in laws), default=np.inf)
    near = [t for t in laws if t.fit.chi2_per_dof < CLEARLY * least]
    best = min(near, key=lambda t: (len(t.effects), misfit(t)), default=None)
    return best if best is not None and len({e.location for e in best.effects}) > 1 else None


def _deviations(spreads: Sequence[Tried], laws: Sequence[Tried]) -> dict[str, Tried]:
    """The spreads that explain what no law does, by place: the likeliest, and any that is about as
    likely. By likelihood, as what a spread leaves is noise by its nature; whether they look random
    says nothing of the place."""
    good = sorted((t for t in spreads if t.adequate and t.leaves_noise), key=lambda t: t.evidence)
    least = min((t.evidence for t in laws), default=np.inf)
    if not good or any(t.adequate for t in laws) or good[0].evidence > least - EVIDENCE:
        return {}
    return first_of_each((t for t in good if t.evidence < good[0].evidence + EVIDENCE), _place)


def _shape(item: tuple[Structure, Dataset, Effect, Sequence[Fit]]) -> Fit | None:
    """The fit of a structure with one piece, if any starts: from the fits without it that are
    nearest once the noise is as large as the misfit of the worst, from the slow flow corrected for
    what the piece starts as, and from a richer structure that says the same."""
    plain, data, piece, bases = item
    structure, rough = plain.with_effects(piece), data.coarse()
    shares = [shares_of(base, data) for base in bases]
    starts = list[CoarseStart]()
    for base, (share, *_) in zip(bases, shares, strict=True):
        inner = [piece.to_internal(row) for row in piece.starts(known_sizes(data, base))]
        starts += coarse(structure, data, [np.r_[base.theta, row] for row in inner], share)[:STARTS]
    first, second, last = max(shares)
    richer = piece.restated(plain)
    if richer is not None:
        same = renamed(piece, structure, richer, candidates(richer, data))
        starts += coarse(structure, data, same, first)[:1]
    distant = physical_starts(structure, rough, piece.starts(known_sizes(data, bases[0])))[:AFAR]
    starts += polish(structure, rough, distant, (ROUGH,), 8)[:STARTS]
    led = polish(structure, data, starts, (first, second), 8)[:STARTS]
    if not led:
        return None
    thetas = np.stack([s.theta for s in led])
    hopeless = no_better(bases[0], data)
    return fit_orbits(structure, data, thetas, continuation=(last, 0.0), hopeless=hopeless)
