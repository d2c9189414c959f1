"""Balance least squares as in the thesis: closed loop (Eq. 4.17) and open loop (Eq. 4.21).

The flame's signal Yf = k_f/(s + ω_f) Y is formed by filtering with assumed numbers, powers of it
in the time domain are the basis functions, and everything else enters linearly:

    closed loop   D Y                  = (n_a,1 s³ + …) u_a + (n_f,1 s⁴ + …) (N₂ Yf² + N₃ Yf³)
    open loop     D Y − N(s) N₁ Yf     = the same right-hand side, with N₁ N(s) specified

In the closed-loop form N₁ Yf is left out (L1 = 0) and D stands for the closed loop. Its true
denominator has the flame's pole as well, which a D of order 2n cannot have: the estimate keeps a
bias on noise-free data. Measured velocities stand among the regressors, so noise biases both.

`retained` says of how many harmonics of Y the signal Yf is made. The thesis's numbers are those of
two (Eq. 4.18 is substituted everywhere); with all harmonics the open-loop form is exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from identify import periods
from identify.thesis.rows import regressors
from identify.thesis.runs import EntrainedRuns

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

BALANCED = 2  # harmonics (Eq. 4.18)
POWERS = (2, 3)  # L2 and L3 (Eq. 4.16)


@dataclass(frozen=True)
class Feedback:
    """What open-loop identification must know of the feedback beside its gain N₁.

    `numerator` holds n_f,3, n_f,2, n_f,1 in units where s is in rad/s: the forward path's
    zeros, s² (n_f,3 + n_f,2 s + n_f,1 s²) = s² Σ_i ψ_i D_i Π_{j≠i} (s² + 2ζ_jω_j s + ω_j²).
    `flame_gain` is k_f.
    """

    numerator: tuple[float, ...]
    flame_gain: float = 1.0

    @classmethod
    def of_modes(
        cls,
        frequency_hz: Sequence[float],
        damping: Sequence[float],
        residue: Sequence[float],
        flame_gain: float = 1.0,
    ) -> "Feedback":
        """From modes, with residues ψ_i(x_f) D_i."""
        dens = [
            np.array([w**2, 2 * z * w, 1.0])
            for w, z in zip(2 * np.pi * np.asarray(frequency_hz), damping, strict=True)
        ]
        total = np.zeros(2 * len(dens) - 1)
        for i, r in enumerate(residue):
            product = np.array([1.0])
            for j, den in enumerate(dens):
                if j != i:
                    product = np.convolve(product, den)
            total += r * product
        return cls(tuple(float(c) for c in total), flame_gain)


@dataclass(frozen=True)
class BalanceFit:
    """A solution of the balance equations.

    `denominator` (order + 1,), `drive` (zeros,) and `nonlinear` (powers, zeros) by rising power
    of x = s/ω₀; `nonlinear` holds the products n_f,j N_i that the thesis calls redundant.
    `error` is ‖A P − F‖/‖F‖ (Eq. 3.18 relative to the known side); `signal_peak` the largest
    |Yf|; `equations` and `unknowns` are counted real.
    """

    denominator: FloatArray
    drive: FloatArray
    nonlinear: FloatArray
    error: float
    scale_rad: float
    signal_peak: float
    flame_pole_hz: float
    equations: int

    @property
    def unknowns(self) -> int:
        return self.denominator.size - 1 + self.drive.size + self.nonlinear.size

    @property
    def roots(self) -> ComplexArray:
        """Roots of D in rad/s."""
        return np.asarray(np.roots(self.denominator[::-1]) * self.scale_rad, dtype=complex)

    @property
    def modes(self) -> tuple[tuple[float, float], ...]:
        """(frequency in Hz, damping ratio) of the complex pairs, by frequency."""
        pairs = [r for r in self.roots if r.imag > 1e-9 * self.scale_rad]
        found = [(abs(r) / (2 * np.pi), -r.real / abs(r)) for r in pairs]
        return tuple((float(f), float(z)) for f, z in sorted(found))

    def characteristics(self, signal: FloatArray) -> FloatArray:
        """n_f,j (N₂ w² + N₃ w³) for each j, normalised to −1 at its extreme, (zeros, n).

        Figs. 4.9, 4.10 and 5.7: were the model exact, all would be one curve.
        """
        powers = np.stack([(signal / self.signal_peak) ** d for d in POWERS])
        curves = self.nonlinear.T @ powers
        extreme = curves[np.arange(curves.shape[0]), np.argmax(np.abs(curves), axis=1)]
        return np.asarray(-curves / extreme[:, None])


def flame_signal(
    runs: EntrainedRuns,
    flame_pole_hz: float,
    gain: float,
    retained: int | None,
    filtered: ComplexArray | float = 1.0,
) -> ComplexArray:
    """Coefficients of Yf = gain/(s + ω_f) · filtered · Y, (runs, retained)."""
    K = runs.velocity.shape[1] if retained is None else retained
    if not 2 <= K <= runs.velocity.shape[1]:
        raise ValueError(
            f"retained={retained!r} is not within 2…{runs.velocity.shape[1]}, the harmonics given"
        )
    if not flame_pole_hz > 0:
        raise ValueError(f"flame_pole_hz={flame_pole_hz!r} is not a frequency > 0")
    whole = gain / (runs.s + 2 * np.pi * flame_pole_hz) * filtered * runs.velocity
    return np.asarray(whole[:, :K])


def solve(
    runs: EntrainedRuns,
    flame_pole_hz: float,
    signal: ComplexArray,
    known: ComplexArray | float = 0.0,
    forward: ComplexArray | float = 1.0,
    actuation: ComplexArray | float = 1.0,
    modes: int = 2,
) -> BalanceFit:
    """Least squares on the balance of two harmonics.

    Parameters
    ----------
    signal : coefficients of Yf.
    known : (runs, BALANCED) added to x^order Y: what feedback is specified.
    forward, actuation : (runs, K) residual dynamics before the forward path and before u_a.
    """
    w0, K = runs.scale_rad, BALANCED
    x = np.asarray(runs.s[:, :K] / w0)
    in_time = periods.to_time(signal, signal.shape[1])
    peak = float(np.max(np.abs(in_time)))
    basis = [periods.to_harmonics((in_time / peak) ** d, signal.shape[1])[:, :K] for d in POWERS]
    forward, actuation = (np.broadcast_to(q, runs.s.shape)[:, :K] for q in (forward, actuation))
    drive_size = float(np.max(np.abs(runs.drive)))
    columns, target = regressors(
        x,
        runs.velocity[:, :K],
        actuation * runs.drive[:, :K] / drive_size,
        basis,
        2 * modes,
        2 * modes - 1,
        forward,
    )
    A = columns.reshape(-1, columns.shape[-1])
    b = (target - known).ravel()
    A_real, b_real = np.concatenate([A.real, A.imag]), np.concatenate([b.real, b.imag])
    size = np.linalg.norm(A_real, axis=0)
    scaled = np.linalg.lstsq(A_real / size, b_real, rcond=None)[0]
    error = float(np.linalg.norm(A_real / size @ scaled - b_real) / np.linalg.norm(b_real))
    p, zeros = scaled / size, 2 * modes - 1
    rest = p[2 * modes :].reshape(-1, zeros)
    return BalanceFit(
        denominator=np.append(p[: 2 * modes], 1.0),
        drive=rest[0] / drive_size,
        nonlinear=rest[1:],
        error=error,
        scale_rad=w0,
        signal_peak=peak,
        flame_pole_hz=flame_pole_hz,
        equations=b_real.size,
    )


def closed_loop(
    runs: EntrainedRuns,
    flame_pole_hz: float,
    retained: int | None = None,
    flame_gain: float = 1.0,
    modes: int = 2,
) -> BalanceFit:
    """Closed-loop identification, L1 = 0 (Eq. 4.17), for an assumed flame pole.

    `retained`: harmonics of Y that Yf is made of; None: all.
    """
    signal = flame_signal(runs, flame_pole_hz, flame_gain, retained)
    return solve(runs, flame_pole_hz, signal, modes=modes)


def open_loop(
    runs: EntrainedRuns,
    flame_pole_hz: float,
    gain: float,
    feedback: Feedback,
    retained: int | None = None,
) -> BalanceFit:
    """Open-loop identification with the feedback's linear part specified (Eq. 4.21).

    D then belongs to the forward path: its roots are the acoustic modes. With `gain` 0 this is
    `closed_loop`.
    """
    modes = (len(feedback.numerator) + 1) // 2
    signal = flame_signal(runs, flame_pole_hz, feedback.flame_gain, retained)
    s, w0 = runs.s[:, :BALANCED], runs.scale_rad
    numerator = s**2 * np.polyval(feedback.numerator[::-1], s) / w0 ** (2 * modes)
    known = gain * numerator * signal[:, :BALANCED]
    return solve(runs, flame_pole_hz, signal, known, modes=modes)
