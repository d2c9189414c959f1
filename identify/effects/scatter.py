"""Random differences from run to run: no parameter describes them, only their spread.

A `Scatter` names the directions in which each run may deviate, effects of one parameter each that
is zero on average; its own parameters are the standard deviations. `identify.scatter` fits it.
"""

from collections.abc import Sequence
from typing import Any

from identify import dual
from identify.effects.experiment import Drift
from identify.parameters import Parameter
from identify.structure import Conditions, Effect, Values


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


class DrivePhase(Effect):
    """The sound lags the recorded drive by a constant phase."""

    name, location = "drive_phase", "actuator"
    parameters = (Parameter("drive_phase.shift", "rad", scale=1e-2),)

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        return dual.exp(p["drive_phase.shift"] * -1j)


# A drift's direction, taken at the campaign's end for every run, is a constant relative change.
SCATTERS: tuple[Scatter, ...] = (
    Scatter(
        "drive_scatter",
        "actuator",
        "",
        (("gain_rms", "1", Drift("speaker_gain")), ("phase_rms_rad", "rad", DrivePhase())),
    ),
    Scatter("flame_gain_modulation", "flame", "", (("modulation_rms", "1", Drift("flame_gain")),)),
    Scatter(
        "parameter_drift", "experiment", "random", (("frequency_rms", "1", Drift("frequency")),)
    ),
)
