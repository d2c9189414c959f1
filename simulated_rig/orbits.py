"""Periodic orbits without time stepping: harmonic balance (thesis Section 4.3) on the rig's system.

Unknowns are the Fourier coefficients of what the scalar nonlinear functions see: z, and the open
end's velocity where its loss is switched on. With x_k = (jkω − A)⁻¹(b_f F_k + b_l Λ_k + b_u U_k),

    W_k − G(jkω) N_k(W) − B(jkω) U_k = 0,        k = 0 … harmonics,

where N holds the coefficients of f(z(t − τ)) and λ(u_L), computed over `POINTS` instants of a
period. Newton's method on real and imaginary parts; its Jacobian is exact. Forced orbits are
sought by size: |z₁| = a needs the drive V(a) = |a (1 − G₁ N(a))/B₁|, with N(a) the describing
function, so the roots of V(a) = V are all candidates, nodes and saddles alike. Near the roots, and
where V(a) has a minimum that may hide two, N(a) is that of the wave with its harmonics
W_k = G_k N_k(W): at small drives they shift the tongue by more than its width.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from simulated_rig.actuator import distorted
from simulated_rig.kernel import preformed, preformed_slope
from simulated_rig.plant import PREFORMS, Plant
from simulated_rig.statespace import DRIVE, FLAME, LOSS, FloatArray, StateSpace, assemble
from simulated_rig.threads import one_thread

ComplexArray = npt.NDArray[np.complex128]
POINTS = 128
HARMONICS = 9
TOLERANCE = 1e-11
MOST_STEPS = 40
ROUNDS = 4  # of harmonics made from the wave with harmonics; each gains a power of their share
WINDOW, FINER = 4, 32  # steps of the grid of sizes looked at closely, and into how many parts
SHIFT = 0.9  # share of the characteristic's slope that is counted to the linear part


@dataclass(frozen=True)
class Orbit:
    """A periodic solution; coefficients c_k with y(t) = Re Σ c_k e^{jkωt}, k = 0 … harmonics.

    `seen` (functions, 1 + harmonics): z, and u_L where there is loss; `velocity` (1 + harmonics)
    in m/s. `converged` False: the numbers are Newton's last, `residual` says how far off.
    """

    frequency_hz: float
    volts: float
    seen: ComplexArray
    velocity: ComplexArray
    converged: bool
    residual: float
    free: bool = False

    @property
    def amplitude(self) -> float:
        """The velocity's fundamental, m/s."""
        return float(abs(self.velocity[1]))


class Balance:
    """The balance equations of one plant, for any frequency and drive.

    Raises
    ------
    ValueError
        For a hysteretic characteristic: it is no function of z alone.
    """

    def __init__(self, plant: Plant, harmonics: int = HARMONICS) -> None:
        if plant.characteristic.preform == "play":
            raise ValueError(
                "preform='play' is not a function of z; take time stepping for hysteresis"
            )
        self.plant = plant
        self.system: StateSpace = assemble(plant, (0.0, 0.05))
        self.harmonics = harmonics
        end = plant.open_end
        self.lossy = end.quadratic_per_m != 0.0 or end.cubic_s_per_m2 != 0.0
        self.functions = 1 + self.lossy
        angle = 2 * np.pi * np.arange(POINTS) / POINTS
        k = np.arange(1, harmonics + 1)
        # y = S r with r = (c_0, Re c_1, Im c_1, …); r = T y.
        self._s = np.ones((POINTS, 2 * harmonics + 1))
        self._s[:, 1::2] = np.cos(np.outer(angle, k))
        self._s[:, 2::2] = -np.sin(np.outer(angle, k))
        self._t = self._s.T * (2.0 / POINTS)
        self._t[0] /= 2
        self._form = np.vectorize(preformed.py_func, otypes=[float])
        self._slope = np.vectorize(preformed_slope.py_func, otypes=[float])
        coefficients = plant.characteristic.coefficients if plant.lit else (0.0,)
        self._poly = np.polynomial.Polynomial(np.array(coefficients))
        self._shift = 0.0
        if plant.lit and plant.flame.delay_s == 0.0:
            self._shift = SHIFT * plant.characteristic.gain
            self.system = shifted(self.system, self._shift)

    # -- representation ----------------------------------------------------------------------

    def to_real(self, coefficients: ComplexArray) -> FloatArray:
        """(functions, 1 + harmonics) complex to (functions · (2 harmonics + 1),) real."""
        out = np.empty((coefficients.shape[0], 2 * self.harmonics + 1))
        out[:, 0] = coefficients[:, 0].real
        out[:, 1::2], out[:, 2::2] = coefficients[:, 1:].real, coefficients[:, 1:].imag
        return out.ravel()

    def to_complex(self, values: FloatArray) -> ComplexArray:
        """The inverse of `to_real`."""
        rows = values.reshape(-1, 2 * self.harmonics + 1)
        out = np.empty((rows.shape[0], 1 + self.harmonics), dtype=np.complex128)
        out[:, 0] = rows[:, 0]
        out[:, 1:] = rows[:, 1::2] + 1j * rows[:, 2::2]
        return np.asarray(out)

    # -- linear part -------------------------------------------------------------------------

    def responses(self, omega: float) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """G (1 + harmonics, functions, functions), B (1 + harmonics, functions), and the
        velocity's row (1 + harmonics, functions + 1) for the functions and the drive."""
        s, m = self.system, self.functions
        channels = [FLAME, LOSS][:m]
        sources = s.b[:, [*channels, DRIVE]]
        k = np.arange(1 + self.harmonics)
        matrices = 1j * omega * k[:, None, None] * np.eye(s.order) - s.a
        x = np.linalg.solve(matrices, np.broadcast_to(sources, (k.size, *sources.shape)))
        rows = np.stack([s.z, s.loss][:m])
        seen = rows @ x
        if self.lossy:
            seen[:, 1, 0] += s.loss_direct
        actuator, flame = self.plant.actuator, self.plant.flame
        lag = np.exp(-1j * omega * k * actuator.delay_s)
        seen[:, :, m] *= lag[:, None]
        seen[:, 0, :] *= np.exp(-1j * omega * k * flame.delay_s)[:, None]
        velocity = s.velocity @ x
        velocity[:, 0] += s.velocity_direct
        velocity[:, m] *= lag
        return np.asarray(seen[:, :, :m]), np.asarray(seen[:, :, m]), np.asarray(velocity)

    def drive(self, volts: float) -> ComplexArray:
        """Coefficients of volts · sin ωt behind the actuator's static part."""
        angle = 2 * np.pi * np.arange(POINTS) / POINTS
        wave = distorted(self.plant.actuator, volts * np.sin(angle))
        return np.asarray(self.to_complex(self._t @ wave)[0])

    # -- nonlinear part ----------------------------------------------------------------------

    def _functions(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What the functions give and their slopes, at the instants; both (functions, POINTS)."""
        rows = values.reshape(self.functions, -1) @ self._s.T
        out, slope = np.empty_like(rows), np.empty_like(rows)
        out[0] = self._flame(rows[0])
        shape = self.plant.characteristic
        s, tilt = rows[0], np.ones(POINTS)
        if shape.preform != "none":
            kind = PREFORMS.index(shape.preform)
            s = self._form(kind, shape.width, rows[0], 0.0)
            tilt = self._slope(kind, shape.width, rows[0], 0.0)
        slope[0] = self._poly.deriv()(s) * tilt - self._shift
        if self.lossy:
            u, end = rows[1], self.plant.open_end
            out[1] = end.quadratic_per_m * np.abs(u) * u + end.cubic_s_per_m2 * u**3
            slope[1] = 2 * end.quadratic_per_m * np.abs(u) + 3 * end.cubic_s_per_m2 * u**2
        return out, slope

    def _flame(self, z: FloatArray) -> FloatArray:
        """f(z) without the part that `system` holds."""
        shape, s = self.plant.characteristic, z
        if shape.preform != "none":
            s = self._form(PREFORMS.index(shape.preform), shape.width, z, 0.0)
        return np.asarray(self._poly(s) - self._shift * z)

    def slopes(self, orbit: Orbit) -> FloatArray:
        """f'(z(t)) and λ'(u_L(t)) along an orbit, (functions, POINTS)."""
        return self._functions(self.to_real(orbit.seen))[1]

    def residual(
        self, values: FloatArray, omega: float, volts: float
    ) -> tuple[FloatArray, FloatArray]:
        """W − G N(W) − B U as reals, and its Jacobian by W."""
        g, b, _ = self.responses(omega)
        n, slope = self._functions(values)
        harmonic = self.to_complex((n @ self._t.T).ravel())
        u = self.drive(volts)
        wanted = np.einsum("kij,jk->ik", g, harmonic) + (b * u[:, None]).T
        error = values - self.to_real(wanted)
        size = 2 * self.harmonics + 1
        jacobian = np.eye(values.size)
        for j in range(self.functions):
            inner = self._t @ (slope[j][:, None] * self._s)  # coefficients of f'·δz by δz's
            for i in range(self.functions):
                rows, columns = slice(i * size, (i + 1) * size), slice(j * size, (j + 1) * size)
                jacobian[rows, columns] -= _turned(g[:, i, j]) @ inner
        return error, jacobian

    # -- orbits --------------------------------------------------------------------------------

    def orbit(
        self, values: FloatArray, omega: float, volts: float, error: float, free: bool = False
    ) -> Orbit:
        """Pack a solution."""
        _, _, row = self.responses(omega)
        n, _ = self._functions(values)
        harmonic = self.to_complex((n @ self._t.T).ravel())
        velocity = np.einsum("kj,jk->k", row[:, :-1], harmonic) + row[:, -1] * self.drive(volts)
        return Orbit(
            frequency_hz=omega / (2 * np.pi),
            volts=volts,
            seen=self.to_complex(values),
            velocity=velocity,
            converged=error < 1e-8,
            residual=error,
            free=free,
        )

    def solve(self, guess: ComplexArray, frequency_hz: float, volts: float) -> Orbit:
        """The forced orbit that Newton's method reaches from `guess` (functions, 1 + harmonics)."""
        omega = 2 * np.pi * frequency_hz
        values = self.to_real(guess)
        error, jacobian = self.residual(values, omega, volts)
        for _ in range(MOST_STEPS):
            if np.linalg.norm(error) <= TOLERANCE * np.linalg.norm(values):
                break
            change = _newton(jacobian, error)
            if change is None:
                break
            values = values - change
            error, jacobian = self.residual(values, omega, volts)
        return self.orbit(values, omega, volts, _relative(error, values))

    def solve_free(self, amplitude: float, frequency_hz: float) -> Orbit:
        """The free cycle from a guess of |z₁| and frequency; its phase is fixed by Im z₁ = 0."""
        values = np.zeros(self.functions * (2 * self.harmonics + 1))
        values[1] = amplitude
        omega = 2 * np.pi * frequency_hz
        error = np.inf
        for _ in range(MOST_STEPS):
            r, jacobian = self.residual(values, omega, 0.0)
            error = _relative(r, values)
            if error <= TOLERANCE:
                break
            step = 1e-6 * omega
            by_omega = (self.residual(values, omega + step, 0.0)[0] - r) / step
            # Im z₁ (index 2) gives way to ω.
            jacobian[:, 2] = by_omega * omega
            change = _newton(jacobian, r)
            if change is None:
                break
            omega -= change[2] * omega
            change[2] = 0.0
            values = values - change
        return self.orbit(values, omega, 0.0, error, free=True)

    def describing(self, size: float) -> tuple[FloatArray, FloatArray]:
        """Amplitudes from 1e-3 to 1e3 times `size`, and the describing function N(a) there."""
        sizes = np.geomspace(1e-3, 1e3, 1200) * max(size, 1e-300)
        angle = np.cos(2 * np.pi * np.arange(POINTS) / POINTS)
        shape = self.plant.characteristic
        if shape.preform == "none":
            # Power p of a·cos contributes c_p a^p ⟨cos^(p+1)⟩: no table of sizes by instants.
            c = self._poly.coef
            shares = np.array([np.mean(angle ** (power + 1)) for power in range(c.size)])
            mean = np.polynomial.polynomial.polyval(sizes, c * shares)
        else:
            seen = self._form(
                PREFORMS.index(shape.preform), shape.width, sizes[:, None] * angle, 0.0
            )
            mean = np.mean(self._poly(seen) * angle, axis=1)
        return sizes, 2 * mean / sizes - self._shift

    def with_harmonics(
        self, sizes: FloatArray, g: ComplexArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Waves (n, 1 + harmonics) with z₁ = `sizes` and the harmonics that f makes of them, and
        their describing function (n,)."""
        waves = np.zeros((sizes.size, 1 + self.harmonics), dtype=np.complex128)
        waves[:, 1] = sizes
        describing = np.zeros(sizes.size, dtype=np.complex128)
        for _ in range(ROUNDS):
            f = self._flame(self.to_real(waves).reshape(sizes.size, -1) @ self._s.T)
            n = self.to_complex((f @ self._t.T).ravel())
            describing = n[:, 1] / sizes
            waves = np.where(np.arange(waves.shape[1]) == 1, waves, n * g[:, 0, 0])
        return waves, describing

    def guesses(self, frequency_hz: float, volts: float) -> list[ComplexArray]:
        """Waves whose size fits the drive, from small to large."""
        omega = 2 * np.pi * frequency_hz
        g, b, _ = self.responses(omega)
        force = b[1, 0] * self.drive(volts)[1]

        def excess(sizes: FloatArray, describing: ComplexArray) -> FloatArray:
            """|B₁| (V(a) − V)."""
            return np.asarray(sizes * np.abs(1 - g[1, 0, 0] * describing) - abs(force))

        sizes, plain = self.describing(abs(force))
        describing = plain.astype(np.complex128)
        waves = np.zeros((sizes.size, 1 + self.harmonics), dtype=np.complex128)
        waves[:, 1] = sizes
        needed = excess(sizes, describing)
        if not self.lossy:
            falls = np.diff(needed) < 0
            least = np.flatnonzero(falls[:-1] & ~falls[1:]) + 1
            near = np.r_[np.flatnonzero(needed[:-1] * needed[1:] <= 0), least]
            window = np.zeros(sizes.size, dtype=bool)
            for i in near:
                window[max(i - WINDOW, 0) : i + WINDOW + 1] = True
            fine = (
                sizes[window, None] * np.geomspace(1, sizes[1] / sizes[0], FINER + 1)[:-1]
            ).ravel()
            fine_waves, fine_describing = self.with_harmonics(fine, g)
            merged = np.r_[sizes[~window], fine]
            order = np.argsort(merged)
            sizes = merged[order]
            describing = np.r_[describing[~window], fine_describing][order]
            waves = np.concatenate([waves[~window], fine_waves])[order]
            needed = excess(sizes, describing)
        found = []
        for i in np.flatnonzero(needed[:-1] * needed[1:] <= 0):
            share = needed[i] / (needed[i] - needed[i + 1])
            wave = waves[i] + share * (waves[i + 1] - waves[i])
            n = describing[i] + share * (describing[i + 1] - describing[i])
            z1 = force / (1 - g[1, 0, 0] * n)
            guess = np.zeros((self.functions, 1 + self.harmonics), dtype=np.complex128)
            guess[0] = wave * (z1 / abs(z1)) ** np.arange(wave.size)
            guess[0, 1] = z1
            if self.lossy:
                guess[1, 1] = g[1, 1, 0] * n * z1 + b[1, 1] * self.drive(volts)[1]
            found.append(guess)
        return found


def shifted(system: StateSpace, gain: float) -> StateSpace:
    """The same system with f(z) − gain · z for f(z): the share of the loop goes into A.

    So an undamped mode (van der Pol) has no pole on the imaginary axis where it is looked at.
    """
    return replace(
        system,
        a=system.a + gain * np.outer(system.b[:, FLAME], system.z),
        loss=system.loss + system.loss_direct * gain * system.z,
        velocity=system.velocity + system.velocity_direct * gain * system.z,
    )


def _newton(jacobian: FloatArray, error: FloatArray) -> FloatArray | None:
    """The step; None where there is none (a singular or overflown Jacobian)."""
    try:
        change = np.linalg.solve(jacobian, error)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(change) if bool(np.all(np.isfinite(change))) else None


def _turned(g: ComplexArray) -> FloatArray:
    """Multiplication of coefficients by g_k, as a real block-diagonal matrix."""
    size = 2 * g.size - 1
    out = np.zeros((size, size))
    out[0, 0] = g[0].real
    re, im = np.arange(1, size, 2), np.arange(2, size, 2)
    out[re, re], out[im, im] = g[1:].real, g[1:].real
    out[im, re], out[re, im] = g[1:].imag, -g[1:].imag
    return out


def _relative(error: FloatArray, values: FloatArray) -> float:
    size = float(np.linalg.norm(values))
    return float(np.linalg.norm(error)) / size if size > 0 else np.inf


@one_thread
def forced_orbits(
    plant: Plant, frequency_hz: float, volts: float, harmonics: int = HARMONICS
) -> list[Orbit]:
    """All orbits at the forcing's frequency, from small to large.

    Examples
    --------
    >>> from simulated_rig.presets import thesis_two_mode
    >>> [round(o.amplitude, 4) for o in forced_orbits(thesis_two_mode(), 166.0, 1.0)]
    [0.5809]
    """
    balance = Balance(plant, harmonics)
    found: list[Orbit] = []
    for guess in balance.guesses(frequency_hz, volts):
        orbit = balance.solve(guess, frequency_hz, volts)
        new = all(abs(orbit.velocity[1] - o.velocity[1]) > 1e-6 * o.amplitude for o in found)
        if orbit.converged and new:
            found.append(orbit)
    return sorted(found, key=lambda o: o.amplitude)


@one_thread
def free_orbit(plant: Plant, harmonics: int = HARMONICS) -> Orbit | None:
    """The free limit cycle; None where there is none to be found.

    Starts from the describing function: G₁(jω) N(a) = 1 needs Im 1/G₁ = 0 and N(a) = Re 1/G₁.
    Of several cycles the one of greatest amplitude is taken.
    """
    balance = Balance(plant, harmonics)
    system = assemble(plant, (0.0, 0.05))
    poles = np.linalg.eigvals(shifted(system, plant.characteristic.gain).a)
    near = float(poles[np.argmax(np.where(poles.imag > 0, poles.real, -np.inf))].imag)
    sizes, describing = balance.describing(_cubic_size(plant))
    best: Orbit | None = None
    grid = near * np.linspace(0.801, 1.199, 200)
    inverse = np.array([1 / balance.responses(w)[0][1, 0, 0] for w in grid])
    for i in np.flatnonzero(inverse.imag[:-1] * inverse.imag[1:] <= 0):
        share = inverse.imag[i] / (inverse.imag[i] - inverse.imag[i + 1])
        omega = grid[i] + share * (grid[i + 1] - grid[i])
        wanted = inverse.real[i] + share * (inverse.real[i + 1] - inverse.real[i])
        excess = describing - wanted
        for j in np.flatnonzero(excess[:-1] * excess[1:] < 0):
            orbit = balance.solve_free(float(sizes[j]), float(omega / (2 * np.pi)))
            larger = best is None or orbit.amplitude > best.amplitude
            if orbit.converged and orbit.frequency_hz > 0 and larger:
                best = orbit
    return best


def _cubic_size(plant: Plant) -> float:
    """|z| at which the highest power has taken the gain: the order of a cycle's size."""
    c = plant.characteristic.coefficients
    for power in range(len(c) - 1, 1, -1):
        if c[power] != 0.0:
            return float(abs(c[1] / c[power]) ** (1 / (power - 1)))
    return float(plant.characteristic.width)
