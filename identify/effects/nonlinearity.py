"""Nonlinearity: another characteristic than the declared one."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from identify import dual
from identify.effect import Conditions, Effect, Known
from identify.parameters import Parameter
from identify.pieces import Characteristic, Operator, Passed, Values
from identify.polynomial import Polynomial
from identify.structure import Structure

Samples = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

CUBIC = 3  # the lowest power that bounds a limit cycle
POWERS = {2: "quadratic", 3: "cubic", 4: "quartic", 5: "quintic", 6: "sextic", 7: "septic"}


class HigherOrder(Effect):
    """Further powers of the flame's input, the next or the next but one, added to the declared
    polynomial."""

    name, location = "nonlinearity_shape", "nonlinearity"

    def __init__(self, powers: tuple[int, ...]) -> None:
        self.powers = powers
        self.form = "_".join(POWERS.get(d, f"power_{d}") for d in powers)
        self.parameters = tuple(
            Parameter(f"nonlinearity_shape.c{d}", f"m^-{d - 1}") for d in powers
        )

    def extends(self, structure: Structure) -> bool:
        return 0 < min(self.powers) - structure.highest_power <= 2

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        w = known.flame_input_amplitude
        return [tuple(-0.02 / w ** (d - 1) for d in self.powers)]

    def restated(self, structure: Structure) -> Structure | None:
        """What lacks the cubic term has no limit cycle, so that its own fit is no place to start
        from; what has it, is."""
        if max(self.powers) != CUBIC or structure.highest_power >= CUBIC:
            return None
        return replace(structure, nonlinearity="polynomial", degree=CUBIC)

    def from_restated(self, structure: Structure, values: Mapping[str, float]) -> list[float]:
        known = [values[q.name] for q in structure.base_parameters]
        return [*known, *(values[f"nonlinearity.c{d}"] for d in self.powers)]

    def to_restated(self, structure: Structure, values: Mapping[str, float]) -> dict[str, float]:
        known = {q.name: values[q.name] for q in structure.base_parameters}
        own = {f"nonlinearity.c{d}": values[f"nonlinearity_shape.c{d}"] for d in self.powers}
        return {**known, **own}

    def neutral(self) -> tuple[float, ...]:
        return (0.0,) * len(self.powers)

    def characteristic(self, p: Values, n: Characteristic, at: Conditions) -> Characteristic:
        coefficients = [p[f"nonlinearity_shape.c{d}"] for d in self.powers]
        if isinstance(n, Polynomial):
            return n.plus(self.powers, coefficients)

        def more(w: Any) -> Any:
            total = n(w)
            for d, c in zip(self.powers, coefficients, strict=True):
                total = total + w**d * c
            return total

        return more


class Saturation(Effect):
    """The flame's input saturates before the declared characteristic acts on it.

    ``tanh``: L tanh(w/L); ``algebraic``: w/√(1 + (w/L)²); ``arctan``: L arctan(w/L); ``rational``:
    w/(1 + |w|/L).
    """

    name, location = "nonlinearity_shape", "nonlinearity"
    parameters = (Parameter("nonlinearity_shape.inverse_level", "1/m", 0.0, np.inf, "even"),)

    def __init__(self, form: str) -> None:
        self.form = form
        self.refines = form in ("arctan", "rational")

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.3 / known.flame_input_amplitude,), (1.0 / known.flame_input_amplitude,)]

    def characteristic(self, p: Values, n: Characteristic, at: Conditions) -> Characteristic:
        inverse = p["nonlinearity_shape.inverse_level"]
        if self.form == "tanh":
            return lambda w: n(dual.tanh(w * inverse) / inverse)
        if self.form == "arctan":
            return lambda w: n(dual.arctan(w * inverse) / inverse)
        if self.form == "rational":
            return lambda w: n(w / (dual.absolute(w * inverse) + 1.0))
        return lambda w: n(w / dual.sqrt((w * inverse) ** 2 + 1.0))


def _rational(x: Any) -> Any:
    return x / (dual.absolute(x) + 1.0)


class SaturatingGain(Effect):
    """The linear term alone saturates, N(w) − w + L g(w/L), beside the declared higher powers.

    ``tanh_gain``: g = tanh; ``arctan_gain``: g = arctan; ``rational_gain``: g(x) = x/(1 + |x|).
    """

    name, location = "nonlinearity_shape", "nonlinearity"
    parameters = (Parameter("nonlinearity_shape.inverse_level", "1/m", 0.0, np.inf, "even"),)

    def __init__(self, form: str) -> None:
        self.form = form
        laws = {"tanh_gain": dual.tanh, "arctan_gain": dual.arctan, "rational_gain": _rational}
        self.law, self.refines = laws[form], form == "rational_gain"

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(q / known.flame_input_amplitude,) for q in (0.2, 0.7, 2.0)]

    def characteristic(self, p: Values, n: Characteristic, at: Conditions) -> Characteristic:
        inverse = p["nonlinearity_shape.inverse_level"]
        return lambda w: n(w) - w + self.law(w * inverse) / inverse


class QuadraticOdd(Effect):
    """An odd term of second degree, b w|w|: the gain changes with the amplitude from the start."""

    name, location, form = "nonlinearity_shape", "nonlinearity", "quadratic_odd"
    parameters = (Parameter("nonlinearity_shape.bent", "m^-1"),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(q / known.flame_input_amplitude,) for q in (-0.05, -0.5)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def characteristic(self, p: Values, n: Characteristic, at: Conditions) -> Characteristic:
        bent = p["nonlinearity_shape.bent"]
        if isinstance(n, Polynomial):
            return n.bending(bent)
        return lambda w: n(w) + w * dual.absolute(w) * bent


class DeadZone(Effect):
    """Nothing passes within ±`width`; beyond it, what exceeds it does."""

    name, location, form = "nonlinearity_shape", "nonlinearity", "dead_zone"
    parameters = (Parameter("nonlinearity_shape.width", "m", 0.0, np.inf, "even", 1e-3),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(q * known.flame_input_amplitude,) for q in (0.005, 0.03, 0.15)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def operator(self, p: Values) -> Operator:
        width = p["nonlinearity_shape.width"]

        def zone(w: Samples) -> Passed:
            half = dual.value(width)
            side = np.where(np.abs(w) > half, np.sign(w), 0.0)
            own = np.broadcast_to(np.arange(w.shape[1]), w.shape)
            out = side * (np.abs(w) - half)
            return Passed(out, [(np.abs(side), own)], [(-side, width)])

        return zone


class SoftDeadZone(Effect):
    """Small motions pass with a lower gain: w − share · L tanh(w/L)."""

    name, location, form = "nonlinearity_shape", "nonlinearity", "soft_dead_zone"
    parameters = (
        Parameter("nonlinearity_shape.share", "1", -3.0, 3.0),
        Parameter("nonlinearity_shape.level", "m", 1e-12, 1e12, "positive"),
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        w = known.flame_input_amplitude
        return [(0.1, 0.2 * w), (0.1, 0.5 * w)]

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.0, float(q) * known.flame_input_amplitude) for q in np.geomspace(0.05, 1.0, 8)]

    def characteristic(self, p: Values, n: Characteristic, at: Conditions) -> Characteristic:
        share, level = p["nonlinearity_shape.share"], p["nonlinearity_shape.level"]
        return lambda w: n(w) - dual.tanh(w / level) * (level * share)


class Hysteresis(Effect):
    """Backlash: the characteristic's argument follows the flame's input a half-width behind.

    The play operator: an output y stays where it is while |y − w| ≤ `width`, and is carried along
    at that distance otherwise.
    """

    name, location, form = "nonlinearity_shape", "nonlinearity", "hysteresis"
    parameters = (Parameter("nonlinearity_shape.width", "m", 0.0, np.inf, "even", 1e-3),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(q * known.flame_input_amplitude,) for q in (0.002, 0.02, 0.1)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def operator(self, p: Values) -> Operator:
        width = p["nonlinearity_shape.width"]
        return lambda w: play(w, width)


def play(w: Samples, width: Any) -> Passed:
    """The play operator over one period of samples `w` (runs, samples), of half-width `width`."""
    x = np.ascontiguousarray(w)
    half = dual.column(width, x.shape[0])
    at, side = _contacts(x, half)
    # what was touched last is remembered: value and derivative of that moment
    out = np.take_along_axis(x, at, axis=1) + side * half[:, None]
    return Passed(out, [(np.ones_like(out), at)], [(side, width)])


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _contacts(x: Samples, half: Samples) -> tuple[Indices, Samples]:
    """When the play last touched, and on which side (−1 below, +1 above): both (runs, samples).

    Two periods, of which the first finds the state; a motion within the play touches nowhere and
    is taken as touching at its first sample.
    """
    at = np.zeros(x.shape, dtype=np.int64)
    side = np.zeros(x.shape)
    for r in range(x.shape[0]):
        y, last, sign = x[r, 0], 0, 0.0
        for lap in range(2):
            for i in range(x.shape[1]):
                if y < x[r, i] - half[r]:
                    y, last, sign = x[r, i] - half[r], i, -1.0
                elif y > x[r, i] + half[r]:
                    y, last, sign = x[r, i] + half[r], i, 1.0
                if lap == 1:
                    at[r, i] = last
                    side[r, i] = sign
    return at, side


EFFECTS: tuple[Effect, ...] = (
    *(HigherOrder((d,)) for d in POWERS),
    *(HigherOrder((d, d + 1)) for d in (2, 4, 6)),
    Saturation("tanh"),
    Saturation("algebraic"),
    Saturation("arctan"),
    Saturation("rational"),
    SaturatingGain("tanh_gain"),
    SaturatingGain("arctan_gain"),
    SaturatingGain("rational_gain"),
    QuadraticOdd(),
    DeadZone(),
    SoftDeadZone(),
    Hysteresis(),
)
