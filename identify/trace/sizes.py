"""Sizes that starting values lean on: of the declared fit, the drive and the misfit."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from identify import assess
from identify.dataset import Dataset
from identify.effect import Effect, Known
from identify.fit import Fit
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]

ROUGH = 0.05  # share of a coefficient's size that counts as noise where the search begins afar


def known_sizes(data: Dataset, fit: Fit) -> Known:
    """Sizes that starting values lean on."""
    v = fit.values
    n = fit.structure.mode_count
    forced = [b for b in data.fit if not b.free]
    velocity = float(np.median(np.concatenate([np.abs(b.measured[:, 0]) for b in forced])))
    drive = float(np.max(np.concatenate([np.abs(b.at.drive[:, 0]) for b in forced])))
    omega = np.concatenate([b.at.omega for b in forced]) / (2 * np.pi)
    pole = 2 * np.pi * v.get("flame.pole_hz", data.free_hz)
    return Known(
        free_hz=data.free_hz,
        modes_hz=tuple(v[f"mode{i}.frequency_hz"] for i in range(1, n + 1)),
        modes_damping=tuple(v[f"mode{i}.damping"] for i in range(1, n + 1)),
        flame_residues=tuple(v[f"mode{i}.flame_residue"] for i in range(1, n + 1)),
        speaker_residues=tuple(v[f"mode{i}.speaker_residue"] for i in range(1, n + 1)),
        flame_input_amplitude=velocity / abs(2j * np.pi * data.free_hz + pole),
        velocity_amplitude=velocity,
        drive_amplitude=drive,
        band_hz=(float(omega.min()), float(omega.max())),
    )


def louder(theta: FloatArray, names: Sequence[str], gain: float) -> FloatArray:
    """Unknowns of these names, the speaker `gain` times as loud."""
    spoken = [n.endswith("speaker_residue") for n in names]
    return np.where(spoken, theta * gain, theta)


def loudness(data: Dataset, effects: Sequence[Effect], p: Mapping[str, float]) -> float:
    """What effects of these values make of the drive at the free frequency: a factor whose sign
    is that of its real part (a resonance below it turns the sign), 1 where it says nothing."""
    at = data.fit[0].at.take(np.array([0]))
    s = np.array([[2j * np.pi * data.free_hz]])
    gain = complex(np.prod([np.ravel(e.actuator(p, at, s))[0] for e in effects]))
    signed = float(np.copysign(abs(gain), gain.real))
    return signed if np.isfinite(signed) and signed != 0 else 1.0


def beside(
    structure: Structure,
    theta: FloatArray,
    data: Dataset,
    effect: Effect,
    values: Sequence[float],
) -> FloatArray:
    """Unknowns of `structure` as they are with one more effect of these values: as loud."""
    p = {q.name: v for q, v in zip(effect.parameters, values, strict=True)}
    return louder(theta, structure.parameters.names, 1 / loudness(data, [effect], p))


def shares_of(base: Fit, data: Dataset) -> tuple[float, float, float]:
    """Noise of the stages as shares of each coefficient's size: of the size of the misfit.

    Much coarser, and an effect that explains it does no better than one that does not.
    """
    misfit = assess.relative_error(
        [assess.predict(base.structure, base.theta, b) for b in data.fit]
    )
    first = float(np.clip(2 * misfit, 1e-4, ROUGH)) if np.isfinite(misfit) else ROUGH
    return first, first / 5, min(0.003, first / 15)
