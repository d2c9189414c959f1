"""Chapters 2 and 3: sums of sinusoids, Bode and Nyquist, van der Pol, Duffing, a basis function."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from daq.service.reproduction.item import Item, because, compared, share
from identify.report import theme
from identify.report.page import drawing
from simulated_rig.continuation import Branch, follow
from simulated_rig.orbits import Orbit, forced_orbits, free_orbit
from simulated_rig.plant import Characteristic, Plant
from simulated_rig.presets import duffing, thesis_two_mode, van_der_pol
from simulated_rig.simulation import Simulation, propagator
from simulated_rig.stability import Entrained, resonance_map
from simulated_rig.statespace import FLAME, FloatArray, assemble

COLOURS = {"stable": theme.GOOD, "saddle": theme.AFTER, "drifting": theme.BEFORE}
SPRING, FORCES = 0.25, (0.03, 0.045, 0.06)  # Table 2.3
CENTRE_HZ = 170.0  # the presets' ω₀/2π: time runs that much faster than in the thesis


@theme.styled
def _sinusoids() -> Figure:
    figure, axes = theme.panels(4.6, 3, 1, sharex=True)
    t = np.linspace(0, 1, 400)
    first = np.sin(2 * np.pi * 2 * t)
    titles = ("constructive: 0°", "marginal: 120°", "destructive: 180°")
    for ax, phase, title in zip(axes[:, 0], (0.0, 120.0, 180.0), titles, strict=True):
        second = np.sin(2 * np.pi * 2 * t + np.radians(phase))
        ax.plot(t, first, color=theme.AFTER, label="In 1")
        ax.plot(t, second, "--", color=theme.THIRD, label="In 2")
        ax.plot(t, first + second, color=theme.MEASURED, lw=1.8, label="Output")
        theme.name_axes(ax, "", "amplitude", title)
    axes[-1, 0].set_xlabel("time (s)")
    theme.legend_above(figure, axes[0, 0])
    return figure


def sinusoids() -> Item:
    """Fig. 2.4."""
    size = abs(1 + np.exp(1j * np.radians(120)))
    rows = [
        ("amplitude in phase", "2 (axis)", "2", "0 %"),
        ("amplitude at the marginal phase", "1 (axis)", f"{size:.3g}", "0 %"),
        ("amplitude in opposition", "0", "0", "none"),
    ]
    body = drawing(_sinusoids(), "figure-2-4", "Fig. 2.4 made again: sums of two sinusoids.")
    body += compared(rows, "The thesis's axes read ±2, ±1 and ±1.")
    body += because(
        "The marginal phase is not stated; 120°, at which the sum is as large as either, "
        "fits the axis. Section 2.2.2 says that the sum varies linearly between the extremes: it "
        "is 2 |cos(φ/2)|."
    )
    return Item(
        "fig-2-4",
        "Fig. 2.4: additive response of two sinusoids",
        ("Fig. 2.4",),
        "reproduced",
        "2 |cos(φ/2)|, not linear in φ as the text has it",
        body,
    )


@lru_cache(maxsize=1)
def _loop_response() -> tuple[FloatArray, np.ndarray]:
    """Frequencies and the two-mode model's loop response at gain 1."""
    plant = thesis_two_mode()
    system = assemble(plant, (0.0, 0.05))
    hz = np.concatenate([np.linspace(1, 400, 1200), np.linspace(160, 180, 600)])
    hz = np.sort(hz)
    eye = np.eye(system.order)
    x = np.linalg.solve(
        2j * np.pi * hz[:, None, None] * eye - system.a,
        np.broadcast_to(system.b[:, FLAME : FLAME + 1], (hz.size, system.order, 1)),
    )
    return hz, np.asarray(x[:, :, 0] @ system.z)


def _critical_gain() -> tuple[float, float]:
    """(gain, Hz) at which the loop's response crosses +1."""
    hz, h = _loop_response()
    crossing = np.flatnonzero((h.imag[:-1] * h.imag[1:] <= 0) & (h.real[:-1] > 0))
    best = crossing[np.argmax(h.real[crossing])]
    part = h.imag[best] / (h.imag[best] - h.imag[best + 1])
    real = h.real[best] + part * (h.real[best + 1] - h.real[best])
    return float(1 / real), float(hz[best] + part * (hz[best + 1] - hz[best]))


@theme.styled
def _bode_nyquist(gains: tuple[float, float]) -> Figure:
    figure, axes = theme.panels(3.6, 1, 2, theme.Margins(left=0.65, across=1.3))
    left, right = axes[0]
    hz, h = _loop_response()
    twin = left.twinx()
    twin.spines["right"].set_visible(True)
    twin.grid(visible=False)
    for gain, colour, name in zip(
        gains, (theme.AFTER, theme.BEFORE), ("stable", "unstable"), strict=True
    ):
        left.plot(hz, 20 * np.log10(gain * np.abs(h)), color=colour, label=f"{name}: gain {gain:g}")
        right.plot((gain * h).real, (gain * h).imag, color=colour)
    twin.plot(hz, np.degrees(np.unwrap(np.angle(h))), ":", color=theme.MUTED, label="phase")
    left.axhline(0, color=theme.MEASURED, lw=0.6)
    left.set_ylim(-60, 12)
    theme.name_axes(left, "frequency (Hz)", "open loop, magnitude (dB)")
    twin.set_ylabel("phase (°)")
    right.plot([1], [0], "+", color=theme.MEASURED, ms=9)
    right.set_aspect("equal", adjustable="datalim")
    theme.name_axes(right, "real part", "imaginary part")
    theme.legend_above(figure, left, twin)
    return figure


def bode_nyquist() -> Item:
    """Figs. 2.5 and 2.6."""
    critical, at = _critical_gain()
    gains = (round(0.7 * critical, 1), round(1.5 * critical, 1))
    rates = [_growth(g) for g in gains]
    body = drawing(
        _bode_nyquist(gains),
        "figure-2-5",
        "Figs. 2.5 and 2.6 made again with the two-mode model's loop, cut at the nonlinearity: one "
        "phase, two gains; +: the critical point 1 + 0j of positive feedback.",
    )
    rows = [
        ("critical point", "1.0 + 0.0i, 0 dB", "the same", ""),
        ("smaller gain: growth rate, 1/s", "stable", f"{rates[0]:.2f}", ""),
        ("larger gain: growth rate, 1/s", "unstable", f"{rates[1]:.2f}", ""),
        (
            "real axis crossed beyond 1 by the unstable loop",
            "yes (axis to 2)",
            f"at {gains[1] / critical:.2f}, {at:.2f} Hz",
            "",
        ),
        ("critical gain from Nyquist", "", f"{critical:.3f}", ""),
        ("growth rate at that gain, 1/s", "", f"{_growth(critical):.1e}", "0 expected"),
    ]
    body += compared(rows)
    body += because(
        "The thesis does not say which system it drew. The model of Chapter 4 serves here; its "
        "frequency range (to 400 Hz) and shape are alike. Growth rates come from the state matrix "
        "and agree with the Nyquist criterion: the critical gain has none."
    )
    return Item(
        "fig-2-5",
        "Figs. 2.5 and 2.6: Bode and Nyquist plots, stable and unstable",
        ("Fig. 2.5", "Fig. 2.6"),
        "reproduced",
        f"critical gain {critical:.2f} of the Chapter 4 loop; same criterion, another "
        "system (theirs is not stated)",
        body,
    )


def _growth(gain: float) -> float:
    plant = thesis_two_mode()
    system = assemble(plant, (0.0, 0.05))
    loop = system.a + gain * np.outer(system.b[:, FLAME], system.z)
    return float(np.max(np.linalg.eigvals(loop).real))


def _strong() -> Plant:
    """x'' − (1 − x²) x' + x = 0 in the form of Eq. 2.8: α = 1, γ = 1/3."""
    w = 2 * np.pi * CENTRE_HZ
    return replace(van_der_pol(), characteristic=Characteristic((0.0, w, 0.0, -w / 3)))


def _trajectory(start: tuple[float, float], periods: float = 8.0) -> FloatArray:
    """(n, 2): x and x'/ω₀ of the van der Pol oscillator from `start`, by time stepping."""
    plant, per_period = _strong(), 400
    w = 2 * np.pi * CENTRE_HZ
    simulation = Simulation(
        propagator(plant, (0.0, 0.05), 1 / (per_period * CENTRE_HZ)), disturbance=0.0
    )
    x, y = start
    f = sum(c * x**k for k, c in enumerate(plant.characteristic.coefficients))
    # The state is η = x and ν = η' − f(η); without the seed's small kick.
    simulation.x[:] = 0.0
    simulation.x[0], simulation.x[1] = x, y * w - f
    out = simulation.run(np.zeros(2 * round(periods * per_period) + 1))
    return np.stack([out[:, 1], out[:, 0] / plant.velocity_scale], axis=1)


@theme.styled
def _phase_plane(paths: list[FloatArray]) -> Figure:
    figure, axes = theme.panels(3.6)
    ax: Axes = axes[0, 0]
    for path in paths:
        ax.plot(path[:, 0], path[:, 1], color=theme.MUTED, lw=0.7)
        ax.plot(path[0, 0], path[0, 1], "o", color=theme.AFTER, ms=3)
    ax.plot(paths[0][-400:, 0], paths[0][-400:, 1], color=theme.BEFORE, lw=2)
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlim(-5, 5)
    ax.set_ylim(-5, 5)
    theme.name_axes(ax, "x", "y = x′/ω₀")
    return figure


def van_der_pol_free() -> Item:
    """Fig. 2.9."""
    starts = [
        (0.1, 0.0),
        (-0.1, -0.1),
        (4.0, 0.0),
        (-4.0, 0.0),
        (0.0, 4.0),
        (0.0, -4.0),
        (3.0, -3.0),
        (-3.0, 3.0),
    ]
    paths = [_trajectory(s) for s in starts]
    sizes = [float(np.max(np.abs(p[-800:, 0]))) for p in paths]
    last = paths[0][-1601:, 0]
    up = np.flatnonzero((last[:-1] < 0) & (last[1:] >= 0))
    at = up - last[up] / (last[up + 1] - last[up])
    period = float(np.mean(np.diff(at))) / 400 * 2 * np.pi
    body = drawing(
        _phase_plane(paths),
        "figure-2-9",
        "Fig. 2.9 made again: trajectories from eight starts (dots) end on one closed orbit.",
    )
    rows = [
        ("axes", "±4", "±4 starts", ""),
        ("amplitude of the cycle", "≈ 2 (picture)", f"{np.mean(sizes):.4f}", "2.0086 known"),
        ("its spread over eight starts", "0 (one cycle)", f"{np.ptp(sizes):.0e}", ""),
        ("period, 1/ω₀", "", f"{period:.4f}", "6.6633 known"),
    ]
    body += compared(rows)
    body += because(
        "The thesis gives no parameters for this figure; its axes fit the standard form with μ = 1 "
        "(amplitude near 2), for which amplitude and period are known numbers."
    )
    return Item(
        "fig-2-9",
        "Fig. 2.9: phase plane of the van der Pol equation",
        ("Fig. 2.9",),
        "reproduced",
        "one limit cycle from every start; amplitude and period as known",
        body,
    )


def _single_harmonic_folds(force: float) -> list[float]:
    """ω at which Eq. 2.7's one-harmonic response turns back: dω/dA = 0 on the stable side.

    ((1 − ω² − ¾ μ A²)² + c² ω²) A² = F²: a quadratic in ω² for each A.
    """
    size = np.linspace(1e-3, 1.5, 200000)
    k = 1 - 0.75 * SPRING * size**2
    b, c = -2 * k + 0.06**2, k**2 - (force / size) ** 2
    with np.errstate(invalid="ignore"):
        lower = np.sqrt((-b - np.sqrt(b * b - 4 * c)) / 2)
    ok = np.isfinite(lower)
    w = lower[ok]
    turns = np.flatnonzero(np.diff(np.sign(np.diff(w))) != 0)
    return [float(w[i + 1]) for i in turns]


@lru_cache(maxsize=1)
def _duffing_branches() -> tuple[Branch, ...]:
    plant = duffing()
    return tuple(
        follow(
            plant,
            forced_orbits(plant, 0.8 * CENTRE_HZ, f / FORCES[0], 7)[0],
            "frequency",
            1.2 * CENTRE_HZ,
            step=0.05,
        )
        for f in FORCES
    )


def _x(orbit: Orbit) -> float:
    return float(abs(orbit.seen[0, 1]))


@theme.styled
def _duffing_figure(points: list[Entrained]) -> Figure:
    figure, axes = theme.panels(3.3)
    ax: Axes = axes[0, 0]
    for branch in _duffing_branches():
        ends = (0, *branch.folds, len(branch.orbits) - 1)
        for i, (begin, end) in enumerate(pairwise(ends)):
            colour, style = (COLOURS["saddle"], "--") if i % 2 else (COLOURS["stable"], "-")
            part = branch.orbits[begin : end + 1]
            w = [o.frequency_hz / CENTRE_HZ for o in part]
            ax.plot(w, [_x(o) for o in part], style, color=colour, lw=1)
        for i in branch.folds:
            o = branch.orbits[i]
            ax.plot(o.frequency_hz / CENTRE_HZ, _x(o), "D", color=theme.THIRD, ms=4)
    _scatter(ax, points, lambda e: (e.orbit.frequency_hz / CENTRE_HZ, _x(e.orbit)))
    ax.plot([], [], "D", color=theme.THIRD, ms=4, label="fold: the response jumps")
    ax.set_xlim(0.8, 1.2)
    theme.name_axes(ax, "frequency ω/ω₀", "response, amplitude of x")
    theme.legend_above(figure, ax)
    return figure


def _scatter(
    ax: Axes, points: list[Entrained], place: Callable[[Entrained], tuple[float, float]]
) -> None:
    names = {"stable": "stable", "saddle": "saddle", "drifting": "not entrained"}
    for kind, colour in COLOURS.items():
        chosen = [place(e) for e in points if e.stability.kind == kind]
        if chosen:
            x, y = np.array(chosen).T
            ax.plot(x, y, "o", color=colour, ms=2.6, mew=0, label=names[kind])


def duffing_response() -> Item:
    """Table 2.3 and Fig. 2.10."""
    plant = duffing()
    grid = CENTRE_HZ * np.arange(0.8, 1.2001, 0.01)
    points = resonance_map(plant, grid, np.array(FORCES) / FORCES[0], 5)
    body = drawing(
        _duffing_figure(points),
        "figure-2-10",
        "Fig. 2.10 made again, F = 0.03, 0.045, 0.06: branches followed through their folds "
        "(dashed between them); dots: orbits at a grid of frequencies, coloured by their Floquet "
        "multipliers.",
    )
    rows: list[tuple[str, str, str, str]] = []
    for force, branch in zip(FORCES, _duffing_branches(), strict=True):
        peak = max(_x(o) for o in branch.orbits)
        rows.append(
            (
                f"F = {force:g}: largest response",
                "about 1 at C2 (picture)" if force == 0.06 else "",
                f"{peak:.3f}",
                f"F/(cω) = {force / 0.06:.2f} at ω = 1",
            )
        )
        theirs = sorted(_single_harmonic_folds(force))
        ours = sorted(branch.orbits[i].frequency_hz / CENTRE_HZ for i in branch.folds)
        if len(ours) != 2 or len(theirs) != 2:
            rows.append((f"F = {force:g}: jumps", f"{len(theirs)}", f"{len(ours)}", ""))
            continue
        for name, a, b in zip(("down, C2 → C1", "up, B1 → B2"), theirs, ours, strict=True):
            rows.append((f"F = {force:g}: jump {name}, at ω", f"{a:.4f}", f"{b:.4f}", share(a, b)))
    body += compared(
        rows,
        "The thesis's column for jumps is its own one-harmonic approximation of "
        "Eq. 2.7 evaluated here; ours is a balance of seven harmonics.",
    )
    body += because(
        "Table 2.3 prints μ = −0.25; with the sign of Eq. 2.7 that would be a hardening spring, "
        "while figure and text show a softening one. μ = +0.25 is used. The thesis calls complex "
        "amplitudes unstable solutions; the saddles between the folds are real ones, and unstable "
        "by their Floquet multipliers."
    )
    return Item(
        "fig-2-10",
        "Table 2.3 and Fig. 2.10: resonant response of Duffing's equation",
        ("Table 2.3", "Fig. 2.10"),
        "reproduced",
        "softening, both branches and both jumps; fold frequencies by continuation",
        body,
    )


DENSITIES = ((0.05, 0.1, 0.2, 0.3), (0.01, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.25, 0.3))


@lru_cache(maxsize=1)
def _van_der_pol_map() -> tuple[tuple[float, Entrained], ...]:
    """(F, orbit) over Table 2.4's conditions; Eq. 2.8 has ω₁² F, the preset 0.1 ω₀² a V."""
    plant = van_der_pol()
    found = []
    for force in DENSITIES[1]:
        for ratio in np.arange(0.5, 1.5001, 0.04):
            volts = 10 * force * ratio**2
            at = np.array([CENTRE_HZ * ratio])
            found += [(force, e) for e in resonance_map(plant, at, np.array([volts]), 3)]
    return tuple(found)


@theme.styled
def _van_der_pol_figure() -> Figure:
    figure, axes = theme.panels(3.4, 1, 2, sharey=True)
    ratio = np.linspace(0.5, 1.5, 301)
    for ax, forces in zip(axes[0], DENSITIES, strict=True):
        for force in forces:
            w, r = _averaged(force, ratio)
            ax.plot(w, r, ".", color=theme.NOISE, ms=1.8, mew=0)
        points = [e for force, e in _van_der_pol_map() if force in forces]
        _scatter(ax, points, lambda e: (e.orbit.frequency_hz / CENTRE_HZ, _x(e.orbit)))
        ax.axhline(np.sqrt(0.5), color=theme.MEASURED, lw=0.8, ls="--", label="Eq. 2.13")
        theme.name_axes(ax, "forcing frequency ω₁/ω₀", "")
    axes[0, 0].set_ylabel("response amplitude / free amplitude")
    theme.legend_above(figure, axes[0, 0])
    return figure


def _averaged(force: float, ratio: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Equilibria of Eqs. 2.11, all that exist: ρ (z² + α² (1 − ρ)²) = (F ω₁/a₀)², ρ = r²."""
    z = (1 - ratio**2) / ratio
    w, r = [], []
    for at, detuning in zip(ratio, z, strict=True):
        roots = np.roots([1 / 16, -2 / 16, 1 / 16 + detuning**2, -((force * at) ** 2)])
        for root in roots:
            if abs(root.imag) < 1e-9 and root.real > 0:
                w.append(at)
                r.append(np.sqrt(root.real))
    return np.array(w), np.array(r)


def van_der_pol_forced() -> Item:
    """Table 2.4 and Fig. 2.11."""
    free = free_orbit(van_der_pol())
    found = _van_der_pol_map()
    stable = [_x(e.orbit) for _, e in found if e.stability.stable]
    agree = [e.stability.stable == _averaged_stable(e) for _, e in found]
    gaps = [_nearest(force, e) for force, e in found if e.stability.stable]
    body = drawing(
        _van_der_pol_figure(),
        "figure-2-11",
        "Fig. 2.11a,b made again in two densities: the rig's orbits (dots) on the thesis's "
        "averaged equations 2.11 (grey); dashed: the condition of Eq. 2.13.",
    )
    amplitude = 0.0 if free is None else _x(free)
    frequency = 0.0 if free is None else free.frequency_hz / CENTRE_HZ
    rows = [
        ("free amplitude", "1.0", f"{amplitude:.5f}", share(1.0, amplitude)),
        ("free frequency, ω/ω₀", "1.0", f"{frequency:.5f}", share(1.0, frequency)),
        ("least amplitude of a stable orbit", "0.7071 (Eq. 2.13)", f"{min(stable):.4f}", ""),
        (
            "orbits whose stability agrees with the averaged equations",
            "",
            f"{sum(agree)} of {len(agree)}",
            "",
        ),
        ("median distance of stable orbits to Eqs. 2.11", "", f"{np.median(gaps):.1e}", ""),
    ]
    body += compared(rows)
    body += because(
        "The averaged equations leave out the third harmonic and terms of second order in α; the "
        "rig does not, hence a free frequency 0.4 % (α²/16) below ω₀. Below Eq. 2.13 the text "
        "speaks of «one half the amplitude»: it is one half of the amplitude's square, 0.707 of "
        "the amplitude. Eqs. 2.11 are printed with Fω₁² for what must be Fω₁."
    )
    return Item(
        "fig-2-11",
        "Table 2.4 and Fig. 2.11: the forced van der Pol equation",
        ("Table 2.4", "Fig. 2.11"),
        "reproduced",
        f"stable orbits from {min(stable):.3f} of the free amplitude (Eq. 2.13: 0.707); "
        f"{sum(agree)} of {len(agree)} orbits judged alike",
        body,
    )


def _averaged_stable(e: Entrained) -> bool:
    """Eqs. 2.11 linearised: negative trace (Eq. 2.13) and positive determinant."""
    rho = _x(e.orbit) ** 2
    ratio = e.orbit.frequency_hz / CENTRE_HZ
    z = (1 - ratio**2) / ratio
    return bool(rho > 0.5 and z**2 + (1 - rho) * (1 - 3 * rho) / 16 > 0)


def _nearest(force: float, e: Entrained) -> float:
    _, r = _averaged(force, np.array([e.orbit.frequency_hz / CENTRE_HZ]))
    return float(np.min(np.abs(r - _x(e.orbit))))


NODES = (-6.0, -3.0, 0.0, 3.0, 6.0)


def _basis(x: FloatArray, at: int) -> FloatArray:
    """The Lagrange polynomial that is 1 at node `at` and 0 at the others (Eq. 3.22)."""
    out = np.ones_like(x)
    for j, node in enumerate(NODES):
        if j != at:
            out = out * (x - node) / (NODES[at] - node)
    return out


@theme.styled
def _basis_figure() -> Figure:
    figure, axes = theme.panels(2.5)
    ax: Axes = axes[0, 0]
    x = np.linspace(-6, 6, 241)
    ax.plot(x, _basis(x, 1), color=theme.AFTER)
    ax.plot(NODES, _basis(np.array(NODES), 1), "o", color=theme.MEASURED)
    theme.name_axes(ax, "nodal coordinate", "polynomial amplitude")
    return figure


def lagrange() -> Item:
    """Fig. 3.3."""
    x = np.linspace(-6, 6, 2401)
    y = _basis(x, 1)
    low, high = f"{np.min(y):.3f}", f"{np.max(y):.3f}"
    body = drawing(
        _basis_figure(), "figure-3-3", "Fig. 3.3 made again: the basis function of the node at −3."
    )
    body += compared(
        [
            ("nodes", "−6 −3 0 3 6", "the same", ""),
            ("value at −3, at the others", "1, 0", f"{_basis(np.array([-3.0]), 1)[0]:g}, 0", "0 %"),
            ("range over the domain", "−0.2…1.2 (axis)", f"{low}…{high}", ""),
        ]
    )
    body += because(
        "Section 3.4.1.3 calls the order of the polynomial k − 1; with nodes 0…k, five here, it is "
        "k = 4. The identification library declares such a characteristic as «lagrange»."
    )
    return Item(
        "fig-3-3",
        "Fig. 3.3: Lagrange basis function of the nonlinearity",
        ("Fig. 3.3",),
        "reproduced",
        f"1 at its node, 0 at the others, range {low}…{high}",
        body,
    )


ITEMS = (
    sinusoids,
    bode_nyquist,
    van_der_pol_free,
    duffing_response,
    van_der_pol_forced,
    lagrange,
)
