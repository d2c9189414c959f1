"""One plant in motion: coefficients, state and the compiled loop behind a small class.

`Simulation` is deterministic: the same drive in pieces of any size gives the same numbers, bit
for bit, because nothing depends on where a piece ends.
"""

from dataclasses import dataclass

import numpy as np

from simulated_rig.etd import Coefficients, coefficients
from simulated_rig.kernel import propagate
from simulated_rig.kernel_plain import ORDERS, propagate_plain
from simulated_rig.plant import PREFORMS, Plant
from simulated_rig.statespace import FloatArray, StateSpace, assemble

EMPTY: FloatArray = np.zeros(0)
DEGREE = 5  # highest power that the kernel's characteristic takes


@dataclass(frozen=True)
class Propagator:
    """What the loop needs to know of a plant at one step size; immutable."""

    plant: Plant
    system: StateSpace
    coefficients: Coefficients

    @property
    def delay_steps(self) -> float:
        return self.plant.flame.delay_s / self.coefficients.h


def propagator(plant: Plant, microphones_m: tuple[float, ...], step_s: float) -> Propagator:
    """Prepare `plant` for steps of `step_s`.

    Raises
    ------
    ValueError
        For a flame delay shorter than one step, or a polynomial of degree above `DEGREE`.
    """
    delay = plant.flame.delay_s
    if 0.0 < delay < step_s * (1 - 1e-12) or delay < 0.0:
        raise ValueError(
            f"flame delay_s={delay!r} is not 0 or at least one step ({step_s!r} s); "
            "take a smaller step (more substeps)"
        )
    if len(plant.characteristic.coefficients) > DEGREE + 1:
        raise ValueError(
            f"coefficients={plant.characteristic.coefficients!r} are not at most {DEGREE + 1}: "
            f"the characteristic's degree is limited to {DEGREE}"
        )
    system = assemble(plant, microphones_m)
    return Propagator(plant, system, coefficients(system, step_s))


def _is_plain(plant: Plant, order: int) -> bool:
    """Whether the unrolled loop can do it."""
    end = plant.open_end
    lossless = end.quadratic_per_m == 0.0 and end.cubic_s_per_m2 == 0.0
    simple = plant.characteristic.preform == "none" and plant.flame.delay_s == 0.0
    return lossless and simple and order in ORDERS


class Simulation:
    """The state of a plant; `run` advances it.

    A new `Propagator` of the same order may be put in place between two calls (drift): the state
    carries over.
    """

    def __init__(self, propagator: Propagator, disturbance: float | None = None) -> None:
        self.propagator = propagator
        seed = propagator.plant.seed_state if disturbance is None else disturbance
        system = propagator.system
        self.x: FloatArray = np.zeros(system.order)
        # A small kick of the first mode's velocity, from which a limit cycle grows.
        scale = propagator.plant.velocity_scale * max(abs(propagator.plant.modes[0].velocity), 1e-9)
        self.x[system.modes] = seed / scale
        self._memory: FloatArray = np.zeros(1)
        size = 1 << max(4, int(np.ceil(np.log2(propagator.delay_steps + 8))))
        self._ring: FloatArray = np.zeros(size)
        self._slope: FloatArray = np.zeros(size)
        self._step = size  # so that a delayed place is never negative

    def run(
        self,
        drive: FloatArray,
        stride: int = 1,
        noise: FloatArray = EMPTY,
        gain: FloatArray = EMPTY,
    ) -> FloatArray:
        """Advance by the steps that `drive` covers.

        Parameters
        ----------
        drive : (2 · steps + 1,) volts at half steps, both ends included.
        stride : one output row every so many steps; must divide `steps`.
        noise, gain : (steps,) turbulence in volts; factor on the flame. Empty: none.

        Returns
        -------
        (steps/stride, 2 + microphones): velocity m/s, z, pressures Pa, each at its step's start.
        """
        steps, odd = divmod(drive.size - 1, 2)
        if odd or steps % stride:
            raise ValueError(
                f"drive.size={drive.size} is not 2·steps + 1 with steps a multiple of {stride}"
            )
        p, c, s = self.propagator.plant, self.propagator.coefficients, self.propagator.system
        delay = self.propagator.delay_steps
        if delay + 4 > self._ring.size:
            raise ValueError(f"flame delay of {delay} steps is longer than the stored past")
        out = np.empty((steps // stride, 2 + s.pressure.shape[0]))
        poly = np.zeros(DEGREE + 1)
        if p.lit:
            poly[: len(p.characteristic.coefficients)] = p.characteristic.coefficients
        direct = np.concatenate([[s.loss_direct, s.velocity_direct], s.pressure_direct])
        volts = np.ascontiguousarray(drive, dtype=np.float64)
        if noise.size == 0 and gain.size == 0 and _is_plain(p, s.order):
            propagate_plain(
                (0.0,) * s.order,
                self.x,
                c.matrix,
                c.beta,
                c.alpha,
                c.alpha_half,
                c.rate_row,
                c.rate_b,
                s.velocity[None, :],
                direct,
                poly,
                volts,
                stride,
                out,
            )
            return out
        propagate(
            self.x,
            np.empty(c.matrix.shape[1]),
            self._memory,
            self._ring,
            self._slope,
            self._step,
            c.h,
            c.matrix,
            c.beta,
            c.alpha,
            c.alpha_half,
            c.rate_row,
            c.rate_b,
            s.velocity,
            direct,
            PREFORMS.index(p.characteristic.preform),
            float(p.characteristic.width),
            poly,
            float(p.open_end.quadratic_per_m),
            float(p.open_end.cubic_s_per_m2),
            float(delay),
            volts,
            noise,
            gain,
            stride,
            out,
        )
        self._step += steps
        return out
