"""Sets with an effect less: refitted from where the whole set has ended."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from identify.dataset import Dataset
from identify.effect import Effect
from identify.fit import Fit, fit_orbits
from identify.structure import MODAL, Structure
from identify.trace.claims import gain_p
from identify.trace.sizes import louder, loudness
from identify.trace.tried import ALPHA, Tried, tried

NEEDLESS = 100.0  # of χ²: what leaving an effect out adds at most, if it is to be left out


def part_of(
    t: Tried,
    effects: tuple[Effect, ...],
    data: Dataset,
    values: Mapping[str, float] | None = None,
) -> Fit:
    """The values of `t`, or those given, with some of its effects, not fitted again: as loud as
    with all."""
    structure = replace(t.fit.structure, effects=effects)
    values = values or t.fit.values
    gone = [e for e in t.effects if e not in effects]
    theta = structure.parameters.unknowns(values)
    theta = louder(theta, structure.parameters.names, loudness(data, gone, values))
    return replace(t.fit, structure=structure, theta=theta)


def with_fewer(t: Tried, effects: tuple[Effect, ...], data: Dataset) -> Fit:
    """The fit with only some of the effects of `t`, started from its values: led in, and straight
    where that ends no nearer. What an effect that stands for nothing leaves is at its minimum
    already, which coarser noise may lead away from."""
    smaller = replace(t.fit.structure, effects=effects)
    known = [t.fit.values]
    for e in t.effects:
        if e not in effects:
            known += named_otherwise(e, t)
            known += [p for p in (_merged(e, t, q) for q in known) if p is not None]
    thetas = np.stack([smaller.parameters.unknowns(p) for p in known])
    led = fit_orbits(smaller, data, thetas, continuation=(0.003, 0.0))
    if led.chi2 < t.fit.chi2 + NEEDLESS:
        return led
    enough = (t.fit.chi2 + NEEDLESS) / data.residuals
    straight = fit_orbits(smaller, data, thetas[0], continuation=(0.0,), hopeless=enough)
    return min(led, straight, key=lambda f: f.chi2)


def eliminate(candidate: Tried, data: Dataset) -> Tried:
    """Backward elimination: effects without which the fit is no worse than chance are dropped. Of
    what predicts the held-out runs, they have a say in it."""
    current = candidate
    while len(current.effects) > 1:
        smaller = []
        for leave in current.effects:
            rest = tuple(e for e in current.effects if e is not leave)
            without = tried(rest, with_fewer(current, rest, data), data)
            gain = without.fit.chi2 - current.fit.chi2
            if current.adequate:
                gain = without.chi2_of_all - current.chi2_of_all
            if np.isfinite(gain) and gain_p(gain, current, without.fit) > ALPHA:
                smaller.append((gain, without))
        if not smaller:
            break
        _, current = min(smaller, key=lambda item: item[0])
    return current


def named_otherwise(effect: Effect, t: Tried) -> list[dict[str, float]]:
    """The values of `t` with another mode in the place of the one that `effect` adds, of which it
    has the name only: any of those that do not sing may be the one too many."""
    values, plain = t.fit.values, replace(t.fit.structure, effects=())
    count = plain.mode_count
    if not _adds_a_mode(effect, plain):
        return []
    full = {**values, **effect.to_restated(plain, values)}
    out = []
    for added in range(2, count + 1):
        stay = [i for i in range(1, count + 2) if i != added]
        moved = {
            f"mode{new}.{kind}": full[f"mode{old}.{kind}"]
            for new, old in enumerate(stay, start=1)
            for kind in MODAL
        }
        for q, kind in zip(effect.parameters, MODAL, strict=True):
            moved[q.name] = full[f"mode{added}.{kind}"]
        out.append({**values, **moved})
    return out


def _adds_a_mode(effect: Effect, plain: Structure) -> bool:
    richer = effect.restated(plain)
    return richer is not None and richer.mode_count == plain.mode_count + 1


def _merged(effect: Effect, t: Tried, p: Mapping[str, float]) -> dict[str, float] | None:
    """Values `p` where the mode that `effect` adds lies within the width of a declared one: that
    one does for both, with their residues together. None where it does not."""
    plain = replace(t.fit.structure, effects=())
    count = plain.mode_count
    if not _adds_a_mode(effect, plain):
        return None
    f, zeta, *residues = (p[q.name] for q in effect.parameters)
    near = min(range(1, count + 1), key=lambda i: abs(p[f"mode{i}.frequency_hz"] - f))
    own = f"mode{near}"
    wide = zeta * f + p[f"{own}.damping"] * p[f"{own}.frequency_hz"]
    if abs(p[f"{own}.frequency_hz"] - f) > wide:
        return None
    both = zip(MODAL[2:], residues, strict=True)
    return {**p, **{f"{own}.{kind}": p[f"{own}.{kind}"] + r for kind, r in both}}
