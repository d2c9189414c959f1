"""The operating point: what flow and equivalence ratio do to gain and damping.

A stand-in, not a combustion model: the flame's small-signal gain grows with the flow and has a
Gaussian optimum over the equivalence ratio; losses grow with the flow (turbulence, vortex
shedding). Both are relative to the reference point, at which the plant is what its preset says. As
only the linear gain moves, the limit cycle's amplitude goes as the square root of the distance from
the Hopf point, where the pair of poles crosses the axis.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from simulated_rig.plant import Plant
from simulated_rig.statespace import assemble


@dataclass(frozen=True)
class OperatingPoint:
    """`flow` relative to the reference; `equivalence_ratio` φ."""

    flow: float = 1.0
    equivalence_ratio: float = 0.6

    def __post_init__(self) -> None:
        if not self.flow > 0:
            raise ValueError(f"flow={self.flow!r} is not a relative flow > 0")
        if not self.equivalence_ratio > 0:
            raise ValueError(f"equivalence_ratio={self.equivalence_ratio!r} is not > 0")


REFERENCE = OperatingPoint()
RICHEST_RESPONSE = 0.7  # equivalence ratio of the greatest gain
RESPONSE_WIDTH = 0.15
LOSS_PER_FLOW = 0.3


def _response(point: OperatingPoint) -> float:
    distance = (point.equivalence_ratio - RICHEST_RESPONSE) / RESPONSE_WIDTH
    return point.flow * float(np.exp(-0.5 * distance**2))


def at_operating_point(plant: Plant, point: OperatingPoint) -> Plant:
    """`plant`, given at `REFERENCE`, at another point."""
    gain = _response(point) / _response(REFERENCE)
    loss = 1.0 + LOSS_PER_FLOW * (point.flow - REFERENCE.flow)
    shape = plant.characteristic
    coefficients = list(shape.coefficients)
    coefficients[1] *= gain
    modes = tuple(replace(m, damping=m.damping * loss) for m in plant.modes)
    return replace(
        plant, modes=modes, characteristic=replace(shape, coefficients=tuple(coefficients))
    )


def growth_rate(plant: Plant) -> float:
    """Largest real part of the closed loop's poles, 1/s: > 0 where a limit cycle grows.

    Without the flame's delay, which is not a pole.
    """
    system = assemble(plant, (0.0, 0.05))
    loop = system.a + np.outer(system.b[:, 0], system.z) * plant.characteristic.gain
    return float(np.max(np.linalg.eigvals(loop).real))


def hopf_flow(
    plant: Plant, equivalence_ratio: float, low: float = 0.05, high: float = 5.0
) -> float:
    """The flow at which the limit cycle is born, at that equivalence ratio.

    Raises
    ------
    ValueError
        When the loop does not change its stability between `low` and `high`.
    """

    def rate(flow: float) -> float:
        return growth_rate(at_operating_point(plant, OperatingPoint(flow, equivalence_ratio)))

    if rate(low) * rate(high) > 0:
        raise ValueError(
            f"equivalence_ratio={equivalence_ratio!r}: no Hopf point between flow {low} and {high}"
        )
    return float(brentq(rate, low, high, xtol=1e-10))
