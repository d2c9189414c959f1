"""From a `Plant` to one linear system with scalar nonlinearities: x' = A x + Σ_c b_c g_c.

With v_i = η_i' − ψ_i f(z) the derivative of f disappears from Eq. 4.12, so f need not be smooth:

    η_i' = v_i + ψ_i f,   v_i' = −2 ζ_i ω_i (v_i + ψ_i f) − ω_i² η_i + ψ_i(x_a) g_a a

The channels c are: ``flame`` g = f(z), ``loss`` g = λ(u_L) at the open end, ``drive`` g = volts
behind the actuator's static part and delay, ``noise`` g = turbulence (V). What the scalar
functions see, and what is measured, are rows: z = c_z x, u_L = c_l x + d_l f, Y = c_y x + d_y f,
and the microphones' p_m = s_m x + r_m x' + d_m f'. There s_m is the pressure common to both, that
of the expansion Σ ψ_i η_i, and the rest obeys the momentum equation exactly between the
microphones, −(p₂ − p₁) = ρ Δx Y', so that the two-microphone formula (thesis Eqs. 5.1, 5.2)
returns Y.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simulated_rig.plant import Plant

FloatArray = npt.NDArray[np.float64]
FLAME, LOSS, DRIVE, NOISE = range(4)


@dataclass(frozen=True)
class StateSpace:
    """n states: η (N), v (N), flame filters, actuator, resonators.

    `a` (n, n); `b` (n, 4), one column a channel; rows `z`, `loss`, `velocity` (n,),
    `pressure_static` and (on x') `pressure` (microphones, n), with the direct shares of f:
    `loss_direct`, `velocity_direct`, `pressure_direct` (microphones,). Velocities are in m/s,
    pressures in Pa.
    """

    a: FloatArray
    b: FloatArray
    z: FloatArray
    loss: FloatArray
    loss_direct: float
    velocity: FloatArray
    velocity_direct: float
    pressure_static: FloatArray
    pressure: FloatArray
    pressure_direct: FloatArray
    modes: int

    @property
    def order(self) -> int:
        return int(self.a.shape[0])


def _order(plant: Plant) -> int:
    flame = plant.flame
    n = 2 * len(plant.modes) + 1 + len(flame.extra_poles_hz) + (flame.slow_share != 0.0)
    n += (plant.actuator.pole_hz is not None) + 2 * len(plant.actuator.resonances)
    return n + 2 * len(plant.resonators)


def assemble(plant: Plant, microphones_m: tuple[float, ...]) -> StateSpace:
    """The system of `plant`, heard by microphones whose mean place stands for the flame's.

    `microphones_m` has shape (microphones,); only distances from their mean matter, because the
    formats' convention takes the two-microphone velocity as the flame's (or, with
    `sensor_offset_m`, as that of a place so far away).
    """
    modes = plant.modes
    count, n = len(modes), _order(plant)
    a, b = np.zeros((n, n)), np.zeros((n, 4))
    psi = np.array([m.psi_flame for m in modes])
    omega = 2 * np.pi * np.array([m.frequency_hz for m in modes])
    decay = 2 * np.array([m.damping for m in modes]) * omega
    eta, v = np.arange(count), count + np.arange(count)

    a[eta, v] = 1.0
    a[v, v] = -decay
    a[v, eta] = -(omega**2)
    if plant.path == "derivative":
        b[eta, FLAME] = psi
        b[v, FLAME] = -decay * psi
        direct = psi
    else:
        b[v, FLAME] = psi
        direct = np.zeros(count)

    speaker = np.array([m.psi_speaker for m in modes]) * plant.actuator.gain
    b[v, NOISE] = psi * plant.actuator.gain
    at_flame = np.array([m.velocity for m in modes])
    loss, loss_direct = _open_end(plant, b, v, direct)

    at = 2 * count
    z, at = _flame(plant, a, b, at_flame, direct, v, at)
    at = _actuator(plant, a, b, speaker, v, at)
    _resonators(plant, a, b, at)

    place = plant.flame_position_m + plant.sensor_offset_m
    measured = np.array([plant.velocity_at(m, place) for m in modes]) * plant.velocity_scale
    velocity = np.zeros(n)
    velocity[v] = measured
    offsets = np.asarray(microphones_m) - np.mean(microphones_m)
    common = np.array([m.pressure for m in modes]) * plant.velocity_scale
    static = np.zeros((offsets.size, n))
    static[:, eta] = plant.density_kg_m3 * common * omega**2
    # Half the difference on either side: Σ D_i η_i'', and η_i'' = v_i' + ψ_i f'.
    shapes = -plant.density_kg_m3 * offsets[:, None] * measured[None, :]
    pressure = np.zeros((offsets.size, n))
    pressure[:, v] = shapes
    return StateSpace(
        a=a,
        b=b,
        z=z,
        loss=loss,
        loss_direct=loss_direct,
        velocity=velocity,
        velocity_direct=float(measured @ direct),
        pressure_static=static,
        pressure=pressure,
        pressure_direct=shapes @ direct,
        modes=count,
    )


def _open_end(
    plant: Plant, b: FloatArray, v: npt.NDArray[np.intp], direct: FloatArray
) -> tuple[FloatArray, float]:
    """Row of the open end's velocity (m/s), and its loss's way back onto the modes."""
    n = b.shape[0]
    end = np.array([plant.velocity_at(m, plant.open_end.length_m) for m in plant.modes])
    row = np.zeros(n)
    row[v] = end * plant.velocity_scale
    if end[0] != 0.0:
        b[v, LOSS] = -end / (end[0] ** 2 * plant.velocity_scale)
    if plant.path == "derivative":
        # v' holds η'' − ψ f', so a force on η'' acts on v alone.
        return row, float(end @ direct) * plant.velocity_scale
    return row, 0.0


def _flame(
    plant: Plant,
    a: FloatArray,
    b: FloatArray,
    at_flame: FloatArray,
    direct: FloatArray,
    v: npt.NDArray[np.intp],
    at: int,
) -> tuple[FloatArray, int]:
    """The flame's filters, states from index `at` on; returns the row of z and the next index."""
    flame, n = plant.flame, a.shape[0]
    omega = 2 * np.pi * flame.pole_hz
    a[at, at] = -omega
    a[at, v] = flame.gain * at_flame
    b[at, FLAME] = flame.gain * float(at_flame @ direct)
    z = np.zeros(n)
    z[at] = 1.0
    last, at = at, at + 1
    for pole_hz in flame.extra_poles_hz:
        w = 2 * np.pi * pole_hz
        a[at, at], a[at, last] = -w, w
        last, at = at, at + 1
        z = np.zeros(n)
        z[last] = 1.0
    if flame.slow_share != 0.0:
        w = 2 * np.pi * flame.slow_pole_hz
        a[at, at], a[at, last] = -w, w
        z[last], z[at] = 1.0 - flame.slow_share, flame.slow_share
        at += 1
    if plant.drives == "displacement":
        z = np.zeros(n)
        z[0] = 1.0
    return z, at


def _actuator(
    plant: Plant,
    a: FloatArray,
    b: FloatArray,
    speaker: FloatArray,
    v: npt.NDArray[np.intp],
    at: int,
) -> int:
    """Voice coil and resonances between the volts and the modes."""
    actuator = plant.actuator
    source: int | None = None  # the state that holds the force's volts; None: the drive itself
    if actuator.pole_hz is not None:
        w = 2 * np.pi * actuator.pole_hz
        a[at, at], b[at, DRIVE] = -w, w
        source, at = at, at + 1
    for resonance_hz, damping in actuator.resonances:
        w = 2 * np.pi * resonance_hz
        a[at, at + 1] = 1.0
        a[at + 1, at], a[at + 1, at + 1] = -(w**2), -2 * damping * w
        if source is None:
            b[at + 1, DRIVE] = w**2
        else:
            a[at + 1, source] = w**2
        source, at = at, at + 2
    if source is None:
        b[v, DRIVE] = speaker
    else:
        a[v, source] = speaker
    return at


def _resonators(plant: Plant, a: FloatArray, b: FloatArray, at: int) -> None:
    """Side resonators: y'' substituted, so that the coupling stays linear in the states."""
    count = len(plant.modes)
    for resonator in plant.resonators:
        w = 2 * np.pi * resonator.frequency_hz
        psi = np.array([plant.psi_at(m, resonator.position_m) for m in plant.modes])
        row = np.zeros(a.shape[0])
        row[at], row[at + 1] = -(w**2), -2 * resonator.damping * w
        row[:count] += w**2 * psi
        a[at, at + 1] = 1.0
        a[at + 1] = row
        a[count : 2 * count] -= resonator.coupling * psi[:, None] * row[None, :]
        at += 2
