"""Linear parts of a fitted loop as state space: forward path, flame path, closed loop.

A mode, y'' + 2ζω y' + ω² y = a u' ' + r F'', has two states in observer form:

    y = r F + z₁,   z₁' = a u' − 2ζω y + z₂,   z₂' = −ω² y

A branch beside the tube feeds the velocity at its mouth back to the modes as a force. First-order
lags have one state. A delay is no finite state space: it becomes a Padé approximation whose order
follows from the error asked for within a band. What effects add to the actuator, the flame path
and beside the tube is known only as a function of s: it is recognised as a rational function of
low order or as a pure delay, and refused otherwise.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import comb, factorial
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.dual import Dual
from identify.effect import Conditions, Effect
from identify.fit import Fit
from identify.pieces import Branch, Mode
from identify.structure import MODAL, Structure, declared_modes

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
Part = Literal["forward", "flame", "closed_loop"]

ACCURACY = 1e-11  # relative, of recognised rational functions and of Padé approximations
HIGHEST_ORDER = 4  # of an effect's transfer function
PADE_PHASE_RAD = 3.0  # one Padé section turns at most by this in the band


class StateSpace(NamedTuple):
    """x' = A x + B u, y = C x + D u. Unpacks as (A, B, C, D)."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray

    def frequency_response(self, s: ComplexArray) -> ComplexArray:
        """C (sI − A)⁻¹ B + D at the complex frequencies `s` (rad/s), (len(s), outputs, inputs)."""
        eye = np.eye(self.A.shape[0])
        inner = np.linalg.solve(s[:, None, None] * eye - self.A, self.B.astype(complex))
        return np.asarray(self.C @ inner + self.D)

    def to_scipy(self) -> Any:
        """A `scipy.signal.StateSpace`."""
        from scipy.signal import StateSpace as Scipy

        return Scipy(*self)

    def to_control(self) -> Any:
        """A `control.StateSpace`; needs the package ``control``, imported here and only here."""
        try:
            from control import ss  # type: ignore[import-not-found,unused-ignore]
        except ImportError as error:
            raise ImportError("package control is missing: pip install control") from error
        return ss(*self)


def standing_still(rows: int = 1) -> Conditions:
    """Conditions of no particular run, at the campaign's start: for the linear parts."""
    nothing = np.zeros((rows, 1), dtype=complex)
    return Conditions(
        omega=np.zeros(rows),
        drive=nothing,
        pressure=nothing,
        velocity=nothing,
        time=np.zeros(rows),
        flame_on=np.ones(rows),
        identity=np.zeros(rows, dtype=np.int64),
        free=np.zeros(rows, dtype=bool),
        spacing_m=np.ones(rows),
    )


def state_space(fit: Fit, part: Part = "forward", band_hz: float | None = None) -> StateSpace:
    """One linear part of a fitted loop.

    Parameters
    ----------
    part
        ``forward``: from drive (V) and flame output (m) to the velocity at the flame (m/s);
        ``flame``: from that velocity to the flame's input w (m);
        ``closed_loop``: from drive to velocity and w with the nonlinearity's slope at zero, the
        growth of small oscillations.
    band_hz
        Delays are approximated to 1e-11 up to here; default: four times the highest mode.

    Raises
    ------
    ValueError
        The fit did not converge, or an effect's transfer function is neither a rational function
        of order 4 or less nor a causal delay.
    """
    if not fit.converged:
        raise ValueError(f"the fit did not converge ({fit.reason}); it has no state space")
    p = fit.values
    modes = _modes(fit.structure, p)
    top = band_hz if band_hz is not None else 4.0 * max(float(m.frequency_hz) for m in modes)
    band = 2 * np.pi * top
    if part == "forward":
        return _forward(fit.structure, p, modes, band)
    if part == "flame":
        return _flame(fit.structure, p, modes, band)
    return _closed(
        _forward(fit.structure, p, modes, band),
        _flame(fit.structure, p, modes, band),
        small_signal_slope(fit.structure, p),
    )


def linear_poles(
    structure: Structure, p: dict[str, float], gain: float | None = None
) -> ComplexArray:
    """Poles (rad/s, Im >= 0) of the closed loop with `gain`, default N′(0), for the nonlinearity.

    Effects without a state space are left out, and Padé's own far poles are cut off: these are
    starting points for the poles of the exact equations.
    """
    modes = _modes(structure, p)
    w0 = 2 * np.pi * modes[0].frequency_hz
    band = 4 * 2 * np.pi * max(m.frequency_hz for m in modes)
    kept = []
    for e in structure.effects:
        try:
            realise(partial(e.flame, p, standing_still()), e.key, w0, band)
        except ValueError:
            continue
        kept.append(e)
    reduced = replace(structure, effects=tuple(kept))
    acoustics = _acoustics(structure, p, modes, band)
    slope = small_signal_slope(structure, p) if gain is None else gain
    found = np.linalg.eigvals(_closed(acoustics, _flame(reduced, p, modes, band), slope).A)
    return np.asarray(found[(found.imag >= 0) & (np.abs(found) < band)], dtype=complex)


def small_signal_slope(structure: Structure, p: dict[str, float]) -> float:
    """N′(0) of the characteristic with all effects."""
    n = structure.assemble(p, standing_still(), np.array([[1j]])).N[0]
    zero = Dual(np.zeros((1, 1)), np.ones((1, 1, 1)))
    return float(dual.derivative(n(zero), (1, 1), 1)[0, 0, 0])


def _modes(structure: Structure, p: dict[str, float]) -> list[Mode]:
    modes = declared_modes(p, structure.mode_count)
    for e in structure.effects:
        modes = e.modes(p, standing_still(), modes)
    return [Mode(*(float(np.ravel(getattr(m, n))[0]) for n in MODAL)) for m in modes]


def _acoustics(
    structure: Structure, p: dict[str, float], modes: list[Mode], band: float
) -> StateSpace:
    tube = _tube(modes)
    for e in structure.effects:
        if type(e).branch is not Effect.branch:
            tube = _beside(tube, e, p, modes, band)
    return tube


def _tube(modes: list[Mode]) -> StateSpace:
    n = len(modes)
    A, B = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2))
    C, D = np.zeros((1, 2 * n)), np.zeros((1, 2))
    for i, m in enumerate(modes):
        w = 2 * np.pi * m.frequency_hz
        decay, spring = 2 * m.damping * w, w * w
        here = slice(2 * i, 2 * i + 2)
        A[here, here] = [[-decay, 1.0], [-spring, 0.0]]
        B[here] = [[m.speaker_residue, -decay * m.flame_residue], [0.0, -spring * m.flame_residue]]
        C[0, 2 * i] = 1.0
        D[0, 1] += m.flame_residue
    return StateSpace(A, B, C, D)


def _beside(
    tube: StateSpace, effect: Effect, p: dict[str, float], modes: list[Mode], band: float
) -> StateSpace:
    """The tube with a branch: v = Σ q_i y_i there, and the force −g_i Z v on mode i."""

    def branch(s: Any) -> Branch:
        found = effect.branch(p, modes, s)
        assert found is not None
        return found

    w0 = 2 * np.pi * modes[0].frequency_hz
    load = realise(lambda s: branch(s).impedance, effect.key, w0, band) or _gain(1.0)
    still = branch(np.array([[1j * w0]]))
    felt, returned = (np.array(x, dtype=float) for x in (still.felt, still.returned))
    A, B, C, D = tube
    there, through = np.zeros_like(C), np.zeros_like(D)
    there[0, ::2] = felt
    through[0, 1] = sum(q * m.flame_residue for q, m in zip(felt, modes, strict=True))
    force = np.zeros((A.shape[0], 1))
    force[::2, 0] = -returned
    back = force @ load.D
    none = np.zeros((1, load.A.shape[0]))
    return StateSpace(
        np.block([[A + back @ there, force @ load.C], [load.B @ there, load.A]]),
        np.vstack([B + back @ through, load.B @ through]),
        np.hstack([C, none]),
        D,
    )


def _forward(
    structure: Structure, p: dict[str, float], modes: list[Mode], band: float
) -> StateSpace:
    acoustics = _acoustics(structure, p, modes, band)
    w0 = 2 * np.pi * modes[0].frequency_hz
    for e in structure.effects:
        actuator = realise(partial(e.actuator, p, standing_still()), e.key, w0, band)
        if actuator is not None:
            acoustics = _before(acoustics, actuator)
    return acoustics


def _flame(structure: Structure, p: dict[str, float], modes: list[Mode], band: float) -> StateSpace:
    chain = []
    for j in range(1, structure.flame_order + 1):
        pole = 2 * np.pi * p["flame.pole_hz" if j == 1 else f"flame.pole{j}_hz"]
        gain = 1.0 if j == 1 else pole
        chain.append(_companion(np.array([0.0, gain]), np.array([1.0, pole]), 1.0))
    if structure.flame_delay:
        chain.append(pade(p["flame.delay_s"], band))
    w0 = 2 * np.pi * modes[0].frequency_hz
    for e in structure.effects:
        added = realise(partial(e.flame, p, standing_still()), e.key, w0, band)
        if added is not None:
            chain.append(added)
    total = _gain(1.0)
    for link in chain:
        total = series(total, link)
    return total


def _closed(forward: StateSpace, flame: StateSpace, slope: float) -> StateSpace:
    """F = slope · w, w = flame(Y), Y = forward(u, F); outputs Y and w."""
    A1, B1, C1, D1 = forward
    A2, B2, C2, D2 = flame
    Bu, Bf = B1[:, :1], B1[:, 1:] * slope
    du, df = D1[:, :1], D1[:, 1:] * slope
    # Y = C1 x1 + du u + df w,  w = C2 x2 + D2 Y: solve for Y
    inverse = 1.0 / (1.0 - float((df @ D2)[0, 0]))
    Yx = inverse * np.hstack([C1, df @ C2])
    Yu = inverse * du
    wx = np.hstack([np.zeros((1, C1.shape[1])), C2]) + D2 @ Yx
    wu = D2 @ Yu
    zero = np.zeros((A1.shape[0], A2.shape[0]))
    A = np.block([[A1, zero], [zero.T, A2]]) + np.vstack([Bf @ wx, B2 @ Yx])
    B = np.vstack([Bu + Bf @ wu, B2 @ Yu])
    return StateSpace(A, B, np.vstack([Yx, wx]), np.vstack([Yu, wu]))


def realise(g: Callable[[Any], Any], name: str, w0: float, band: float) -> StateSpace | None:
    """State space of a transfer function given as a function of s; None where it is one."""
    x = np.geomspace(0.2, 5.0, 24)
    points = np.concatenate([1j * x, 0.3 * x])
    # an effect may answer with a plain number where it changes nothing
    values = np.broadcast_to(np.asarray(g(w0 * points[:, None])), (points.size, 1))[:, 0]
    if np.allclose(values, 1.0, rtol=0, atol=1e-14):
        return None
    logs = np.log(np.abs(values[24:])) / (w0 * points[24:].real)
    if np.ptp(logs) <= 1e-9 * abs(logs[0]) and np.allclose(np.abs(values[:24]), 1.0, atol=1e-9):
        if logs[0] > 0:
            raise ValueError(
                f"effect {name!r}: delay {-logs[0]:.3g} s is negative; no causal state space"
            )
        return pade(-float(logs[0]), band)
    for order in range(HIGHEST_ORDER + 1):
        found = _rational(points, values, order)
        if found is not None:
            return _companion(*found, w0)
    raise ValueError(
        f"effect {name!r}: its transfer function is neither rational of order <= {HIGHEST_ORDER} "
        "nor a delay; use its frequency response instead"
    )


def _rational(x: ComplexArray, g: ComplexArray, order: int) -> tuple[FloatArray, FloatArray] | None:
    """(numerator, denominator) by falling power of x with real coefficients, or None."""
    powers = x[:, None] ** np.arange(order, -1, -1)
    # numerator − g · (denominator's lower powers) = g · x^order, the denominator being monic
    matrix = np.hstack([powers, -g[:, None] * powers[:, 1:]])
    right = g * x**order
    real = np.concatenate([matrix.real, matrix.imag])
    norm = np.linalg.norm(real, axis=0)
    target = np.concatenate([right.real, right.imag])
    found = np.linalg.lstsq(real / norm, target, rcond=None)[0] / norm
    top, bottom = found[: order + 1], np.r_[1.0, found[order + 1 :]]
    modelled = np.polyval(top, x) / np.polyval(bottom, x)
    return (top, bottom) if np.max(np.abs(modelled / g - 1)) < ACCURACY else None


def _companion(top: FloatArray, bottom: FloatArray, w0: float) -> StateSpace:
    """Observer form of top/bottom, polynomials in s/w0 by falling power, bottom monic."""
    n = bottom.size - 1
    if n == 0:
        return _gain(float(top[0]))
    through = float(top[0])
    A = np.zeros((n, n))
    A[:, 0] = -bottom[1:]
    A[:-1, 1:] = np.eye(n - 1)
    B = (top[1:] - through * bottom[1:])[:, None]
    C = np.zeros((1, n))
    C[0, 0] = 1.0
    return StateSpace(w0 * A, w0 * B, C, np.array([[through]]))


def pade(delay_s: float, band: float) -> StateSpace:
    """e^{−sτ} to `ACCURACY` for |ω| ≤ `band` (rad/s): equal diagonal Padé sections in series.

    Section [n/n] in x = sτ: Σ c_k (−x)^k / Σ c_k x^k with c_k = n!/(k! (n−k)!) · (2n−k)!/(2n)!.
    """
    sections = max(1, int(np.ceil(band * delay_s / PADE_PHASE_RAD)))
    tau = delay_s / sections
    x = 1j * np.linspace(0.05, 1.0, 20) * band * tau
    for n in range(1, 16):
        k = np.arange(n, -1, -1)
        c = np.array([comb(n, int(i)) * factorial(2 * n - int(i)) / factorial(2 * n) for i in k])
        section = np.polyval(c * (-1.0) ** k, x) / np.polyval(c, x)
        if np.max(np.abs(section - np.exp(-x))) * sections < ACCURACY:
            break
    one = _companion(c * (-1.0) ** k / c[0], c / c[0], 1.0 / tau)
    total = one
    for _ in range(sections - 1):
        total = series(total, one)
    return total


def series(first: StateSpace, second: StateSpace) -> StateSpace:
    """second after first, both with one input and one output."""
    A1, B1, C1, D1 = first
    A2, B2, C2, D2 = second
    zero = np.zeros((A1.shape[0], A2.shape[0]))
    A = np.block([[A1, zero], [B2 @ C1, A2]])
    return StateSpace(A, np.vstack([B1, B2 @ D1]), np.hstack([D2 @ C1, C2]), D2 @ D1)


def _before(plant: StateSpace, actuator: StateSpace) -> StateSpace:
    """The plant with an actuator in front of its first input."""
    A, B, C, D = plant
    Aa, Ba, Ca, Da = actuator
    top = np.hstack([A, B[:, :1] @ Ca])
    low = np.hstack([np.zeros((Aa.shape[0], A.shape[0])), Aa])
    drive = np.vstack([B[:, :1] @ Da, Ba])
    rest = np.vstack([B[:, 1:], np.zeros((Aa.shape[0], B.shape[1] - 1))])
    return StateSpace(
        np.vstack([top, low]),
        np.hstack([drive, rest]),
        np.hstack([C, D[:, :1] @ Ca]),
        np.hstack([D[:, :1] @ Da, D[:, 1:]]),
    )


def _gain(value: float) -> StateSpace:
    return StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[value]]))
