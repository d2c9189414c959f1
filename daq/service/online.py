"""The fit that goes with a campaign (`daq.online`): what is known so far, what is still missing.

After a usable run the declared model is fitted to everything recorded so far, from where the last
fit ended; where that does not end as well, from the data alone. The campaign has seen enough once
the fit has converged, every wanted standard error is reached, and noise explains the rest
(p > `LEAST_P`): a precise parameter of a model that does not fit is worth nothing.
"""

from pathlib import Path
from typing import Any

from daq.errors import InputError
from daq.events import Review, Reviewer
from daq.online import Online
from daq.plan import Plan
from daq.schedule import Outcome
from identify.assess import lack_of_fit_p
from identify.fit import Fit, fit_orbits
from identify.identification import Prepared, declared_structure, fit_structure, prepare
from identify.load import load_campaign
from identify.record import DeclaredModel

LEAST_P = 0.01
WORSE = 2.0  # times the χ² a degree of freedom of the last fit: started anew


def reviewer(plan: Plan) -> Reviewer | None:
    """What `run_campaign` shall ask after each run; None where the plan does not ask for it.

    Raises `InputError` where a wanted parameter is none of the model's.
    """
    if plan.online is None:
        return None
    names = declared_structure(DeclaredModel(**plan.declared_model)).parameters.names
    for name in plan.online.wanted:
        if name not in names:
            raise InputError(
                f"online.wanted: {name!r} is not a parameter of the declared model: "
                f"{', '.join(names)}"
            )
    return OnlineFit(plan.online)


class OnlineFit:
    """A `Reviewer` that remembers its last fit."""

    def __init__(self, wanted: Online) -> None:
        self._wanted = wanted
        self._last: Fit | None = None
        self._looks = 0

    def __call__(self, folder: Path, outcome: Outcome) -> Review | None:
        """Fit what is recorded; None before there is enough to fit, and between looks."""
        if outcome.kind != "forced":
            return None
        campaign = load_campaign(folder)
        forced = [r for r in campaign.runs if r.kind == "forced" and r.exit_status == "success"]
        if len([r for r in forced if r.role == "fit"]) < self._wanted.after_runs:
            return None
        self._looks += 1
        if (self._looks - 1) % self._wanted.every:
            return None
        try:
            ready = prepare(campaign)
        except ValueError as error:  # the runs so far cannot be fitted: later ones may
            return Review({"runs": len(forced), "converged": False, "reason": str(error)})
        fit = self._last = self._fit(ready)
        return self._judge(fit, len(forced))

    def _fit(self, ready: Prepared) -> Fit:
        if self._last is not None and self._last.converged:
            fit = fit_orbits(ready.structure, ready.data, self._last.theta, continuation=(0.0,))
            if fit.converged and fit.chi2_per_dof < WORSE * max(1.0, self._last.chi2_per_dof):
                return fit
        return fit_structure(ready.structure, ready.data)

    def _judge(self, fit: Fit, runs: int) -> Review:
        p = lack_of_fit_p(fit.chi2, fit.dof)
        parameters = {name: found.to_json() for name, found in fit.estimates.items()}
        relative = {
            name: found.stderr / abs(found.value) if found.value else float("inf")
            for name, found in fit.estimates.items()
        }
        limits = self._limits(relative)
        missing = {name: relative[name] for name, most in limits.items() if relative[name] > most}
        data: dict[str, Any] = {
            "runs": runs,
            "converged": fit.converged,
            "chi2_per_dof": fit.chi2_per_dof,
            "p": p,
            "parameters": parameters,
            "relative_error": {name: _finite(value) for name, value in relative.items()},
            "missing": {name: _finite(value) for name, value in missing.items()},
        }
        return Review(data, fit.converged and bool(limits) and not missing and p > LEAST_P)

    def _limits(self, relative: dict[str, float]) -> dict[str, float]:
        most = self._wanted.relative_error
        every = {} if most is None else dict.fromkeys(relative, most)
        return {**every, **self._wanted.wanted}


def _finite(value: float) -> float | None:
    return value if value < float("inf") else None
