"""`SimulatedRig`: a plant and its chain behind `drivers.protocols.DuplexRig`.

Time is cut into quanta of `QUANTUM_S`, on a grid counted in frames. For each quantum the output
guard renders the drive at twice the integration rate, the plant moves on, the chain samples; what
is read is taken from a buffer. So the samples do not depend on the sizes in which they are read,
and a command takes effect at the next quantum, as in a device with a buffer.

With a virtual clock waiting *is* simulating: `read` lets just as much time pass as it needs. With
the real clock a thread keeps up with the wall, and falling behind ends in a gap and a fault, never
in silently late data.
"""

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from types import TracebackType
from typing import Self

import numpy as np

from drivers.errors import DeviceLost, DeviceTimeout, SettingError
from drivers.guard import OutputGuard
from drivers.protocols import Clock
from drivers.types import Block, Channel, Gap, OutputLimits, StreamStatus, Tone, require
from simulated_rig.actuator import DrivePath
from simulated_rig.clocks import RealClock, VirtualClock
from simulated_rig.config import RigConfig
from simulated_rig.drift import drifted
from simulated_rig.operating import REFERENCE, OperatingPoint, at_operating_point
from simulated_rig.plant import Plant
from simulated_rig.sensors import Chain, ColouredNoise
from simulated_rig.simulation import EMPTY, Simulation, propagator
from simulated_rig.statespace import FloatArray

QUANTUM_S = 0.01
INTERNAL_RATE_HZ = 50000.0
BUFFER_S = 60.0
LATE_S = 0.5  # as much may the real-time thread fall behind before frames are given up
DRIFT_EVERY = 10  # quanta between looks at a drifting parameter
WARM_UP_S = 4.0  # simulated before the first frame: the limit cycle is there already
RUN_DOWN_S = 2.0  # at most simulated of a pause between two streams


class SimulatedRig:
    """A combustor in software; see the module.

    Parameters
    ----------
    config : what it is made of.
    seed : of every random number in it.
    clock : `VirtualClock` (default) or `RealClock`; any other clock is taken for real.
    name : what it is called. Says nothing of effects.
    """

    def __init__(
        self,
        config: RigConfig,
        seed: int = 0,
        clock: Clock | None = None,
        name: str = "simulated rig",
    ) -> None:
        self._config = config
        self._seed = seed
        self._clock: Clock = VirtualClock() if clock is None else clock
        self._name = name
        self._m = oversampling(config)
        rate = config.sample_rate_hz
        self._quantum = max(1, round(QUANTUM_S * rate))
        self._plant: Plant = config.plant
        self._point = REFERENCE
        self._simulation = Simulation(propagator(config.plant, config.microphones_m, self._step_s))
        self._born_s = self._clock.now()
        self._ended_s: float | None = None
        self._streams = 0
        self._lock = threading.RLock()
        self._ready = threading.Condition(self._lock)
        self._guard = OutputGuard(
            config.limits,
            2 * self._m * rate,
            self._clock.now,
            max_frames=2 * self._m * self._quantum,
        )
        self._running = False
        self._closed = False
        self._lost = False
        self._fault: str | None = None
        self._thread: threading.Thread | None = None
        self._buffer: deque[tuple[int, FloatArray]] = deque()
        self._gaps: list[Gap] = []
        self._produced = self._next = 0
        self._start_s = self._born_s
        sources = np.random.default_rng([seed, 1]).spawn(5)
        turbulence_rng, modulation_rng, self._scatter_rng = sources[:3]
        self._amplifier_rng, self._drop_rng = sources[3:]
        self._dropping = 0
        turbulence = config.plant.turbulence
        self._turbulence = ColouredNoise(turbulence_rng, turbulence.corner_hz, rate * self._m)
        self._modulation = ColouredNoise(
            modulation_rng, config.modulation.corner_hz, rate * self._m
        )
        self._advance_silently(WARM_UP_S)

    # -- what it is ------------------------------------------------------------------------

    @property
    def name(self) -> str:
        return self._name

    @property
    def clock(self) -> Clock:
        return self._clock

    @property
    def sample_rate_hz(self) -> float:
        return self._config.sample_rate_hz

    @property
    def limits(self) -> OutputLimits:
        return self._config.limits

    @property
    def channels(self) -> tuple[Channel, ...]:
        full = self._config.converter.full_scale_v
        pressure = [
            Channel(f"p{i}", "pressure", "Pa", m.volts_per_pa, full, position_m=m.position_m)
            for i, m in enumerate(self._config.microphones, start=1)
        ]
        return (*pressure, Channel("drive", "voltage", "V", 1.0, full))

    def status(self) -> StreamStatus:
        """A snapshot; never blocks."""
        gaps = tuple(self._gaps)
        return StreamStatus(
            running=self._running,
            frames=self._produced,
            lost_frames=sum(gap.frames for gap in gaps),
            xruns=len(gaps),
            gaps=gaps,
            output_v=self._guard.output_v if self._running else 0.0,
            muted=self._guard.muted,
            fault=self._fault,
        )

    # -- input -----------------------------------------------------------------------------

    def start(self) -> None:
        """Begin sampling; frame numbers count from here. Harmless when running."""
        with self._lock:
            self._require_present()
            if self._running:
                return
            now = self._clock.now()
            self._pause(now)
            self._streams += 1
            self._begin_stream(now)
            self._running = True
            if isinstance(self._clock, VirtualClock):
                self._clock.subscribe(self._pump)
            else:
                self._thread = threading.Thread(
                    target=self._keep_up, name=f"{self._name} plant", daemon=True
                )
                self._thread.start()

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        """Next `frames` frames, always contiguous: frames before a gap that are too few for a
        block are given up with it (`first_frame` jumps, flag ``gap``)."""
        require(frames >= 1, "frames", frames, "an integer >= 1")
        with self._ready:
            self._require_present()
            if not self._running:
                raise SettingError("running=False is not True: start() the stream before read()")
            gap = False
            while True:
                gap = self._skip_gap(frames) or gap
                available = self._buffered()
                if available >= frames:
                    return self._take(frames, gap)
                self._wait(frames - available, timeout_s)
                if not self._running:
                    raise DeviceLost(f"{self._name} was stopped during a read")

    def stop(self) -> None:
        """End sampling and silence the output; harmless when not started."""
        self._guard.silence()
        with self._ready:
            if not self._running:
                return
            self._running = False
            self._run_out()
            self._ended_s = self._clock.now()
            if isinstance(self._clock, VirtualClock):
                self._clock.unsubscribe(self._pump)
            self._ready.notify_all()
            thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join(2.0)

    # -- output ----------------------------------------------------------------------------

    def drive(self, tone: Tone) -> Tone:
        self._require_present()
        return self._guard.drive(tone)

    def feed(self) -> None:
        self._guard.feed()

    def silence(self) -> None:
        self._guard.silence()

    def emergency_stop(self, reason: str = "emergency stop") -> None:
        self._guard.stop(reason)

    def reset_stop(self) -> None:
        self._guard.reset()

    def close(self) -> None:
        self.stop()
        self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # -- the laboratory's hands --------------------------------------------------------------

    def flame_off(self) -> None:
        """Shut the fuel: the loop is open, the tube cold-runs. The oscillation rings down."""
        self._operate(lambda plant: replace(plant, lit=False))

    def flame_on(self) -> None:
        """Light the flame again; the limit cycle grows out of what is left of the noise."""
        self._operate(lambda plant: replace(plant, lit=True))

    def set_operating_point(self, point: OperatingPoint) -> None:
        """Turn flow and fuel: gain and damping change, through the Hopf point if need be."""
        base, self._point = self._config.plant, point
        self._operate(lambda plant: replace(at_operating_point(base, point), lit=plant.lit))

    def operating_ranges(self) -> Mapping[str, tuple[float, float]]:
        """What `operate` sets: the fields of `OperatingPoint`."""
        return {"flow": (0.05, 5.0), "equivalence_ratio": (0.3, 1.2)}

    def operate(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Set quantities of the operating point by name; returns the whole of it."""
        for name, value in values.items():
            low, high = self.operating_ranges().get(name, (0.0, -1.0))
            require(low <= value <= high, name, value, f"of {dict(self.operating_ranges())}")
        self.set_operating_point(replace(self._point, **values))
        return asdict(self._point)

    def drop_frames(self, frames: int) -> None:
        """Lose at least so many of the coming frames, in whole quanta, as an overrun would."""
        require(frames >= 1, "frames", frames, "an integer >= 1")
        with self._lock:
            self._dropping += -(-frames // self._quantum)

    def unplug(self) -> None:
        """Pull the cable: sampling ends, the output is dead, every verb but silence fails."""
        self._lost = True
        self._fault = "device lost: unplugged"
        self.stop()

    def replug(self) -> None:
        """Put it back; the stream must be started anew."""
        self._lost = False
        self._fault = None

    @property
    def flame_lit(self) -> bool:
        return self._plant.lit

    def _require_present(self) -> None:
        if self._closed:
            raise DeviceLost(f"{self._name} is closed; open it anew")
        if self._lost:
            raise DeviceLost(f"{self._name}: {self._fault}; replug() and start() anew")

    # -- inside ------------------------------------------------------------------------------

    @property
    def _step_s(self) -> float:
        return 1.0 / (self._config.true_rate_hz * self._m)

    def _operate(self, change: Callable[[Plant], Plant]) -> None:
        with self._lock:
            self._plant = change(self._plant)
            self._retune(self._rig_time_s())

    def _rig_time_s(self) -> float:
        """Time since the rig was built: what drifts go by."""
        if self._running:
            return self._start_s - self._born_s + self._produced / self._config.sample_rate_hz
        return self._clock.now() - self._born_s

    def _retune(self, time_s: float) -> None:
        plant = drifted(self._plant, self._config.drifts, time_s, self._seed)
        self._simulation.propagator = propagator(plant, self._config.microphones_m, self._step_s)

    def _begin_stream(self, now: float) -> None:
        """A fresh buffer and chain, and this run's share of the scatter of the drive."""
        self._buffer.clear()
        self._gaps = []
        self._produced = self._next = 0
        self._start_s = now
        self._fault = None
        config = self._config
        self._chain = Chain(config, self._m, [self._seed, 2, self._streams])
        scatter = config.scatter
        gain = 1.0 + scatter.gain_rms * float(self._scatter_rng.standard_normal())
        phase = scatter.phase_rms_rad * abs(float(self._scatter_rng.standard_normal()))
        actuator = config.plant.actuator
        # A phase lag, as a delay that gives it at 170 Hz.
        actuator = replace(actuator, delay_s=actuator.delay_s + phase / (2 * np.pi * 170.0))
        self._path = DrivePath(actuator, 2 * self._m * config.sample_rate_hz)
        self._run_gain = gain
        self._last_u = self._last_force = 0.0
        self._retune(now - self._born_s)

    def _pause(self, now: float) -> None:
        """What happened to the plant while nobody sampled: it ran on, undriven."""
        if self._ended_s is not None:
            self._advance_silently(min(now - self._ended_s, RUN_DOWN_S))

    def _run_out(self) -> None:
        """The output's ramp to zero, which no frame shows: nothing is left of it at a restart."""
        fine = 2 * self._m * self._quantum
        # Bounded, because another thread may ask for a tone while this goes on.
        for _ in range(2 + int(self._config.limits.silence_ramp_s / QUANTUM_S)):
            if self._guard.output_v == 0.0:
                break
            force = self._path.process(self._run_gain * self._guard.render(fine))
            drive = np.concatenate([[self._last_force], force])
            self._last_force = float(force[-1])
            noise, gain = self._random(self._m * self._quantum)
            self._simulation.run(drive, self._m * self._quantum, noise, gain)

    def _advance_silently(self, seconds: float) -> None:
        steps = int(seconds / self._step_s)
        if steps > 0:
            noise, gain = self._random(steps)
            self._simulation.run(np.zeros(2 * steps + 1), steps, noise, gain)

    def _random(self, steps: int) -> tuple[FloatArray, FloatArray]:
        noise = gain = EMPTY
        level, rms = self._config.plant.turbulence.level_v, self._config.modulation.rms
        if level:
            noise = level * self._turbulence.take(steps)
        if rms:
            gain = 1.0 + rms * self._modulation.take(steps)
        return noise, gain

    def _produce(self) -> None:
        """One quantum: render, integrate, sample."""
        if self._config.drifts and (self._produced // self._quantum) % DRIFT_EVERY == 0:
            self._retune(self._rig_time_s())
        fine = 2 * self._m * self._quantum
        rendered = self._guard.render(fine)
        recorded = np.concatenate([[self._last_u], rendered[:-1]])[::2]
        force = self._path.process(self._run_gain * rendered)
        if self._config.amplifier_noise_v:
            hiss = self._amplifier_rng.standard_normal(fine)
            force = force + self._config.amplifier_noise_v * hiss
        drive = np.concatenate([[self._last_force], force])
        self._last_u, self._last_force = float(rendered[-1]), float(force[-1])
        noise, gain = self._random(self._m * self._quantum)
        out = self._simulation.run(drive, 1, noise, gain)
        samples = self._chain.process(out[:, 2:], recorded)
        rate = self._config.converter.drops_per_s
        if rate and self._drop_rng.uniform() < rate * self._quantum / self.sample_rate_hz:
            self._dropping += 1
        full = self._buffered() + self._quantum > BUFFER_S * self.sample_rate_hz
        if full or self._dropping:
            self._dropping = max(0, self._dropping - 1)
            self._lose(self._quantum)
            return
        self._buffer.append((self._produced, samples))
        self._produced += self._quantum

    def _lose(self, frames: int) -> None:
        """Frames that nobody will see: one gap, grown if it adjoins the last."""
        last = self._gaps[-1] if self._gaps else None
        if last is not None and last.first_frame + last.frames == self._produced:
            self._gaps[-1] = Gap(last.first_frame, last.frames + frames)
        else:
            self._gaps.append(Gap(self._produced, frames))
        self._produced += frames

    def _pump(self, until_s: float) -> None:
        """Produce every quantum that is over by `until_s`; the virtual clock calls this."""
        with self._ready:
            rate = self.sample_rate_hz
            while self._running:
                end = self._start_s + (self._produced + self._quantum) / rate
                if end > until_s + 1e-9:
                    break
                if isinstance(self._clock, VirtualClock):
                    self._clock.set(self._start_s + self._produced / rate)
                self._produce()
            self._ready.notify_all()

    def _keep_up(self) -> None:
        """The real-time thread. What goes wrong in it ends the stream with a fault."""
        try:
            while self._running:
                self._catch_up()
        except Exception as error:
            with self._ready:
                self._fault = f"plant failed: {error}"
                self._lost = True
                self._running = False
                self._ready.notify_all()

    def _catch_up(self) -> None:
        """Wait for the next quantum's end, or give frames up when too late."""
        rate = self.sample_rate_hz
        now = self._clock.now()
        due = self._start_s + (self._produced + self._quantum) / rate
        if now < due:
            self._clock.sleep(due - now)
            return
        if now - due > LATE_S:
            with self._ready:
                self._lose(int((now - due) * rate) // self._quantum * self._quantum)
                self._fault = f"fell {now - due:.2f} s behind real time; frames were given up"
        self._pump(now)

    def _wait(self, missing: int, timeout_s: float) -> None:
        """Let the frames come."""
        if isinstance(self._clock, VirtualClock):
            quanta = -(-missing // self._quantum)
            rate = self.sample_rate_hz
            end = self._start_s + (self._produced + quanta * self._quantum) / rate
            self._clock.sleep(max(end - self._clock.now(), 1e-12))
            return
        before = self._produced
        if not self._ready.wait(timeout_s) and self._running and self._produced == before:
            raise DeviceTimeout(f"{missing} frames are missing after timeout_s={timeout_s}")

    def _buffered(self) -> int:
        """Contiguous frames from the next one on."""
        if not self._buffer:
            return 0
        edge = next((g.first_frame for g in self._gaps if g.first_frame > self._next), None)
        return (self._produced if edge is None else edge) - max(self._next, self._buffer[0][0])

    def _skip_gap(self, frames: int) -> bool:
        """Step over a gap that stands before the next `frames` frames; True if there was one."""
        for gap in self._gaps:
            ahead = gap.first_frame - self._next
            if 0 <= ahead < frames:
                self._next = gap.first_frame + gap.frames
                while self._buffer and self._buffer[0][0] < self._next:
                    self._buffer.popleft()
                return True
        return False

    def _take(self, frames: int, gap: bool) -> Block:
        first, parts, wanted = self._next, [], frames
        while wanted:
            start, samples = self._buffer[0]
            part = samples[self._next - start : self._next - start + wanted]
            parts.append(part)
            wanted -= part.shape[0]
            self._next += part.shape[0]
            if self._next == start + samples.shape[0]:
                self._buffer.popleft()
        joined = np.concatenate(parts)
        flags: set[str] = {"gap"} if gap else set()
        full = self._config.converter.full_scale_v
        if np.max(np.abs(joined)) >= full * (1 - 2.0 ** (2 - self._config.converter.bits)):
            flags.add("clipped")
        time_s = self._start_s + first / self.sample_rate_hz
        return Block(first, joined, time_s, frozenset(flags))  # type: ignore[arg-type]


def oversampling(config: RigConfig) -> int:
    """Integration steps per frame: at least `INTERNAL_RATE_HZ`, and none longer than a delay."""
    rate = config.sample_rate_hz
    m = max(1, int(np.ceil(INTERNAL_RATE_HZ / rate)))
    delay = config.plant.flame.delay_s
    if delay > 0:
        m = max(m, int(np.ceil(1.0 / (delay * rate) - 1e-9)))
    return m


__all__ = ["RealClock", "SimulatedRig", "VirtualClock"]
