"""The recorded drive is itself uncertain: what that adds to the covariance of the residuals.

The model is driven by the measured coefficients U + n_U, so that a residual Y − Ŷ(U) contains
−S n_U beside the velocity's own noise, S = ∂Ŷ/∂U on the entrained orbit. Its covariance becomes

    C = C_Y + S C_U Sᵀ.

Turning a run into the phase of its drive leaves that as it is: the equations do not know where
time begins. S needs a model, so a fit without it comes first and is repeated with it.
"""

from dataclasses import replace

import numpy as np

from identify import balance
from identify.dataset import Batch, Dataset, whitener
from identify.fit import Fit, repeated

NEGLIGIBLE = 1e-3  # of a coefficient's own variance


def refitted(fit: Fit, data: Dataset, model: Fit | None = None) -> tuple[Dataset, Fit]:
    """`data`, as recorded, with the drive's uncertainty as `model` passes it on (default: `fit`),
    and `fit` repeated on them; the same objects where it is negligible, or where nothing comes of
    a fit that is far from the data.

    As recorded: covariances that hold the drive's share already would get it twice.
    """
    return repeated(fit, data, with_uncertain_drive(model or fit, data))


def with_uncertain_drive(fit: Fit, data: Dataset) -> Dataset:
    """`data` with the drive's share in every covariance; the same object where it is negligible."""
    if not fit.converged:
        return data
    parts = [tuple(_added(fit, b) for b in group) for group in (data.fit, data.validation)]
    old = (*data.fit, *data.validation)
    if all(a is b for a, b in zip((*parts[0], *parts[1]), old, strict=True)):
        return data
    return replace(data, fit=parts[0], validation=parts[1])


def _added(fit: Fit, batch: Batch) -> Batch:
    if batch.free or batch.drive_noise is None or not np.any(batch.drive_noise > 0):
        return batch
    orbits = balance.solve(fit.structure, fit.theta, batch.at)
    S = balance.drive_sensitivity(fit.structure, fit.theta, batch.at, orbits)
    K, total = batch.compared, batch.at.harmonics
    seen = S[:, np.r_[0:K, total : total + K]]
    recorded = np.any(batch.at.drive != 0, axis=0)  # harmonics of the drive that were measured
    seen = seen[:, :, np.r_[recorded, recorded]]
    added = 0.5 * batch.drive_noise[:, None, None] * (seen @ np.swapaxes(seen, 1, 2))
    own = np.diagonal(batch.covariance, axis1=1, axis2=2)
    share = np.diagonal(added, axis1=1, axis2=2) / own
    if not np.isfinite(added).all() or np.max(share) < NEGLIGIBLE:
        return batch
    covariance = batch.covariance + added
    return replace(
        batch,
        covariance=covariance,
        whitener=np.stack([whitener(c) for c in covariance]),
        noise=batch.noise + np.diagonal(added, axis1=1, axis2=2).reshape(-1, 2, K).sum(axis=1),
    )
