"""The thesis's own estimators, for comparison and for starts (Sections 3.4, 4.5 to 4.7, 5.3, 5.4).

They work on arrays (`EntrainedRuns`), need no noise model and return the thesis's identification
error. With noise they fail (`identify.fit` does not): see each module's text.
"""

from identify.thesis.balance import BalanceFit, Feedback, closed_loop, open_loop
from identify.thesis.residual import (
    Place,
    ResidualDynamics,
    Surface,
    error_surface,
    with_residuals,
)
from identify.thesis.runs import EntrainedRuns
from identify.thesis.search import Search, search_flame_pole, search_gain

__all__ = [
    "BalanceFit",
    "EntrainedRuns",
    "Feedback",
    "Place",
    "ResidualDynamics",
    "Search",
    "Surface",
    "closed_loop",
    "error_surface",
    "open_loop",
    "search_flame_pole",
    "search_gain",
    "with_residuals",
]
