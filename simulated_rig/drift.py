"""How a plant differs from itself at a later rig time."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from simulated_rig.config import Drift
from simulated_rig.plant import Plant

WALK_STEP_S = 10.0


def change_at(drift: Drift, time_s: float, seed: int) -> float:
    """Relative change at `time_s`. A walk is drawn from `seed`, the same for every caller."""
    if drift.kind == "linear":
        return drift.change * time_s / drift.over_s
    steps = int(time_s // WALK_STEP_S) + 2
    size = drift.change * np.sqrt(WALK_STEP_S / drift.over_s)
    path = np.concatenate([[0.0], np.cumsum(np.random.default_rng(seed).normal(0, size, steps))])
    return float(np.interp(time_s / WALK_STEP_S, np.arange(path.size), path))


def drifted(plant: Plant, drifts: Sequence[Drift], time_s: float, seed: int = 0) -> Plant:
    """`plant` as it is at `time_s`."""
    for index, drift in enumerate(drifts):
        factor = 1.0 + change_at(drift, time_s, seed + index)
        if drift.target in ("frequency", "sound_speed"):
            modes = tuple(replace(m, frequency_hz=m.frequency_hz * factor) for m in plant.modes)
            plant = replace(plant, modes=modes)
        elif drift.target == "damping":
            modes = tuple(replace(m, damping=m.damping * factor) for m in plant.modes)
            plant = replace(plant, modes=modes)
        elif drift.target == "flame_gain":
            c = plant.characteristic
            scaled = replace(c, coefficients=tuple(a * factor for a in c.coefficients))
            plant = replace(plant, characteristic=scaled)
        else:
            actuator = replace(plant.actuator, gain=plant.actuator.gain * factor)
            plant = replace(plant, actuator=actuator)
    return plant
