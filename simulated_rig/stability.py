"""Is a periodic orbit stable? Floquet multipliers from the variational equation.

Along an orbit a small disturbance obeys δx' = (A + Σ b_c g_c'(t) c_c) δx, with period T. Its
monodromy matrix is the product of matrix exponentials of the equation frozen at the middle of
short intervals with the fourth-order Magnus correction; multipliers are its eigenvalues. An orbit
is stable when all lie inside the unit circle (for a free cycle: all but the one at 1, its phase).

A flame delay makes the state infinite: it is then replaced by an all-pass of `PADE` lags
((1 − sτ/2n)/(1 + sτ/2n))ⁿ, good while ωτ/2n ≪ 1.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from simulated_rig.orbits import Balance, ComplexArray, Orbit, forced_orbits
from simulated_rig.plant import Plant
from simulated_rig.statespace import FLAME, LOSS, FloatArray
from simulated_rig.threads import one_thread

INTERVALS = 64
PADE = 4
MARGIN = 1e-9


@dataclass(frozen=True)
class Stability:
    """`multipliers` by falling size; `kind` as the thesis colours them: stable nodes (and foci),
    saddles (one real multiplier beyond +1: a fold was passed), and `drifting` (a complex pair
    beyond the circle: the free oscillation is not suppressed)."""

    multipliers: ComplexArray
    stable: bool
    kind: str


def _delayed(a: FloatArray, row: FloatArray, delay_s: float) -> tuple[FloatArray, FloatArray]:
    """`a` grown by a chain of all-passes behind `row`; the chain's own couplings and output row.

    y = (1 − sT)/(1 + sT) u is p' = (u − p)/T, y = 2p − u with T = τ/2n... applied n times.
    """
    n, t = a.shape[0], delay_s / (2 * PADE)
    grown = np.zeros((n + PADE, n + PADE))
    grown[:n, :n] = a
    source = np.concatenate([row, np.zeros(PADE)])
    for i in range(PADE):
        grown[n + i] = source / t
        grown[n + i, n + i] -= 1 / t
        source = -source
        source[n + i] += 2.0
    return grown, source


def monodromy(balance: Balance, orbit: Orbit) -> FloatArray:
    """Disturbances after one period, per disturbance now."""
    system = balance.system
    slopes = balance.slopes(orbit)
    a, z = system.a, system.z
    if balance.plant.flame.delay_s > 0:
        a, z = _delayed(system.a, system.z, balance.plant.flame.delay_s)
    n = a.shape[0]
    b = np.zeros((n, 4))
    b[: system.order] = system.b
    loss = np.zeros(n)
    loss[: system.order] = system.loss

    def frozen(f: float, l: float) -> FloatArray:
        # z and u_L as rows of the state; u_L sees f directly.
        out = a + f * np.outer(b[:, FLAME], z)
        if balance.lossy:
            seen = loss + system.loss_direct * f * z
            out = out + l * np.outer(b[:, LOSS], seen)
        return np.asarray(out)

    step = 1 / (orbit.frequency_hz * INTERVALS)
    # Magnus, fourth order: from the two Gauss points c = ½ ∓ √3/6 of each interval.
    at = (np.arange(INTERVALS)[:, None] + 0.5 + np.array([-1, 1]) * np.sqrt(3) / 6) / INTERVALS
    first, second = (_at(slopes, at[:, i]) for i in range(2))
    # Balanced, so that exponentials of η and v are of one size.
    size = np.ones(n)
    w = np.sqrt(np.maximum(-np.diag(system.a[system.modes :])[: system.modes], 1.0))
    size[: system.modes] = 1 / w
    product = np.eye(n)
    generators = np.empty((INTERVALS, n, n))
    for i in range(INTERVALS):
        one = frozen(first[0, i], first[-1, i]) / size[:, None] * size[None, :]
        two = frozen(second[0, i], second[-1, i]) / size[:, None] * size[None, :]
        commutator = two @ one - one @ two
        generators[i] = step / 2 * (one + two) + step**2 * np.sqrt(3) / 12 * commutator
    for factor in expm(generators):
        product = factor @ product
    return np.asarray(product)


def _at(slopes: FloatArray, place: FloatArray) -> FloatArray:
    """Band-limited interpolation of periodic samples at `place` (in periods)."""
    spectrum = np.fft.rfft(slopes, axis=1) / slopes.shape[1]
    k = np.arange(spectrum.shape[1])
    weights = np.where((k == 0) | (k == slopes.shape[1] // 2), 1.0, 2.0)
    turn = np.exp(2j * np.pi * np.outer(k, place))
    return np.asarray(((spectrum * weights) @ turn).real)


@one_thread
def stability(plant: Plant, orbit: Orbit) -> Stability:
    """Floquet multipliers of `orbit` and what they say."""
    balance = Balance(plant, orbit.velocity.size - 1)
    found = np.linalg.eigvals(monodromy(balance, orbit))
    found = found[np.argsort(-np.abs(found))].astype(np.complex128)
    # A free cycle's phase has the multiplier 1 but for rounding: the nearest one is left out.
    others = np.delete(found, np.argmin(np.abs(found - 1))) if orbit.free else found
    beyond = others[np.abs(others) > 1 + MARGIN]
    if beyond.size == 0:
        return Stability(found, True, "stable")
    if beyond.size == 1 and beyond[0].real > 0:
        return Stability(found, False, "saddle")
    return Stability(found, False, "drifting")


@dataclass(frozen=True)
class Entrained:
    """One point of a resonance map."""

    orbit: Orbit
    stability: Stability


def resonance_map(
    plant: Plant, frequencies_hz: FloatArray, volts: FloatArray, harmonics: int = 5
) -> list[Entrained]:
    """Every orbit at every condition, with its stability (thesis Figs. 2.10, 2.11, 4.4)."""
    return [
        Entrained(orbit, stability(plant, orbit))
        for amplitude in volts
        for frequency in frequencies_hz
        for orbit in forced_orbits(plant, float(frequency), float(amplitude), harmonics)
    ]


def lock_in_volts(
    plant: Plant, frequency_hz: float, low_v: float, high_v: float, tolerance: float = 1e-3
) -> float:
    """The least drive with a stable orbit at that frequency, to a relative `tolerance`.

    Bisection between a drive that does not entrain and one that does.

    Raises
    ------
    ValueError
        When `low_v` entrains or `high_v` does not.
    """

    def entrains(volts: float) -> bool:
        return any(stability(plant, o).stable for o in forced_orbits(plant, frequency_hz, volts))

    if entrains(low_v) or not entrains(high_v):
        raise ValueError(
            f"low_v={low_v!r}, high_v={high_v!r} do not enclose the boundary at {frequency_hz} Hz"
        )
    while high_v - low_v > tolerance * high_v:
        middle = (low_v + high_v) / 2
        low_v, high_v = (low_v, middle) if entrains(middle) else (middle, high_v)
    return high_v
