"""The experiment: parameters that change in the course of a campaign."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.effect import Conditions, Effect, Known
from identify.effects.sensor import as_velocity, upper_pressure, with_leak
from identify.parameters import Parameter
from identify.pieces import Mode, Values
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]

FIRST = {"first_mode": "frequency", "first_damping": "damping"}  # what changes of mode 1 alone
NAMED = {
    "frequency": "All frequencies",
    "first_mode": "Mode 1's frequency",
    "flame_gain": "The flame's gain",
    "damping": "All dampings",
    "first_damping": "Mode 1's damping",
    "speaker_gain": "The speaker's gain",
}
ONE_BY_ONE = ("frequency", "flame_gain", "damping", "speaker_gain")
EACH_SIDE = 2  # runs at least, before and after a step: one alone is no evidence of a course


def course(at: Conditions, change: Any, curvature: Any = None) -> Any:
    """Factor on a parameter, one row a run: 1 at the campaign's start, 1 + change at its end, a
    parabola in between where there is a curvature."""
    t = at.time[:, None]
    moved: Any = change * t
    if curvature is not None:
        moved = moved + curvature * (t * t - t)
    return moved + 1.0


def settling(at: Conditions, change: Any, time: Any) -> Any:
    """The same towards 1 + change, exponentially within `time`, as a share of the campaign's."""
    return (1.0 - dual.exp(-(at.time[:, None] / time))) * change + 1.0


def step(at: Conditions, change: Any, when: Any) -> Any:
    """The same at once, at `when`; runs do not tell when between two of them, so no derivative."""
    return change * (at.time[:, None] > dual.value(when)) + 1.0


def changed(modes: list[Mode], what: str, factor: Any) -> list[Mode]:
    """The modes with one thing of theirs multiplied."""
    if what == "frequency":
        return [replace(m, frequency_hz=m.frequency_hz * factor) for m in modes]
    if what in FIRST:
        return [*changed(modes[:1], FIRST[what], factor), *modes[1:]]
    if what == "flame_gain":
        return [replace(m, flame_residue=m.flame_residue * factor) for m in modes]
    if what == "damping":
        return [replace(m, damping=m.damping * factor) for m in modes]
    return [replace(m, speaker_residue=m.speaker_residue * factor) for m in modes]


class Drift(Effect):
    """A relative change over the campaign: linear in time, with a quadratic part (``_curve``), or
    towards a last value, as what warms up does (``_settling``). Times are shares of the time from
    the campaign's start to its last run.

    ``frequency``: all modal frequencies together, as temperature does; ``flame_gain``: the fuel;
    ``damping``; ``speaker_gain``: a warming voice coil; ``first_mode`` and ``first_damping``: mode
    1's frequency or damping alone.
    Time is 0 at the campaign's start, 1 at the start of its last run.
    """

    name, location = "parameter_drift", "experiment"

    def __init__(self, form: str) -> None:
        self.form = form
        self.what = form.removesuffix("_curve").removesuffix("_settling")
        self.curved, self.settles = form.endswith("_curve"), form.endswith("_settling")
        scale = 1e-3 if "frequency" in form or "mode" in form else 1e-2
        change, curvature = (
            Parameter(f"parameter_drift.{n}", "1", -0.8, 0.8, scale=scale)
            for n in ("relative_change", "curvature")
        )
        time = Parameter("parameter_drift.settling_time", "1", 0.04, 5.0, "positive")
        more = (curvature,) if self.curved else (time,) if self.settles else ()
        self.parameters = (change, *more)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        size = self.parameters[0].scale
        rest = (0.3,) if self.settles else (0.0,) * (len(self.parameters) - 1)
        return [(sign * q * size, *rest) for q in (1.0, 5.0, 20.0) for sign in (1.0, -1.0)]

    def neutral(self) -> tuple[float, ...] | None:
        return None if self.settles else (0.0,) * len(self.parameters)

    def told(self, values: Mapping[str, float], span_s: float) -> str:
        change, *more = (values[q.name] for q in self.parameters)
        moved = f"{NAMED[self.what]}: {100 * change:+.3g} %".replace("-", "−")
        if self.settles:
            return f"{moved} in the end. {_settles(more[0], span_s)}"
        return f"{moved} from the campaign's start to its last run, {span_s:.0f} s later."

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.0, q) for q in (0.06, 0.1, 0.17, 0.3, 0.6)] if self.settles else []

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        change = p["parameter_drift.relative_change"]
        if self.settles:
            factor = settling(at, change, p["parameter_drift.settling_time"])
        else:
            curvature = p["parameter_drift.curvature"] if self.curved else None
            factor = course(at, change, curvature)
        return changed(modes, self.what, factor)


def _settles(time: float, span_s: float) -> str:
    return f"It settles within {time * span_s:.0f} s (1/e)."


class Step(Effect):
    """A relative change at once, as where a valve or a knob was turned between two runs. Times as
    in a linear drift.

    Of what, as in `Drift`. It lies between two of the runs at `times`, those that are fitted and
    those that are not, with `EACH_SIDE` of the `fitted` before and after; without them is none.
    """

    name, location = "parameter_drift", "experiment"
    when = Parameter("parameter_drift.step_time", "1", 0.0, 1.0)

    def __init__(
        self, what: str, fitted: Sequence[float] = (), held_out: Sequence[float] = ()
    ) -> None:
        self.what, self.form = what, f"{what}_step"
        self.fitted, self.times = np.unique(fitted), np.unique([*fitted, *held_out])
        self.parameters = (Drift(what).parameters[0], self.when)

    def among(self, fitted: Sequence[float], held_out: Sequence[float]) -> Effect:
        return Step(self.what, fitted, held_out)

    def extends(self, structure: Structure) -> bool:
        return len(self.between) > 0

    @property
    def between(self) -> list[float]:
        """When it may have been: half-way between two fitted runs."""
        middles = (self.fitted[:-1] + self.fitted[1:]) / 2
        return [float(t) for t in middles[EACH_SIDE - 1 : middles.size - EACH_SIDE + 1]]

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        size = self.parameters[0].scale
        return [(q * size, t) for q in (5.0, -5.0) for t in self.between]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        change = values.get(self.parameters[0].name, 0.0)
        known = values.get(self.when.name)
        return [(change, t) for t in (self.between if known is None else [known])]

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.0, t) for t in self.between]

    def as_well(self, values: Mapping[str, float]) -> list[dict[str, float]]:
        before, after = _next_to(self.fitted, values[self.when.name])
        inside = self.times[(self.times >= before) & (self.times <= after)]
        return [{self.when.name: float(t)} for t in (inside[:-1] + inside[1:]) / 2]

    def resolution(self, values: Mapping[str, float]) -> dict[str, float]:
        before, after = _next_to(self.times, values[self.when.name])
        return {self.when.name: (after - before) / np.sqrt(12.0)}

    def told(self, values: Mapping[str, float], span_s: float) -> str:
        before, after = _next_to(self.times, values[self.when.name])
        return f"It came between {before * span_s:.0f} s and {after * span_s:.0f} s."

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        change, when = (p[q.name] for q in self.parameters)
        return changed(modes, self.what, step(at, change, when))


def _next_to(times: FloatArray, when: float) -> tuple[float, float]:
    """The last of `times` before `when`, and the first after."""
    after = int(np.clip(np.searchsorted(times, when), 1, times.size - 1))
    return float(times[after - 1]), float(times[after])


class Cycle(Effect):
    """A relative change to and fro, as where a thermostat or a compressor goes on and off:
    1 + a sin ωt + b (1 − cos ωt). Times as in a linear drift.

    Of what, as in `Drift`.
    """

    name, location = "parameter_drift", "experiment"

    def __init__(self, what: str) -> None:
        self.what, self.form = what, f"{what}_cycle"
        scale = Drift(what).parameters[0].scale
        self.parameters = (
            Parameter("parameter_drift.sine", "1", -0.8, 0.8, scale=scale),
            Parameter("parameter_drift.cosine", "1", -0.8, 0.8, scale=scale),
            Parameter("parameter_drift.period", "1", 0.2, 3.0, "positive"),
        )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        size = 5 * self.parameters[0].scale
        return [
            (a * size, b * size, period)
            for *_, period in self.shapes(known)
            for a, b in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
        ]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        names = [q.name for q in self.parameters]
        if names[-1] in values:
            return [tuple(values[name] for name in names)]
        change = values.get("parameter_drift.relative_change", 0.0)
        return [(change * a, change * b, t) for a, b, t in ((0.6, 0.0, 1.5), (0.0, 0.5, 1.0))]

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.0, 0.0, period) for period in (0.3, 0.4, 0.52, 0.68, 0.9, 1.3, 2.0)]

    def told(self, values: Mapping[str, float], span_s: float) -> str:
        sine, cosine, period = (values[q.name] for q in self.parameters)
        return f"It is ± {np.hypot(sine, cosine):.2g} within {period * span_s:.0f} s."

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        sine, cosine, period = (p[q.name] for q in self.parameters)
        turned = 2 * np.pi * at.time[:, None] / period
        factor = sine * dual.sin(turned) + cosine * (1.0 - dual.cos(turned)) + 1.0
        return changed(modes, self.what, factor)


class SeveralDrifts(Effect):
    """Frequencies, damping, flame and speaker gain change together, each by its own share: what
    warms changes more than one thing."""

    name, location, form = "parameter_drift", "experiment", "several"
    parameters = tuple(
        Parameter(f"parameter_drift.{what}_change", "1", -0.8, 0.8, scale=scale)
        for what, scale in (
            ("frequency", 1e-3),
            ("damping", 1e-2),
            ("flame_gain", 1e-2),
            ("speaker_gain", 1e-2),
        )
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.0,) * len(self.parameters)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,) * len(self.parameters)

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        for q in self.parameters:
            what = q.name.removeprefix("parameter_drift.").removesuffix("_change")
            modes = changed(modes, what, course(at, p[q.name]))
        return modes


class Warming(Effect):
    """All frequencies and dampings change together towards a last value, as the tube's temperature
    does; from where the frequencies alone came nearest. Times as in a linear drift."""

    name, location, form, refines = "parameter_drift", "experiment", "warming", True
    frequency = Drift("frequency_settling")
    parameters = (
        *SeveralDrifts.parameters[:2],
        frequency.parameters[1],
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(change, 0.0, time) for change, time in self.frequency.starts(known)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        size, damping, time = (q.name for q in self.parameters)
        change = values.get(size, values.get("parameter_drift.relative_change", 0.0))
        if not other.form.startswith(("frequency", "several")):
            change = 0.0
        times = (values[time],) if time in values else (0.3, 1.0)
        return [(change, values.get(damping, 0.0), q) for q in times]

    def told(self, values: Mapping[str, float], span_s: float) -> str:
        return _settles(values[self.parameters[-1].name], span_s)

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        size, damping, time = (p[q.name] for q in self.parameters)
        modes = changed(modes, "frequency", settling(at, size, time))
        return changed(modes, "damping", settling(at, damping, time))


class SensorDrift(Effect):
    """The upper microphone's sensitivity changes over the campaign against the lower one's."""

    name, location, form = "parameter_drift", "experiment", "channel_gain"
    needs = ("pressure",)
    parameters = (Parameter("parameter_drift.relative_change", "1", -0.5, 0.5, scale=1e-3),)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.001,), (-0.001,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        read = course(at, p["parameter_drift.relative_change"])
        leak = as_velocity(at, s, upper_pressure(at, s))
        return with_leak(at, y, leak * (1.0 / read - 1.0))


class FlameDrift(Effect):
    """The flame's linear answer to the velocity changes over the campaign.

    A factor on its first pole: ``flame_pole``, where its answer to slow changes stays, ω/(s + ω);
    ``flame_rate``, where that to fast ones does, 1/(s + ω). Or ``flame_input``, on its gain before
    the characteristic, and so on the amplitude at which it saturates.
    """

    name, location = "parameter_drift", "experiment"
    parameters = (Parameter("parameter_drift.relative_change", "1", -0.8, 0.8, scale=1e-2),)

    def __init__(self, form: str) -> None:
        self.form = form
        self.needs = () if form == "flame_input" else ("flame_pole",)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.01,), (-0.01,)]

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        factor = course(at, p["parameter_drift.relative_change"])
        if self.form == "flame_input":
            return factor + 0.0 * s
        pole = 2 * 3.141592653589793 * p["flame.pole_hz"]
        moved = pole * factor
        kept = moved / pole if self.form == "flame_pole" else 1.0
        return (s + pole) / (s + moved) * kept


EFFECTS: tuple[Effect, ...] = (
    Drift("frequency"),
    Drift("first_mode"),
    Drift("flame_gain"),
    Drift("damping"),
    Drift("first_damping"),
    Drift("speaker_gain"),
    *(Drift(f"{what}_{course}") for what in ONE_BY_ONE for course in ("curve", "settling")),
    *map(Step, ONE_BY_ONE),
    *map(Cycle, ONE_BY_ONE),
    SensorDrift(),
    FlameDrift("flame_input"),
    FlameDrift("flame_pole"),
    FlameDrift("flame_rate"),
    SeveralDrifts(),
    Warming(),
)
