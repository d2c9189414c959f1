"""The order of the search: singles, run-to-run scatter, pairs and triples, and what contests them.

The steps are in `law_steps`, `chance_steps` and `contesting`; what they work on is `UnderWay`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects import CANDIDATES
from identify.effects.scatter import Scatter
from identify.executor import Executor, InProcess, Progress
from identify.fit import Fit, fit_orbits
from identify.structure import Structure
from identify.trace.chance_steps import try_chance
from identify.trace.claims import MUCH, against_chance
from identify.trace.contesting import contest, one_more
from identify.trace.contests import BEHIND
from identify.trace.fewer import with_fewer
from identify.trace.law_steps import (
    grow,
    plainest,
    try_each_alone,
    try_foreseen,
    try_more_modes,
    try_one_place,
    try_pairs,
    try_singles,
)
from identify.trace.scores import ScoreTest
from identify.trace.tried import GROSS, Tried, best_by_name, best_form, least, misfit, tried
from identify.trace.under_way import UnderWay, as_a_parent
from identify.trace.usable import usable

STANDS_OUT = 30.0  # times less misfit than with any other effect


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
    going = UnderWay(
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
    singles = try_singles(going, scores)
    level = best_by_name(singles)
    pieces = [] if going.explained or depth < 2 else try_one_place(going)
    places = {t.effects[0].location for t in pieces if t.adequate}
    if places:  # three effects would stand for one that nobody has named …
        depth = min(depth, 2)
    if len(places) == 1 and least(singles) > GROSS:  # … and so would two, with none that is near
        depth = 1
    for size in range(2, depth + 1):
        # a spread alone does not end the search: a pair may explain the same without chance
        explaining = [t for t in going.tried if t.explains]
        enough = any(t.spread is None or len(t.effects) > 1 or size > 2 for t in explaining)
        if enough or going.late():
            break
        parents = sorted(level, key=as_a_parent)[:2]
        if size > 2:  # one of two effects may leave much; two of three hardly more than others do
            parents = [t for t in parents if misfit(t) <= BEHIND * misfit(parents[0])]
        if size == 2:
            try_foreseen(going)
        nowhere = size == 2 and not (places or _a_place_to_grow_from(singles, base))
        found = try_pairs(going, singles) if nowhere and not going.by_law else []
        if not (going.by_law or (nowhere and going.explained)):
            found = grow(going, parents, found)
        if size == 2 and going.seeking():
            found = grow(going, plainest(going, singles), found)
        if size == 2 and not going.late():
            try_chance(going, parents)
            # what was grown from may have been no part of the matter
            lost = not going.explained or least(found) > MUCH
            if lost and base.chi2_per_dof > GROSS and not (nowhere or places):
                found += try_pairs(going, singles)
        level = best_by_name(found)
        if size == 2 and going.seeking():
            level = [*try_more_modes(going, level), *level]
    if going.seeking():
        try_each_alone(going, scores)
        if depth > 1 and going.seeking():
            try_foreseen(going, last=True)
    contest(going)
    if one_more(going, depth):
        contest(going)
    everything = against_chance(going.tried)
    ranked = tuple(sorted(everything, key=lambda t: (not t.adequate, t.fit.chi2)))
    return Search(ranked, tuple(singles), tuple(pieces), whole=not going.left_out)


def _a_place_to_grow_from(singles: Sequence[Tried], base: Fit) -> bool:
    """Whether the best single leaves little, or so much less than any other, or than there is
    without it, that it is surely part of the matter."""
    best = [t.fit.chi2_per_dof for t in best_by_name(singles)]
    if not best:
        return False
    others = min([*best[1:], np.inf])
    return best[0] <= GROSS or STANDS_OUT * best[0] < max(others, base.chi2_per_dof / STANDS_OUT)


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
    """Forms for one mode or two more than declared."""
    out: list[Effect] = []
    for added in (1, 2):
        more = replace(structure, mode_count=structure.mode_count + added)
        found = (e for e in catalogue if e.mode_count is not None and usable(e, data, more))
        out += [e for e in found if not e.refines]
    return tuple(out)
