"""Forward path: what the acoustics may hold beyond the declared modes."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from identify.parameters import Parameter
from identify.polynomial import Polynomial
from identify.structure import (
    Branch,
    Conditions,
    Effect,
    Known,
    Loss,
    Mode,
    Structure,
    Values,
    declared_modes,
    resonance,
)


class AcousticMode(Effect):
    """One more acoustic mode, of the same four parameters as the declared ones.

    A weakly coupled side resonator or plenum appears as one more mode too.
    """

    name, location, form = "acoustic_mode", "forward", "mode"
    parameters = (
        Parameter("acoustic_mode.frequency_hz", "Hz", 5.0, 5e3, "positive"),
        Parameter("acoustic_mode.damping", "1", 5e-4, 0.5, "positive"),
        Parameter("acoustic_mode.flame_residue", "1/s"),
        Parameter("acoustic_mode.speaker_residue", "m/s²/V"),
    )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        r, a = known.flame_residues[0], known.speaker_residues[0]
        ratios = (0.55, 1.45, 1.85, 2.33, 2.75, 3.3)
        return [(q * known.free_hz, 0.04, 0.02 * r, 0.02 * a) for q in ratios]

    def shapes(self, known: Known) -> list[tuple[float, ...]]:
        frequencies = known.free_hz * np.geomspace(0.4, 4.0, 48)
        return [(float(f), zeta, 0.0, 0.0) for f in frequencies for zeta in (0.012, 0.05)]

    def restated(self, structure: Structure) -> Structure | None:
        return replace(structure, mode_count=structure.mode_count + 1)

    def from_restated(self, structure: Structure, values: Mapping[str, float]) -> list[float]:
        """Which of the modes is the further one is a matter of naming: here the one that takes
        the smallest part in the response near mode 1, which sings and is never the one."""
        kinds = ("frequency_hz", "damping", "flame_residue", "speaker_residue")
        table = [
            [values[f"mode{i}.{k}"] for k in kinds] for i in range(1, structure.mode_count + 2)
        ]
        f1, _, r1, a1 = table[0]

        def part(row: list[float]) -> float:
            f, _, r, a = row
            return (abs(r / (r1 or 1.0)) + abs(a / (a1 or 1.0))) / (abs((f / f1) ** 2 - 1) + 1e-9)

        extra = min(range(1, len(table)), key=lambda i: part(table[i]))
        declared = [row for i, row in enumerate(table) if i != extra]
        rest = [values[q.name] for q in structure.base_parameters[4 * structure.mode_count :]]
        return [*(x for row in declared for x in row), *rest, *table[extra]]

    def to_restated(self, structure: Structure, values: Mapping[str, float]) -> dict[str, float]:
        last = structure.mode_count + 1
        own = {f"mode{last}.{q.name.split('.')[1]}": values[q.name] for q in self.parameters}
        return {**{q.name: values[q.name] for q in structure.base_parameters}, **own}

    def modes(self, p: Values, at: Conditions, modes: list[Mode]) -> list[Mode]:
        names = (x.name for x in self.parameters)
        return [*modes, Mode(*(p[n] for n in names))]


class SideResonator(Effect):
    """A resonator beside the tube, a Helmholtz resonator or a plenum, coupled to `modes` modes.

    y'' + 2ζω y' + ω² y = ω² Σ q_i η_i, with the displacements η_i at its mouth, and it pushes back
    on mode i by −κ_i y''. So κ_i ω² s/(s² + 2ζωs + ω²) loads the velocity there; q_1 = 1.
    Other than one more mode, it moves the poles of the others, and its residues have phases.
    """

    name, location, form = "acoustic_mode", "forward", "side_resonator"
    refines = True

    def __init__(self, modes: int) -> None:
        self.mode_count = self.count = modes
        each = range(1, modes + 1)
        self.parameters = (
            Parameter("acoustic_mode.frequency_hz", "Hz", 5.0, 5e3, "positive"),
            Parameter("acoustic_mode.damping", "1", 5e-4, 0.5, "positive"),
            *(Parameter(f"acoustic_mode.coupling{i}", "1", -1.0, 1.0, scale=1e-3) for i in each),
            *(Parameter(f"acoustic_mode.mouth_ratio{i}", "1", -20.0, 20.0) for i in each[1:]),
        )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        ones = (1.0,) * (self.count - 1)
        places = [q * known.free_hz for q in (0.8, 1.3, 1.9)]
        return [(f, 0.04, *(3e-3,) * self.count, *ones) for f in places]

    def starts_from(self, other: Effect, values: Mapping[str, float]) -> list[tuple[float, ...]]:
        """From one more mode: at its frequency the load takes the place of its residues, so that
        r_e = −ω² (Σ κ_i b_i) (Σ q_i b_i r_i), and a_e likewise; κ_i is taken to go as q_i."""
        if not isinstance(other, AcousticMode):
            return []
        f, zeta, r_e, a_e = (values[q.name] for q in other.parameters)
        s = 2j * np.pi * f
        modes = declared_modes(values, self.count)
        b = np.array([complex(resonance(m, s)) for m in modes])
        r = np.array([m.flame_residue for m in modes])
        a = np.array([m.speaker_residue for m in modes])
        part = (b * (a * r_e - r * a_e)).imag  # Σ q_i part_i = 0
        q = np.ones(self.count)
        if self.count > 1 and np.all(part[1:] != 0):
            q[1:] = np.clip(-part[0] / part[1:] / (self.count - 1), -20.0, 20.0)
        size = -r_e / (abs(s) ** 2 * np.sum(q * b) * np.sum(q * b * r))
        row = (f, zeta, *(size.real * q).tolist(), *q[1:].tolist())
        return [row] if np.isfinite(row).all() else []

    def branch(self, p: Values, modes: list[Mode], s: Any) -> Branch:
        f, zeta = p["acoustic_mode.frequency_hz"], p["acoustic_mode.damping"]
        w = 2 * np.pi * f
        values = [p[q.name] for q in self.parameters[2:]]
        none = [0.0] * (len(modes) - self.count)  # modes of another effect
        return Branch(
            impedance=resonance(Mode(f, zeta, 0.0, 0.0), s) * (w * w),
            felt=[1.0, *values[self.count :], *none],
            returned=[*values[: self.count], *none],
        )


class NonlinearDamping(Effect):
    """Amplitude-dependent acoustic loss β |v|^(n−1) v, as by vortices shed at the open end.

    ``quadratic`` and ``cubic`` act on the flame's velocity and on all modes alike; with ``_mode``
    on the singing mode's part alone. With ``_end`` the velocity is that of another place, where the
    modes meet in other proportions, v = Σ q_i y_i, and act back on mode i by g_i β: q_1 = g_1 = 1.
    """

    name, location = "nonlinear_damping", "forward"

    def __init__(self, form: str, modes: int | None = None) -> None:
        self.form, self.mode_count = form, modes
        self.power = 2 if form.startswith("quadratic") else 3
        self.mode_only = form.endswith("_mode")
        unit = "1/m" if self.power == 2 else "s/m²"
        self.parameters = (
            Parameter("nonlinear_damping.coefficient", unit, 0.0),
            *(
                Parameter(f"nonlinear_damping.{word}_ratio{i}", "1", -20.0, 20.0)
                for i in range(2, (modes or 1) + 1)
                for word in ("end", "return")
            ),
        )

    def starts(self, known: Known) -> list[tuple[float, ...]]:
        # a share of the linear loss 2ζω at the amplitude of the forced runs
        loss = 4 * 3.14159 * known.modes_damping[0] * known.modes_hz[0]
        size = 0.2 * loss / known.velocity_amplitude ** (self.power - 1)
        signs = product((-1.0, 1.0), repeat=len(self.parameters) // 2)
        return [(size, *np.repeat(q, 2).tolist()) for q in signs]

    def neutral(self) -> tuple[float, ...]:
        return (0.0, *(1.0,) * (len(self.parameters) - 1))

    def loss(self, p: Values, at: Conditions, modes: list[Mode]) -> Loss:
        beta = p["nonlinear_damping.coefficient"]
        cubic = self.power == 3
        characteristic = Polynomial((0.0, 0.0, 1.0)) if cubic else Polynomial((0.0,), bent=1.0)
        count = len(modes)
        if self.mode_count is not None:
            ones = [1.0] * count  # modes of another effect come after its own
            q: list[Any] = [1.0, *(p[n.name] for n in self.parameters[1::2]), *ones][:count]
            g: list[Any] = [1.0, *(p[n.name] for n in self.parameters[2::2]), *ones][:count]
            return Loss([beta * x for x in g], characteristic, q)
        weights = [1.0] + [0.0 if self.mode_only else 1.0] * (count - 1)
        return Loss([beta] * count, characteristic, weights)


EFFECTS: tuple[Effect, ...] = (
    AcousticMode(),
    *(SideResonator(n) for n in (1, 2, 3)),
    NonlinearDamping("quadratic"),
    NonlinearDamping("quadratic_mode"),
    NonlinearDamping("cubic"),
    NonlinearDamping("cubic_mode"),
    *(NonlinearDamping(f"{law}_end", n) for law in ("quadratic", "cubic") for n in (2, 3)),
)
