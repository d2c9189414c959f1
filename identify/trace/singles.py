"""Every effect by itself on the declared model; the best of them in their other forms too."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from identify.dataset import Dataset
from identify.effect import Effect
from identify.executor import Executor, InProcess, Progress
from identify.fit import Fit
from identify.structure import Structure
from identify.trace.again import started_again
from identify.trace.contests import at_the_same_place
from identify.trace.exchange import in_other_forms
from identify.trace.scores import ScoreTest, score_tests
from identify.trace.stages import try_effects
from identify.trace.to_the_end import led_on
from identify.trace.tried import Tried, misfit

#: What an effect leaves at another minimum of the declared model, at most, over what the best does,
#: by the tangents there, if it is tried there.
PROMISING = 2.0


@dataclass(frozen=True)
class Alone:
    """What a worker needs to try effects one by one."""

    structure: Structure
    data: Dataset
    base: Fit
    available: tuple[Effect, ...]
    scores: Mapping[str, ScoreTest] | None
    minima: tuple[Fit, ...]  # others of the declared model
    far: bool  # whether the declared fit is no place to start from


def try_alone(work: Alone, run: Executor, report: Progress) -> list[Tried]:
    """Every effect by itself; the best of them in their other forms too."""
    data, base, available = work.data, work.base, work.available
    far = work.far
    apart = [e for e in available if not e.refines]
    singles = try_effects(
        work.structure, data, base, apart, executor=run, keep=8,
        far=far, progress=lambda share, text: report(0.6 * share, text), scores=work.scores,
    )  # fmt: skip
    singles += _from_other_minima(work, apart, singles, run, report)
    if far and not any(t.adequate for t in singles):
        report(0.6, "starting the best once more from afar")
        singles = started_again(singles, data, run)
    richer = [e for e in available if e.refines and e.restated(work.structure) is not None]
    if richer and not any(t.explains for t in singles):
        found = try_effects(
            work.structure, data, base, richer, executor=run, keep=1, far=False,
            progress=lambda share, text: report(0.6, text),
        )  # fmt: skip
        # of so many parameters that, beside another effect, they would stand for it
        singles += [t for t in found if t.explains]
    singles += in_other_forms(singles, data, available, run)
    singles += at_the_same_place(singles, data, available, run)
    singles += led_on(singles, data, run)
    return singles


def _from_other_minima(
    work: Alone,
    effects: Sequence[Effect],
    singles: Sequence[Tried],
    run: Executor,
    report: Progress,
) -> list[Tried]:
    """Effects from other minima of the declared model, where one promises to leave no more there
    than the best of `singles` does (40024: a gain that the fit of a mode gone astray hides)."""
    out: list[Tried] = []
    for base in work.minima:
        scores = score_tests(work.structure, work.data, base, effects, run)
        promised = base.chi2 - max((s.drop for s in scores.values()), default=0.0)
        if promised < PROMISING * min((misfit(t) for t in (*singles, *out)), default=np.inf):
            out += try_effects(
                work.structure, work.data, base, effects, executor=run, keep=8, far=False,
                progress=lambda share, text: report(0.6, text), scores=scores,
            )  # fmt: skip
    return out


def by_itself(work: Alone) -> list[Tried]:
    return try_alone(work, InProcess(), lambda share, text: None)
