"""The next experiment: which runs tell rival explanations apart, or sharpen a model, soonest.

*Discrimination.* Were model a right, model b, refitted to old and new runs together, would have to
leave the least χ² more of

    D_ab = min_u (u − u_b)ᵀ Σ_b⁻¹ (u − u_b) + |W (y_a − y_b(u))|²
         ≈ eᵀ (I + W J_b Σ_b J_bᵀ Wᵀ)⁻¹ e,                       e = W (y_a − y_b),

y being the predicted harmonics of the new runs, W their whitener, J_b their derivatives by b's
unknowns and Σ_b the covariance that the runs at hand leave: what b can absorb within what is known
of its parameters is no evidence (Hunter and Reiner's criterion). Runs are chosen one after the
other, each time the one that adds most to the mean of min(D_ab, ENOUGH) over all ordered pairs per
minute of rig time. The second, linearised form ranks all possible runs; near a resonance it can
promise a hundredfold too much, so that the best of each kind are judged by the first, solved anew.

*Precision.* On one model the same greedy choice maximises log det of the information
(D-optimality), each run adding log det(I + W J Σ Jᵀ Wᵀ).

Unknowns that the data hardly fix get a standard deviation of the size of their values: beyond that
no linearisation holds.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from identify.fit import Fit, resolved
from identify.foresee import Past, Possible, possible
from identify.identification import Prepared
from identify.parameters import Estimate
from identify.reach import Option, Reach, exchanged, reach_of
from identify.record import Campaign
from identify.results import declared_json
from identify.trace import EVIDENCE

FloatArray = npt.NDArray[np.float64]

ENOUGH = 6 * EVIDENCE  # Δχ² to be expected of a pair, with a margin for what is linearised here
LITTLE = 2.0  # Δχ² not worth a run
TELLING = 4.0  # Δχ² of two standard errors: what tells less tells nothing
MOST_RUNS = 6
LENGTHS = (1.0, 2.0, 4.0)  # record lengths tried, over the campaign's own
MOST_RIVALS = 3
SHORTLIST = 2  # runs of each kind that are judged without linearising
PLAN_FORMAT = "campaign-plan/1"


class Aim(Protocol):
    """What a choice of runs is after; it remembers the runs that are chosen."""

    def worth(self, index: int) -> float:
        """What run `index` would add, linearised: cheap, for all runs."""

    def exact(self, index: int) -> float:
        """The same without linearising: for those that look best."""

    def take(self, index: int) -> None:
        """Run `index` is chosen."""


@dataclass
class Refitted:
    """Rival b where a's truth would have moved it: its D, its straightened unknowns, what is then
    known of them, and what it says of every run, with its slopes."""

    found: float
    u: FloatArray
    spread: FloatArray
    rho: FloatArray
    slopes: FloatArray


class Discrimination:
    """Rivals told apart: for each ordered pair (a, b), b refitted to the runs chosen so far."""

    def __init__(self, fits: Sequence[Fit], runs: Possible) -> None:
        self.runs = runs
        self.chosen: list[int] = []
        self.past = [Past.of(f) for f in fits]
        self.seen = [runs.seen_by(f.structure, f.theta) for f in fits]
        self.pairs = {
            (a, b): Refitted(
                0.0, past.centre, past.spread, seen.rho, past.slopes(seen, past.centre)
            )
            for a in range(len(fits))
            for b, (past, seen) in enumerate(zip(self.past, self.seen, strict=True))
            if a != b
        }

    @property
    def found(self) -> dict[tuple[int, int], float]:
        """D of every ordered pair."""
        return {pair: r.found for pair, r in self.pairs.items()}

    @property
    def total(self) -> float:
        return _mean_enough(self.found.values())

    def worth(self, index: int) -> float:
        ahead = []
        for (a, _), b in self.pairs.items():
            e = b.rho[index] - self.seen[a].rho[index]
            noise = _noise(b.slopes[index], b.spread)
            ahead.append(b.found + float(e @ np.linalg.solve(noise, e)))
        return _mean_enough(ahead) - self.total

    def exact(self, index: int) -> float:
        ahead = [
            r.found if r.found >= ENOUGH else self._refit(pair, [*self.chosen, index])[0]
            for pair, r in self.pairs.items()
        ]
        return _mean_enough(ahead) - self.total

    def take(self, index: int) -> None:
        self.chosen.append(index)
        for pair, r in self.pairs.items():
            past = self.past[pair[1]]
            r.found, r.u = self._refit(pair, self.chosen)
            seen = self.runs.seen_by(past.structure, past.theta(r.u))
            r.rho, r.slopes = seen.rho, past.slopes(seen, r.u)
            r.spread = narrowed(r.spread, r.slopes[index])

    def _refit(self, pair: tuple[int, int], rows: Sequence[int]) -> tuple[float, FloatArray]:
        """D of a set of runs, and b's unknowns after it."""
        a, b = pair
        start = self.pairs[pair].u
        runs = self.runs.measured_as(self.seen[a], rows)
        return self.past[b].refit(runs, start) or (0.0, start)


def _mean_enough(found: Iterable[float]) -> float:
    return float(np.mean([min(d, ENOUGH) for d in found]))


def _noise(J: FloatArray, spread: FloatArray) -> FloatArray:
    """Covariance of a whitened prediction's error, noise included: I + J Σ Jᵀ."""
    return np.asarray(np.eye(J.shape[0]) + J @ spread @ J.T)


class Precision:
    """The information on one model's unknowns: log det gained."""

    def __init__(self, fit: Fit, runs: Possible) -> None:
        past = Past.of(fit)
        self.slopes = past.slopes(runs.seen_by(fit.structure, fit.theta), past.centre)
        self.spread = past.spread
        self.total = 0.0

    def worth(self, index: int) -> float:
        return float(np.linalg.slogdet(_noise(self.slopes[index], self.spread))[1])

    exact = worth

    def take(self, index: int) -> None:
        self.total += self.worth(index)
        self.spread = narrowed(self.spread, self.slopes[index])


def narrowed(spread: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Covariance after one more run of whitened Jacobian (m, p)."""
    carried = spread @ jacobian.T
    inner = np.eye(jacobian.shape[0]) + jacobian @ carried
    out = spread - carried @ np.linalg.solve(inner, carried.T)
    return np.asarray(0.5 * (out + out.T))


@dataclass(frozen=True)
class Chosen:
    """Options in the order chosen, what each added and all together, and the rig time."""

    options: tuple[Option, ...] = ()
    gains: tuple[float, ...] = ()
    seconds: float = 0.0
    total: float = 0.0
    pairs: dict[tuple[int, int], float] = field(default_factory=dict)


def choose(
    aim: Aim,
    options: Sequence[Option],
    seconds: Callable[[Option], float],
    *,
    first: Sequence[int] = (),
    most: int = MOST_RUNS,
    least_gain: float = LITTLE,
    budget_s: float = np.inf,
) -> tuple[list[int], list[float]]:
    """Greedy choice by worth per second: indices in order, and what each added.

    `first` are taken in any case (the free run that every campaign begins with) and not returned.
    Ends after `most` runs, at `budget_s`, or where the best adds less than `least_gain`.
    """
    for i in first:
        aim.take(i)
    spent = sum(seconds(options[i]) for i in first)
    left = {i for i in range(len(options)) if i not in first}
    picked: list[int] = []
    gains: list[float] = []
    while left and len(picked) < most:
        possible = [i for i in left if spent + seconds(options[i]) <= budget_s]
        guessed = {i: aim.worth(i) / seconds(options[i]) for i in possible}
        sure = {i: aim.exact(i) for i in _promising(guessed, options)}
        useful = [i for i, w in sure.items() if w >= least_gain]
        if not useful:
            break
        best = max(useful, key=lambda i: sure[i] / seconds(options[i]))
        aim.take(best)
        picked.append(best)
        gains.append(sure[best])
        spent += seconds(options[best])
        left.remove(best)
    return picked, gains


def _promising(rates: dict[int, float], options: Sequence[Option]) -> list[int]:
    """The best of each kind of run at different frequencies, `SHORTLIST` of each."""
    out: dict[tuple[str, float | None], int] = {}
    kinds: dict[str, int] = {}
    for i in sorted(rates, key=lambda i: -rates[i]):
        kind, place = options[i].kind, (options[i].kind, options[i].frequency_hz)
        if place not in out and kinds.get(kind, 0) < SHORTLIST:
            out[place] = i
            kinds[kind] = kinds.get(kind, 0) + 1
    return list(out.values())


def reach_in(ready: Prepared) -> Reach:
    """What the rig of a campaign can do; nothing near runs that the quality gate has excluded."""
    return reach_of(ready.campaign, ready.measured, ready.data.free_hz, ready.quality.excluded)


@dataclass(frozen=True)
class Rival:
    """An explanation by name, as fitted."""

    name: str
    fit: Fit


def tell_apart(
    rivals: Sequence[Rival], ready: Prepared, reach: Reach, *, by_hand: bool = False
) -> Chosen:
    """The runs that tell `rivals` apart in the least rig time, of the shortest length that does.

    Where even the best of them leaves more than noise, that much more counts as noise: a
    difference that is small beside what nobody explains decides nothing.
    `by_hand`: among runs with the microphones exchanged, instead of those that need nobody.
    """
    fits = [r.fit for r in rivals]
    misfit = float(np.sqrt(max(1.0, min(f.chi2_per_dof for f in fits))))
    fits = [replace(f, jacobian=f.jacobian / misfit) for f in fits]
    best = Chosen()
    for length in LENGTHS:
        record_s = length * reach.record_s
        options = reach.options(record_s)
        if by_hand:
            options = exchanged(options)
        free = reach.free(record_s)
        runs = possible((free, *options), ready, fits, misfit)
        if not runs.options:  # no run that they all have an answer for
            continue
        aim = Discrimination(fits, runs)
        first = [i for i, o in enumerate(runs.options) if o.kind == "free"]
        picked, gains = choose(aim, runs.options, reach.cost.seconds, first=first)
        taken = tuple(runs.options[i] for i in picked)
        seconds = reach.cost.seconds(free) + sum(map(reach.cost.seconds, taken))
        found = Chosen(taken, tuple(gains), seconds, aim.total, aim.found)
        if found.total > best.total:
            best = found
        if best.total > 0.9 * ENOUGH:
            break
    return best


def sharpen(
    fit: Fit,
    ready: Prepared,
    reach: Reach,
    *,
    record_s: float | None = None,
    runs: int = 2 * MOST_RUNS,
    budget_s: float = np.inf,
    given: Chosen | None = None,
) -> Chosen:
    """The D-optimal runs on one model: most information on all unknowns per minute.

    `given`: runs chosen already, to which these are added.
    """
    length = record_s or reach.record_s
    before = given or Chosen()
    free = reach.free(length)
    wanted = dict.fromkeys((free, *before.options, *reach.options(length)))
    able = possible(tuple(wanted), ready, [fit])
    if not able.options:
        return before
    aim = Precision(fit, able)
    taken = (free, *before.options)
    first = [i for i, o in enumerate(able.options) if o in taken]
    picked, gains = choose(
        aim, able.options, reach.cost.seconds, first=first, most=runs, least_gain=1e-3,
        budget_s=budget_s,
    )  # fmt: skip
    more = tuple(able.options[i] for i in picked)
    seconds = (before.seconds or reach.cost.seconds(free)) + sum(map(reach.cost.seconds, more))
    return Chosen(
        (*before.options, *more), (*before.gains, *gains), seconds, aim.total, before.pairs
    )


def expected_estimates(fit: Fit, ready: Prepared, chosen: Chosen) -> dict[str, Estimate]:
    """The parameters with the standard errors that the chosen runs are expected to leave."""
    runs = possible(chosen.options, ready, [fit]) if chosen.options else None
    stacked = fit.jacobian
    if runs is not None and runs.options:
        new = runs.seen_by(fit.structure, fit.theta).jacobian
        stacked = np.concatenate([stacked, new.reshape(-1, fit.theta.size)])
    known = resolved(fit.structure, fit.theta, stacked)
    return fit.structure.parameters.estimates(fit.theta, known)


def continued(campaign: Campaign) -> str | None:
    """What a plan may continue: the campaign's id, where the store recorded it itself."""
    return campaign.identifier if any("rig" in run.notes for run in campaign.runs) else None


def plan_of(
    chosen: Chosen, ready: Prepared, title: str, record_s: float, continues: str | None = None
) -> dict[str, Any]:
    """The runs as a campaign plan (`campaign-plan/1`, what `entrain campaign run` reads)."""

    def conditions(kind: str) -> list[dict[str, float | None]]:
        return [
            {"frequency_hz": o.frequency_hz, "amplitude_v": o.amplitude_v}
            for o in chosen.options
            if o.kind == kind
        ]

    campaign = ready.campaign
    declared = declared_json(campaign.declared_model)
    known = ("modes", "flame", "nonlinearity", "nonlinearity_degree")
    plan: dict[str, Any] = {
        "format": PLAN_FORMAT,
        "title": title,
        "free_runs": 1,
        "conditions": conditions("forced"),
        "cold": conditions("cold"),
        "record_s": float(record_s),
        "medium": {
            "density_kg_m3": campaign.medium.density_kg_m3,
            "sound_speed_m_s": campaign.medium.sound_speed_m_s,
        },
        "declared_model": {k: declared[k] for k in known},
    }
    if continues:
        plan["continues"] = continues
    return plan


ELSEWHERE = (
    "This campaign was recorded elsewhere: add the new runs to its folder, in campaign.toml too, "
    "and diagnose that again; by themselves they are another campaign."
)


def next_experiment(
    rivals: Sequence[Rival], ready: Prepared, verdict: str
) -> dict[str, Any] | None:
    """What to measure next, as the diagnosis says it; None where nothing would tell much.

    `rivals`: those that explain the data alike, or, where none does, the best of those tried.
    """
    finite = [r for r in rivals if np.isfinite(r.fit.chi2) and np.isfinite(r.fit.jacobian).all()]
    settled = [r for r in finite if r.fit.converged]
    usable = (settled if len(settled) > 1 else finite)[:MOST_RIVALS]
    if len(usable) < 2:
        return None
    reach = reach_in(ready)
    told = tell_apart(usable, ready, reach)
    if not told.options:
        return None
    record_s = told.options[0].record_s
    chosen = told
    if verdict == "unexplained":  # what nobody foresees shows where it has not been looked for yet
        missing = MOST_RUNS - len(told.options)
        best = usable[0].fit
        chosen = sharpen(best, ready, reach, record_s=record_s, runs=missing, given=told)
    names = [r.name for r in usable]
    least = min(told.pairs.values())
    continues = continued(ready.campaign)
    return {
        "reason": _reason(names, chosen, verdict) + ("" if continues else f" {ELSEWHERE}"),
        "rivals": names,
        "expected_discrimination": least,
        "pairs": [
            {"if_true": names[a], "against": names[b], "delta_chi2": d}
            for (a, b), d in told.pairs.items()
        ],
        "rig_minutes": chosen.seconds / 60,
        "conditions": [
            {
                "kind": o.kind,
                "frequency_hz": o.frequency_hz,
                "amplitude_v": o.amplitude_v,
                "record_s": o.record_s,
                "for": "discrimination" if o in told.options else "precision",
            }
            for o in chosen.options
        ],
        "by_hand": _by_hand(usable, ready, reach, least) if least < EVIDENCE else None,
        "plan": plan_of(
            chosen,
            ready,
            f"next: {' or '.join(names)}"[:120],
            record_s,
            continues,
        ),
    }


def _reason(names: Sequence[str], chosen: Chosen, verdict: str) -> str:
    least = min(chosen.pairs.values())
    listed = "; ".join(o.words() for o in chosen.options)
    begin = (
        f"{', '.join(names[:-1])} and {names[-1]} explain these data alike."
        if verdict == "ambiguous"
        else f"No known effect explains these data; nearest come {', '.join(names)}. Measure where "
        "they differ most, and where the parameters are fixed best."
    )
    end = "is expected to leave" if least >= EVIDENCE else "would leave no more than"
    little = ", which hardly tells them apart; nothing within the rig's reach does"
    return (
        f"{begin} A free run, then {listed}; records of {chosen.options[0].record_s:g} s, about "
        f"{chosen.seconds / 60:.1f} min of rig time. After that the wrong one of any two {end} "
        f"a χ² higher by {least:.3g}, whatever its parameters{little if least < TELLING else ''}."
    )


def _by_hand(
    rivals: Sequence[Rival], ready: Prepared, reach: Reach, least: float
) -> dict[str, Any] | None:
    """The same with the microphones exchanged, where that tells clearly more: never of rivals
    that say the same of the microphones."""
    if not any(e.location == "sensor" for r in rivals for e in r.fit.structure.effects):
        return None
    hands = tell_apart(rivals, ready, reach, by_hand=True)
    if not hands.options or min(hands.pairs.values()) < 2 * least:
        return None
    return {
        "do": "exchange the two microphones, then record",
        "conditions": [o.words() for o in hands.options],
        "rig_minutes": hands.seconds / 60,
        "expected_discrimination": min(hands.pairs.values()),
    }
