"""Flame path: how the heat release may follow the velocity other than declared."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from identify import dual
from identify.effect import Conditions, Effect, Known
from identify.parameters import Parameter
from identify.pieces import Values

FASTEST_S = 1e-6  # least lag of a flame that is plausible: 0.1 mm of flow at 100 m/s
CANCELS = 0.2  # of a zero's frequency: so near to it a pole is as good as none


class FlameDelay(Effect):
    """Convective time delay of the flame's response, e^{−sτ} (n–τ model)."""

    name, location = "flame_delay", "flame"
    parameters = (Parameter("flame_delay.delay_s", "s", FASTEST_S, 0.02, scale=1e-4),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(q,) for q in known.delays(cycles=4.0)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        return dual.exp(-(s * p["flame_delay.delay_s"]))


class ExtraPole(Effect):
    """One more first-order lag, 1/(1 + sT)."""

    name, location, form = "flame_dynamics", "flame", "pole"
    parameters = (Parameter("flame_dynamics.time_s", "s", FASTEST_S, 0.1, scale=1e-4),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        period = 1 / known.free_hz
        return [(0.02 * period,), (0.1 * period,)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """What another lags behind, without its time scales."""
        if isinstance(other, LaggingTimeScales):
            return [(values["flame_dynamics.lag_s"],)]
        return super().starts_from(other, values)

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        return 1.0 / (s * p["flame_dynamics.time_s"] + 1.0)


class SecondTimeScale(Effect):
    """A second, parallel time scale: 1 − share + share/(1 + sT).

    A negative share leads: it is a zero at the time (1 − share) T above the pole's.
    """

    name, location, form = "flame_dynamics", "flame", "second_time_scale"
    parameters = (
        Parameter("flame_dynamics.share", "1", -50.0, 2.0),
        Parameter("flame_dynamics.time_s", "s", 1e-6, 1.0, "positive"),
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        period = 1 / known.free_hz
        return [(0.1, 0.05 * period), (0.1, 0.5 * period), (-3.0, 0.01 * period)]

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.0, float(q) / known.free_hz) for q in np.geomspace(0.01, 2.0, 12)]

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        share, time = p["flame_dynamics.share"], p["flame_dynamics.time_s"]
        return 1.0 - share + share / (s * time + 1.0)


class LaggingTimeScales(Effect):
    """Two parallel time scales behind one more lag, (1 − share + share/(1 + sT)) / (1 + sT').

    Two poles and a zero more than declared: tried where neither explains the data alone.
    """

    name, location, form, refines = "flame_dynamics", "flame", "second_time_scale_pole", True
    scales = SecondTimeScale()
    parameters = (
        *scales.parameters,
        Parameter("flame_dynamics.lag_s", "s", 0.0, 0.1, scale=1e-4),
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(*row, 0.02 / known.free_hz) for row in self.scales.starts(known)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """From the time scales, or with the lag that another has at low frequencies; beside it the
        other time scale may be a longer one or shorter."""
        if other.form == "second_time_scale":
            return [(*(values[q.name] for q in other.parameters), 0.0)]
        if other.form == "second_order":
            damping = values["flame_dynamics.damping"]
            lag = damping / (np.pi * values["flame_dynamics.frequency_hz"])
        else:
            lag = values[other.parameters[0].name]
        return [(0.02, ratio * lag, lag) for ratio in (10.0, 0.3)]

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        return self.scales.flame(p, at, s) / (s * p["flame_dynamics.lag_s"] + 1.0)

    def plainer(self, values: Mapping[str, float]) -> list[dict[str, float]]:
        """The zero at (1 − share) T may stand on the declared pole a, which has then none of the
        flame's size: r/(s + a) (1 + s/a)/(1 + sT) = (r/aT)/(s + 1/T), and the nonlinearity, behind
        a pole that lets 1/(aT) times as much through, has c_d (aT)^(1 − d)."""
        share, time = values["flame_dynamics.share"], values["flame_dynamics.time_s"]
        pole = 2 * np.pi * values.get("flame.pole_hz", 0.0)
        if not abs((1.0 - share) * time * pole - 1.0) < CANCELS:
            return []
        gain = 1.0 / (pole * time)
        out = {**values, "flame.pole_hz": 1.0 / (2 * np.pi * time), "flame_dynamics.share": 0.0}
        for name, value in values.items():
            if name.endswith("flame_residue"):
                out[name] = value * gain
            elif name.startswith("nonlinearity.c"):
                out[name] = value * gain ** (int(name.removeprefix("nonlinearity.c")) - 1)
        return [out]


class FlameResonance(Effect):
    """Second-order response of the flame, ω²/(s² + 2ζωs + ω²)."""

    name, location, form = "flame_dynamics", "flame", "second_order"
    parameters = (
        Parameter("flame_dynamics.frequency_hz", "Hz", 5.0, 1e4, "positive"),
        Parameter("flame_dynamics.damping", "1", 0.02, 10.0, "positive"),
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(5 * known.free_hz, 0.7), (1.6 * known.free_hz, 0.5)]

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        w = 2 * np.pi * p["flame_dynamics.frequency_hz"]
        return w * w / (s * s + 2.0 * p["flame_dynamics.damping"] * w * s + w * w)


class DistributedDelay(Effect):
    """A delay spread around its mean τ by σ, gamma-distributed: (1 + sσ²/τ)^(−τ²/σ²).

    No delay is negative. With σ = τ/√n it is n equal lags in a row, from the extra pole (n = 1)
    to the pure delay (n → ∞); a narrow one is as good as normal, exp(−sτ + s²σ²/2).
    """

    name, location, form = "flame_dynamics", "flame", "distributed_delay"
    generalises = ("flame_delay",)
    parameters = (
        Parameter("flame_dynamics.delay_s", "s", 1e-7, 0.02, "positive"),
        Parameter("flame_dynamics.spread_s", "s", 1e-7, 0.02, "positive"),
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        period = 1 / known.free_hz
        return [(0.1 * period, 0.05 * period)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """From a delay, spread little or much; from a lag, spread as widely as it is long."""
        if isinstance(other, FlameDelay):
            delay = max(values["flame_delay.delay_s"], 1e-6)
            return [(delay, share * delay) for share in (0.1, 0.5, 1.0)]
        if isinstance(other, ExtraPole):
            lag = max(values["flame_dynamics.time_s"], 1e-6)
            return [(lag, share * lag) for share in (0.5, 1.0)]
        return super().starts_from(other, values)

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        tau, sigma = p["flame_dynamics.delay_s"], p["flame_dynamics.spread_s"]
        ratio = tau / sigma
        return dual.exp(-(dual.log(s * (sigma / ratio) + 1.0) * (ratio * ratio)))


EFFECTS: tuple[Effect, ...] = (
    FlameDelay(),
    ExtraPole(),
    SecondTimeScale(),
    LaggingTimeScales(),
    FlameResonance(),
    DistributedDelay(),
)
