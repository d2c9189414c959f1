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
hooks of `Effect`. Written once with numbers or Duals alike, the same lines give the equations and
their derivatives.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.dual import Dual
from identify.parameters import Parameter, ParameterSet
from identify.periods import to_harmonics, to_time
from identify.polynomial import Polynomial

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Values = Mapping[str, Any]  # physical parameter values by name: floats or Duals
Characteristic = Callable[[Any], Any]  # static function of time samples, shape (runs, samples)
NONLINEARITIES = ("polynomial", "saturation", "lagrange", "linear")


BY_RUN = ("omega", "time", "flame_on", "identity", "free", "spacing_m")
BY_HARMONIC = ("drive", "pressure", "velocity")
FINE = 2048  # samples a period behind an amplifier: corners alias below 1e-6
MODAL = ("frequency_hz", "damping", "flame_residue", "speaker_residue")  # of each declared mode


@dataclass(frozen=True)
class Conditions:
    """What is known of a batch of runs before any model: one row a run, one column a harmonic.

    Arrays of shape (runs,) or (runs, harmonics); `drive`, `pressure` and `velocity` are measured
    Fourier coefficients, zero above the harmonics that were measured. `time` runs from 0 at the
    campaign's start to 1 at the start of its last run; `flame_on` is 0 for cold runs. Of a `free`
    run `omega` is only near its frequency; `spacing_m` is negative where microphones are exchanged.
    By its `deviations` a run is known to differ from what the model says of all runs.
    """

    omega: FloatArray
    drive: ComplexArray
    pressure: ComplexArray
    velocity: ComplexArray
    time: FloatArray
    flame_on: FloatArray
    identity: npt.NDArray[np.int64]
    free: npt.NDArray[np.bool_]
    spacing_m: FloatArray
    deviations: tuple["Deviation", ...] = ()
    centre_m: float = 0.6858
    density_kg_m3: float = 1.2
    sound_speed_m_s: float = 343.0

    @property
    def runs(self) -> int:
        return int(self.omega.size)

    @property
    def harmonics(self) -> int:
        return int(self.drive.shape[1])

    def take(self, rows: npt.NDArray[np.int64]) -> "Conditions":
        """The same for some of the runs."""
        own = tuple(replace(d, size=d.size[rows]) for d in self.deviations)
        arrays: dict[str, Any] = {n: getattr(self, n)[rows] for n in (*BY_RUN, *BY_HARMONIC)}
        return replace(self, deviations=own, **arrays)

    def tile(self, times: int) -> "Conditions":
        """All runs repeated `times` times, for as many parameter vectors at once."""
        if times == 1:
            return self
        if times not in self._tiled:
            self._tiled[times] = self.take(np.tile(np.arange(self.runs), times))
        return self._tiled[times]

    @cached_property
    def s(self) -> ComplexArray:
        """j k ω of each harmonic, (runs, harmonics); of free runs near their frequency."""
        return np.asarray(1j * self.omega[:, None] * np.arange(1, self.harmonics + 1))

    @cached_property
    def _tiled(self) -> dict[int, "Conditions"]:
        return {}

    @cached_property
    def free_rows(self) -> IntArray:
        return np.flatnonzero(self.free)

    @cached_property
    def of_free(self) -> "Conditions":
        """The same for the free runs alone."""
        return self.take(self.free_rows)

    @cached_property
    def with_free_again(self) -> "Conditions":
        """All runs, and behind them the free ones once more."""
        return self.take(np.concatenate([np.arange(self.runs), self.free_rows]))

    def padded(self, harmonics: int) -> "Conditions":
        """The same with columns of zeros up to so many harmonics, where there are fewer."""
        missing = ((0, 0), (0, max(harmonics - self.harmonics, 0)))
        wide: dict[str, Any] = {n: np.pad(getattr(self, n), missing) for n in BY_HARMONIC}
        return replace(self, **wide)

    def joined(self, other: "Conditions") -> "Conditions":
        """These runs, then the other's, with as many harmonics as either has, and deviations in
        the same directions."""
        K = max(self.harmonics, other.harmonics)
        pair = self.padded(K), other.padded(K)
        joined: dict[str, Any] = {
            n: np.concatenate([getattr(c, n) for c in pair]) for n in (*BY_RUN, *BY_HARMONIC)
        }
        own = tuple(
            replace(a, size=np.concatenate([a.size, b.size]))
            for a, b in zip(self.deviations, other.deviations, strict=True)
        )
        return replace(self, deviations=own, **joined)


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


class Effect:
    """Something that a declared model may lack: parameters, and changes to pieces of the loop.

    A subclass sets `name`, `location`, `form` and `parameters` and overrides the hooks it needs;
    every hook defaults to «no change». `p` maps the effect's own parameter names to values.
    `starts` proposes starting values from what is known: rows of physical values.
    """

    name: str = ""
    location: str = ""
    form: str = ""
    parameters: tuple[Parameter, ...] = ()
    needs: tuple[str, ...] = ()  # a "pressure" measured, or a "velocity" alone; a "flame_pole"
    generalises: tuple[str, ...] = ()  # effects of which this is an extension, not a rival
    mode_count: int | None = None  # only for declared models of that many modes
    located: tuple[str, ...] = ()  # parameters known to within their size, or it is not seen at all
    refines: bool = False  # tried only from where another form of it has come without explaining
    empirical: bool = False  # numbers that stand for a law: a form with the law is preferred
    rails: bool = False  # an `amplifier` that ends at its supply: what bends besides comes before
    smooth: bool = False  # an `amplifier` that few samples a period describe

    def extends(self, structure: "Structure") -> bool:
        """Whether it says what this declared model does not say already."""
        return self.mode_count in (None, structure.mode_count)

    def starts(self, known: "Known") -> list[tuple[float, ...]]:
        raise NotImplementedError(f"effect {self.name!r} proposes no starting values")

    def starts_from(self, other: "Effect", values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Starting values from those that another form of the same effect has come to (with the
        declared model's): what has the same unit is taken over."""
        known = [(q.unit, values[q.name]) for q in other.parameters]
        row = []
        for q in self.parameters:
            at = next((i for i, (unit, _) in enumerate(known) if unit == q.unit), None)
            if at is None:
                return []
            row.append(known.pop(at)[1])
        return [tuple(row)]

    def plainer(self, values: Mapping[str, float]) -> list[dict[str, float]]:
        """Other values of the whole model with which it responds nearly as with `values`, since
        what this form has too much of cancels with what was declared: simpler forms start there."""
        return []

    def apart_from(self, other: "Effect", values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Starting values of a form that refines another, from what that has come to, with which
        it responds otherwise: in a valley of its own, which no descent from `starts_from` finds."""
        return []

    def neutral(self) -> tuple[float, ...] | None:
        """Values at which the effect vanishes, where a score test can be taken; None: nowhere."""
        return None

    def shapes(self, known: "Known") -> list[tuple[float, ...]]:
        """Values at which the effect vanishes whatever shape it would have: zero for its sizes,
        which are tested at one shape after the other. Empty where `neutral` says it all."""
        return []

    def among(self, fitted: Sequence[float], held_out: Sequence[float]) -> "Effect":
        """The effect for a campaign whose runs are at these `Conditions.time`."""
        return self

    def as_well(self, values: Mapping[str, float]) -> list[dict[str, float]]:
        """Values of its own that the fitted runs do not tell apart; the held-out ones may."""
        return []

    def resolution(self, values: Mapping[str, float]) -> dict[str, float]:
        """Standard deviations of those parameters of which the runs say no more than between which
        of them a value lies, with no tangent: by name."""
        return {}

    def told(self, values: Mapping[str, float], span_s: float) -> str:
        """What an experimenter would ask next of these values, in a sentence; `span_s` is the time
        from the campaign's start to that of its last run."""
        return ""

    def to_internal(self, values: Sequence[float]) -> FloatArray:
        """Unknowns of the effect's own parameters from their physical values."""
        return ParameterSet(self.parameters).to_internal(values)

    def restated(self, structure: "Structure") -> "Structure | None":
        """A richer structure without the effect that says the same, if there is one: its own
        starting values then serve too."""
        return None

    def from_restated(self, structure: "Structure", values: Mapping[str, float]) -> list[float]:
        """Values of `structure` with this effect, in order, from those of `restated`."""
        raise NotImplementedError(f"effect {self.name!r} has no restated structure")

    def to_restated(self, structure: "Structure", values: Mapping[str, float]) -> dict[str, float]:
        """Values of `restated` from those of `structure` with this effect."""
        raise NotImplementedError(f"effect {self.name!r} has no restated structure")

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        return modes

    def flame(self, p: Values, at: Conditions, s: Any) -> Any:
        return 1.0

    def characteristic(self, p: Values, n: Characteristic, at: Conditions) -> Characteristic:
        return n

    def operator(self, p: Values) -> Operator | None:
        """What acts on the flame's input before the characteristic and has corners or remembers:
        it takes one period of time samples, periodically continued."""
        return None

    def loss(self, p: Values, at: Conditions, modes: list[Mode]) -> Loss | None:
        return None

    def branch(self, p: Values, modes: list[Mode], s: Any) -> Branch | None:
        return None

    def generator(self, p: Values, at: Conditions) -> Any:
        """A factor on the recorded drive's harmonics, ahead of the amplifier."""
        return 1.0

    def amplifier(self, p: Values, v: FloatArray) -> Bent:
        """What the drive becomes sample by sample, from its samples over one period."""
        return Bent(v, np.ones_like(v), ())

    def drive(self, p: Values, at: Conditions, u: Any) -> Any:
        """The drive's harmonics behind the amplifier."""
        return u

    def actuator(self, p: Values, at: Conditions, s: Any) -> Any:
        return 1.0

    def sensor(self, p: Values, at: Conditions, s: Any, y: Any) -> Any:
        return y

    @property
    def key(self) -> str:
        return f"{self.name}:{self.form}" if self.form else self.name

    @property
    def distorts(self) -> bool:
        """Whether it distorts the drive, which then does not enter linearly."""
        own = type(self)
        return own.amplifier is not Effect.amplifier or own.drive is not Effect.drive


@dataclass(frozen=True)
class Deviation:
    """How far each run deviates along an effect of one parameter: `size` (runs,)."""

    effect: Effect
    size: FloatArray

    @property
    def values(self) -> dict[str, FloatArray]:
        """The effect's parameter by name, one row a run."""
        return {self.effect.parameters[0].name: self.size[:, None]}


@dataclass(frozen=True)
class Known:
    """What starting values may lean on: sizes of the declared fit, never a simulator's truth."""

    free_hz: float
    modes_hz: tuple[float, ...]
    modes_damping: tuple[float, ...]
    flame_residues: tuple[float, ...]
    speaker_residues: tuple[float, ...]
    flame_input_amplitude: float
    velocity_amplitude: float
    drive_amplitude: float
    band_hz: tuple[float, float]

    def delays(self, cycles: float) -> list[float]:
        """Delays to start from, s, up to so many periods of the free oscillation: their misfit has
        a minimum every half of one, which then holds one as near to its own as any other does."""
        return [q / self.free_hz for q in (0.02, 0.08, *np.arange(0.2, cycles, 1 / 6).tolist())]


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


def at_the_flame(effects: Sequence[Effect], p: Values, at: Conditions, s: Any) -> ComplexArray:
    """The measured velocity as it is at the flame, without what `effects` put between them. What
    they form from measured signals is in the measurement's own phase, in free runs too."""
    given, y = replace(at, free=np.zeros_like(at.free)), at.velocity
    for e in reversed(effects):
        if type(e).sensor is not Effect.sensor:
            none = e.sensor(p, given, s, np.zeros_like(y))
            y = (y - none) / (e.sensor(p, given, s, np.ones_like(y)) - none)
    return y


def driven(effects: Sequence[Effect], p: Values, at: Conditions, drive: Any) -> Any:
    """The drive's harmonics at the speaker's terminals.

    From one curve of the amplifier to the next it goes as a wave: with its mean, and with more
    harmonics than are compared.
    """
    curves = [e for e in effects if type(e).amplifier is not Effect.amplifier]
    if curves and np.any(dual.value(drive)):
        samples = None if len(curves) == 1 and curves[0].smooth else FINE
        in_turn = [partial(e.amplifier, p) for e in sorted(curves, key=_rails)]
        drive = _bent(in_turn, drive, samples)
    for e in effects:
        drive = e.drive(p, at, drive)
    return drive


def _rails(effect: Effect) -> bool:
    return effect.rails


def _bent(curves: Sequence[Callable[[FloatArray], Bent]], drive: Any, samples: int | None) -> Any:
    """Harmonics of a drive behind `curves`, with their derivatives."""
    K = drive.shape[1]
    wave = to_time(drive, K, samples)
    v = dual.value(wave)
    slope = np.ones_like(v)
    moved: list[tuple[FloatArray, Dual]] = []
    for curve in curves:
        bent = curve(v)
        moved = [(m * bent.slope, x) for m, x in moved]
        moved += [(own(), x) for own, x in bent.by if isinstance(x, Dual)]
        v, slope = bent.output, slope * bent.slope
    # parameters vary all samples alike: their derivatives are taken to harmonics before the seeds
    total = dual.chain(
        to_harmonics(v, K, samples), *((to_harmonics(m, K, samples), x) for m, x in moved)
    )
    if not isinstance(wave, Dual):
        return total
    return total + to_harmonics(Dual(np.zeros_like(v), wave.d * slope[..., None]), K, samples)


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
