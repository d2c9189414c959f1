"""What the page draws of a fitted model: Nyquist curve, flame path, nonlinearity, with 95 % bands.

All from the assembled equations of `identify.structure`: L(jω) = H·Σ r_i b_i s is the small-signal
loop gain, 1 at the brink of oscillation; N the static characteristic over the range that the free
limit cycle reaches. Bands come from `DRAWS` parameter sets drawn from the fit's covariance.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from identify.results import Assessment, Comparison
from identify.statespace import standing_still
from identify.structure import Loop, Structure

FloatArray = npt.NDArray[np.float64]
DRAWS = 60


def comparisons(assessment: Assessment) -> list[dict[str, Any]]:
    """Measured and predicted harmonics of every run, and their difference in standard errors."""
    return [_comparison(row) for row in assessment.comparisons]


def _comparison(row: Comparison) -> dict[str, Any]:
    return {
        "run": row.run,
        "kind": row.kind,
        "role": row.role,
        "frequency_hz": row.frequency_hz,
        "amplitude_v": row.amplitude_v,
        "measured": _polar(row.measured),
        "predicted": _polar(row.predicted),
        "in_stderr": _finite(np.abs(row.normalised)),
    }


def _polar(values: npt.NDArray[np.complex128]) -> dict[str, list[float | None]]:
    return {
        "amplitude": _finite(np.abs(values)),
        "phase_deg": _finite(np.degrees(np.angle(values))),
    }


def _finite(values: FloatArray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def curves(assessment: Assessment, seed: int = 0) -> dict[str, Any] | None:
    """Curves of the fitted model with bands; None where the fit has not converged."""
    fit = assessment.fit
    cycle = assessment.measured_cycle or assessment.model_cycle
    if not fit.converged or cycle is None:
        return None
    structure, free_hz = fit.structure, cycle.frequency_hz
    frequency = np.unique(np.append(_grid(fit.values, free_hz), free_hz))
    at = int(np.searchsorted(frequency, free_hz))
    best = _loop(structure, fit.values, frequency)
    reach = 1.1 * float(np.abs(_column(best.H, frequency))[at]) * cycle.amplitude
    inputs = np.linspace(-reach, reach, 81)
    draws = np.random.default_rng(seed).multivariate_normal(
        fit.theta, fit.covariance, DRAWS, check_valid="ignore", method="svd"
    )
    gains, outputs = [], []
    for theta in draws:
        loop = _loop(structure, structure.parameters.plain(theta), frequency)
        gains.append(_column(loop.P[0][0], frequency))
        outputs.append(_output(loop, inputs))
    gain = _column(best.P[0][0], frequency)
    return {
        "frequency_hz": frequency.tolist(),
        "free_hz": free_hz,
        "loop": {"re": gain.real.tolist(), "im": gain.imag.tolist()},
        "gain_db": _banded(_db(gain), _db(np.array(gains))),
        "phase_deg": np.degrees(np.unwrap(np.angle(gain))).tolist(),
        "flame_input": inputs.tolist(),
        "flame_output": _banded(_output(best, inputs), np.array(outputs)),
    }


def _grid(values: dict[str, float], free_hz: float) -> FloatArray:
    """Frequencies that draw every resonance's circle in even steps of its phase.

    Near a mode the phase goes by arctan of the detuning over ζ f; with steps of it even, so are
    those along the Nyquist curve. An even grid beside it shows the rest.
    """
    modes = [name.removesuffix(".frequency_hz") for name in values if name.endswith("frequency_hz")]
    turns = np.tan(np.linspace(-1.54, 1.54, 121))
    parts = [np.linspace(0.3 * free_hz, 1.3 * max(values[f"{m}.frequency_hz"] for m in modes), 300)]
    for mode in modes:
        centre = values[f"{mode}.frequency_hz"]
        width = abs(values.get(f"{mode}.damping", 0.01)) * centre
        near = centre + width * turns
        parts.append(near[(near > parts[0][0]) & (near < parts[0][-1])])
    return np.unique(np.concatenate(parts))


def _loop(structure: Structure, values: dict[str, float], frequency: FloatArray) -> Loop:
    unit = np.ones((1, frequency.size), dtype=np.complex128)
    at = replace(standing_still(), drive=unit)
    return structure.assemble(values, at, 2j * np.pi * frequency[None, :])


def _column(value: Any, frequency: FloatArray) -> npt.NDArray[np.complex128]:
    row: npt.NDArray[np.complex128] = np.broadcast_to(
        np.asarray(value, dtype=np.complex128), (1, frequency.size)
    )[0]
    return row


def _output(loop: Loop, inputs: FloatArray) -> FloatArray:
    row: FloatArray = np.asarray(loop.N[0](inputs[None, :]), dtype=np.float64)[0]
    return row


def _db(gain: npt.NDArray[np.complex128]) -> FloatArray:
    return np.asarray(20 * np.log10(np.maximum(np.abs(gain), 1e-12)))


def _banded(best: FloatArray, drawn: FloatArray) -> dict[str, list[float]]:
    low, high = np.quantile(drawn, (0.025, 0.975), axis=0)
    return {"value": best.tolist(), "low": low.tolist(), "high": high.tolist()}
