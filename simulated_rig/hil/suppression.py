"""How far a phase shifter quietens the tube: over phase and gain, and while the tube changes.

Every point starts on the developed limit cycle, runs with the controller on for `settle_s`, and is
measured over `window_s`: the rms pressure at the controller's microphone against that of the free
limit cycle, in dB. Beside it stands what linear algebra says of the same loop (`controllers`): the
growth rate of the rest, whose sign is the boundary, and what noise leaves where it is negative.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from simulated_rig.config import RigConfig
from simulated_rig.controllers import (
    PhaseSearch,
    PhaseShifter,
    growth_rate,
    linear_plant,
    residual_pa,
)
from simulated_rig.hil.loop import PlantLoop
from simulated_rig.plant import Plant
from simulated_rig.statespace import FloatArray

#: Frames and steps per second. At 12 kHz and 170 Hz the integrator's ωh is 0.09: (ωh)⁴ = 6e-5.
RATE_HZ = 12000.0
FREE_S = 3.0


@dataclass(frozen=True)
class SuppressionMap:
    """Arrays (gains, phases). `measured_db` and `predicted_db` > 0 where quieter than the free
    limit cycle of `free_pa` rms; `predicted_db` is NaN where `growth_rate` (1/s) is not < 0."""

    phases_rad: FloatArray
    gains_v_per_pa: FloatArray
    measured_db: FloatArray
    growth_rate: FloatArray
    predicted_db: FloatArray
    free_pa: float

    @property
    def best(self) -> tuple[int, int]:
        """Index of the greatest suppression."""
        gain, phase = np.unravel_index(np.argmax(self.measured_db), self.measured_db.shape)
        return int(gain), int(phase)


def free_cycle_state(
    config: RigConfig, microphone: int, rate_hz: float = RATE_HZ
) -> tuple[FloatArray, float]:
    """State on the free limit cycle, and the rms pressure (Pa) there."""
    loop = PlantLoop(config, rate_hz, least_steps_hz=rate_hz)
    loop.process(np.zeros(round(FREE_S * rate_hz)))
    pressure = loop.process(np.zeros(round(rate_hz)))[:, microphone]
    return loop.x.copy(), float(np.std(pressure))


def suppression_map(
    config: RigConfig,
    shifter: PhaseShifter,
    phases_rad: FloatArray,
    gains_v_per_pa: FloatArray,
    *,
    settle_s: float = 2.0,
    window_s: float = 1.0,
    rate_hz: float = RATE_HZ,
    workers: int | None = None,
) -> SuppressionMap:
    """Suppression by `shifter` at every phase and gain, measured and predicted; see the module."""
    start, free_pa = free_cycle_state(config, shifter.microphone, rate_hz)
    plant = linear_plant(config.plant, config.microphones_m, rate_hz)

    def point(index: tuple[int, int]) -> tuple[float, float, float]:
        gain, phase = gains_v_per_pa[index[0]], phases_rad[index[1]]
        tuned = replace(shifter, phase_rad=float(phase), gain_v_per_pa=float(gain))
        controller = tuned.linear(rate_hz, len(config.microphones))
        seed = 1 + index[0] * phases_rad.size + index[1]
        loop = PlantLoop(config, rate_hz, controller, seed, least_steps_hz=rate_hz)
        loop.x[:] = start
        loop.process(np.zeros(round(settle_s * rate_hz)))
        rest = loop.process(np.zeros(round(window_s * rate_hz)))[:, shifter.microphone]
        rate = growth_rate(plant, controller, rate_hz)
        noise = np.nan
        if rate < 0:
            noise = residual_pa(config, controller, rate_hz, shifter.microphone)
        return _db(free_pa / float(np.std(rest))), rate, _db(free_pa / noise)

    shape = (gains_v_per_pa.size, phases_rad.size)
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        found = np.array(list(pool.map(point, np.ndindex(shape)))).reshape(*shape, 3)
    return SuppressionMap(
        phases_rad, gains_v_per_pa, found[..., 0], found[..., 1], found[..., 2], free_pa
    )


def _db(ratio: float) -> float:
    return float(20 * np.log10(ratio))


@dataclass(frozen=True)
class Tracked:
    """One row a window: time at its end (s), phase centre (rad), rms pressure (Pa), and the growth
    rate (1/s) that the linear model gives the loop as it stood."""

    time_s: FloatArray
    phase_rad: FloatArray
    pressure_pa: FloatArray
    growth_rate: FloatArray


def track(
    config: RigConfig,
    shifter: PhaseShifter,
    plant_at: Callable[[float], Plant],
    duration_s: float,
    search: PhaseSearch | None = None,
    *,
    window_s: float = 0.5,
    rate_hz: float = RATE_HZ,
    seed: int = 0,
) -> Tracked:
    """Control the tube while `plant_at(time)` changes it, window by window.

    With `search` the phase is the search's (starting from its own), else `shifter`'s throughout.
    """
    count = len(config.microphones)
    start, _ = free_cycle_state(config, shifter.microphone, rate_hz)
    loop = PlantLoop(config, rate_hz, seed=seed, least_steps_hz=rate_hz)
    loop.x[:] = start
    rows = []
    for k in range(round(duration_s / window_s)):
        plant = plant_at(k * window_s)
        loop.operate(plant)
        applied = shifter.phase_rad if search is None else search.applied_rad
        controller = replace(shifter, phase_rad=applied).linear(rate_hz, count)
        loop.control(controller)
        pressure = loop.process(np.zeros(round(window_s * rate_hz)))[:, shifter.microphone]
        # The first half is the answer to the new phase, still under way.
        rms = float(np.std(pressure[pressure.size // 2 :]))
        centre = shifter.phase_rad if search is None else search.phase_rad
        rate = growth_rate(linear_plant(plant, config.microphones_m, rate_hz), controller, rate_hz)
        rows.append(((k + 1) * window_s, centre, rms, rate))
        if search is not None:
            search = search.step(float(20 * np.log10(max(rms, 1e-9))))
    time_s, phase, level, rates = np.array(rows).T
    return Tracked(time_s, phase, level, rates)
