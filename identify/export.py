"""Out of here: JSON by contract, MATLAB files, state space, a summary in plain text.

`to_json` writes `identification/1` or `diagnosis/1`; `to_mat` the same with arrays, for MATLAB and
Octave; `to_state_space` gives the linear parts for scipy.signal and python-control.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from identify.fit import Fit
from identify.report.gallery import Result, assessments
from identify.report.summary import summary_text
from identify.results import Assessment
from identify.statespace import Part, StateSpace, state_space

__all__ = ["summary_text", "to_json", "to_mat", "to_state_space"]


def to_json(result: Result, path: Path | str | None = None) -> str:
    """The result as JSON text (`formats.md`), written to `path` where one is given.

    Strict JSON: what has no value (an infinite χ², an undetermined standard error) is null.
    """
    text = json.dumps(strict(result.to_json()), indent=2, ensure_ascii=False, allow_nan=False)
    if path is not None:
        Path(path).write_text(text + "\n", encoding="utf-8")
    return text


def strict(value: Any) -> Any:
    """The same structure with plain types, and null for what is no finite number."""
    if isinstance(value, Mapping):
        return {str(k): strict(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [strict(v) for v in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value if value is None or isinstance(value, str) else str(value)


def to_state_space(fit: Fit, part: Part = "forward", band_hz: float | None = None) -> StateSpace:
    """(A, B, C, D) of a linear part of the loop; see `identify.statespace.state_space`.

    Inputs and outputs: ``forward`` from drive (V) and flame output (m) to velocity (m/s), ``flame``
    from that velocity to the flame's input (m), ``closed_loop`` from drive to both. Frequency
    responses with their standard errors: `identify.report.responses.responses`.
    ``scipy.signal.StateSpace(*to_state_space(fit))`` and ``control.ss(*to_state_space(fit))``.
    """
    return state_space(fit, part, band_hz)


def to_mat(path: Path | str, result: Result) -> Path:
    """Write a MATLAB 5 file with one variable, the structure ``entrain``.

    Fields: campaign, verdict (diagnoses), `before` and `after`, each with scalars, `parameters`
    (name → value, stderr, unit; dots in names become underscores), `runs` (name, frequency,
    amplitude, measured, predicted, stderr) and, where one exists, `forward`, `flame` and
    `closed_loop` as A, B, C, D; json holds the result by contract.
    """
    from scipy.io import savemat

    before, after = assessments(result)
    content: dict[str, Any] = {
        "campaign": result.campaign,
        "json": to_json(result),
        "before": _mat(before),
        "after": _mat(before if after is None else after),
    }
    verdict = getattr(result, "verdict", None)
    if verdict is not None:
        content["verdict"] = verdict
    target = Path(path)
    savemat(target, {"entrain": content}, long_field_names=True, oned_as="row")
    return target


def _mat(a: Assessment) -> dict[str, Any]:
    out: dict[str, Any] = {
        "converged": a.fit.converged,
        "fit_error": a.fit_error,
        "validation_error": a.validation_error,
        "noise_floor": a.noise_floor,
        "expected_error": a.expected_error,
        "chi2_per_dof": a.chi2_per_dof,
        "dof": float(a.dof),
        "runs": _runs(a),
    }
    if not a.fit.converged:
        return out
    out["parameters"] = {
        name.replace(".", "_"): {"value": e.value, "stderr": e.stderr, "unit": e.unit}
        for name, e in a.parameters.items()
    }
    out["theta"], out["covariance"] = a.fit.theta, a.fit.covariance
    parts: tuple[Part, ...] = ("forward", "flame", "closed_loop")
    try:
        systems: dict[str, Any] = {part: state_space(a.fit, part)._asdict() for part in parts}
    except ValueError as error:  # an effect without a finite state space: said, not hidden
        out["state_space_missing"] = str(error)
    else:
        out.update(systems)
    return out


def _runs(a: Assessment) -> dict[str, Any]:
    rows = a.comparisons
    K = min((c.measured.size for c in rows), default=0)

    def known(x: float | None) -> float:
        return np.nan if x is None else float(x)

    return {
        "name": np.array([c.run for c in rows], dtype=object),
        "kind": np.array([c.kind for c in rows], dtype=object),
        "role": np.array([c.role for c in rows], dtype=object),
        "frequency_hz": np.array([c.frequency_hz for c in rows]),
        "amplitude_v": np.array([known(c.amplitude_v) for c in rows]),
        "started_s": np.array([c.started_s for c in rows]),
        "measured": np.array([c.measured[:K] for c in rows]),
        "predicted": np.array([c.predicted[:K] for c in rows]),
        "stderr": np.array([c.stderr[:K] for c in rows]),
    }
