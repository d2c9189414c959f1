"""Forward path: what the acoustics may hold beyond the declared modes."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations, product
from typing import Any

import numpy as np
import numpy.typing as npt

from identify.effect import Conditions, Effect, Known
from identify.parameters import Parameter
from identify.pieces import Branch, Loss, Mode, Values
from identify.polynomial import Polynomial
from identify.structure import MODAL, Structure, declared_modes, resonance

FloatArray = npt.NDArray[np.float64]


class AcousticMode(Effect):
    """One more acoustic mode, of the same four parameters as the declared ones.

    A weakly coupled side resonator or plenum appears as one more mode too. With the form
    ``two_modes`` two more, tried where one alone does not explain the data.
    """

    name, location = "acoustic_mode", "forward"

    def __init__(self, form: str = "mode", more: int = 1) -> None:
        self.form, self.more = form, more
        self.refines = more > 1
        self.parameters = tuple(
            q for i in range(1, more + 1) for q in _mode_parameters("" if i == 1 else str(i))
        )
        self.located = tuple(q.name for q in self.parameters if q.unit == "Hz")
        self.residues = tuple((self.of(i)[2].name, self.of(i)[3].name) for i in range(more))
        # two that are overdamped follow whatever is smooth: an echo was claimed as such
        dampings = tuple(q.name for q in self.parameters if ".damping" in q.name)
        self.modal = dampings if more > 1 else ()

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        r, a = 0.02 * known.flame_residues[0], 0.02 * known.speaker_residues[0]
        ratios = (0.55, 1.45, 1.85, 2.33, 2.75, 3.3)
        return [
            tuple(x for q in chosen for x in (q * known.free_hz, 0.04, r, a))
            for chosen in combinations(ratios, self.more)
        ]

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        if self.more > 1:
            return []
        frequencies = known.free_hz * np.geomspace(0.4, 4.0, 48)
        return [(float(f), zeta, 0.0, 0.0) for f in frequencies for zeta in (0.012, 0.05)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        return []  # its own starts, of all modes at once, reach farther

    def restated(self, structure: Structure) -> Structure | None:
        return replace(structure, mode_count=structure.mode_count + self.more)

    def from_restated(self, structure: Structure, values: Mapping[str, float]) -> list[float]:
        """Which of the modes are the further ones is a matter of naming: here those that take
        the smallest part in the response near mode 1, which sings and is never one of them."""
        count = structure.mode_count + self.more
        table = [[values[f"mode{i}.{k}"] for k in MODAL] for i in range(1, count + 1)]
        f1, _, r1, a1 = table[0]

        def part(row: list[float]) -> float:
            f, _, r, a = row
            # of several, the drive near one frequency knows the speaker's shares together only
            share = abs(r / (r1 or 1.0)) + (abs(a / (a1 or 1.0)) if self.more == 1 else 0.0)
            return share / (abs((f / f1) ** 2 - 1) + 1e-9)

        extra = sorted(sorted(range(1, count), key=lambda i: part(table[i]))[: self.more])
        rows = [row for i, row in enumerate(table) if i not in extra] + [table[i] for i in extra]
        flat = [x for row in rows for x in row]
        rest = [values[q.name] for q in structure.base_parameters[4 * structure.mode_count :]]
        at = 4 * structure.mode_count
        return [*flat[:at], *rest, *flat[at:]]

    def to_restated(self, structure: Structure, values: Mapping[str, float]) -> dict[str, float]:
        first = structure.mode_count + 1
        own = {}
        for i in range(self.more):
            for q, kind in zip(self.of(i), _mode_parameters(""), strict=True):
                own[f"mode{first + i}.{kind.name.split('.')[1]}"] = values[q.name]
        return {**{q.name: values[q.name] for q in structure.base_parameters}, **own}

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        more = [Mode(*(p[q.name] for q in self.of(i))) for i in range(self.more)]
        return [*modes, *more]

    def of(self, i: int) -> tuple[Parameter, ...]:
        """The four parameters of the further mode number `i`, from 0."""
        return self.parameters[4 * i : 4 * i + 4]


def _mode_parameters(which: str) -> tuple[Parameter, ...]:
    return (
        Parameter(f"acoustic_mode.frequency{which}_hz", "Hz", 5.0, 5e3, "positive"),
        Parameter(f"acoustic_mode.damping{which}", "1", 5e-4, 0.5, "positive"),
        Parameter(f"acoustic_mode.flame_residue{which}", "1/s"),
        Parameter(f"acoustic_mode.speaker_residue{which}", "m/s²/V"),
    )


class _Resonator(Effect):
    """A resonator beside the tube, coupled to the first `count` modes.

    y'' + 2ζω y' + ω² y = ω² Σ h_i η_i, with the displacements η_i at its mouth, and it pushes back
    on mode i by −g_i h_i y''. So g_i h_i ω² s/(s² + 2ζωs + ω²) loads the velocity there.
    """

    name, location = "acoustic_mode", "forward"
    own = _mode_parameters("")[:2]  # frequency and damping, as of any mode
    count: int

    def coupled(self, p: Values) -> tuple[list[Any], list[Any]]:
        """What of each mode it feels, and what it gives back."""
        raise NotImplementedError

    def of_a_mode(
        self, other: Effect, values: Mapping[str, float]
    ) -> list[tuple[float, float, float, FloatArray]]:
        """From one more mode, or any of several: at its frequency the load takes the place of its
        residues, so that r_e = −ω² (Σ κ_i b_i) (Σ q_i b_i r_i), and a_e likewise, with
        κ_i = κ_1 q_i taken for the g_i h_i. Frequency, damping, κ_1 and q (count,); none from
        another effect."""
        if not isinstance(other, AcousticMode):
            return []
        modes = declared_modes(values, self.count)
        r = np.array([m.flame_residue for m in modes])
        a = np.array([m.speaker_residue for m in modes])
        out = []
        for i in range(other.more):
            f, zeta, r_e, a_e = (values[q.name] for q in other.of(i))
            s = 2j * np.pi * f
            b = np.array([complex(resonance(m, s)) for m in modes])
            part = (b * (a * r_e - r * a_e)).imag  # Σ q_i part_i = 0
            q = np.ones(self.count)
            if self.count > 1 and np.all(part[1:] != 0):
                q[1:] = np.clip(-part[0] / part[1:] / (self.count - 1), -20.0, 20.0)
            size = -r_e / (abs(s) ** 2 * np.sum(q * b) * np.sum(q * b * r))
            if np.isfinite([f, zeta, size.real, *q]).all():
                # a strong one has moved the modes: from a tenth of the load they are brought there
                out += [(f, zeta, load, q) for load in (size.real, 0.1 * size.real)]
        return out

    def branch(self, p: Values, modes: list[Mode], s: Any) -> Branch:
        f, zeta = p["acoustic_mode.frequency_hz"], p["acoustic_mode.damping"]
        w = 2 * np.pi * f
        felt, returned = self.coupled(p)
        none = [0.0] * (len(modes) - self.count)  # modes of another effect
        return Branch(
            impedance=resonance(Mode(f, zeta, 0.0, 0.0), s) * (w * w),
            felt=[*felt, *none],
            returned=[*returned, *none],
        )


class SideResonatorOfMode(_Resonator):
    """A resonator beside the tube of which the singing mode's load κ = h_1² is all that matters."""

    form, count = "side_resonator_mode", 1
    parameters = (*_Resonator.own, Parameter("acoustic_mode.coupling", "1", 0.0, 1.0, scale=1e-3))

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        return [(q * known.free_hz, 0.04, 1e-3) for q in (0.8, 0.9, 1.05, 1.15, 1.4)]

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        frequencies = known.free_hz * np.geomspace(0.6, 1.7, 27)
        return [(float(f), zeta, 0.0) for f in frequencies for zeta in (0.02, 0.05)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(f, zeta, load) for f, zeta, load, _ in self.of_a_mode(other, values)]

    def coupled(self, p: Values) -> tuple[list[Any], list[Any]]:
        return [1.0], [p["acoustic_mode.coupling"]]


class SideResonator(_Resonator):
    """A Helmholtz resonator or a plenum beside the tube, coupled to each mode by its own strength.

    Of `modes` modes, relative to the first, g_1 = 1. Of a mode that has a node at the mouth it
    feels nothing and gives nothing back, h_i = 0; and it takes energy from every mode, never gives,
    g_i > 0. Other than one more mode, it moves the poles of the others, and its residues have
    phases.
    """

    form, refines = "side_resonator", True

    def __init__(self, modes: int) -> None:
        self.mode_count = self.count = modes
        each = range(1, modes + 1)
        self.felt = tuple(
            Parameter(f"acoustic_mode.mouth{i}", "1", -3.0, 3.0, scale=0.03) for i in each
        )
        self.ratios = tuple(
            Parameter(f"acoustic_mode.return_ratio{i}", "1", 1e-4, 1e4, "positive")
            for i in each[1:]
        )
        self.parameters = (*self.own, *self.felt, *self.ratios)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        felt, ones = (0.055,) * self.count, (1.0,) * len(self.ratios)
        return [(q * known.free_hz, 0.04, *felt, *ones) for q in (0.8, 1.3, 1.9)]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """From one more mode, or from what loads mode 1 alone."""
        ones = (1.0,) * len(self.ratios)
        if isinstance(other, SideResonatorOfMode):
            f, zeta, coupling = (values[q.name] for q in other.parameters)
            return [(f, zeta, np.sqrt(max(coupling, 0.0)), *(0.0,) * len(ones), *ones)]
        found = self.of_a_mode(other, values)
        return [(f, zeta, *(np.sqrt(abs(load)) * q), *ones) for f, zeta, load, q in found]

    def apart_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """With the mouth where other modes are as large as the singing one, some of them opposite:
        the way from one sign to the other is barred where nothing is felt."""
        if not isinstance(other, SideResonatorOfMode):
            return []
        f, zeta, coupling = (values[q.name] for q in other.parameters)
        mouth, ones = np.sqrt(max(coupling, 1e-6)), (1.0,) * len(self.ratios)
        signs = list(product((1.0, -1.0), repeat=self.count - 1))[1:]
        return [(f, zeta, mouth, *(mouth * np.array(q)).tolist(), *ones) for q in signs]

    def coupled(self, p: Values) -> tuple[list[Any], list[Any]]:
        felt = [p[q.name] for q in self.felt]
        ratios = [p[q.name] for q in self.ratios]
        return felt, [felt[0], *(g * h for g, h in zip(ratios, felt[1:], strict=True))]


LOSSES = {"quadratic": (2, "1/m"), "cubic": (3, "s/m²")}  # power of the velocity, unit


class NonlinearDamping(Effect):
    """Amplitude-dependent acoustic loss β |v|^(n−1) v, as by vortices shed at the open end.

    ``quadratic``, ``cubic`` and, from where one of these has come, ``quadratic_cubic``, their sum,
    are of the flame's velocity and act on all modes alike; with ``_mode`` of the singing mode's
    part, and on that mode alone: its damping grows. With ``_end`` the velocity is that of another
    place, where the modes meet in other proportions, v = Σ q_i y_i, and they act back on mode i by
    g_i β: q_1 = g_1 = 1, so that near a node of mode 1 the others are large.
    """

    name, location = "nonlinear_damping", "forward"

    def __init__(self, form: str, modes: int | None = None) -> None:
        self.form, self.mode_count = form, modes
        self.laws = [law for law in LOSSES if law in form]
        self.refines = len(self.laws) > 1
        self.mode_only = form.endswith("_mode")
        self.own = tuple(
            Parameter(f"nonlinear_damping.{law if self.refines else 'coefficient'}", unit, 0.0)
            for law, (_, unit) in LOSSES.items()
            if law in self.laws
        )
        self.ratios = tuple(
            Parameter(f"nonlinear_damping.{word}_ratio{i}", "1", -100.0, 100.0)
            for i in range(2, (modes or 1) + 1)
            for word in ("end", "return")
        )
        self.parameters = (*self.own, *self.ratios)

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        # a share of the linear loss 2ζω at the amplitude of the forced runs; a declared fit may
        # have put all of it down to the flame
        loss = 0.2 * 4 * np.pi * max(known.modes_damping[0], 0.005) * known.modes_hz[0]
        sizes = [loss / known.velocity_amplitude ** (LOSSES[law][0] - 1) for law in self.laws]
        signs = product((-1.0, 1.0), repeat=len(self.ratios) // 2)
        return [(*sizes, *np.repeat(q, 2).tolist()) for q in signs]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """The sum starts from either law, wherever that acts; a law at another place from one of
        all modes, or of the singing mode alone, for which the others are nothing there."""
        if not isinstance(other, NonlinearDamping) or not (self.refines or self.ratios):
            return super().starts_from(other, values)
        if not (self.refines or set(self.laws) <= set(other.laws)):
            return []
        known = {q.unit: values[q.name] for q in other.own}
        sizes = [known.get(q.unit, 0.0) for q in self.own]
        share = 0.0 if other.mode_only else 1.0
        return [(*sizes, *(values.get(q.name, share) for q in self.ratios))]

    def neutral(self) -> tuple[float, ...]:
        return (*(0.0 for _ in self.own), *(1.0 for _ in self.ratios))

    def loss(self, p: Values, at: Conditions, modes: list[Mode]) -> Loss:
        beta: Any = p[self.own[0].name]
        characteristic = Polynomial((0.0, 0.0, 1.0))
        if self.refines:
            beta, characteristic = 1.0, Polynomial((0.0, 0.0, p[self.own[1].name]), bent=beta)
        elif "quadratic" in self.laws:
            characteristic = Polynomial((0.0,), bent=1.0)
        count = len(modes)
        if self.mode_count is not None:
            ones = [1.0] * count  # modes of another effect come after its own
            q: list[Any] = [1.0, *(p[n.name] for n in self.ratios[0::2]), *ones][:count]
            g: list[Any] = [1.0, *(p[n.name] for n in self.ratios[1::2]), *ones][:count]
            return Loss([beta * x for x in g], characteristic, q)
        if self.mode_only:
            others = [0.0] * (count - 1)
            return Loss([beta, *others], characteristic, [1.0, *others])
        return Loss([beta] * count, characteristic, [1.0] * count)


MODE_COUNTS = (2, 3, 4)  # of models for which there are forms with a share of each mode

EFFECTS: tuple[Effect, ...] = (
    AcousticMode(),
    AcousticMode("two_modes", 2),
    SideResonatorOfMode(),
    *(SideResonator(n) for n in MODE_COUNTS),
    NonlinearDamping("quadratic"),
    NonlinearDamping("quadratic_mode"),
    NonlinearDamping("cubic"),
    NonlinearDamping("cubic_mode"),
    *(NonlinearDamping(f"{law}_end", n) for law in LOSSES for n in MODE_COUNTS),
    NonlinearDamping("quadratic_cubic"),
    NonlinearDamping("quadratic_cubic_mode"),
    *(NonlinearDamping("quadratic_cubic_end", n) for n in MODE_COUNTS),
)
