"""What the loop is made of, as an effect may change it: modes, curves, losses, a branch.

Each value is a number, a Dual, or either with one row a run.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Values = Mapping[str, Any]  # physical parameter values by name: floats or Duals
Characteristic = Callable[[Any], Any]  # static function of time samples, shape (runs, samples)


@dataclass(frozen=True)
class Mode:
    """One acoustic mode; each value a number, a Dual, or either with one row a run."""

    frequency_hz: Any
    damping: Any
    flame_residue: Any
    speaker_residue: Any
    sensor_ratio: Any = None  # velocity at the sensor over velocity at the flame; None: 1


@dataclass(frozen=True)
class Passed:
    """What an operator makes of one period of time samples: its output, (runs, samples).

    `follows`: whose inputs the output follows, as pairs of its slope by an input, (runs, samples),
    and the sample of that input, (runs, samples); `by`: its partial derivatives by parameters,
    (runs, samples), with these.
    """

    output: FloatArray
    follows: Sequence[tuple[FloatArray, IntArray]]
    by: Sequence[tuple[FloatArray, Any]]


@dataclass(frozen=True)
class Bent:
    """What a static curve makes of a wave, sample by sample: its output and its slope there, (runs,
    samples), and its partial derivatives by parameters, worked out where they are asked for."""

    output: FloatArray
    slope: FloatArray
    by: tuple[tuple[Callable[[], FloatArray], Any], ...]


Operator = Callable[[FloatArray], Passed]  # of time samples, (runs, samples)


@dataclass(frozen=True)
class Preceded:
    """A characteristic with an operator before it that has corners or remembers, and so needs
    whole periods, finely sampled.

    Called like any other it is the curve alone (small signals, plots of N).
    """

    curve: Characteristic
    operator: Operator

    def __call__(self, w: Any) -> Any:
        return self.curve(w)


@dataclass(frozen=True)
class Loss:
    """An amplitude-dependent loss L_i = `coefficients`[i] · g(v), v = Σ `weights`[i] · y_i.

    y_i is mode i's part of the flame's velocity: weights of one make v that velocity. `response`
    filters what g makes, by s: what is in phase with the motion shifts the frequency.
    """

    coefficients: Sequence[Any]
    characteristic: Characteristic
    weights: Sequence[Any]
    response: Callable[[Any], Any] = lambda s: 1.0


@dataclass(frozen=True)
class Branch:
    """A linear load beside the tube: Z v pushes back on mode i by `returned`[i], where
    v = Σ `felt`[i] · y_i is the velocity there and `impedance` is Z (1/s), (runs, harmonics)."""

    impedance: Any
    felt: Sequence[Any]
    returned: Sequence[Any]
