"""The free limit cycle by time stepping: what sizes and checks refer to."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from simulated_rig.plant import Plant
from simulated_rig.simulation import Simulation, propagator

RATE_HZ = 20000.0


@dataclass(frozen=True)
class FreeCycle:
    """Frequency, velocity amplitude (m/s) and peak of z; amplitude 0 where there is none.

    `steadiness` is the relative change of the velocity's rms over the last two stretches.
    """

    frequency_hz: float
    velocity_m_s: float
    z_peak: float
    steadiness: float

    @property
    def exists(self) -> bool:
        return self.velocity_m_s > 1e-4 and np.isfinite(self.velocity_m_s)


@lru_cache(maxsize=256)
def free_cycle(plant: Plant, settle_s: float = 6.0) -> FreeCycle:
    """Start small, wait, look. `plant` is taken as it is, turbulence left out."""
    plant = replace(plant, lit=True)
    step = 1 / RATE_HZ
    if 0.0 < plant.flame.delay_s < step:
        step = plant.flame.delay_s
    simulation = Simulation(propagator(plant, (0.0, 0.05), step), disturbance=0.05)
    steps = int(settle_s / step)
    simulation.run(np.zeros(2 * steps + 1), stride=steps)
    window = int(0.4 / step)
    early = simulation.run(np.zeros(2 * window + 1))
    late = simulation.run(np.zeros(2 * window + 1))
    y = late[:, 0]
    with np.errstate(over="ignore", invalid="ignore"):
        rms, before = float(np.std(y)), float(np.std(early[:, 0]))
    if not np.isfinite(rms) or rms < 1e-6:
        return FreeCycle(0.0, 0.0, float(np.max(np.abs(late[:, 1]))), 0.0)
    centred = y - y.mean()
    up = np.flatnonzero((centred[:-1] < 0) & (centred[1:] >= 0))
    if up.size < 3:
        return FreeCycle(0.0, 0.0, float(np.max(np.abs(late[:, 1]))), 0.0)
    crossing = up - centred[up] / (centred[up + 1] - centred[up])
    frequency = (up.size - 1) / ((crossing[-1] - crossing[0]) * step)
    steadiness = abs(rms - before) / rms
    rms = float(np.std(y[up[0] : up[-1]]))  # whole periods
    peak = float(np.max(np.abs(late[:, 1])))
    return FreeCycle(float(frequency), rms * np.sqrt(2.0), peak, steadiness)


def free_amplitude(plant: Plant) -> float:
    """Peak of z on the free cycle: the size that relative widths refer to.

    Raises
    ------
    ValueError
        When the plant has no limit cycle of its own.
    """
    cycle = free_cycle(plant)
    if not cycle.exists:
        raise ValueError("the plant is stable: an effect sized by its limit cycle has no size")
    return cycle.z_peak
