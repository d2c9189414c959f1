"""Random differences from run to run: no parameter describes them, only their spread.

A `Scatter` names the directions in which each run may deviate, effects of one parameter each that
is zero on average; its own parameters are the standard deviations. `identify.scatter` fits it.
Deviations along a direction add up: twice 0.1 is 0.2, so that a ratio is named by its logarithm.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from identify import dual
from identify.effect import Conditions, Effect
from identify.effects.experiment import changed
from identify.parameters import Parameter
from identify.pieces import Mode, Values


class Direction(Effect):
    """An effect of one parameter, through its hooks `modes` and `generator` alone."""

    common = True  # whether the declared model absorbs what all runs deviate by together

    @property
    def scale(self) -> float:
        return self.parameters[0].scale

    @property
    def unit(self) -> str:
        return self.parameters[0].unit

    def neutral(self) -> tuple[float, ...]:
        return (0.0,)


class Scatter(Effect):
    """Standard deviations of what changes from run to run, and the directions it takes."""

    def __init__(
        self,
        name: str,
        location: str,
        form: str,
        sizes: Sequence[tuple[str, str, Direction]],
        about: str = "What passes here differs at random from run to run.",
    ) -> None:
        self.name, self.location, self.form, self._about = name, location, form, about
        self.parameters = tuple(
            Parameter(f"{name}.{word}", unit, 0.0, 0.3, "positive") for word, unit, _ in sizes
        )
        self.directions = tuple(direction for _, _, direction in sizes)

    @property
    def about(self) -> str:
        return f"{self._about} Standard deviations of the relative changes."

    @property
    def wanders(self) -> bool:
        """Whether runs near each other in time may deviate alike; along one direction."""
        return self.location == "experiment"


class Change(Direction):
    """A change of frequency or flame gain, as the logarithm of its ratio."""

    location = "experiment"

    def __init__(self, what: str, scale: float) -> None:
        self.what, self.name = what, f"change_{what}"
        self.parameters = (Parameter(f"{self.name}.log_ratio", "1", scale=scale),)

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        return changed(modes, self.what, dual.exp(p[self.parameters[0].name]))


class DriveGain(Direction):
    """The amplifier is given more than the recorded drive: the logarithm of their ratio."""

    name, location = "drive_gain", "actuator"
    parameters = (Parameter("drive_gain.log_ratio", "1", scale=1e-2),)

    def generator(self, p: Values, at: Conditions) -> Any:
        return dual.exp(p["drive_gain.log_ratio"])


class DrivePhase(Direction):
    """The amplifier is given what lags the recorded drive, by this phase of the fundamental."""

    name, location = "drive_phase", "actuator"
    parameters = (Parameter("drive_phase.shift", "rad", scale=1e-2),)
    common = False

    def generator(self, p: Values, at: Conditions) -> Any:
        orders = np.arange(1, at.harmonics + 1)
        return dual.exp(p["drive_phase.shift"] * (-1j * orders))


class SensorGain(Direction):
    """The velocity is measured as more than it is: the logarithm of the ratio."""

    name, location = "sensor_gain", "sensor"
    parameters = (Parameter("sensor_gain.log_ratio", "1", scale=1e-2),)

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        gain = dual.exp(p["sensor_gain.log_ratio"])
        known = ((m, 1.0 if m.sensor_ratio is None else m.sensor_ratio) for m in modes)
        return [replace(m, sensor_ratio=gain * ratio) for m, ratio in known]


SCATTERS: tuple[Scatter, ...] = (
    Scatter(
        "drive_scatter",
        "actuator",
        "",
        (("gain_rms", "1", DriveGain()), ("phase_rms_rad", "rad", DrivePhase())),
        "What reaches the amplifier differs at random from run to run from the recorded drive, in "
        "amplitude and phase.",
    ),
    Scatter(
        "flame_gain_modulation",
        "flame",
        "",
        (("modulation_rms", "1", Change("flame_gain", 1e-2)),),
        "The flame's gain differs at random from run to run.",
    ),
    Scatter(
        "parameter_drift",
        "experiment",
        "random",
        (("frequency_rms", "1", Change("frequency", 1e-3)),),
        "All frequencies wander at random in the course of the campaign.",
    ),
)
