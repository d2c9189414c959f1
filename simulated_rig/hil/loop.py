"""The plant with its loop closed, frame by frame, compiled: what is run in real time.

A frame is `substeps` integration steps (see `kernel`). In frame k

    p_k   pressures at its start, plus the controller's own microphone noise
    u     straight line from speaker sample k−1 to k (so the speaker lags one frame), plus the
          controller's volts, which are held
    next  the controller's volts out of p_k, for frame k+1

so a linear controller's closed loop is exactly the one whose poles `simulated_rig.controllers`
computes. Nothing depends on where a block ends: blocks of any size give the same numbers.
"""

from dataclasses import replace

import numba
import numpy as np

from simulated_rig.actuator import DrivePath
from simulated_rig.config import RigConfig
from simulated_rig.controllers import Law, LinearController, no_controller
from simulated_rig.kernel import propagate
from simulated_rig.plant import PREFORMS, Plant
from simulated_rig.sensors import ColouredNoise
from simulated_rig.simulation import DEGREE, EMPTY, Propagator, propagator
from simulated_rig.statespace import FloatArray

#: The usual audio rates above take one step a frame.
LEAST_STEPS_HZ = 44000.0


@numba.njit(cache=True, nogil=True)
def run_frames(
    x: FloatArray,
    acc: FloatArray,
    memory: FloatArray,
    ring: FloatArray,
    slope: FloatArray,
    first: int,
    h: float,
    matrix: FloatArray,
    beta: FloatArray,
    alpha: FloatArray,
    alpha_half: FloatArray,
    rate_row: FloatArray,
    rate_b: FloatArray,
    velocity: FloatArray,
    direct: FloatArray,
    kind: int,
    width: float,
    poly: FloatArray,
    loss2: float,
    loss3: float,
    delay: float,
    substeps: int,
    speaker: FloatArray,
    noise: FloatArray,
    hiss: FloatArray,
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    limit: float,
    s: FloatArray,
    held: FloatArray,
    out: FloatArray,
    volts: FloatArray,
) -> None:
    """Advance by ``out.shape[0]`` frames.

    `speaker` (frames · 2 · substeps + 1) volts at half steps; `noise` (frames,) or empty; `hiss`
    (frames, microphones) Pa; `a`, `b`, `c`, `limit` the controller's, `s` its state, `held[0]` its
    volts now; `out` (frames, 2 + microphones) as the kernel's; `volts` (frames,) the controller's.
    """
    frames, fine = out.shape[0], 2 * substeps
    drive = np.empty(fine + 1)
    pushed = np.empty(substeps if noise.size else 0)
    gain = np.empty(0)
    nc = s.size
    new = np.empty(nc)
    for k in range(frames):
        u = held[0]
        volts[k] = u
        for i in range(fine + 1):
            drive[i] = speaker[k * fine + i] + u
        for i in range(pushed.size):
            pushed[i] = noise[k]
        propagate(
            x,
            acc,
            memory,
            ring,
            slope,
            first + k * substeps,
            h,
            matrix,
            beta,
            alpha,
            alpha_half,
            rate_row,
            rate_b,
            velocity,
            direct,
            kind,
            width,
            poly,
            loss2,
            loss3,
            delay,
            drive,
            pushed,
            gain,
            substeps,
            out[k : k + 1],
        )
        total = 0.0
        for i in range(nc):
            y = 0.0
            for j in range(nc):
                y += a[i, j] * s[j]
            for m in range(b.shape[1]):
                y += b[i, m] * (out[k, 2 + m] + hiss[k, m])
            new[i] = y
            total += c[i] * y
        for i in range(nc):
            s[i] = new[i]
        held[0] = min(max(total, -limit), limit)


class PlantLoop:
    """A plant with an optional controller in its loop; `process` takes speaker volts, gives Pa.

    Parameters
    ----------
    config : the rig; its plant, speaker, turbulence and microphone noise are used here, the rest
        of its measuring chain is not (see `hil.device`).
    rate_hz : frames per second.
    controller : linear (compiled), any function of the pressures (called once a frame), or None.
    seed : of all noise.
    disturbance : first velocity of mode 1 in the model's unit; None: the plant's `seed_state`.
    least_steps_hz : integration steps per second, at least; frames are split to reach it.

    Raises
    ------
    ValueError
        When the flame's delay is shorter than an integration step.
    """

    def __init__(
        self,
        config: RigConfig,
        rate_hz: float,
        controller: LinearController | Law | None = None,
        seed: int = 0,
        disturbance: float | None = None,
        least_steps_hz: float = LEAST_STEPS_HZ,
    ) -> None:
        self.config = config
        self.rate_hz = rate_hz
        delay = config.plant.flame.delay_s
        need = max(least_steps_hz, 1.0 / delay if delay > 0 else 0.0)
        self.substeps = max(1, int(np.ceil(need / rate_hz - 1e-9)))
        self.plant = config.plant
        self._law: Law | None = None
        self._linear = no_controller(len(config.microphones))
        self._s: FloatArray = np.zeros(1)
        self._held: FloatArray = np.zeros(1)
        self._propagator = self._prepared(config.plant)
        system = self._propagator.system
        self.x: FloatArray = np.zeros(system.order)
        seed_state = config.plant.seed_state if disturbance is None else disturbance
        scale = config.plant.velocity_scale * max(abs(config.plant.modes[0].velocity), 1e-9)
        self.x[system.modes] = seed_state / scale
        self._memory: FloatArray = np.zeros(1)
        size = 1 << max(4, int(np.ceil(np.log2(self._propagator.delay_steps + 8))))
        self._ring: FloatArray = np.zeros(size)
        self._slope: FloatArray = np.zeros(size)
        self._step = size
        turbulence, hiss = np.random.default_rng([seed, 3]).spawn(2)
        self._turbulence = ColouredNoise(turbulence, config.plant.turbulence.corner_hz, rate_hz)
        self._hiss = hiss
        self._path = DrivePath(config.plant.actuator, 2 * self.substeps * rate_hz)
        self._last_sample = self._last_force = 0.0
        self.control_v: FloatArray = EMPTY
        self.velocity_m_s: FloatArray = EMPTY
        self.control(controller)

    def control(self, controller: LinearController | Law | None) -> None:
        """Put another controller in place; a linear one of equal order keeps the state."""
        linear = controller if isinstance(controller, LinearController) else None
        self._law = None if linear is not None or controller is None else controller  # type: ignore[assignment]
        if linear is None:
            linear = no_controller(len(self.config.microphones))
            self._held = np.zeros(1)
        if self._s.size != linear.order:
            self._s = np.zeros(linear.order)
        # Contiguous, or the kernel would be compiled anew for strides, in the first block.
        a, b, c = (np.ascontiguousarray(part) for part in (linear.a, linear.b, linear.c))
        self._linear = replace(linear, a=a, b=b, c=c)

    def operate(self, plant: Plant) -> None:
        """Another operating point of the same kind of plant; the state carries on."""
        self._propagator = self._prepared(plant)
        self.plant = plant

    def process(self, speaker_v: FloatArray) -> FloatArray:
        """Pressures (frames, microphones) at the frames' starts, for speaker samples (frames,)."""
        speaker = self._interpolated(speaker_v)
        frames = speaker_v.size
        level = self.config.plant.turbulence.level_v
        noise = level * self._turbulence.take(frames) if level else EMPTY
        rms = np.array([m.noise_pa for m in self.config.microphones])
        hiss = rms * self._hiss.standard_normal((frames, rms.size))
        out = np.empty((frames, 2 + rms.size))
        volts = np.empty(frames)
        law = self._law
        if law is None:
            self._run(speaker, noise, hiss, out, volts)
        else:
            fine, limit = 2 * self.substeps, self._linear.limit_v
            for k in range(frames):
                one = slice(k, k + 1)
                part = speaker[k * fine : (k + 1) * fine + 1]
                self._run(part, noise[one], hiss[one], out[one], volts[one])
                answer = _volts(law(out[k, 2:] + hiss[k]))
                self._held[0] = min(max(answer, -limit), limit)
        self.control_v = volts
        self.velocity_m_s = out[:, 0]
        return out[:, 2:]

    def _prepared(self, plant: Plant) -> Propagator:
        step_s = 1.0 / (self.rate_hz * self.substeps)
        return propagator(plant, self.config.microphones_m, step_s)

    def _interpolated(self, speaker_v: FloatArray) -> FloatArray:
        """Force volts at half steps, behind distortion and delay; the last block's end first."""
        fine = 2 * self.substeps
        starts = np.concatenate([[self._last_sample], speaker_v])
        weights = np.arange(1, fine + 1) / fine
        lines = starts[:-1, None] + np.diff(starts)[:, None] * weights
        force = self._path.process(lines.ravel())
        joined = np.concatenate([[self._last_force], force])
        self._last_sample, self._last_force = float(speaker_v[-1]), float(force[-1])
        return joined

    def _run(
        self,
        speaker: FloatArray,
        noise: FloatArray,
        hiss: FloatArray,
        out: FloatArray,
        volts: FloatArray,
    ) -> None:
        prepared = self._propagator
        p, c, system = prepared.plant, prepared.coefficients, prepared.system
        poly = np.zeros(DEGREE + 1)
        if p.lit:
            poly[: len(p.characteristic.coefficients)] = p.characteristic.coefficients
        control = self._linear
        run_frames(
            self.x,
            np.empty(c.matrix.shape[1]),
            self._memory,
            self._ring,
            self._slope,
            self._step,
            c.h,
            c.matrix,
            c.beta,
            c.alpha,
            c.alpha_half,
            c.rate_row,
            c.rate_b,
            system.velocity,
            np.concatenate([[system.loss_direct, system.velocity_direct], system.pressure_direct]),
            PREFORMS.index(p.characteristic.preform),
            float(p.characteristic.width),
            poly,
            float(p.open_end.quadratic_per_m),
            float(p.open_end.cubic_s_per_m2),
            float(prepared.delay_steps),
            self.substeps,
            speaker,
            noise,
            hiss,
            control.a,
            control.b,
            control.c,
            float(control.limit_v),
            self._s,
            self._held,
            out,
            volts,
        )
        self._step += out.shape[0] * self.substeps


def _volts(answer: object) -> float:
    """A controller's answer; raises `ValueError` for what is no voltage."""
    try:
        volts = float(answer)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        volts = np.nan
    if not np.isfinite(volts):
        raise ValueError(f"the controller's answer {answer!r} is not a finite voltage")
    return volts


def silent(config: RigConfig) -> RigConfig:
    """`config` without any noise: what linear theory is checked against."""
    plant = replace(config.plant, turbulence=replace(config.plant.turbulence, level_v=0.0))
    return replace(
        config,
        plant=plant,
        microphones=tuple(replace(m, noise_pa=0.0) for m in config.microphones),  # type: ignore[arg-type]
    )
