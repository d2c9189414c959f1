"""An effect: parameters, and the hooks by which it changes pieces of the loop.

    drive         U' = A(s) · g(γ U)              γ_k: what the amplifier is given of the recorded U
    measurement   M = sensor(Y)

The rest of the loop is in `identify.structure`. What lies between the recorded drive and the sound,
or between the velocity and its measurement, can be applied to recorded signals too (`driven`,
`at_the_flame`). A run's own `Deviation` goes through the same hooks.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from identify import dual
from identify.dual import Dual
from identify.parameters import Parameter, ParameterSet
from identify.periods import to_harmonics, to_time
from identify.pieces import Bent, Branch, Characteristic, Loss, Mode, Operator, Values

if TYPE_CHECKING:
    from identify.structure import Structure

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

BY_RUN = ("omega", "time", "flame_on", "identity", "free", "spacing_m")
BY_HARMONIC = ("drive", "pressure", "velocity")
MANY = 64  # rows among which it pays to look for those that are alike
FINE = 2048  # samples a period behind an amplifier: corners alias below 1e-6


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
    modal: tuple[str, ...] = ()  # damping ratios that must be a mode's: with more, it is a shape
    located: tuple[str, ...] = ()  # parameters known to within their size, or it is not seen at all
    residues: tuple[tuple[str, str], ...] = ()  # of a mode, the flame's part and the speaker's
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

    @property
    def about(self) -> str:
        """What it is, for people."""
        return (type(self).__doc__ or "").strip().partition("\n\n")[0]

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
        in_turn = sorted(curves, key=lambda e: e.rails)
        own = {q.name: p[q.name] for e in curves for q in e.parameters}
        each, again = _alike(own, drive)
        if each is not None:
            own, drive = {name: value[each] for name, value in own.items()}, drive[each]
        bent = _bent([partial(e.amplifier, own) for e in in_turn], drive, samples)
        drive = bent if each is None else bent[again]
    for e in effects:
        drive = e.drive(p, at, drive)
    return drive


def _alike(own: Values, drive: Any) -> tuple[IntArray, IntArray] | tuple[None, None]:
    """Of many rows that are given the same drive and the same parameters one each, and where each
    row finds its own among them: thousands of starts differ in all but what the amplifier does.
    Neither, where few are alike, or derivatives are wanted."""
    columns, rows = [drive, *own.values()], drive.shape[0]
    plain = all(isinstance(c, np.ndarray) and len(c) == rows for c in columns)
    if rows < MANY or not plain:
        return None, None
    table = np.ascontiguousarray(np.concatenate(columns, axis=1, dtype=complex))
    keys = table.view(np.dtype((np.void, table[0].nbytes)))[:, 0]
    _, each, again = np.unique(keys, return_index=True, return_inverse=True)
    return (each, again) if 2 * len(each) < rows else (None, None)


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
