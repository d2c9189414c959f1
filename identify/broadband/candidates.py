"""Effects that a declared oscillator under broadband excitation may lack, and their score test.

Each candidate adds parameters whose neutral values leave the model as it is, so that the declared
fit's residual r can be tested against their sensitivities without refitting: with both whitened,
and the sensitivities freed of what the fitted parameters can absorb (their component along the
fit's own Jacobian), Δχ² = ‖projection of r on them‖² is what adding them would gain to first order.
`share` is Δχ² over χ²; `unabsorbed` the part of the sensitivity that the fit cannot imitate.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify.broadband.fit import Fit, Whitener
from identify.broadband.model import Excitation, Structure
from identify.chances import f_tail

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Candidate:
    """One effect of `formats.md` (or beside it) with the parameters that carry it.

    `probe` are the names probed at their neutral values; `starts` those of the refit.
    """

    effect: str
    location: str
    kind: str
    starts: tuple[tuple[str, float], ...]
    probe: tuple[str, ...]
    equivalent_to: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.starts)


def _term(effect: str, location: str, kind: str, name: str, *equivalent: str) -> Candidate:
    return Candidate(effect, location, kind, ((name, 0.0),), (name,), equivalent)


def candidates(sample_rate_hz: float) -> tuple[Candidate, ...]:
    """All effects tried. Friction starts at a threshold of 0.4 rms speeds, the recorder's edge at
    0.4 of the sample rate, as decimating converters have it."""
    return (
        _term("nonlinearity_shape", "nonlinearity", "cubic", "cubic"),
        _term("nonlinearity_shape", "nonlinearity", "quadratic", "quadratic", "operating_point"),
        _term("nonlinearity_shape", "nonlinearity", "quintic", "quintic"),
        _term("nonlinear_damping", "forward", "amplitude squared", "damping_y2"),
        _term("nonlinear_damping", "forward", "speed squared", "damping_v3"),
        Candidate(
            "nonlinear_damping",
            "forward",
            "saturating friction",
            (("friction", 0.0), ("friction_threshold", 0.4)),
            ("friction",),
        ),
        _term("actuator_nonlinearity", "actuator", "quadratic", "input_square"),
        _term("actuator_nonlinearity", "actuator", "cubic", "input_cube"),
        _term("actuator_dynamics", "actuator", "direct path", "feedthrough"),
        _term("channel_mismatch", "sensor", "sampling time", "delay", "actuator_dynamics"),
        Candidate(
            "recorder_filter",
            "sensor",
            "anti-alias filter of both channels",
            (("recorder_edge", 0.4 * sample_rate_hz), ("recorder_dispersion", 0.0)),
            ("recorder_dispersion",),
        ),
    )


@dataclass(frozen=True)
class Score:
    candidate: Candidate
    share: float
    delta_chi2: float
    p_value: float
    unabsorbed: float


def score_test(record: Excitation, fitted: Fit, whiten: Whitener) -> list[Score]:
    """Candidates not yet in the structure, the largest share first.

    p is Fisher's F of the share with as many degrees of freedom as the whitened vector has,
    Bonferroni-corrected for the number of candidates.
    """
    free = [
        c
        for c in candidates(record.sample_rate_hz)
        if not any(name in fitted.structure for name in c.names)
    ]
    neutral = {"friction_threshold": 0.4} if any("friction" in c.probe for c in free) else {}
    values = dict(zip(fitted.structure.names, fitted.theta, strict=True)) | neutral
    probed = Structure((*values, *(name for c in free for name in c.probe)))
    theta = np.array([values.get(name, 0.0) for name in probed.names])
    _, jacobian = record.predict(probed, theta)
    column = {name: jacobian[:, i] for i, name in enumerate(probed.names)}
    own = whiten(np.column_stack([column[name] for name in fitted.structure.names]))
    size = np.linalg.norm(own, axis=0)
    basis, _ = np.linalg.qr(own / np.where(size > 0, size, 1.0))
    residual = whiten(fitted.residual)
    residual = residual - basis @ (basis.T @ residual)
    total = float(residual @ residual)
    scores = []
    for c in free:
        s = whiten(np.column_stack([column[name] for name in c.probe]))
        size = np.linalg.norm(s, axis=0)
        s = s / np.where(size > 0, size, 1.0)
        s = s - basis @ (basis.T @ s)
        left = float(np.linalg.norm(s))
        q, _ = np.linalg.qr(s)
        gain = float(np.sum((q.T @ residual) ** 2))
        k, dof = len(c.probe), residual.size - own.shape[1] - len(c.probe)
        p = f_tail(gain / k / max((total - gain) / dof, 1e-300), k, dof)
        scores.append(Score(c, gain / total, gain, min(1.0, p * len(free)), left))
    return sorted(scores, key=lambda s: -s.share)
