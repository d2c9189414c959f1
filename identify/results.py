"""What identification and tracing hand over: plain, frozen, printable, and JSON by contract.

An `Assessment` is one model against the data: errors, χ², parameters, and every compared
coefficient, from which tables and figures are made. An `Identification` holds one assessment, a
`Diagnosis` two (before, after) with the evidence that leads from one to the other.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from identify.fit import Fit
from identify.lockin import LockIn
from identify.parameters import Estimate
from identify.profile import Interval
from identify.record import DeclaredModel
from identify.structure import Structure
from identify.whiteness import ResidualTest

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
Verdict = Literal["no_discrepancy", "traced", "ambiguous", "unexplained"]


@dataclass(frozen=True)
class QualityFlag:
    """Something wrong with one run's recording. `severity`: noted, down-weighted or excluded;
    `harmonics`: those concerned, if not the whole run; `error`: relative error of the run's
    coefficients that it may cause, 0 where that is not known."""

    run: str
    flag: str
    detail: str
    severity: Literal["noted", "down_weighted", "excluded"] = "noted"
    harmonics: tuple[int, ...] = ()
    error: float = 0.0

    def to_json(self) -> dict[str, Any]:
        return {
            "run": self.run,
            "flag": self.flag,
            "detail": self.detail,
            "severity": self.severity,
            "harmonics": list(self.harmonics),
            "relative_error": number(self.error),
        }


@dataclass(frozen=True)
class Comparison:
    """One run: measured and predicted Fourier coefficients of the velocity, (K,) complex, m/s.

    `stderr` is √E|noise|² of each coefficient, `predicted_stderr` that of the prediction, from
    the parameters' covariance (None: not converged). A free run is turned so that both fundamentals
    are real; `predicted_hz` is its own model frequency.
    """

    run: str
    kind: str
    role: str
    frequency_hz: float
    predicted_hz: float
    amplitude_v: float | None
    started_s: float
    measured: ComplexArray
    predicted: ComplexArray
    stderr: FloatArray
    predicted_stderr: FloatArray | None = None

    @property
    def normalised(self) -> ComplexArray:
        """(measured − predicted)/stderr, of order one where the model is right and infinite where
        it has no steady state."""
        rest = self.measured - self.predicted
        return np.asarray(rest.real / self.stderr + 1j * (rest.imag / self.stderr))


@dataclass(frozen=True)
class LimitCycle:
    """A free limit cycle: frequency (Hz), amplitude of the velocity (m/s), harmonics over the
    fundamental; standard errors where they exist. Of a model's cycle: whether it is `stable`, and
    the rate (1/s, negative: a decay) of the disturbance that dies out last."""

    frequency_hz: float
    amplitude: float
    harmonics: tuple[float, ...]
    frequency_stderr_hz: float | None = None
    amplitude_stderr: float | None = None
    stable: bool | None = None
    harmonics_stderr: tuple[float, ...] | None = None
    leading_rate_per_s: float | None = None

    def to_json(self) -> dict[str, Any]:
        return {
            "frequency_hz": self.frequency_hz,
            "amplitude": self.amplitude,
            "harmonics": list(self.harmonics),
            "frequency_stderr_hz": self.frequency_stderr_hz,
            "amplitude_stderr": self.amplitude_stderr,
            "stable": self.stable,
            "harmonics_stderr": None
            if self.harmonics_stderr is None
            else list(self.harmonics_stderr),
            "leading_rate_per_s": self.leading_rate_per_s,
        }


@dataclass(frozen=True)
class Assessment:
    """One fitted model against the data; `fit_p`: the chance that noise alone leaves as much of the
    fitted runs."""

    structure: Structure
    fit: Fit
    fit_error: float
    validation_error: float
    noise_floor: float
    comparisons: tuple[Comparison, ...]
    measured_cycle: LimitCycle | None
    model_cycle: LimitCycle | None
    cross_validated: bool = False
    lock_in: tuple[LockIn, ...] = ()
    residual_tests: tuple[ResidualTest, ...] = ()
    fit_p: float = float("nan")

    @property
    def chi2_per_dof(self) -> float:
        return self.fit.chi2_per_dof

    @property
    def dof(self) -> int:
        return self.fit.dof

    @property
    def parameters(self) -> dict[str, Estimate]:
        return self.fit.estimates

    @property
    def expected_error(self) -> float:
        """The validation error that noise and the parameters' uncertainty together would cause,
        √(Σ(E|noise|² + E|δŶ|²)/Σ|Y|²) over the validation runs: a model that is right stays near
        it. NaN without validation runs or where the fit did not converge."""
        held_out = [c for c in self.comparisons if c.role == "validation"]
        variance = power = 0.0
        for c in held_out:
            if c.predicted_stderr is None:
                return float("nan")
            variance += float(np.sum(c.stderr**2 + c.predicted_stderr**2))
            power += float(np.sum(np.abs(c.measured) ** 2))
        return float(np.sqrt(variance / power)) if power > 0 else float("nan")

    def to_json(self) -> dict[str, Any]:
        return {
            "converged": self.fit.converged,
            "reason": self.fit.reason,
            "fit_error": number(self.fit_error),
            "validation_error": number(self.validation_error),
            "expected_error": number(self.expected_error),
            "chi2_per_dof": number(self.chi2_per_dof),
            "dof": self.dof,
            "fit_p": number(self.fit_p),
            "parameters": {n: e.to_json() for n, e in self.parameters.items()}
            if self.fit.converged
            else {},
            "lock_in_boundary": [
                {
                    "run": b.run,
                    "frequency_hz": b.frequency_hz,
                    "drive_v": b.measured_v,
                    "boundary_v": b.boundary_v,
                    "boundary_stderr_v": number(b.stderr_v),
                    "lost_by": b.kind,
                }
                for b in self.lock_in
            ],
            "validation_predictions": [
                {
                    "run": c.run,
                    "frequency_hz": c.frequency_hz,
                    "amplitude_v": c.amplitude_v,
                    "measured": _complex(c.measured),
                    "predicted": _complex(c.predicted),
                    "stderr": [float(x) for x in c.stderr],
                    "predicted_stderr": None
                    if c.predicted_stderr is None
                    else [number(x) for x in c.predicted_stderr],
                }
                for c in self.comparisons
                if c.role == "validation"
            ],
            "residual_tests": {
                t.name: {"statistic": number(t.statistic), "p_value": number(t.p_value)}
                for t in self.residual_tests
            },
        }


@dataclass(frozen=True, repr=False)
class Identification:
    """The declared model fitted to a campaign."""

    campaign: str
    declared_model: DeclaredModel
    assessment: Assessment
    quality: tuple[QualityFlag, ...]
    seconds: float
    undetermined: tuple[str, ...] = ()  # combinations of parameters that the data do not fix
    intervals: Mapping[str, Interval] = field(default_factory=dict)  # 95 %, by parameter

    def __repr__(self) -> str:
        a = self.assessment
        said = f"χ²/dof {a.chi2_per_dof:.3g}" if a.fit.converged else a.fit.reason
        return f"<Identification of {self.campaign!r}: {said}>"

    def to_json(self) -> dict[str, Any]:
        a = self.assessment
        return {
            "format": "identification/1",
            "campaign": self.campaign,
            "declared_model": declared_json(self.declared_model),
            **a.to_json(),
            "noise_floor": number(a.noise_floor),
            "free_limit_cycle": {
                "measured": None if a.measured_cycle is None else a.measured_cycle.to_json(),
                "model": None if a.model_cycle is None else a.model_cycle.to_json(),
            },
            "quality": [q.to_json() for q in self.quality],
            "undetermined": list(self.undetermined),
            "intervals_95": {
                n: {"lower": i.lower, "upper": i.upper, "by": i.method}
                for n, i in self.intervals.items()
            },
            "seconds": self.seconds,
        }


@dataclass(frozen=True)
class Candidate:
    """One set of effects added to the declared model and refitted."""

    effects: tuple[str, ...]
    forms: tuple[str, ...]
    locations: tuple[str, ...]
    chi2: float
    chi2_per_dof: float
    validation_error: float
    p_value: float  # of the gain in χ² over the declared model, corrected for the search
    parameters: Mapping[str, Estimate]
    equivalent_to: tuple[str, ...] = ()
    plausible: bool = True
    adequate: bool = False  # its own lack of fit is within noise
    note: str = ""

    @property
    def key(self) -> str:
        return " + ".join(self.effects)

    @property
    def named(self) -> list[str]:
        """Each effect; with its form, ``flame_dynamics:pole``, where two go by the same name."""
        twice = len(set(self.effects)) < len(self.effects)
        pairs = zip(self.effects, self.forms, strict=True)
        return [f"{effect}:{form}" if twice and form else effect for effect, form in pairs]

    @property
    def words(self) -> str:
        """The effects as `equivalent_to` names them."""
        return " + ".join(self.named)

    @property
    def objection(self) -> str:
        """Why it does not explain the data; empty: it does."""
        if not self.adequate:
            return "misfit left"
        return "" if self.plausible else self.note or "implausible"

    def to_json(self) -> dict[str, Any]:
        return {
            "effects": list(self.effects),
            "forms": list(self.forms),
            "locations": list(self.locations),
            "chi2_per_dof": number(self.chi2_per_dof),
            "validation_error": number(self.validation_error),
            "p_value": number(self.p_value),
            "parameters": {n: e.to_json() for n, e in self.parameters.items()},
            "equivalent_to": list(self.equivalent_to),
            "plausible": self.plausible,
            "adequate": self.adequate,
            "note": self.note,
        }


@dataclass(frozen=True)
class TracedEffect:
    """One effect of the verdict, with its parameters.

    `other_forms` of the same effect do as well on these data: which law it follows is open.
    """

    effect: str
    location: str
    form: str
    parameters: Mapping[str, Estimate]
    other_forms: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        return {
            "effect": self.effect,
            "location": self.location,
            "form": self.form,
            "other_forms": list(self.other_forms),
            "parameters": {n: e.to_json() for n, e in self.parameters.items()},
        }


@dataclass(frozen=True)
class Residual:
    """Whether the declared model's misfit exceeds the noise, and what it looks like."""

    significant: bool
    p_value: float
    signature: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return {
            "significant": self.significant,
            "p_value": number(self.p_value),
            "signature": dict(self.signature),
        }


PLACES = {
    "forward": "forward path",
    "flame": "flame path",
    "nonlinearity": "nonlinearity",
    "actuator": "actuator",
    "sensor": "sensors",
    "experiment": "course of the experiment",
}


PARTLY = 10.0  # χ²/dof that a place's shape leaves, beyond which it is not what is missing


@dataclass(frozen=True)
class Whereabouts:
    """Where an unexplained misfit lies: what is left of it with a freely shaped piece, or a known
    effect that does better, at each place.

    `left` is χ²/dof by place, best first, `before` that of the declared model; `likely` are the
    places that are not ruled out, none where no place takes up most of the misfit. A place where
    nothing could be fitted is not in `left`, and not ruled out unless another explains it all.
    `from_run_to_run`: no law takes it up, but runs that each deviate at a likely place do.
    `together`: χ²/dof of several effects that leave far less than any one place; the likely places
    are then theirs, all of them (None: one place, or any of several).
    """

    likely: tuple[str, ...]
    left: Mapping[str, float]
    before: float
    from_run_to_run: bool = False
    together: float | None = None

    @property
    def words(self) -> str:
        """One sentence."""
        if not self.left:
            return "Where it lies is not known: no freely shaped piece could be fitted."
        listed = ", ".join(f"{place} {left:.3g}" for place, left in self.left.items())
        unknown = [place for place in self.likely if place not in self.left]
        listed += f"; no fit: {', '.join(unknown)}" if unknown else ""
        sizes = f"χ²/dof {self.before:.3g}; with a free shape or one effect in one place: {listed}"
        if not self.likely:
            return f"No place in the loop takes it up by itself ({sizes})."
        if self.together is not None:
            where = " and the ".join(PLACES[p] for p in self.likely)
            return (
                f"No one place takes it up; effects of the {where} together leave χ²/dof "
                f"{self.together:.3g} ({sizes})."
            )
        if len(self.likely) == len(PLACES) and not self.from_run_to_run:
            return f"It cannot be located: no place in the loop is ruled out ({sizes})."
        partly = min(self.left.values()) > PARTLY and not self.from_run_to_run
        sure = "lies" if len(self.likely) == 1 and not partly else "may lie"
        where = " or the ".join(PLACES[p] for p in self.likely)
        how = "differs from run to run and " if self.from_run_to_run else ""
        rest = (
            " No shape there takes it all up: it is of a kind that none follows." if partly else ""
        )
        return f"What is missing {how}{sure} in the {where} ({sizes}).{rest}"

    def to_json(self) -> dict[str, Any]:
        return {
            "likely": list(self.likely),
            "chi2_per_dof": {place: number(left) for place, left in self.left.items()},
            "before": number(self.before),
            "from_run_to_run": self.from_run_to_run,
            "together": self.together,
        }


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """What the declared model lacks, or that nothing known explains it."""

    campaign: str
    declared_model: DeclaredModel
    quality: tuple[QualityFlag, ...]
    before: Assessment
    residual: Residual
    candidates: tuple[Candidate, ...]
    verdict: Verdict
    effects: tuple[TracedEffect, ...]
    after: Assessment
    next_experiment: Mapping[str, Any] | None
    seconds: float
    explanation: str = ""
    whereabouts: Whereabouts | None = None  # of an unexplained misfit

    def __repr__(self) -> str:
        said = ", ".join(f"{e.effect} ({e.location})" for e in self.effects)
        return f"<Diagnosis of {self.campaign!r}: {self.verdict}{f', {said}' if said else ''}>"

    @property
    def noise_floor(self) -> float:
        return self.before.noise_floor

    def to_json(self) -> dict[str, Any]:
        return {
            "format": "diagnosis/1",
            "campaign": self.campaign,
            "declared_model": declared_json(self.declared_model),
            "seconds": self.seconds,
            "quality": [q.to_json() for q in self.quality],
            "noise_floor": number(self.noise_floor),
            "before": self.before.to_json(),
            "residual": self.residual.to_json(),
            "candidates": [c.to_json() for c in self.candidates],
            "verdict": self.verdict,
            "effects": [e.to_json() for e in self.effects],
            "after": self.after.to_json(),
            "next_experiment": None if self.next_experiment is None else dict(self.next_experiment),
            "explanation": self.explanation,
            "whereabouts": None if self.whereabouts is None else self.whereabouts.to_json(),
        }


def _complex(c: ComplexArray) -> list[list[float | None]]:
    """Complex numbers as [real, imaginary]."""
    return [[number(x.real), number(x.imag)] for x in c]


def number(x: float) -> float | None:
    """A JSON number, or null where there is none: JSON has no NaN and no infinity."""
    return float(x) if np.isfinite(x) else None


def declared_json(model: DeclaredModel) -> dict[str, Any]:
    return {
        "modes": model.modes,
        "flame": model.flame,
        "nonlinearity": model.nonlinearity,
        "nonlinearity_degree": model.nonlinearity_degree,
        **dict(model.options),
    }
