"""Two effects sought at once, for where both are gross.

A search that adds one effect at a time starts from the best single, and a second gross effect has
led that one astray. So every pair of names, each in the few forms that stand for the others, is led
through coarse noise from the slow flow corrected for both of them; one more mode as one more
declared mode. What comes nearest is led on, and the best few are refitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from identify.dataset import Dataset
from identify.effect import Effect, Known
from identify.executor import Executor, Progress
from identify.fit import Fit, fit_orbits
from identify.start import CoarseStart, dense_placements, polish, reseated, signed_starts
from identify.structure import Structure
from identify.trace.restated import canonical, renamed
from identify.trace.sizes import known_sizes
from identify.trace.stages import OF_MODES, likely_placements
from identify.trace.tried import Tried, few_of_each, tried

FIRST, SECOND = 0.05, 0.01  # shares of each coefficient's size that count as noise, by stage
SIDE_BY_SIDE = 16  # starts of a pair without a further mode that are led on …
ANYWHERE = 64  # … and with several declared modes beside the one that sings
PLACED = 1500  # values of a pair's effects with places of these modes that are tried at the most
NEARER = 40  # pairs that come to the second stage …
NEAREST = 6  # … and that are refitted in full
VALUES = 6  # of an effect that are tried beside a further mode
BEST_SINGLES = 3  # whose forms stand for their effects too

#: The forms that stand for the others of their effects; of an effect without one here, the first.
STANDING = {
    "acoustic_mode:mode",
    "nonlinear_damping:quadratic_end",
    "nonlinear_damping:cubic_end",
    "flame_dynamics:pole",
    "flame_dynamics:second_time_scale",
    "flame_dynamics:second_order",
    "nonlinearity_shape:quadratic_cubic",
    "nonlinearity_shape:cubic",
    "nonlinearity_shape:quartic_quintic",
    "nonlinearity_shape:tanh",
    "nonlinearity_shape:quadratic_odd",
    "actuator_dynamics:resonance",
    "actuator_dynamics:delay",
    "actuator_nonlinearity:quadratic_cubic",
    "channel_mismatch:gain_skew",
    "channel_mismatch:lower_skew",
    "parameter_drift:frequency_settling",
    "parameter_drift:several",
}


@dataclass(frozen=True)
class _Pair:
    """What a worker needs to seek two effects at once."""

    plain: Structure
    effects: tuple[Effect, Effect]
    data: Dataset
    rough: Dataset
    known: Known
    placements: tuple[tuple[float, ...], ...]

    @property
    def richer(self) -> Structure | None:
        """The structure that says the same as the plain one with the first effect, if any."""
        return self.effects[0].restated(self.plain)

    @property
    def sought(self) -> Structure:
        """What is led through the stages: with the richer structure, or with both effects."""
        if self.richer is not None:
            return self.richer.with_effects(self.effects[1])
        return self.plain.with_effects(*self.effects)

    @property
    def proposals(self) -> list[tuple[float, ...]]:
        """Each of the first effect's own starting values with each of the second's."""
        each = (e.starts(self.known) for e in self.effects)
        return [(*first, *second) for first, second in product(*each)]


@dataclass(frozen=True)
class _Led:
    """A pair with the best of its starts, best first."""

    pair: _Pair
    starts: tuple[CoarseStart, ...]


def pairs_from_afar(
    structure: Structure,
    data: Dataset,
    base: Fit,
    available: Sequence[Effect],
    singles: Sequence[Tried],
    executor: Executor,
    progress: Progress,
) -> list[Tried]:
    """The pairs of effects that come nearest from the slow flow, refitted; `base` is the declared
    fit, which sizes of effects lean on."""
    forms = representatives(available, singles)
    rough, known = data.coarse(), known_sizes(data, base)
    placements = likely_placements(structure, rough)
    pairs = [
        _Pair(structure, both, data, rough, known, placements)
        for both in combinations(forms, 2)
        if both[0].name != both[1].name
    ]
    pairs.sort(key=lambda p: p.richer is None)  # which take longest: not to be waited for
    led = []
    for i, found in enumerate(executor.map(_lead, pairs), start=1):
        led.append(found)
        progress(0.7 * i / len(pairs), f"seeking {_named(found.pair)}")
    second = list(executor.map(_lead_on, _best(led, NEARER)))
    progress(0.85, "refitting pairs")
    chosen = _best(second, NEAREST)
    fits = list(executor.map(_refit, chosen))
    progress(1.0, "refitting pairs")
    return [
        tried(found.pair.effects, fit, data)
        for found, fit in zip(chosen, fits, strict=True)
        if np.isfinite(fit.chi2)
    ]


def representatives(available: Sequence[Effect], singles: Sequence[Tried]) -> list[Effect]:
    """The forms that stand for their effects from afar, and those of the best singles; those that
    have a richer structure first."""
    named = {e.name for e in available if e.key in STANDING}
    firsts = {e.name: e.key for e in reversed(available) if e.name not in named}
    near = {t.effects[0].key for t in singles[:BEST_SINGLES]}
    keys = STANDING | near | set(firsts.values())
    chosen = [e for e in available if e.key in keys and not e.refines]
    return sorted(chosen, key=lambda e: e.restated(Structure()) is None)


def _named(pair: _Pair) -> str:
    return " and ".join(e.key for e in pair.effects)


def _lead(pair: _Pair) -> _Led:
    """The pair's starts through the first stage."""
    sought, rough = pair.sought, pair.rough
    steps = 4  # most starts fall behind at once, but a valley may be long: a further mode's is
    if pair.richer is not None:
        other = pair.effects[1]
        neutral = other.neutral()
        rows = [*([neutral] if neutral else []), *other.starts(pair.known)][:VALUES]
        starts = signed_starts(sought, rough, rows, dense_placements(sought.mode_count - 1))
        many, steps = OF_MODES, 10
    elif pair.plain.mode_count > 2:  # the others trade off each other
        starts, many = _anywhere(pair), ANYWHERE
    else:
        starts = signed_starts(sought, rough, pair.proposals, pair.placements)
        many = SIDE_BY_SIDE
    ahead = polish(sought, rough, starts[:many], (FIRST,), steps)[: max(8, many // 4)]
    return _Led(pair, tuple(polish(sought, rough, ahead, (FIRST,), 10)[:3]))


def _anywhere(pair: _Pair) -> list[CoarseStart]:
    """Starts with the modes that do not sing anywhere, best first. Where the effects' own values
    are many, each row of them is tried with its share of the places, in turn: next to it is one
    that is tried with others."""
    rows, places = pair.proposals, dense_placements(pair.plain.mode_count - 1)
    shares = min(len(places), -(-len(rows) * len(places) // PLACED))
    found = [
        start
        for i in range(shares)
        for start in signed_starts(pair.sought, pair.rough, rows[i::shares], places[i::shares])
    ]
    return sorted(found, key=lambda start: start.cost)


def _lead_on(led: _Led) -> _Led:
    pair = led.pair
    starts = polish(pair.sought, pair.rough, led.starts, (SECOND,), 20)
    return _Led(pair, tuple(starts[:2]))


def _refit(led: _Led) -> Fit:
    """To the data's own noise, with the effects by their names."""
    pair, thetas = led.pair, [s.theta for s in led.starts]
    structure = pair.plain.with_effects(*pair.effects)
    if pair.richer is not None:
        thetas = renamed(pair.effects[0], structure, pair.sought, thetas)
    fit = fit_orbits(structure, pair.data, np.stack(thetas), continuation=(0.003, 0.0))
    return canonical(reseated(fit, pair.data), pair.data)


def _best(led: Sequence[_Led], count: int) -> list[_Led]:
    """Those that came nearest, no more than two of the same effects."""
    ranked = sorted((f for f in led if f.starts), key=lambda f: f.starts[0].cost)
    return few_of_each(ranked, lambda f: frozenset(e.name for e in f.pair.effects), 2)[:count]
