"""Effects that a richer declared model says as well: their unknowns in its terms, and back."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from identify.dataset import Dataset
from identify.effect import Effect
from identify.fit import Fit, fit_orbits
from identify.start import fit_from_data
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]


def as_declared(item: tuple[Structure, Dataset, Effect]) -> Fit:
    """An effect fitted from the data alone, as if the model had been declared with it."""
    structure, data, effect = item
    richer = effect.restated(structure)
    assert richer is not None
    larger, found = structure.with_effects(effect), fit_from_data(richer, data)
    return fit_orbits(larger, data, by_name(effect, larger, found.values), continuation=(0.0,))


def canonical(fit: Fit, data: Dataset) -> Fit:
    """The same fit with its effects' parameters named by the effects' own rules."""
    structure = fit.structure
    plain = replace(structure, effects=())
    for effect in structure.effects:
        if effect.restated(plain) is None:
            continue
        p = {**fit.values, **effect.to_restated(plain, fit.values)}
        theta = by_name(effect, structure, p)
        if np.allclose(theta, fit.theta, rtol=1e-9, atol=1e-12):
            continue
        renamed = fit_orbits(structure, data, theta, continuation=(0.0,))
        # beside an effect that speaks of the modes by number, another name is another model
        if renamed.converged >= fit.converged and renamed.chi2 < fit.chi2 + 1.0:
            fit = renamed
    return fit


def by_name(effect: Effect, larger: Structure, p: Mapping[str, float]) -> FloatArray:
    """Unknowns of `larger`, of which `effect` is one, from values of the richer structure that says
    the same as the declared model with it, and of what else is in `larger`."""
    plain = replace(larger, effects=())
    names = [*plain.parameters.names, *(q.name for q in effect.parameters)]
    now = {**p, **dict(zip(names, effect.from_restated(plain, p), strict=True))}
    return larger.parameters.unknowns(now)


def renamed(
    effect: Effect, larger: Structure, richer: Structure, thetas: Iterable[FloatArray]
) -> list[FloatArray]:
    """Unknowns of `larger`, of which `effect` is one, from those of the `richer` structure that
    says the same."""
    return [by_name(effect, larger, richer.parameters.plain(theta)) for theta in thetas]
