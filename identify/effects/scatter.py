"""Random differences from run to run: no parameter describes them, only their spread.

A `Scatter` names the directions in which each run may deviate, effects of one parameter each that
is zero on average; its own parameters are the standard deviations. `identify.scatter` fits it.
"""

from collections.abc import Sequence
from typing import Any

from identify import dual
from identify.effects.experiment import changed
from identify.parameters import Parameter
from identify.structure import Conditions, Effect, Mode, Values


class Scatter(Effect):
    """Standard deviations of what changes from run to run, and the directions it takes."""

    def __init__(
        self, name: str, location: str, form: str, sizes: Sequence[tuple[str, str, Effect]]
    ) -> None:
        self.name, self.location, self.form = name, location, form
        self.parameters = tuple(
            Parameter(f"{name}.{word}", unit, 0.0, 0.3, "positive") for word, unit, _ in sizes
        )
        self.directions = tuple(direction for _, _, direction in sizes)


class Change(Effect):
    """A constant relative change of frequency, flame or speaker gain."""

    location = "experiment"

    def __init__(self, what: str, scale: float) -> None:
        self.what, self.name = what, f"change_{what}"
        self.parameters = (Parameter(f"{self.name}.relative", "1", scale=scale),)

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        return changed(modes, self.what, p[self.parameters[0].name] + 1.0)


class DrivePhase(Effect):
    """The sound lags the recorded drive by a constant phase."""

    name, location = "drive_phase", "actuator"
    parameters = (Parameter("drive_phase.shift", "rad", scale=1e-2),)

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        return dual.exp(p["drive_phase.shift"] * -1j)


SCATTERS: tuple[Scatter, ...] = (
    Scatter(
        "drive_scatter",
        "actuator",
        "",
        (("gain_rms", "1", Change("speaker_gain", 1e-2)), ("phase_rms_rad", "rad", DrivePhase())),
    ),
    Scatter(
        "flame_gain_modulation", "flame", "", (("modulation_rms", "1", Change("flame_gain", 1e-2)),)
    ),
    Scatter(
        "parameter_drift",
        "experiment",
        "random",
        (("frequency_rms", "1", Change("frequency", 1e-3)),),
    ),
)
