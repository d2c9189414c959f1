"""What the fundamentals alone tell of the singing mode, corrected for effects of assumed size.

Near the limit cycle amplitude and phase of the fundamental change slowly, and U₁/Y₁ is nearly
linear in the frequency and in |Y₁|²: three complex numbers, robust where the whole model is wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from identify.dataset import Batch, Dataset
from identify.effect import Effect, at_the_flame, driven
from identify.pieces import Mode, Values
from identify.start.vectors import named, of_others, usual_placements
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]


def corrected(data: Dataset, effects: Sequence[Effect], p: Values) -> Dataset | None:
    """The data as they would be without `effects` of assumed values `p`, as far as these stand
    between the recorded drive and the sound, or between the velocity and its measurement.

    None where the values are so extreme that nothing finite is left.
    """

    def clean(b: Batch) -> Batch:
        s = b.at.s
        drive, y = driven(effects, p, b.at, b.at.drive), at_the_flame(effects, p, b.at, s)
        for e in effects:
            drive = e.actuator(p, b.at, s) * drive
        at = replace(b.at, drive=np.broadcast_to(drive, y.shape), velocity=y)
        return replace(b, at=at, measured=y[:, : b.compared])

    with np.errstate(all="ignore"):
        batches = tuple(clean(b) for b in data.fit)
    finite = all(np.isfinite(b.at.drive).all() and np.isfinite(b.measured).all() for b in batches)
    return replace(data, fit=batches) if finite else None


@dataclass(frozen=True)
class SlowFlow:
    """What the fundamentals alone tell: U₁/Y₁ = z₀ + z₁ (ω − ω₀) + z₂ |Y₁|² (complex z).

    For a single mode, a U₁/Y₁ ≈ 2ζω₁ + 2j(ω − ω₁) − r jω H(jω) (1 + ¾ c₃ |w|²): the slope gives
    the speaker residue, the argument of z₂ the flame's phase and so its pole, z₀ the growth.
    """

    a: float
    z0: complex
    z2: complex
    pole: float  # rad/s
    omega: float
    flame_phase: complex
    misfit: float


def slow_flow(data: Dataset, effects: Sequence[Effect] = (), p: Values | None = None) -> SlowFlow:
    """Least squares over the forced runs' fundamentals, the free run included as U = 0.

    `effects` with assumed values `p` correct drive, velocity, flame phase and modal frequency
    first, through their own hooks. The misfit is relative to the drive.
    """
    p = p or {}
    rows, right, w0 = [], [], 2 * np.pi * data.free_hz
    phase = 1.0 + 0j
    for b in data.fit:
        s = b.at.s
        drive, y = driven(effects, p, b.at, b.at.drive), at_the_flame(effects, p, b.at, s)
        modes = [Mode(1.0, 1.0, 1.0, 1.0)]
        for e in effects:
            drive = e.actuator(p, b.at, s) * drive
            modes = e.modes(p, b.at, modes)
        shift = np.broadcast_to(np.asarray(modes[0].frequency_hz, dtype=float), (b.runs, 1))[:, 0]
        Y, U = y[:, 0], np.broadcast_to(drive, y.shape)[:, 0]
        columns = [Y, Y * (b.at.omega - w0 * shift), Y * np.abs(Y) ** 2]
        weight = 1.0 / (np.abs(Y) + 1e-300) * b.at.flame_on
        rows.append(np.stack(columns, axis=1) * weight[:, None])
        right.append(U * weight)
    one = data.fit[0].at.take(np.array([0]))
    for e in effects:
        phase = phase * complex(np.ravel(e.flame(p, one, np.array([[1j * w0]])))[0])
    A, target = np.concatenate(rows), np.concatenate(right)
    scale = np.sqrt(np.sum(np.abs(A) ** 2, axis=0)) + 1e-300
    z = np.linalg.lstsq(A / scale, target, rcond=1e-9)[0] / scale
    rest = target - A @ z
    misfit = float(np.sum(np.abs(rest) ** 2) / (np.sum(np.abs(target) ** 2) + 1e-300))
    slope = 2j / z[1] if z[1] != 0 else 1.0 + 0j
    a = float(np.sign(slope.real) * np.abs(slope)) or 1.0
    # −r jω H φ |H|² · ¾ c₃: with r > 0 and c₃ < 0 its argument is that of jωφ/(jω + ω_f)
    angle = float(np.angle(a * z[2] / phase))
    pole = w0 * np.tan(np.clip(angle, 0.1, 1.45))
    return SlowFlow(a, complex(z[0]), complex(z[2]), float(pole), w0, phase, misfit)


def slow_flow_vectors(
    structure: Structure,
    data: Dataset,
    effect_values: Sequence[Sequence[float]],
    placements: Sequence[tuple[float, ...]] | None,
) -> list[FloatArray]:
    """For each row of assumed values of the effects, dampings of the singing mode and places of the
    others."""
    return [v for row in effect_values for v in _vectors(structure, data, row, placements)]


def _vectors(
    structure: Structure,
    data: Dataset,
    effect_values: Sequence[float],
    placements: Sequence[tuple[float, ...]] | None,
) -> list[FloatArray]:
    names = [q.name for e in structure.effects for q in e.parameters]
    p = dict(zip(names, effect_values, strict=True))
    flow = slow_flow(data, structure.effects, {**p, "flame.pole_hz": data.free_hz})
    w0, others = flow.omega, of_others(structure, "frequency_hz")
    unknowns = [structure.parameters.parameters[i] for i in others]
    placed = [
        [q.to_internal(x * w0 / (2 * np.pi)) for q, x in zip(unknowns, ratios, strict=True)]
        for ratios in placements or usual_placements(len(others))
    ]
    thetas = []
    for pole in (flow.pole, 0.6 * w0) if structure.flame_order else (0.0,):
        gain = 1j * w0 / (1j * w0 + pole) * flow.flame_phase
        for zeta in (0.004, 0.012, 0.035):
            # Re: 2ζω₁ − r Re(jωH) = Re(a z₀);  Im: 2(ω₀ − ω₁) − r Im(jωH) = Im(a z₀)
            r = (2 * zeta * w0 - (flow.a * flow.z0).real) / (gain.real or 1e-9)
            w1 = w0 - 0.5 * ((flow.a * flow.z0).imag + r * gain.imag)
            h2 = 1.0 / abs(1j * w0 + pole) ** 2
            c3 = -float(np.abs(flow.a * flow.z2) / (0.75 * abs(r * gain) * h2 + 1e-300))
            values: dict[str, float] = {
                **p,
                "mode1.frequency_hz": float(np.clip(w1, 0.9 * w0, 1.1 * w0)) / (2 * np.pi),
                "mode1.damping": zeta,
                "mode1.flame_residue": float(r),
                "mode1.speaker_residue": flow.a,
            }
            for i in range(2, structure.mode_count + 1):
                values[f"mode{i}.frequency_hz"] = w0 / (2 * np.pi)
                values[f"mode{i}.damping"] = 0.03
                values[f"mode{i}.flame_residue"] = 0.05 * float(r)
                values[f"mode{i}.speaker_residue"] = 0.05 * flow.a
            for j in range(1, structure.flame_order + 1):
                key = "flame.pole_hz" if j == 1 else f"flame.pole{j}_hz"
                values[key] = pole * (1.0 if j == 1 else 5.0 * j) / (2 * np.pi)
            theta = named(structure, values, [0.0, c3])
            for frequencies in placed:
                moved = theta.copy()
                moved[others] = frequencies
                thetas.append(moved)
    return thetas
