"""The experiment: parameters that change in the course of a campaign."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from identify import dual
from identify.parameters import Parameter
from identify.structure import Conditions, Effect, Known, Mode, Values

FIRST = {"first_mode": "frequency", "first_damping": "damping"}  # what changes of mode 1 alone


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
    """A relative change over the campaign, linear in time; ``_curve``: and quadratic;
    ``_settling``: towards a last value, as what warms up does.

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
        time = Parameter("parameter_drift.settling_time", "1", 0.15, 5.0, "positive")
        more = (curvature,) if self.curved else (time,) if self.settles else ()
        self.parameters = (change, *more)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        size = self.parameters[0].scale
        rest = (0.3,) if self.settles else (0.0,) * (len(self.parameters) - 1)
        return [(sign * q * size, *rest) for q in (1.0, 5.0, 20.0) for sign in (1.0, -1.0)]

    def neutral(self) -> tuple[float, ...] | None:
        return None if self.settles else (0.0,) * len(self.parameters)

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        return [(0.0, q) for q in (0.17, 0.3, 0.6)] if self.settles else []

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        change = p["parameter_drift.relative_change"]
        if self.settles:
            factor = settling(at, change, p["parameter_drift.settling_time"])
        else:
            curvature = p["parameter_drift.curvature"] if self.curved else None
            factor = course(at, change, curvature)
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
    does; from where the frequencies alone came nearest."""

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

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        size, damping, time = (p[q.name] for q in self.parameters)
        modes = changed(modes, "frequency", settling(at, size, time))
        return changed(modes, "damping", settling(at, damping, time))


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
    Drift("frequency_curve"),
    Drift("frequency_settling"),
    Drift("flame_gain_curve"),
    Drift("flame_gain_settling"),
    FlameDrift("flame_input"),
    FlameDrift("flame_pole"),
    FlameDrift("flame_rate"),
    SeveralDrifts(),
    Warming(),
)
