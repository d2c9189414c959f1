"""Sensors: how the two-microphone velocity may differ from the velocity at the flame.

The measured pressures themselves say what a mismatch or an offset does: the correction is formed
from them and added to the prediction, so that it needs no model of the pressure field.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.effect import Conditions, Effect, Known
from identify.effects.heard import unbent
from identify.parameters import Parameter
from identify.pieces import Mode, Values

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]


def upper_pressure(at: Conditions, s: Any) -> Any:
    """Measured pressure at the upper microphone, from the mean pressure and the velocity."""
    return at.pressure - _half_the_difference(at, s)


def lower_pressure(at: Conditions, s: Any) -> Any:
    """The same at the lower microphone."""
    return at.pressure + _half_the_difference(at, s)


def _half_the_difference(at: Conditions, s: Any) -> Any:
    return s * (0.5 * at.density_kg_m3 * at.spacing_m[:, None]) * at.velocity


def as_velocity(at: Conditions, s: Any, pressure: Any) -> Any:
    """p/(ρ Δx s): what the two-microphone method takes p less at the upper microphone for."""
    return pressure / (s * (at.density_kg_m3 * at.spacing_m[:, None]))


def with_leak(at: Conditions, y: Any, leak: Any) -> Any:
    """Prediction plus a leak formed from measured signals, in the measurement's phase.

    A free run's orbit has a phase of its own: it is turned first, so that its fundamental stands
    where the measured one stands without the leak.
    """
    if not at.free.any():
        return y + leak
    target = (at.velocity - leak)[:, :1]
    z = target * dual.conj(y[:, :1])
    unit = z / dual.sqrt((z * dual.conj(z)).real)
    free = at.free[:, None]
    turn = dual.powers(unit, at.harmonics) * free + ~free
    return y * turn + leak


def heard_by_one(at: Conditions, s: Any, y: Any, inverse: Any, upper: bool) -> Any:
    """Prediction where one microphone reads 1/`inverse` times the pressure."""
    heard = upper_pressure(at, s) if upper else -lower_pressure(at, s)
    return with_leak(at, y, as_velocity(at, s, heard) * (inverse - 1.0))


class ChannelMismatch(Effect):
    """The upper microphone reads g times the pressure: gain, sampling time, phase, low- or
    high-pass.

    û_measured − û_true = −p̂₂ (1 − 1/g) / (ρ Δx s): common pressure leaks into the velocity. A skew,
    a phase and a low-pass time above zero are a lag of that microphone. Where the lower one lags
    (``lower_skew``, ``lower_lowpass``: below zero), both are late against the drive besides.
    """

    name, location = "channel_mismatch", "sensor"
    needs = ("pressure",)

    def __init__(self, form: str) -> None:
        self.form, self.upper = form, not form.startswith("lower_")
        gain = Parameter("channel_mismatch.gain", "1", -0.9, 9.0, scale=1e-3)
        skew = Parameter("channel_mismatch.skew_s", "s", -1e-2, 1e-2, scale=1e-6)
        phase = Parameter("channel_mismatch.phase_rad", "rad", -1.0, 1.0, scale=1e-3)
        lag = Parameter("channel_mismatch.lowpass_time_s", "s", -1e-2, 1e-2, scale=1e-6)
        corner = Parameter("channel_mismatch.highpass_hz", "Hz", -100.0, 100.0)
        self.parameters = {
            "gain": (gain,),
            "skew": (skew,),
            "lower_skew": (skew,),
            "gain_skew": (gain, skew),
            "phase": (phase,),
            "gain_phase": (gain, phase),
            "lowpass": (lag,),
            "lower_lowpass": (lag,),
            "highpass": (corner,),
            "gain_lowpass": (gain, lag),
            "gain_highpass": (gain, corner),
            "skew_lowpass": (skew, lag),
        }[form]
        self.refines = form in ("gain_lowpass", "gain_highpass", "skew_lowpass")

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        small = tuple(p.scale for p in self.parameters)
        if "gain" in self.form:  # as of another range of a preamplifier
            gains = (-0.65, -0.35, -0.03, 0.03, 0.5, 1.5, 4.0)  # 3 %: as of two microphones unlike
            return [small, *((gain, *small[1:]) for gain in gains)]
        if self.form not in ("skew", "lower_skew"):
            return [small]
        # as of a multiplexed converter, or of one that began later: of either
        lags = (1e-5, 3e-5, *known.delays(cycles=2.0))
        return [small, *((sign * q,) for q in lags for sign in (1.0, -1.0))]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,) * len(self.parameters)

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """With what it shares with another form, and the rest at nothing."""
        if not self.refines:
            return super().starts_from(other, values)
        known = {q.name for q in other.parameters}
        return [tuple(values[q.name] if q.name in known else 0.0 for q in self.parameters)]

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        inverse: Any = 1.0
        for q in self.parameters:
            value = p[q.name] if self.upper else -p[q.name]
            if q.name.endswith("gain"):
                inverse = inverse / (value + 1.0)
            elif q.name.endswith("skew_s"):
                inverse = inverse * dual.exp(s * value)
            elif q.name.endswith("phase_rad"):
                inverse = inverse * dual.exp(1j * value)
            elif q.name.endswith("highpass_hz"):
                inverse = inverse * (2 * np.pi * value / s + 1.0)
            else:
                inverse = inverse * (s * value + 1.0)
        return heard_by_one(at, s, y, inverse, self.upper)


class MicrophoneResonance(Effect):
    """One microphone's own resonance, of its membrane or of the hole before it: it reads
    1/(1 + 2ζs/ω + s²/ω²) times the pressure."""

    name, location = "channel_mismatch", "sensor"
    needs = ("pressure",)
    parameters = (
        Parameter("channel_mismatch.frequency_hz", "Hz", 50.0, 1e5, "positive"),
        Parameter("channel_mismatch.damping", "1", 0.005, 5.0, "positive"),
    )
    located = ("channel_mismatch.frequency_hz",)

    def __init__(self, upper: bool) -> None:
        self.upper, self.form = upper, "upper_resonance" if upper else "lower_resonance"

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(m * known.free_hz, z) for m in (6.0, 12.0, 30.0) for z in (0.1, 0.6)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """From a lag T of the upper one: far below its resonance a microphone lags by 2ζ/ω."""
        if isinstance(other, MicrophoneResonance):
            return super().starts_from(other, values)
        known = ("channel_mismatch.skew_s", "channel_mismatch.lowpass_time_s")
        lag = sum(values.get(name, 0.0) for name in known) * (1 if self.upper else -1)
        return [(z / (np.pi * lag), z) for z in (0.1, 0.4, 0.8)] if lag > 0 else []

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        w = 2 * np.pi * p[self.parameters[0].name]
        inverse = (s / w + 2.0 * p[self.parameters[1].name]) * (s / w) + 1.0
        return heard_by_one(at, s, y, inverse, self.upper)


BENT = {2: ("1/Pa", 1e-2), 3: ("1/Pa²", 1e-4)}  # by the power: a microphone's most, and its unit


class MicrophoneDistortion(Effect):
    """A microphone bends what it hears, or what amplifies it does: it reads p + a pⁿ, less its
    mean. Both alike, or one of them.
    """

    name, location = "sensor_nonlinearity", "sensor"
    needs = ("pressure",)

    def __init__(self, power: int, which: str) -> None:
        self.power, self.which = power, which
        self.form = {"both": "", "upper": "upper_", "lower": "lower_"}[which]
        self.form += {2: "quadratic", 3: "cubic"}[power]
        name, (unit, most) = f"sensor_nonlinearity.a{power}", BENT[power]
        self.parameters = (Parameter(name, unit, -most, most, scale=1e-3 * most),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        pressure = 400.0 * known.velocity_amplitude  # ρc times that, Pa
        size = 0.01 / pressure ** (self.power - 1)
        return [(size,), (-size,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        a = p[self.parameters[0].name]
        more: Any = 0.0  # was heard than read, in the upper microphone against the lower
        if self.which != "lower":
            more = more + unbent(upper_pressure(at, at.s), a, self.power)
        if self.which != "upper":
            more = more - unbent(lower_pressure(at, at.s), a, self.power)
        return with_leak(at, y, as_velocity(at, s, more))


class SensorOffset(Effect):
    """The velocity is taken a distance away from the flame.

    ``propagation`` carries it over a lossless duct with the measured pressure,
    u(x + δ) = u(x) cos kδ − j p(x) sin kδ / (ρc); ``mode_shapes`` takes each declared mode's own
    shape, ∝ sin(k_i x), at the flame and at the sensor.
    """

    name, location = "sensor_offset", "sensor"
    parameters = (Parameter("sensor_offset.distance_m", "m", -0.5, 0.5, scale=1e-2),)

    def __init__(self, form: str) -> None:
        self.form = form
        self.needs = ("pressure",) if form == "propagation" else ()

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.01,), (-0.01,), (0.08,), (-0.08,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        if self.form != "mode_shapes":
            return modes
        distance = p["sensor_offset.distance_m"]
        out = []
        for m in modes:
            k = 2 * np.pi * m.frequency_hz / at.sound_speed_m_s
            x = at.centre_m
            ratio = dual.sin(k * x) / dual.sin(k * (x - distance))
            out.append(Mode(m.frequency_hz, m.damping, m.flame_residue, m.speaker_residue, ratio))
        return out

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        if self.form != "propagation":
            return y
        # sensor at x, flame at x − δ:  u_flame = u cos kδ + j p sin kδ/(ρc), so that
        # u = (u_flame − j p sin kδ/(ρc)) / cos kδ with the pressure measured at the sensor
        angle = (-1j * s) * p["sensor_offset.distance_m"] * (1.0 / at.sound_speed_m_s)
        impedance = at.density_kg_m3 * at.sound_speed_m_s
        leak = dual.sin(angle) * (1j / impedance * at.pressure)
        cosine = dual.cos(angle)
        return with_leak(at, y / cosine, -(leak / cosine))


class ModalOffset(Effect):
    """The velocity is taken away from the flame, in modes of unknown shape.

    Each mode's velocity at the sensor over that at the flame, relative to mode 1's: a ratio common
    to all modes only changes the scale of the velocity and cannot be seen.
    """

    name, location, empirical = "sensor_offset", "sensor", True

    def __init__(self, modes: int) -> None:
        self.form = f"modal_{modes}"
        self.mode_count = modes
        self.parameters = tuple(
            Parameter(f"sensor_offset.ratio{i}", "1", -50.0, 50.0, scale=1e-2)
            for i in range(2, modes + 1)
        )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        near, beyond = (0.98, 1.02, 0.8, 1.25, 0.6, 1.6), (0.2, -0.3, -1.0, -3.0, -8.0, 3.0, 8.0)
        return [(q,) * len(self.parameters) for q in (*near, *beyond)]

    def neutral(self) -> tuple[float, ...]:
        return (1.0,) * len(self.parameters)

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        ratios = [1.0, *(p[q.name] for q in self.parameters)]
        pairs = zip(modes, ratios, strict=False)  # an added mode is measured as it is
        seen = [replace(m, sensor_ratio=ratio) for m, ratio in pairs]
        return [*seen, *modes[len(seen) :]]


#: Slowest first-order lag of a pressure channel that is plausible, s: 2 dB down at 12 kHz, 3 dB at
#: 16 kHz. Measuring microphones and dynamic pressure sensors reach further by their data sheets.
SLOWEST_MICROPHONE_S = 1e-5
#: Least corner of a pressure channel's coupling that is plausible, Hz: a charge amplifier's of a
#: piezoelectric sensor, with a time constant of 16 s.
LOWEST_HZ = 0.01


class SensorLag(Effect):
    """The sensors share a first-order low-pass, 1/(1 + sT).

    ``lowpass``: both microphones, which are fast; a longer lag of theirs is implausible, and since
    what oscillates freely has no phase to tell them by, it would be taken for the speaker's.
    ``slow``: the sensor of a velocity that no two microphones give, such as a hot wire.
    """

    name, location = "sensor_dynamics", "sensor"

    def __init__(self, form: str) -> None:
        self.form = form
        fast = form == "lowpass"
        self.needs = ("pressure",) if fast else ("velocity",)
        slowest = SLOWEST_MICROPHONE_S if fast else 0.1
        self.parameters = (Parameter("sensor_dynamics.time_s", "s", 0.0, slowest, scale=1e-4),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.03 / known.free_hz,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        return y / (s * p["sensor_dynamics.time_s"] + 1.0)


class SensorCoupling(Effect):
    """Both microphones pass no direct voltage: a first-order high-pass, s/(s + ω)."""

    name, location, form = "sensor_dynamics", "sensor", "highpass"
    parameters = (Parameter("sensor_dynamics.corner_hz", "Hz", LOWEST_HZ, 1e3, scale=10.0),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.03 * known.free_hz,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        return y * (s / (2 * np.pi * p["sensor_dynamics.corner_hz"] + s))


class DrivePickup(Effect):
    """The drive's voltage is picked up in the recorded channels: crosstalk of cables, converters.

    ``pressure``: Pa/V more of it in the upper microphone's channel than in the lower's, which the
    two-microphone method takes for a velocity, −U/(ρ Δx s); ``velocity``: m/s/V in a channel that
    is a velocity.
    """

    name, location = "drive_pickup", "sensor"

    def __init__(self, form: str) -> None:
        self.form = form
        self.needs = ("pressure",) if form == "pressure" else ()
        unit, scale = ("Pa/V", 1e-1) if form == "pressure" else ("m/s/V", 1e-4)
        self.parameters = (Parameter("drive_pickup.pickup", unit, scale=scale),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        size = 0.01 * known.velocity_amplitude / known.drive_amplitude
        if self.form == "pressure":
            size *= 0.4 * known.free_hz  # ρ Δx ω, of microphones 5 cm apart
        return [(size,), (-size,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        heard: Any = at.drive
        if self.form == "pressure":
            heard = as_velocity(at, s, -heard)
        return y + heard * p["drive_pickup.pickup"]


EFFECTS: tuple[Effect, ...] = (
    ChannelMismatch("gain"),
    ChannelMismatch("skew"),
    ChannelMismatch("lower_skew"),
    ChannelMismatch("gain_skew"),
    ChannelMismatch("phase"),
    ChannelMismatch("gain_phase"),
    ChannelMismatch("lowpass"),
    ChannelMismatch("lower_lowpass"),
    ChannelMismatch("highpass"),
    ChannelMismatch("gain_lowpass"),
    ChannelMismatch("gain_highpass"),
    ChannelMismatch("skew_lowpass"),
    MicrophoneResonance(upper=True),
    MicrophoneResonance(upper=False),
    *(MicrophoneDistortion(n, which) for which in ("both", "upper", "lower") for n in (2, 3)),
    SensorOffset("propagation"),
    SensorOffset("mode_shapes"),
    ModalOffset(2),
    ModalOffset(3),
    ModalOffset(4),
    SensorLag("lowpass"),
    SensorLag("slow"),
    SensorCoupling(),
    DrivePickup("pressure"),
    DrivePickup("velocity"),
)
