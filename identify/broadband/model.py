"""The declared loop as a model an engineer can read, and its simulation with derivatives.

    y'' + 2ζω₀ y' + ω₀² (y + k₂y² + k₃y³ + k₅y⁵ + damping and input terms) = ω₀² (K u(t − τ) + b)

`NAMES` lists every parameter that a structure may hold; a `Structure` is the set in use. The
simulation runs in scaled, dimensionless coefficients (`kernel`); `physical` translates them, with
their covariance, into hertz, ratios and the channels' units.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from identify.broadband.kernel import FloatArray, integrate
from identify.broadband.recorder import RecorderFilter, interpolate, inverse, inverse_slope

ComplexArray = npt.NDArray[np.complex128]

# Terms of the feedback: name -> powers of (y, y', u).
MONOMIALS: dict[str, tuple[int, int, int]] = {
    "stiffness": (1, 0, 0),
    "damping": (0, 1, 0),
    "input": (0, 0, 1),
    "bias": (0, 0, 0),
    "quadratic": (2, 0, 0),
    "cubic": (3, 0, 0),
    "quartic": (4, 0, 0),
    "quintic": (5, 0, 0),
    "damping_y2": (2, 1, 0),
    "damping_v3": (0, 3, 0),
    "input_square": (0, 0, 2),
    "input_cube": (0, 0, 3),
}
FRICTION = ("friction", "friction_threshold")
RECORDER = ("recorder_edge", "recorder_dispersion")
LINEAR = ("stiffness", "damping", "input", "bias")
NAMES = (*MONOMIALS, *FRICTION, "delay", *RECORDER, "feedthrough")
_RECORDED = 2  # the recorder's filter acts at twice the sample rate: a cube of the band fits in


@dataclass(frozen=True)
class Structure:
    """Parameters in use, in the order of `NAMES`."""

    names: tuple[str, ...]

    def __post_init__(self) -> None:
        unknown = [name for name in self.names if name not in NAMES]
        if unknown:
            raise ValueError(f"names={unknown} are not among {list(NAMES)}")
        object.__setattr__(self, "names", tuple(n for n in NAMES if n in self.names))

    def plus(self, *names: str) -> "Structure":
        return Structure((*self.names, *names))

    def __contains__(self, name: str) -> bool:
        return name in self.names


@dataclass(frozen=True)
class Scale:
    """Units of the dimensionless equation: time 1/rate, output and input in their own units."""

    rate: float
    output: float
    input: float
    output_unit: str = "V"
    input_unit: str = "V"


@dataclass(frozen=True)
class Excitation:
    """One record: measured input and output, shape (samples,), and its sample rate.

    `substeps` is the number of Runge–Kutta steps a sample, a power of two from 2; see `refined`.
    """

    u: FloatArray
    y: FloatArray
    sample_rate_hz: float
    scale: Scale
    _spectrum: ComplexArray = field(repr=False)
    substeps: int = _RECORDED

    @classmethod
    def of(
        cls,
        u: npt.ArrayLike,
        y: npt.ArrayLike,
        sample_rate_hz: float,
        units: tuple[str, str] = ("V", "V"),
    ) -> "Excitation":
        """Check and scale a record; ω₀'s scale is where |Y/U| is largest. `units` of u and y.

        Raises
        ------
        ValueError : unequal or short arrays, non-finite or constant values, a bad rate.
        """
        u = np.array(u, dtype=np.float64)
        y = np.array(y, dtype=np.float64)
        if u.ndim != 1 or u.shape != y.shape or u.size < 1024:
            raise ValueError(
                f"u {u.shape} and y {y.shape} are not two channels of equal length >= 1024"
            )
        if not (np.isfinite(u).all() and np.isfinite(y).all() and u.std() > 0 and y.std() > 0):
            raise ValueError("u or y is constant or holds a value that is not a finite number")
        if not sample_rate_hz > 0:
            raise ValueError(f"sample_rate_hz={sample_rate_hz} is not > 0")
        if u.size % 2:
            u, y = u[:-1], y[:-1]
        rate = 2 * np.pi * _resonance(u, y, sample_rate_hz)
        scale = Scale(rate, float(y.std()), float(u.std()), units[1], units[0])
        return cls(u, y, sample_rate_hz, scale, np.fft.rfft(u))

    @property
    def samples(self) -> int:
        return int(self.u.size)

    def predict(
        self, structure: Structure, theta: FloatArray, *, derivatives: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """Simulated output (samples,) and its Jacobian (samples, parameters), all from rest."""
        value = dict(zip(structure.names, theta, strict=True))
        n, factor = self.samples, 2 * self.substeps
        f = np.asarray(np.fft.rfftfreq(n, 1 / self.sample_rate_hz), dtype=np.float64)
        filter_ = None
        if "recorder_edge" in value or "recorder_dispersion" in value:
            filter_ = RecorderFilter(
                value.get("recorder_edge", 0.4 * self.sample_rate_hz),
                value.get("recorder_dispersion", 0.0),
            )
        # With the dispersion alone (score test, neutral value 0) the low-pass itself is absent.
        a = None
        if filter_ is not None:
            low_pass = "recorder_edge" in value
            a = filter_.response(f) if low_pass else np.ones(f.size, dtype=np.complex128)
        late = np.exp(-2j * np.pi * f * value.get("delay", 0.0))
        clean = self._spectrum * late * (inverse(a) if a is not None else 1.0)
        inputs, paths = self._input_slopes(structure, f, clean, late, a, filter_)
        keep = derivatives and len(paths) > 0
        terms = [name for name in structure.names if name in MONOMIALS]
        w = interpolate(clean, n, factor) / self.scale.input
        slopes = (
            np.array([interpolate(s, n, factor) for s in inputs]) / self.scale.input
            if keep
            else np.zeros((0, w.size))
        )
        h = self.scale.rate / (self.sample_rate_hz * self.substeps)
        eta, rows = integrate(
            w,
            slopes,
            np.array([value[name] for name in terms]),
            np.array([MONOMIALS[name] for name in terms]),
            value.get("friction", 0.0),
            value.get("friction_threshold", 0.5) if "friction" in value else 0.0,
            h,
            derivatives=derivatives,
        )
        skip = self.substeps // _RECORDED
        eta, rows = eta[::skip], rows[::skip]
        sampled, slopes_out = self._record(eta, rows, filter_, a)
        feed = value.get("feedthrough", 0.0)
        prediction = sampled * self.scale.output + feed * self.u
        if not derivatives:
            return prediction, np.empty((n, 0))
        labels = [*terms, *(FRICTION if "friction" in value else ()), *paths]
        columns = dict(zip(labels, slopes_out.T * self.scale.output, strict=True))
        if filter_ is not None and a is not None:
            for name, slope in self._filter_slopes(structure, self._fine(), filter_):
                columns[name] = columns[name] + self.scale.output * _through(eta, slope)
        columns["feedthrough"] = self.u
        return prediction, np.column_stack([columns[name] for name in structure.names])

    def refined(self, structure: Structure, theta: FloatArray, tolerance: float) -> "Excitation":
        """The record with as many steps a sample as keep the integration error's RMS small.

        Richardson: the fourth-order error at n steps is 16/15 of the change from n to 2n. It must
        stay below `tolerance`, in the output's unit, or what is measured well enough would show the
        integrator's error as an effect. At most 16 steps.
        """
        record = self
        coarse, _ = record.predict(structure, theta, derivatives=False)
        while record.substeps < 16:
            finer = replace(record, substeps=2 * record.substeps)
            fine, _ = finer.predict(structure, theta, derivatives=False)
            if float(np.sqrt(np.mean((fine - coarse) ** 2))) * 16 / 15 < tolerance:
                break
            record, coarse = finer, fine
        return record

    def _filter_slopes(
        self, structure: Structure, f: FloatArray, filter_: RecorderFilter
    ) -> list[tuple[str, ComplexArray]]:
        edge, dispersion = filter_.slopes(f)
        if "recorder_edge" not in structure:
            dispersion = dispersion / filter_.response(f)
        table = {"recorder_edge": edge, "recorder_dispersion": dispersion}
        return [(name, table[name]) for name in RECORDER if name in structure]

    def _input_slopes(
        self,
        structure: Structure,
        f: FloatArray,
        clean: ComplexArray,
        late: ComplexArray,
        a: ComplexArray | None,
        filter_: RecorderFilter | None,
    ) -> tuple[list[ComplexArray], list[str]]:
        """Spectra of ∂u/∂(delay, recorder's parameters), in the order of the kernel's rows."""
        spectra, names = [], []
        if "delay" in structure:
            spectra.append(-2j * np.pi * f * clean)
            names.append("delay")
        if filter_ is not None and a is not None:
            for name, slope in self._filter_slopes(structure, f, filter_):
                spectra.append(self._spectrum * late * inverse_slope(a, slope))
                names.append(name)
        return spectra, names

    def _record(
        self,
        eta: FloatArray,
        rows: FloatArray,
        filter_: RecorderFilter | None,
        a: ComplexArray | None,
    ) -> tuple[FloatArray, FloatArray]:
        """What the recorder makes of it: through A, then decimated."""
        if filter_ is None or a is None or bool(np.all(a == 1)):
            return eta[:-1:_RECORDED], rows[:-1:_RECORDED]
        response = filter_.response(self._fine())
        filtered = [_through(column, response) for column in rows.T]
        return _through(eta, response), np.array(filtered).T.reshape(self.samples, -1)

    def _fine(self) -> FloatArray:
        rate = self.sample_rate_hz * _RECORDED
        return np.asarray(np.fft.rfftfreq(self.samples * _RECORDED, 1 / rate), dtype=np.float64)


def _through(column: FloatArray, response: ComplexArray) -> FloatArray:
    if not np.isfinite(column[-1]):
        return np.full((column.size - 1) // _RECORDED, np.nan)
    with np.errstate(over="ignore", invalid="ignore"):  # sensitivities of a start that runs away
        spectrum = np.fft.rfft(column[:-1]) * response
        return np.asarray(np.fft.irfft(spectrum, column.size - 1)[::_RECORDED])


def _resonance(u: FloatArray, y: FloatArray, sample_rate_hz: float) -> float:
    """Frequency at which the averaged |Y|/|U| is largest, where the input has power."""
    segment = min(2048, u.size // 4)
    count = u.size // segment
    window = np.hanning(segment)
    power_u = (np.abs(np.fft.rfft(u[: count * segment].reshape(count, -1) * window)) ** 2).mean(0)
    power_y = (np.abs(np.fft.rfft(y[: count * segment].reshape(count, -1) * window)) ** 2).mean(0)
    excited = power_u > 1e-2 * np.median(np.sort(power_u)[-power_u.size // 3 :])
    excited[:3] = False
    ratio = np.where(excited, power_y / np.maximum(power_u, 1e-300), 0)
    return float(np.fft.rfftfreq(segment, 1 / sample_rate_hz)[int(np.argmax(ratio))])


def physical(structure: Structure, theta: FloatArray, scale: Scale) -> dict[str, tuple[float, str]]:
    """Scaled parameters as (value, unit) an engineer reads."""
    value = dict(zip(structure.names, theta, strict=True))
    if value.get("friction_threshold", 1.0) < 0:  # μ tanh(v/s): the same with both signs turned
        value |= {name: -value[name] for name in FRICTION}
    k = -value["stiffness"]
    root = np.sqrt(abs(k))
    out: dict[str, tuple[float, str]] = {
        "mode1.frequency_hz": (scale.rate * root / (2 * np.pi), "Hz"),
        "mode1.damping": (-value["damping"] / (2 * root), "1"),
    }
    size, into, out_of = scale.output, scale.input_unit, scale.output_unit
    table = {
        "input": ("static_gain", size / scale.input / k, f"{out_of}/{into}"),
        "bias": ("bias", size / k, out_of),
        "quadratic": ("nonlinearity.c2", -1 / (k * size), f"1/{out_of}"),
        "cubic": ("nonlinearity.c3", -1 / (k * size**2), f"1/{out_of}^2"),
        "quartic": ("nonlinearity.c4", -1 / (k * size**3), f"1/{out_of}^3"),
        "quintic": ("nonlinearity.c5", -1 / (k * size**4), f"1/{out_of}^4"),
        "damping_y2": (
            "nonlinear_damping.y2",
            1 / (value["damping"] * size**2),
            f"1/{out_of}^2",
        ),
        "damping_v3": (
            "nonlinear_damping.v2",
            1 / (value["damping"] * (size * scale.rate) ** 2),
            f"s^2/{out_of}^2",
        ),
        "input_square": (
            "actuator_nonlinearity.c2",
            1 / (value["input"] * scale.input),
            f"1/{into}",
        ),
        "input_cube": (
            "actuator_nonlinearity.c3",
            1 / (value["input"] * scale.input**2),
            f"1/{into}^2",
        ),
        "friction": ("nonlinear_damping.friction", -size / k, out_of),
        "friction_threshold": (
            "nonlinear_damping.threshold",
            size * scale.rate,
            f"{out_of}/s",
        ),
        "delay": ("input_delay_s", 1.0, "s"),
        "recorder_edge": ("recorder.edge_hz", 1.0, "Hz"),
        "recorder_dispersion": ("recorder.dispersion_rad", 1.0, "rad"),
        "feedthrough": ("feedthrough", 1.0, f"{out_of}/{into}"),
    }
    for name, (label, factor, unit) in table.items():
        if name in value:
            out[label] = (float(value[name] * factor), unit)
    return out
