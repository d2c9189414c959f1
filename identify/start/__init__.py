"""Starting values from data alone, and the fits that begin there.

`poles` and `slow_flow` each make starts of their own, `vectors` says where the modes that do not
sing may lie, `rough` sorts and leads on at coarse noise, `kinds` puts them together and `fits`
takes the best to the likelihood's maximum; `reseat` moves a mode that does nothing there.
"""

from identify.start.fits import (
    NEARLY,
    fit_declared,
    fit_from_balance,
    fit_from_data,
    other_minima,
)
from identify.start.kinds import distant_starts, every_start, physical_starts, signed_starts
from identify.start.poles import candidates
from identify.start.reseat import reseated
from identify.start.rough import CoarseStart, coarse, distinct, polish
from identify.start.slow_flow import corrected
from identify.start.vectors import dense_placements

__all__ = [
    "NEARLY",
    "CoarseStart",
    "candidates",
    "coarse",
    "corrected",
    "dense_placements",
    "distant_starts",
    "distinct",
    "every_start",
    "fit_declared",
    "fit_from_balance",
    "fit_from_data",
    "other_minima",
    "physical_starts",
    "polish",
    "reseated",
    "signed_starts",
]
