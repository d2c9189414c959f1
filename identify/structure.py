"""The loop as a declared structure: what it is made of, and its equations at harmonics of ω.

    velocity      Y = Σ_i b_i(s) [ r_i s F + a_i U' − L_i ],   b_i(s) = s / (s² + 2ζ_i ω_i s + ω_i²)
    flame input   w = H(s) Y,       first order: H = 1 / (s + ω_f)          (Eq. 4.12)
    flame output  F = N(w) = w + c2 w² + c3 w³ + …             slope one: the gain sits in r_i
    drive         U' = A(s) · g(γ U)              γ_k: what the amplifier is given of the recorded U
    measurement   M = sensor(Y)

`r_i` = k_f · 22.5 · ψ_i(xf) D_i and `a_i` = ψ_i(xa) D_i in the thesis's terms: only these products
are identifiable from one velocity signal, so four numbers describe a mode. The single
nonlinearity enters once. `L_i` is an amplitude-dependent loss, absent unless declared.

A `Structure` is a base plus effects; each effect may change any one of these pieces through the
hooks of `identify.effect.Effect`. Written once with numbers or Duals alike, the same lines give the
equations and their derivatives.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.dual import Dual
from identify.effect import Conditions, Effect, driven
from identify.parameters import Parameter, ParameterSet
from identify.pieces import Branch, Characteristic, Loss, Mode, Preceded, Values
from identify.polynomial import Polynomial

NONLINEARITIES = ("polynomial", "saturation", "lagrange", "linear")
MODAL = ("frequency_hz", "damping", "flame_residue", "speaker_residue")  # of each declared mode


@dataclass(frozen=True)
class Loop:
    """The assembled equations for one batch: transfer functions (runs, harmonics) and functions.

    loops a, b: 0 is the flame, 1 the loss if there is one.
        v_a = Σ_b P[a][b] N_b(v_b) + Q[a],   Y = Σ_b G[b] N_b(v_b) + G_u
    """

    P: tuple[tuple[Any, ...], ...]
    Q: tuple[Any, ...]
    G: tuple[Any, ...]
    G_u: Any
    N: tuple[Characteristic, ...]
    sensor: Callable[[Any], Any]
    H: Any


@dataclass(frozen=True)
class Structure:
    """A declared model: number of modes, flame path, nonlinearity, and effects added to it.

    `flame_order` counts first-order low-passes in the flame path; `flame_delay` adds a delay.
    `nonlinearity` is ``polynomial`` of `degree`, ``saturation`` (tanh), ``lagrange`` (through
    values at given nodes, Eq. 3.22) or ``linear``; all have slope one at zero.
    """

    mode_count: int = 2
    flame_order: int = 1
    flame_delay: bool = False
    nonlinearity: str = "polynomial"
    degree: int = 3
    nodes: tuple[float, ...] = ()
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        if self.mode_count < 1:
            raise ValueError(f"modes={self.mode_count} is not an integer >= 1")
        if self.flame_order < 0:
            raise ValueError(f"flame_order={self.flame_order} is not an integer >= 0")
        if self.nonlinearity not in NONLINEARITIES:
            raise ValueError(f"nonlinearity={self.nonlinearity!r} is not one of {NONLINEARITIES}")
        if self.nonlinearity == "polynomial" and self.degree < 1:
            raise ValueError(f"nonlinearity_degree={self.degree} is not an integer >= 1")
        if self.nonlinearity == "lagrange" and len(self.nodes) < 2:
            raise ValueError(f"nodes={self.nodes} are not at least two values other than zero")

    @property
    def highest_power(self) -> int:
        """The highest power of the flame's input that the characteristic has, or, if it is no
        polynomial, that stands for it."""
        powers = {"polynomial": self.degree, "linear": 1, "lagrange": len(self.nodes) + 1}
        return powers.get(self.nonlinearity, 3)

    @property
    def base_parameters(self) -> tuple[Parameter, ...]:
        out: list[Parameter] = []
        for i in range(1, self.mode_count + 1):
            out += [
                Parameter(f"mode{i}.frequency_hz", "Hz", 1.0, 1e5, "positive"),
                Parameter(f"mode{i}.damping", "1", 1e-4, 1.5, "positive"),
                Parameter(f"mode{i}.flame_residue", "1/s"),
                Parameter(f"mode{i}.speaker_residue", "m/s²/V"),
            ]
        for j in range(1, self.flame_order + 1):
            name = "flame.pole_hz" if j == 1 else f"flame.pole{j}_hz"
            out.append(Parameter(name, "Hz", 0.5, 1e5, "positive"))
        if self.flame_delay:
            out.append(Parameter("flame.delay_s", "s", 1e-7, 0.05, "positive"))
        return (*out, *_characteristic_parameters(self))

    @cached_property
    def parameters(self) -> ParameterSet:
        own = [p for e in self.effects for p in e.parameters]
        return ParameterSet((*self.base_parameters, *own))

    @cached_property
    def cornered(self) -> bool:
        """Whether corners or memory precede the characteristic: harmonics then fall off slowly."""
        return any(type(e).operator is not Effect.operator for e in self.effects)

    @property
    def undistorted(self) -> "Structure":
        """The same without what distorts the drive."""
        return replace(self, effects=tuple(e for e in self.effects if not e.distorts))

    def with_effects(self, *effects: Effect) -> "Structure":
        return replace(self, effects=(*self.effects, *effects))

    def assemble(self, p: Values, at: Conditions, s: Any) -> Loop:
        """The loop's equations at the complex frequencies `s`, shape (runs, harmonics)."""
        modes = self._modes(p, at)
        resonators = [resonance(m, s) for m in modes]
        H = self.flame_path(p, at, s)
        given: Any = 1.0
        for d in at.deviations:
            given = d.effect.generator(d.values, at) * given
        for e in self.effects:
            given = e.generator(p, at) * given
        drive = driven(self.effects, p, at, given * at.drive)
        for e in self.effects:
            drive = e.actuator(p, at, s) * drive
        on = at.flame_on[:, None]
        by_flame = [m.flame_residue for m in modes]
        by_drive = [m.speaker_residue for m in modes]
        response = _responses(resonators, self._branch(p, modes, s))
        at_flame, from_drive = (
            response(resonators, by_flame) * s * on,
            response(resonators, by_drive),
        )
        seen, seen_flame, seen_drive = resonators, at_flame, from_drive
        if any(m.sensor_ratio is not None for m in modes):
            ratios = [1.0 if m.sensor_ratio is None else m.sensor_ratio for m in modes]
            seen = [b * q for b, q in zip(resonators, ratios, strict=True)]
            seen_flame, seen_drive = response(seen, by_flame) * s * on, response(seen, by_drive)

        def sensor(y: Any) -> Any:
            for e in self.effects:
                y = e.sensor(p, at, s, y)
            return y

        n = self._flame_characteristic(p, at)
        loss = self._loss(p, at, modes)
        if loss is None:
            q = H * (from_drive * drive)
            return Loop(
                ((H * at_flame,),), (q,), (seen_flame,), seen_drive * drive, (n,), sensor, H
            )
        lost = [c * loss.response(s) for c in loss.coefficients]
        lossy = -response(resonators, lost)
        felt = [b * w for b, w in zip(resonators, loss.weights, strict=True)]
        seen_lossy = lossy if seen is resonators else -response(seen, lost)
        row = (response(felt, by_flame) * s * on, -response(felt, lost))
        q_loss = response(felt, by_drive) * drive
        return Loop(
            ((H * at_flame, H * lossy), row),
            (H * (from_drive * drive), q_loss),
            (seen_flame, seen_lossy),
            seen_drive * drive,
            (n, loss.characteristic),
            sensor,
            H,
        )

    def characteristics(self, p: Values, at: Conditions) -> tuple[Characteristic, ...]:
        """Those of `assemble` alone: all nonlinearities of the equations."""
        loss = self._loss(p, at, self._modes(p, at))
        own = () if loss is None else (loss.characteristic,)
        return (self._flame_characteristic(p, at), *own)

    @cached_property
    def shaping(self) -> npt.NDArray[np.int64]:
        """Which of the parameters shape the characteristics: no other reaches them but by their
        inputs."""
        bent = {q.name for q in _characteristic_parameters(self)}
        for e in self.effects:
            hooks = (
                (type(e).characteristic, Effect.characteristic),
                (type(e).operator, Effect.operator),
                (type(e).loss, Effect.loss),
            )
            if any(own is not none for own, none in hooks):
                bent |= {q.name for q in e.parameters}
        return np.flatnonzero([n in bent for n in self.parameters.names])

    def _modes(self, p: Values, at: Conditions) -> list[Mode]:
        modes = declared_modes(p, self.mode_count)
        for e in self.effects:
            modes = e.modes(p, at, modes)
        for d in at.deviations:
            modes = d.effect.modes(d.values, at, modes)
        return modes

    def _branch(self, p: Values, modes: list[Mode], s: Any) -> Branch | None:
        found = [x for e in self.effects if (x := e.branch(p, modes, s)) is not None]
        if len(found) > 1:
            raise ValueError("two effects declare a branch beside the tube; one at most")
        return found[0] if found else None

    def _loss(self, p: Values, at: Conditions, modes: list[Mode]) -> Loss | None:
        found = [x for e in self.effects if (x := e.loss(p, at, modes)) is not None]
        if len(found) > 1:
            raise ValueError("two effects declare an amplitude-dependent loss; one at most")
        return found[0] if found else None

    def _flame_characteristic(self, p: Values, at: Conditions) -> Characteristic:
        n = self._characteristic(p)
        for e in self.effects:
            n = e.characteristic(p, n, at)
        for e in self.effects:
            if (operator := e.operator(p)) is not None:
                n = Preceded(n, operator)
        return n

    def flame_path(self, p: Values, at: Conditions, s: Any) -> Any:
        """From the velocity at the flame to the nonlinearity's input."""
        H: Any = 1.0
        for j in range(1, self.flame_order + 1):
            pole = 2 * np.pi * p["flame.pole_hz" if j == 1 else f"flame.pole{j}_hz"]
            H = _low_pass(None if j == 1 else pole, pole, s) * H
        if self.flame_delay:
            H = H * dual.exp(-(s * p["flame.delay_s"]))
        for e in self.effects:
            H = H * e.flame(p, at, s)
        return H

    def _characteristic(self, p: Values) -> Characteristic:
        if self.nonlinearity == "saturation":
            level = p["nonlinearity.level"]
            return lambda w: level * dual.tanh(w / level)
        if self.nonlinearity == "lagrange":
            values = [p[f"nonlinearity.value{j}"] for j in range(1, len(self.nodes) + 1)]
            return Polynomial((1.0, *_lagrange_coefficients(self.nodes, values)))
        last = self.degree if self.nonlinearity == "polynomial" else 1
        return Polynomial((1.0, *(p[f"nonlinearity.c{d}"] for d in range(2, last + 1))))


def _characteristic_parameters(structure: Structure) -> list[Parameter]:
    if structure.nonlinearity == "polynomial":
        return [
            Parameter(f"nonlinearity.c{d}", f"m^-{d - 1}") for d in range(2, structure.degree + 1)
        ]
    if structure.nonlinearity == "saturation":
        return [Parameter("nonlinearity.level", "m", 0.0, np.inf, "positive")]
    if structure.nonlinearity == "lagrange":
        return [Parameter(f"nonlinearity.value{j + 1}", "m") for j in range(len(structure.nodes))]
    return []


def _lagrange_coefficients(nodes: Sequence[float], values: Sequence[Any]) -> list[Any]:
    """Coefficients c2, c3, … of the polynomial w + c2 w² + … through (node, value) (Eq. 3.22).

    Zero with slope one is fixed, so a degree of len(nodes) + 1 passes through all nodes.
    """
    x = np.asarray(nodes, dtype=float)
    matrix = np.linalg.inv(np.stack([x ** (d + 2) for d in range(x.size)], axis=1))
    excess = [v - xn for v, xn in zip(values, x.tolist(), strict=True)]
    return [_sum(matrix[d, j] * excess[j] for j in range(x.size)) for d in range(x.size)]


def declared_modes(p: Values, count: int) -> list[Mode]:
    """The first `count` modes, without effects."""
    return [Mode(*(p[f"mode{i}.{n}"] for n in MODAL)) for i in range(1, count + 1)]


def resonance(mode: Mode, s: Any) -> Any:
    """b = s/(s² + 2ζωs + ω²) with its partial derivatives by s, ω and ζ."""
    w = 2 * np.pi * mode.frequency_hz
    z = mode.damping
    sv, wv, zv = dual.value(s), dual.value(w), dual.value(z)
    b = sv / (sv * sv + (2.0 * zv * wv) * sv + wv * wv)
    if not (isinstance(s, Dual) or isinstance(w, Dual)):
        return b
    q = b * b / sv  # −∂b/∂(denominator)
    terms = [(b / sv - q * (2.0 * sv + 2.0 * zv * wv), s)] if isinstance(s, Dual) else []
    terms += [(-q * (2.0 * zv * sv + 2.0 * wv), w), (-q * (2.0 * wv * sv), z)]
    return dual.chain(b, *terms)


def _low_pass(top: Any, pole: Any, s: Any) -> Any:
    """top/(s + pole) for a plain or Dual pole and a top of 1 or the pole itself."""
    inverse = 1.0 / (dual.value(s) + dual.value(pole))
    unit = dual.chain(inverse, (-inverse * inverse, s), (-inverse * inverse, pole))
    return unit if top is None else unit * top


def _responses(
    resonators: Sequence[Any], branch: Branch | None
) -> Callable[[Sequence[Any], Sequence[Any]], Any]:
    """Σ_i o_i y_i as a function of the modes' responses with their outputs, b_i o_i, and of the
    forces f_i on them: y_i = b_i (f_i − g_i Z Σ_j q_j y_j) with a branch of Z, q and g."""

    def free(outputs: Sequence[Any], forces: Sequence[Any]) -> Any:
        return _sum(b * f for b, f in zip(outputs, forces, strict=True))

    if branch is None:
        return free
    felt = [b * q for b, q in zip(resonators, branch.felt, strict=True)]
    returned = branch.returned
    load = branch.impedance / (branch.impedance * free(felt, returned) + 1.0)

    def loaded(outputs: Sequence[Any], forces: Sequence[Any]) -> Any:
        return free(outputs, forces) - load * free(outputs, returned) * free(felt, forces)

    return loaded


def _sum(terms: Any) -> Any:
    total: Any = 0.0
    for t in terms:
        total = total + t
    return total
