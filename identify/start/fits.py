"""Fits from data alone: starts of every kind, led on until one reaches the noise or none does."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from identify import assess
from identify.dataset import Dataset
from identify.fit import Fit, failed, fit_orbits, no_better
from identify.start.kinds import balanced_starts, physical_starts
from identify.start.rough import CoarseStart, best_of_each, coarse, distinct, polish
from identify.start.slow_flow import slow_flow_vectors
from identify.start.vectors import dense_placements, moved, signed
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]

DENSE = 96  # starts that are polished where sparser ones led nowhere
NEARLY = 100.0  # χ²/dof beyond which the model is to blame, not a mode at the wrong place
LONG = 600  # iterations that lead on what comes nearest and has not converged
DAMPED = (3e-4, 0.5)  # damping ratios between which a mode is one
REFUSED = 1e-3  # chance of held-out runs below which another minimum is sought that suits them too
SAME_DEPTH = 1e-3  # share of χ² by which two minima differ
FEW = 4.0  # degrees of freedom an unknown: with fewer, a misplaced mode may look worse than that


def fit_from_balance(structure: Structure, data: Dataset) -> tuple[Fit | None, list[CoarseStart]]:
    """The fit from the best start of the polynomial balance, exact where the model is, if there is
    any; and all of these starts, best first."""
    starts = balanced_starts(structure, data)
    return (fit_orbits(structure, data, starts[0].theta) if starts else None), starts


def fit_from_data(structure: Structure, data: Dataset) -> Fit:
    """The maximum-likelihood fit from data alone, over several starts; the best one wins.

    A start of the polynomial balance that reaches the noise (χ² within five standard deviations
    of its expectation) settles it. Otherwise all kinds of start are led in side by side: those of
    the polynomial balance, exact where the model is, and of the slow flow, robust where it is not.
    Where that ends near the noise but not at it, or the runs are few, or a mode has strayed, the
    other modes are placed more densely.
    """
    exact, starts = fit_from_balance(structure, data)
    if exact is not None and _adequate(exact):
        return exact
    rough = data.coarse()
    starts = sorted([*starts[:6], *physical_starts(structure, rough)], key=lambda c: c.cost)
    polished = polish(structure, rough, starts[:12])
    if not polished:
        p = len(structure.parameters)
        return failed(structure, data, np.zeros(p), "no start exists for these data")
    thetas = np.stack([s.theta for s in polished[:4]])
    fit = fit_orbits(structure, data, thetas, continuation=(0.003, 0.0), iterations=120)
    hopeless = fit.chi2_per_dof > NEARLY and fit.dof >= FEW * fit.theta.size and not _strayed(fit)
    if structure.mode_count < 2 or _adequate(fit) or hopeless:
        return fit
    found = [fit, *_replaced(structure, data, rough, fit)]
    best = min(found, key=lambda f: f.chi2)
    if not best.converged:  # in a long valley, with few runs
        found.append(fit_orbits(structure, data, best.theta, continuation=(0.0,), iterations=LONG))
    return min(found, key=lambda f: (not f.converged, f.chi2))


def fit_declared(structure: Structure, data: Dataset) -> Fit:
    """`fit_from_data`, unless the held-out runs refuse what it found and have a solution in common
    with the fitted ones: a few runs may have several, of which they are fitted by the wrong one.

    The fit is of the fitted runs alone, from there.
    """
    fit = fit_from_data(structure, data)
    if not (data.validation and _adequate(fit)) or not _refused(fit, data):
        return fit
    everything = replace(data, fit=(*data.fit, *data.validation), validation=())
    whole = fit_from_data(structure, everything)
    if not _adequate(whole):
        return fit
    other = fit_orbits(structure, data, whole.theta, continuation=(0.0,))
    return other if other.chi2 < _noise(other.dof) and not _refused(other, data) else fit


def _strayed(fit: Fit) -> bool:
    """Whether a mode has gone where none is: hardly damped at all, or hardly ringing."""
    modes = range(1, fit.structure.mode_count + 1)
    dampings = [fit.values[f"mode{i}.damping"] for i in modes]
    return not all(DAMPED[0] < zeta < DAMPED[1] for zeta in dampings)


def _refused(fit: Fit, data: Dataset) -> bool:
    """Whether the held-out runs are beyond noise and the parameters' own uncertainty."""
    held_out = [assess.predict(fit.structure, fit.theta, b) for b in data.validation]
    return assess.validation_p(held_out, fit.covariance) < REFUSED


def _adequate(fit: Fit) -> bool:
    return fit.converged and fit.chi2 < _noise(fit.dof)


def _noise(dof: int) -> float:
    """χ² that noise hardly exceeds: five standard deviations above its mean."""
    return dof + 5 * float(np.sqrt(2 * dof))


def _replaced(structure: Structure, data: Dataset, rough: Dataset, near: Fit) -> list[Fit]:
    """The fit from starts with the other modes placed more densely; none where none exists."""
    chosen = _denser(structure, rough, near, data.free_hz)
    if not chosen:
        return []
    worse, steps = no_better(near, data), (0.003, 0.0)
    thetas = np.stack(chosen)
    return [fit_orbits(structure, data, thetas, continuation=steps, iterations=120, hopeless=worse)]


def _denser(structure: Structure, rough: Dataset, near: Fit, free_hz: float) -> list[FloatArray]:
    """Starts with the other modes placed more densely than at first, best first.

    Modes that do not sing are seen at a few harmonics only: between those, a fit with one of them
    at the wrong place is a local minimum in its own right, from which no descent comes back. What
    such a fit says of the singing mode, flame and nonlinearity is good all the same.
    """
    dense = dense_placements(structure.mode_count - 1)
    thetas = signed(structure, slow_flow_vectors(structure, rough, ((),), dense))
    for placement in dense:
        thetas += moved(structure, near, free_hz, placement)
    starts = best_of_each(structure, coarse(structure, rough, thetas))
    polished = polish(structure, rough, starts[:DENSE])
    return [s.theta for s in distinct(structure, polished)[:8]]


def other_minima(structure: Structure, data: Dataset, near: Fit, times: float) -> list[Fit]:
    """Fits of the declared model that converge elsewhere and leave no more than so many times what
    `near` leaves, best first: where the model lacks something, the least misfit may be of a mode
    that has gone to the wrong place to make up for it."""
    if structure.mode_count < 2:
        return []
    out = [near]
    starts = _denser(structure, data.coarse(), near, data.free_hz)
    fits = [fit_orbits(structure, data, t, continuation=(0.003, 0.0)) for t in starts]
    for fit in sorted(fits, key=lambda f: f.chi2):
        if fit.chi2 < times * near.chi2 and not _known(fit, out):
            end = fit
            if not fit.converged:  # without what the model lacks, a valley may be long
                end = fit_orbits(structure, data, fit.theta, continuation=(0.0,), iterations=LONG)
            if end.converged and not _known(end, out):
                out.append(end)
    return out[1:]


def _known(fit: Fit, others: Sequence[Fit]) -> bool:
    """Whether one of `others` is as deep: the same, maybe with two modes' names exchanged."""
    return any(abs(fit.chi2 - o.chi2) < SAME_DEPTH * o.chi2 for o in others)
