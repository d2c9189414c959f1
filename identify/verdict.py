"""From all that was tried to a verdict: what explains the data, has no rival, and may be said.

The declared model must fail first. What explains the data must account for what it takes away
(`identify.trace.accounts`), have come to values, and not be outdone by a freely shaped piece; where
others do as well, all are named. A law that leaves a visible but practically empty rest is claimed
with what it leaves. Else nothing is, and the best is reported.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from identify import trace
from identify.dataset import Dataset
from identify.fit import Fit
from identify.results import Assessment, Verdict
from identify.trace import ALPHA, EVIDENCE, Tried
from identify.trace.tried import LUCK

DOUBTFUL = 0.05  # probability of a claim's lack of fit below which free shapes contest it
SLIGHT = 10.0  # χ²/dof of the declared model below which they contest every claim


@dataclass(frozen=True)
class Declared:
    """The declared model, fitted, and whether it leaves more than noise."""

    model: Tried
    assessment: Assessment
    scores: dict[str, trace.ScoreTest]
    p_value: float

    @property
    def fit(self) -> Fit:
        return self.model.fit

    @property
    def significant(self) -> bool:
        return self.p_value < ALPHA


def judge(
    declared: Declared,
    tried: Sequence[Tried],
    data: Dataset,
    pieces: Sequence[Tried] = (),
) -> tuple[Verdict, Tried | None, str]:
    """Verdict, the candidate it rests on, and the reason in words; `pieces` are freely shaped, and
    what is far less likely than one of them is not claimed."""
    if not declared.significant:
        return "no_discrepancy", None, _not_contradicted(declared.fit)
    every = [t for t in tried if t.explains and trace.accounts(t, declared.model, tried)]
    shapes = [p for p in pieces if p.spread is None]
    # a law that chance with a name may stand for is its rival, and no worse for chance without
    laws = [t for t in every if t.spread is None]
    against_laws = pieces if len(laws) == len(every) else shapes
    good = [t for t in every if not trace.outdone(t, against_laws if t.spread is None else pieces)]
    settled = [t for t in good if t.has_values]  # of these alone one is claimed
    if settled:
        spreads = [t for t in tried if t.spread is not None and not t.explains]
        implausible = _implausible(tried)
        # of laws that differ little, one is not the surer for what is likelier than the other
        explaining = [*laws, *(t for t in good if t.spread is not None)]
        best, others = trace.claimed(settled, [*explaining, *spreads, *implausible])
        words = best.words
        if not others:
            open_ = trace.other_forms(best, good)
            forms = [
                f" Forms of {e.name} that do as well: {', '.join(open_[e.name])}."
                for e in best.effects
                if open_[e.name]
            ]
            less = {t.words: None for t in explaining if t.key != best.key and not best.within(t)}
            rival = "nothing else does" if not less else (
                f"of what else would, {' or '.join(list(less)[:3])}, none is as likely"
            )  # fmt: skip
            said = f"Adding {words} explains the data; {rival}."
            said += "".join(
                f" {t.words} would do as well, but {t.implausibility}."
                for t in trace.but_for_values(best, implausible)
            )
            if best.spread is not None and best.spread.objection:
                said += f" No law comes near: that {best.spread.objection} is put down to luck."
            if best.spread is not None:
                said += (
                    " Single runs lie at random within that spread, and are predicted no better."
                )
            return "traced", best, said + "".join(dict.fromkeys(forms))
        names = ", ".join(t.words for t in others)
        return "ambiguous", best, f"{words} explains the data, and so does: {names}."
    least = declared.fit.chi2  # what leaves more with an effect than without has lost its way
    ranked = sorted(
        (t for t in tried if t.plausible and t.fit.chi2 < least), key=lambda t: t.fit.chi2
    )
    near = nearly(ranked, least, data.noise_floor(data.validation), pieces)
    if near is not None:
        words = near.words
        return "traced", near, (
            f"Adding {words} takes away all but a trace of the misfit and predicts the validation "
            "runs as well as noise permits, but for bad luck; "
            f"χ²/dof {near.fit.chi2_per_dof:.2g} is left."
        )  # fmt: skip
    chosen = trace.foremost(ranked)
    left = "" if chosen is None else (
        f" The best, {chosen.words}, leaves χ²/dof {chosen.fit.chi2_per_dof:.3g}; "
        "it is reported, not claimed."
    )  # fmt: skip
    near_it = [t for t in tried if t.explains]
    if good:
        nearest = trace.best_form(good)
        said = f"{nearest.words} comes near to the data, with no values: {nearest.fit.reason}."
    elif any(trace.outdone(t, shapes) for t in near_it):
        said = "What comes near to the data is far less likely than a law that nobody here knows."
    elif any(trace.outdone(t, pieces) for t in near_it):
        said = (
            "What comes near to the data is no likelier than chance that nobody here knows: its "
            "numbers may follow runs that differ at random."
        )
    elif near_it:
        said = (
            "What comes near to the data takes too little more of the misfit away than what has an "
            "effect less, or predicts the runs that no fit has seen worse."
        )
    else:
        said = "No known effect explains the data to within noise."
    return "unexplained", chosen, said + left + _but_for_values(declared, tried)


def _implausible(tried: Sequence[Tried]) -> list[Tried]:
    """Laws that leave no more than noise, with values that cannot be true."""
    return [t for t in tried if t.spread is None and t.but_for_values]


def _but_for_values(declared: Declared, tried: Sequence[Tried]) -> str:
    """Which law of one effect or two would explain the data, if its values could be true."""
    few = [t for t in _implausible(tried) if len(t.effects) < 3]
    near = [t for t in few if trace.accounts(t, declared.model, tried)]
    if not near:
        return ""
    best = trace.best_form(near)
    return f" Adding {best.words} would leave no more than noise, but {best.implausibility}."


def _not_contradicted(fit: Fit) -> str:
    said, p = "The declared model explains the data to within noise.", fit.theta.size
    if fit.dof >= p:
        return said
    left = f"{fit.dof} degree{'' if fit.dof == 1 else 's'} of freedom beside its {p} parameters"
    return f"{said} That says little: the usable runs leave {left}. Record more of them."


def asks_for_shapes(chosen: Tried, base: Fit) -> bool:
    """Whether freely shaped pieces contest a claim: where it hardly comes to the noise, where a
    spread or several laws may take up much that is not theirs, and where so little was missing from
    the declared fit `base` that many laws follow it (48030)."""
    if chosen.spread is not None or len(chosen.effects) > 1:
        return True
    return chosen.fit_p < DOUBTFUL or base.chi2_per_dof < SLIGHT


def nearly(
    ranked: Sequence[Tried], base_chi2: float, floor: float, pieces: Sequence[Tried]
) -> Tried | None:
    """A law alone that leaves a statistically visible but practically empty residual.

    It must take away 99.8 % of the excess misfit, predict held-out runs within 1.5 times the noise
    (`floor`; none without such runs) or no worse than noise and its parameters let expect but for
    bad luck (54135, a saturation extrapolated to five times the free amplitude), and stand ten
    times better than any law or laws without it and far likelier than a spread; nor may a free
    shape be far likelier. An idealisation (a slightly other law of the same effect) may then
    remain, or bad luck; another cause hardly.
    """
    best = next((t for t in ranked if len(t.effects) == 1 and t.spread is None), None)
    if best is None or best.explains or not best.fit.converged or best.fit.chi2_per_dof > 3.0:
        return None  # what explains the data is claimed for that, or not at all
    excess = max(best.fit.chi2 - best.fit.dof, 0.0)
    if base_chi2 < SLIGHT * best.fit.dof:
        return None  # of so little, hardly anything is an empty trace
    empty = excess < 0.002 * (base_chi2 - best.fit.dof)
    if not (empty and (best.validation_error < 1.5 * floor or best.validation_p > LUCK)):
        return None
    others = [t for t in ranked if best.names[0] not in t.names]
    rivalled = any(
        t.fit.chi2 < 10 * best.fit.chi2
        if t.spread is None
        else t.evidence < best.evidence + EVIDENCE
        for t in others
    )
    # unlike for `trace.outdone`, it need not be adequate: the law is not either
    bettered = any(t.evidence < best.evidence - EVIDENCE for t in pieces if t.spread is None)
    return None if rivalled or bettered else best
