"""Actuator: what stands between the recorded drive and the sound at the speaker."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.effect import Conditions, Effect, Known
from identify.parameters import Parameter
from identify.pieces import Bent, Mode, Values
from identify.structure import resonance

FloatArray = npt.NDArray[np.float64]

#: Least lag of an amplifier and a speaker that is plausible, s: 3 dB down at 160 kHz. Where little
#: noise shows less than that, such a phase may come from anything.
FASTEST_S = 1e-6
SLOWEST_HZ = 0.1  # least corner of an amplifier's coupling: a time constant of 1.6 s
UNEQUAL = (0.87, 0.95, 1.05, 1.15)  # of one level, where the two of a pair are sought


class SpeakerResonance(Effect):
    """A second-order speaker: ω²/(s² + 2ζωs + ω²), or s² over the same for ``acceleration``."""

    name, location = "actuator_dynamics", "actuator"
    parameters = (
        Parameter("actuator_dynamics.frequency_hz", "Hz", 5.0, 5e3, "positive"),
        Parameter("actuator_dynamics.damping", "1", 0.005, 5.0, "positive"),
    )
    located = ("actuator_dynamics.frequency_hz",)

    def __init__(self, form: str) -> None:
        self.form = form

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        f = known.free_hz
        return [(0.6 * f, 0.2), (0.85 * f, 0.15), (1.2 * f, 0.15), (2.0 * f, 0.3), (1.0 * f, 0.4)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """From a lag T: far below its resonance a speaker lags by 2ζ/ω."""
        if self.form != "resonance" or not isinstance(other, VoiceCoil | ActuatorDelay):
            return super().starts_from(other, values)
        lag = values[other.parameters[0].name]
        return [(z / (np.pi * lag), z) for z in (0.15, 0.3, 0.6)] if lag > 0 else []

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        w = 2 * np.pi * p["actuator_dynamics.frequency_hz"]
        top = w * w if self.form == "resonance" else s * s
        return top / (s * s + 2.0 * p["actuator_dynamics.damping"] * w * s + w * w)


class VoiceCoil(Effect):
    """First-order lag of the voice coil, 1/(1 + sT)."""

    name, location, form = "actuator_dynamics", "actuator", "pole"
    parameters = (Parameter("actuator_dynamics.time_s", "s", FASTEST_S, 0.1, scale=1e-4),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.03 / known.free_hz,), (0.3 / known.free_hz,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        return 1.0 / (s * p["actuator_dynamics.time_s"] + 1.0)


class Coupling(Effect):
    """An amplifier that passes no direct voltage: a first-order high-pass, s/(s + ω)."""

    name, location, form = "actuator_dynamics", "actuator", "highpass"
    parameters = (Parameter("actuator_dynamics.corner_hz", "Hz", SLOWEST_HZ, 1e3, scale=10.0),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.03 * known.free_hz,), (0.3 * known.free_hz,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        return s / (2 * np.pi * p["actuator_dynamics.corner_hz"] + s)


class LaggingResonance(Effect):
    """A second-order speaker behind a first-order lag: its resonance and its coil, or a plenum."""

    name, location, form = "actuator_dynamics", "actuator", "resonance_pole"
    resonance, lag = SpeakerResonance("resonance"), VoiceCoil()
    parameters = (*resonance.parameters, *lag.parameters)
    located = resonance.located

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(*row, *self.lag.starts(known)[0]) for row in self.resonance.starts(known)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        if other.form != "resonance":
            return []
        f, z = (values[q.name] for q in other.parameters)
        return [(f, z, 0.0), (f, z, 0.1 / f)]

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        return self.resonance.actuator(p, at, s) * self.lag.actuator(p, at, s)


class SpeakerPeak(Effect):
    """A peak or a notch that the speaker's enclosure adds to an even response:
    (s² + 2(ζ + g)ωs + ω²)/(s² + 2ζωs + ω²), 1 + g/ζ the response at ω.

    Runs far from ω tell g alone: neither ζ nor how high the peak is.
    """

    name, location, form = "actuator_dynamics", "actuator", "peak"
    parameters = (
        Parameter("actuator_dynamics.strength", "1", -5.0, 10.0, scale=1e-2),
        *SpeakerResonance.parameters,
    )
    located = ("actuator_dynamics.strength", *SpeakerResonance.located)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        sizes = (0.5, -0.5)
        return [(size * z, f, z) for size in sizes for _, f, z in self.shapes(known)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        if other.form != "resonance":
            return []
        f, z = (values[q.name] for q in other.parameters)
        return [(0.5 * z, f, z), (-0.5 * z, f, z)]

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        places = (0.7, 0.95, 1.05, 1.4, 1.9, 2.1, 2.7, 3.1)
        return [(0.0, q * known.free_hz, z) for q in places for z in (0.05, 0.2)]

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        strength, f, zeta = (p[q.name] for q in self.parameters)
        return resonance(Mode(f, zeta, 0.0, 0.0), s) * (4 * np.pi * f * strength) + 1.0


class ActuatorDelay(Effect):
    """A delay between the recorded drive and the sound.

    A delay of both microphones against the drive is the same thing seen from the other side.
    """

    name, location, form = "actuator_dynamics", "actuator", "delay"
    parameters = (Parameter("actuator_dynamics.delay_s", "s", 0.0, 0.05, scale=1e-4),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(q,) for q in known.delays(cycles=4.0)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        return dual.exp(-(s * p["actuator_dynamics.delay_s"]))


class Distortion(Effect):
    """Polynomial distortion of the drive: u + α₂ u² + α₃ u³ (compression where α₃ < 0)."""

    name, location = "actuator_nonlinearity", "actuator"
    smooth = True

    def __init__(self, powers: tuple[int, ...]) -> None:
        self.powers = powers
        words = {2: "quadratic", 3: "cubic", 5: "quintic", 7: "septic"}
        self.form = "_".join(words[d] for d in powers)
        self.parameters = tuple(
            Parameter(f"actuator_nonlinearity.a{d}", f"V^-{d - 1}") for d in powers
        )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        u = known.drive_amplitude
        return [tuple(-0.02 / u ** (d - 1) for d in self.powers)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,) * len(self.powers)

    def amplifier(self, p: Values, v: FloatArray) -> Bent:
        power = [np.ones_like(v), v]  # products: far faster than powers
        while len(power) <= max(self.powers):
            power.append(power[-1] * v)
        output, slope = v, power[0]
        by: list[tuple[Callable[[], FloatArray], Any]] = []
        for d in self.powers:
            given = p[f"actuator_nonlinearity.a{d}"]
            share = dual.value(given)
            output, slope = output + share * power[d], slope + d * share * power[d - 1]
            by.append((partial(np.asarray, power[d]), given))
        return Bent(output, slope, tuple(by))


class PowerCompression(Effect):
    """A voice coil that warms: a gain of 1/(1 + hU²), U the amplitude of the drive's fundamental.

    It follows the power of many periods, and so makes no harmonics.
    """

    name, location, form = "actuator_nonlinearity", "actuator", "power_compression"
    parameters = (Parameter("actuator_nonlinearity.per_power", "V^-2", scale=1e-2),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(q / known.drive_amplitude**2,) for q in (0.02, 0.2)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def drive(self, p: Values, at: Conditions, u: Any) -> Any:
        first = u[:, :1]
        power = (first * dual.conj(first)).real
        return u / (power * p["actuator_nonlinearity.per_power"] + 1.0)


class Clipping(Effect):
    """The amplifier saturates: L tanh(u/L)."""

    name, location, form = "actuator_nonlinearity", "actuator", "saturation"
    rails = smooth = True
    parameters = (Parameter("actuator_nonlinearity.inverse_level", "1/V", 0.0, np.inf, "even"),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.3 / known.drive_amplitude,), (1.0 / known.drive_amplitude,)]

    def amplifier(self, p: Values, v: FloatArray) -> Bent:
        given = p["actuator_nonlinearity.inverse_level"]
        inverse = dual.value(given)
        curve = np.tanh(v * inverse)
        slope = 1.0 - curve * curve
        output = curve / inverse
        return Bent(output, slope, ((lambda: (v * slope - output) / inverse, given),))


class HardClipping(Effect):
    """The amplifier's rails: the drive is cut off at ± a level."""

    name, location, form = "actuator_nonlinearity", "actuator", "clipping"
    rails = True
    parameters = (Parameter("actuator_nonlinearity.level_v", "V", 1e-9, np.inf, "positive"),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(share * known.drive_amplitude,) for share in (0.25, 0.5, 0.7, 0.85, 0.96)]

    def amplifier(self, p: Values, v: FloatArray) -> Bent:
        given = p["actuator_nonlinearity.level_v"]
        level = dual.value(given)
        cut = np.abs(v) > level
        # only the cut samples depend on the level; their harmonics are its derivative
        return Bent(
            np.clip(v, -level, level), np.where(cut, 0.0, 1.0), ((lambda: np.sign(v) * cut, given),)
        )


class UnequalClipping(Effect):
    """Rails of an amplifier that are not alike: the drive is cut off at one level above and at
    another below."""

    name, location, form = "actuator_nonlinearity", "actuator", "unequal_clipping"
    rails = True
    parameters = (
        Parameter("actuator_nonlinearity.upper_v", "V", 1e-9, np.inf, "positive"),
        Parameter("actuator_nonlinearity.lower_v", "V", 1e-9, np.inf, "positive"),
    )
    refines = True

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        u = known.drive_amplitude
        return [(q * share * u, share * u / q) for share in (0.5, 0.8) for q in UNEQUAL]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Levels on either side of one that stands for both."""
        both = [values[q.name] for q in other.parameters if q.unit == "V"]
        return [(q * level, level / q) for level in both for q in UNEQUAL]

    def amplifier(self, p: Values, v: FloatArray) -> Bent:
        upper, lower = p["actuator_nonlinearity.upper_v"], p["actuator_nonlinearity.lower_v"]
        top, bottom = dual.value(upper), -dual.value(lower)
        above, below = v > top, v < bottom
        return Bent(
            np.clip(v, bottom, top),
            np.where(above | below, 0.0, 1.0),
            (
                (lambda: np.where(above, 1.0, 0.0), upper),
                (lambda: np.where(below, -1.0, 0.0), lower),
            ),
        )


class Crossover(Effect):
    """An amplifier that passes nothing within ± a level, and beyond it what exceeds it."""

    name, location, form = "actuator_nonlinearity", "actuator", "crossover"
    parameters = (Parameter("actuator_nonlinearity.level_v", "V", 1e-9, np.inf, "positive"),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(share * known.drive_amplitude,) for share in (0.005, 0.03, 0.1)]

    def amplifier(self, p: Values, v: FloatArray) -> Bent:
        given = p["actuator_nonlinearity.level_v"]
        level = dual.value(given)
        passed = np.abs(v) > level
        left = v - np.clip(v, -level, level)
        return Bent(left, np.where(passed, 1.0, 0.0), ((lambda: -np.sign(v) * passed, given),))


class UnequalHalves(Effect):
    """An amplifier of two halves, or a speaker, whose gain is not the same for either sign of the
    drive: u + a |u|."""

    name, location, form = "actuator_nonlinearity", "actuator", "unequal_halves"
    parameters = (Parameter("actuator_nonlinearity.asymmetry", "1", -0.5, 0.5, scale=1e-2),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.02,), (-0.02,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def amplifier(self, p: Values, v: FloatArray) -> Bent:
        given = p["actuator_nonlinearity.asymmetry"]
        share, size = dual.value(given), np.abs(v)
        return Bent(v + share * size, 1.0 + share * np.sign(v), ((lambda: size, given),))


class Knee(Effect):
    """An amplifier near its rails: u / (1 + |u/L|ⁿ)^(1/n), linear below L, ± L above.

    The order n is the knee's sharpness (Rapp's model of amplifiers; n → ∞ clips hard).
    """

    name, location, form = "actuator_nonlinearity", "actuator", "knee"
    rails = True
    parameters = (
        Parameter("actuator_nonlinearity.level_v", "V", 1e-9, np.inf, "positive"),
        Parameter("actuator_nonlinearity.order", "1", 1.0, 60.0, "positive"),
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        u = known.drive_amplitude
        return [(share * u, n) for share in (0.35, 0.6, 0.9) for n in (3.0, 8.0)]

    def amplifier(self, p: Values, v: FloatArray) -> Bent:
        L, n = p["actuator_nonlinearity.level_v"], p["actuator_nonlinearity.order"]
        level, order = dual.value(L), dual.value(n)
        ratio = np.maximum(np.abs(v) / level, 1e-12)
        power = ratio**order
        q = 1.0 + power
        gain = q ** (-1.0 / order)
        out = v * gain

        def by_level() -> FloatArray:
            return np.asarray(out * power / q / level)

        def by_order() -> FloatArray:
            bend = np.log(q) / order**2 - power * np.log(ratio) / (order * q)
            return np.asarray(out * bend)

        return Bent(out, gain / q, ((by_level, L), (by_order, n)))


EFFECTS: tuple[Effect, ...] = (
    SpeakerResonance("resonance"),
    SpeakerResonance("acceleration"),
    VoiceCoil(),
    Coupling(),
    LaggingResonance(),
    SpeakerPeak(),
    ActuatorDelay(),
    Distortion((2,)),
    Distortion((3,)),
    Distortion((2, 3)),
    Distortion((3, 5)),
    PowerCompression(),
    Clipping(),
    HardClipping(),
    UnequalClipping(),
    Crossover(),
    UnequalHalves(),
    Knee(),
)
