"""Freely shaped pieces for each place of the loop: they stand for no law, only for the place.

A linear response is 1 + Σ_j h_j (B^j − 1), B = (ω₀ − s)/(ω₀ + s), j = 1 … 4: powers of an all-pass
step at the free frequency follow any smooth response and grow nowhere (Laguerre's functions).
Every piece vanishes where its parameters do, and starts from there and as lags of several sizes.
None is a candidate of a diagnosis: they say where something lies that no candidate explains
(`identify.trace.places`). What no smooth law takes up may remember (`ShapedMemory`), or differ from
run to run by chance (`CHANCES`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.effect import Conditions, Effect, Known
from identify.effects.actuator import Distortion
from identify.effects.experiment import course
from identify.effects.forward import AcousticMode, NonlinearDamping
from identify.effects.nonlinearity import HigherOrder, play
from identify.effects.scatter import Change, DriveGain, DrivePhase, Scatter, SensorGain
from identify.effects.sensor import as_velocity, upper_pressure, with_leak
from identify.parameters import Parameter
from identify.pieces import Bent, Characteristic, Loss, Mode, Operator, Passed, Values
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]

STEPS = 4
MODE = AcousticMode()
LOSS = NonlinearDamping("quadratic_cubic")
DISTORTION = Distortion((2, 3))
CUT_OFF = Distortion((2, 3, 5, 7))  # at both ends
MORE_POWERS = 4  # of the flame's input, than declared
WANDERING = ("frequency", "damping", "flame", "speaker")
LAGS = (0.2, 0.8)  # times of the lags to start from, in 1/ω₀


def lag(time: float) -> tuple[float, ...]:
    """The response's numbers of 1/(1 + s · time/ω₀), whose series in B is geometric."""
    ratio = (time - 1.0) / (time + 1.0)
    return tuple(2 * time / (1.0 + time) ** 2 * ratio**j for j in range(STEPS))


@dataclass(frozen=True)
class Setting:
    """What the pieces of a campaign are made for: the free frequency, how many modes are declared,
    the velocity (m/s) that the fundamental usually has in forced runs, whether a pressure is known
    beside it, and the highest power of the flame's input that is declared."""

    free_hz: float
    modes: int
    velocity: float = 1.0
    pressure: bool = True
    highest_power: int = 3


class Shaped(Effect):
    """Root of the pieces: a linear response, and what a place needs besides."""

    linear = True
    besides: tuple[Parameter, ...] = ()

    def __init__(self, setting: Setting) -> None:
        self.setting, self.corner = setting, 2 * np.pi * setting.free_hz
        self.name = f"shaped_{self.location}"
        steps = range(1, STEPS + 1) if self.linear else ()
        own = tuple(Parameter(f"{self.name}.h{j}", "1", scale=1e-2) for j in steps)
        self.parameters = (*own, *self.besides, *self.of_the_setting())

    def of_the_setting(self) -> tuple[Parameter, ...]:
        """What it needs besides in this setting."""
        return ()

    def responses(self) -> list[tuple[float, ...]]:
        """The linear response's numbers where there is none, and those of lags."""
        return [(0.0,) * STEPS, *map(lag, LAGS)] if self.linear else [()]

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        rest = (0.0,) * (len(self.parameters) - len(self.responses()[0]))
        return [(*h, *rest) for h in self.responses()]

    def neutral(self) -> tuple[float, ...] | None:
        return (0.0,) * len(self.parameters)

    def step(self, s: Any) -> Any:
        return (self.corner - s) / (s + self.corner)

    def response(self, p: Values, s: Any) -> Any:
        step = self.step(s)
        power, total = step, 1.0
        for j in range(1, STEPS + 1):
            total = total + (power - 1.0) * p[f"{self.name}.h{j}"]
            power = power * step
        return total


class ShapedFlame(Shaped):
    """Any smooth linear response of the flame."""

    location = "flame"

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        return self.response(p, s)


class AmplitudeFlame(ShapedFlame):
    """The same with gain and lag that follow the run's loudness, the square of the flame's input:
    what a describing function says of a flame that answers otherwise to a louder sound."""

    form = "amplitude"
    besides = tuple(Parameter(f"shaped_flame.loud{j}", "1", scale=1e-2) for j in (0, 1, 2, 3))

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        lag = np.abs(1j * at.omega[:, None] + self.corner) / (np.sqrt(2) * self.corner)
        loud = (np.abs(at.velocity[:, :1]) / (lag * self.setting.velocity)) ** 2 - 1.0
        shares: Sequence[Any] = [p[q.name] for q in self.besides]
        step = self.step(s)
        linear, square = shares[0] + step * shares[1], shares[2] + step * shares[3]
        return self.response(p, s) * (linear * loud + square * loud**2 + 1.0)


class ShapedActuator(Shaped):
    """Any smooth linear response of the speaker, and its distortion."""

    location, distortion = "actuator", DISTORTION
    besides = distortion.parameters

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        return self.response(p, s)

    def amplifier(self, p: Values, v: FloatArray) -> Bent:
        return self.distortion.amplifier(p, v)


class CutActuator(ShapedActuator):
    """The same with a distortion as strong as where an amplifier clips."""

    form, distortion = "cut_off", CUT_OFF
    besides = distortion.parameters


class ShapedSensor(Shaped):
    """Any smooth linear response of the velocity's measurement, and a share of the pressure."""

    location = "sensor"
    shares = tuple(Parameter(f"shaped_sensor.pressure{j}", "1", scale=1e-3) for j in (0, 1, 2))

    def of_the_setting(self) -> tuple[Parameter, ...]:
        return self.shares if self.setting.pressure else ()

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        if not self.setting.pressure:
            return y * self.response(p, s)
        step = self.step(s)
        leak = as_velocity(at, s, upper_pressure(at, s))
        shares: Sequence[Any] = [p[q.name] for q in self.shares]
        passed = shares[0] + step * shares[1] + step * step * shares[2]
        return with_leak(at, y * self.response(p, s), leak * passed)


class ModalSensor(ShapedSensor):
    """The same with each mode as large there as it likes."""

    form = "modal"

    def of_the_setting(self) -> tuple[Parameter, ...]:
        others = range(2, self.setting.modes + 1)
        ratios = (Parameter(f"shaped_sensor.ratio{i}", "1", scale=1e-2) for i in others)
        return (*super().of_the_setting(), *ratios)

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        first, *others = modes
        shares = (p[f"shaped_sensor.ratio{i}"] + 1.0 for i in range(2, len(modes) + 1))
        return [first, *(replace(m, sensor_ratio=q) for m, q in zip(others, shares, strict=True))]


class ShapedForward(Shaped):
    """Any smooth linear response common to flame and speaker, one more mode, and a loss that grows,
    or a frequency: a share of it acts a quarter period earlier or later.

    A factor on the acoustics changes the velocity that is measured and that the flame feels.
    """

    location = "forward"
    besides = (
        *MODE.parameters,
        *LOSS.parameters,
        Parameter("shaped_forward.reactance", "1", scale=1e-1),
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        rows, none = MODE.starts(known), (*LOSS.neutral(), 0.0)
        small = [0.1 * size for size in LOSS.starts(known)[0]]
        reactive = [((0.0,) * STEPS, (*small, sign)) for sign in (3.0, -3.0)]
        kinds = [*((h, none) for h in self.responses()), *reactive]
        return [(*h, *row, *loss) for h, loss in kinds for row in rows]

    def neutral(self) -> None:
        return None

    def restated(self, structure: Structure) -> Structure | None:
        return MODE.restated(structure)

    def from_restated(self, structure: Structure, values: Mapping[str, float]) -> list[float]:
        found, at = MODE.from_restated(structure, values), -len(MODE.parameters)
        return [*found[:at], *(0.0,) * STEPS, *found[at:], *LOSS.neutral(), 0.0]

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        return self.response(p, s)

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        return y * self.response(p, s)

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        return MODE.modes(p, at, modes)

    def loss(self, p: Values, at: Conditions, modes: list[Mode]) -> Loss:
        reactance = p["shaped_forward.reactance"]
        whole = LOSS.loss(p, at, modes)
        return replace(whole, response=lambda s: self.step(s) * reactance + 1.0)


class ShapedNonlinearity(Shaped):
    """The next powers of the flame's input, four to seven where three are declared."""

    location, linear = "nonlinearity", False

    def __init__(self, setting: Setting) -> None:
        first = setting.highest_power + 1
        self.powers = HigherOrder(tuple(range(first, first + MORE_POWERS)))
        self.besides = self.powers.parameters
        super().__init__(setting)

    def characteristic(self, p: Values, n: Characteristic, at: Conditions) -> Characteristic:
        return self.powers.characteristic(p, n, at)

    def restated(self, structure: Structure) -> Structure | None:
        if structure.nonlinearity not in ("polynomial", "linear"):
            return None
        highest = max(self.powers.powers)
        return replace(structure, nonlinearity="polynomial", degree=highest)

    def from_restated(self, structure: Structure, values: Mapping[str, float]) -> list[float]:
        return self.powers.from_restated(structure, values)


class ShapedMemory(Shaped):
    """A rate-independent memory of the flame's input: w + Σ_j a_j (P_j(w) − w) of plays P_j, each
    half as wide as the one before (Prandtl and Ishlinskii's model)."""

    location, form, linear = "nonlinearity", "memory", False
    besides = (
        Parameter("shaped_nonlinearity.reach", "m", 0.0, np.inf, "positive"),
        *(Parameter(f"shaped_nonlinearity.play{j}", "1", scale=1e-2) for j in (1, 2, 3)),
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        reaches = (q * known.flame_input_amplitude for q in (0.02, 0.1, 0.5))
        return [(reach, 0.3, 0.3, 0.3) for reach in reaches]

    def neutral(self) -> None:
        return None

    def operator(self, p: Values) -> Operator:
        reach, *shares = (p[q.name] for q in self.besides)

        def remembered(w: FloatArray) -> Passed:
            halves = [0.5**j for j in range(len(shares))]
            plays = [play(w, dual.value(reach) * half) for half in halves]
            sizes = [np.broadcast_to(dual.value(a), (len(w), 1)) for a in shares]
            behind = [passed.output - w for passed in plays]
            total = w + sum(size * b for size, b in zip(sizes, behind, strict=True))
            rest = np.broadcast_to(1.0 - sum(sizes), w.shape)
            follows = [(rest, np.broadcast_to(np.arange(w.shape[1]), w.shape))]
            by_reach = np.zeros_like(w)
            for passed, half, size in zip(plays, halves, sizes, strict=True):
                follows += [(size * slope, at) for slope, at in passed.follows]
                by_reach = by_reach + sum(half * size * side for side, _ in passed.by)
            return Passed(total, follows, [(by_reach, reach), *zip(behind, shares, strict=True)])

        return remembered


class ShapedExperiment(Shaped):
    """Frequencies, damping, flame and speaker gain that change with time, quadratically."""

    location, linear = "experiment", False
    besides = tuple(
        Parameter(f"shaped_experiment.{what}_{word}", "1", scale=1e-3)
        for what in WANDERING
        for word in ("change", "curvature")
    )

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        f, z, r, a = (
            course(
                at, p[f"shaped_experiment.{what}_change"], p[f"shaped_experiment.{what}_curvature"]
            )
            for what in WANDERING
        )
        return [
            replace(
                m,
                frequency_hz=m.frequency_hz * f,
                damping=m.damping * z,
                flame_residue=m.flame_residue * r,
                speaker_residue=m.speaker_residue * a,
            )
            for m in modes
        ]


PIECES: tuple[type[Shaped], ...] = (
    ShapedForward,
    ShapedFlame,
    AmplitudeFlame,
    ShapedNonlinearity,
    ShapedActuator,
    CutActuator,
    ShapedSensor,
    ModalSensor,
    ShapedExperiment,
)

#: What may differ from run to run by chance at each place: a factor on all that passes there, of
#: which the phase is a shift in time, of the record as good as of the drive; and the tube's
#: frequencies and damping.
CHANCES: tuple[Scatter, ...] = (
    Scatter(
        "chance_actuator",
        "actuator",
        "",
        (("gain_rms", "1", DriveGain()), ("phase_rms_rad", "rad", DrivePhase())),
    ),
    Scatter(
        "chance_sensor",
        "sensor",
        "",
        (("gain_rms", "1", SensorGain()), ("phase_rms_rad", "rad", DrivePhase())),
    ),
    Scatter("chance_flame", "flame", "", (("gain_rms", "1", Change("flame_gain", 1e-2)),)),
    Scatter(
        "chance_experiment",
        "experiment",
        "",
        (
            ("frequency_rms", "1", Change("frequency", 1e-3)),
            ("damping_rms", "1", Change("damping", 1e-2)),
        ),
    ),
)
