"""Whole campaigns in a fraction of a second: plan, simulate, write as a campaign folder.

The same plant, actuator path, sensors and converter as in `SimulatedRig`, without clock and
guard: every run is one call of the compiled loop. A plan is made as an experimenter makes one:
whole-hertz frequencies around the free cycle's, amplitudes above the lock-in boundary, each tried
until the response no longer changes. What comes out are recordings and what a campaign's file
would say of them; effects in the rig are not among it.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.io import wavfile

from simulated_rig.actuator import DrivePath
from simulated_rig.config import RigConfig
from simulated_rig.cycle import FreeCycle, free_cycle
from simulated_rig.drift import drifted
from simulated_rig.sensors import Chain, ColouredNoise
from simulated_rig.simulation import EMPTY, Simulation, propagator
from simulated_rig.statespace import FloatArray

Kind = Literal["free", "forced", "cold"]
Role = Literal["fit", "validation"]

STEP_RATE_HZ = 20000.0  # at 170 Hz an error of 7e-8 of the fundamental
CORNERED = 32  # times that with backlash or dead zone, whose corners cost the scheme its order
PLACES = 5  # of a step, at least, where periods meet a corner: then what that costs averages out
SLOT_S = 120.0  # from one run's start to the next
SETTLED = 1e-7  # relative change of the response's coefficients from one second to the next
MOST_SECONDS = 12
LEAD_FRAMES = 64  # sampled before the recording starts, for the chain's filters to fill


@dataclass(frozen=True)
class PlannedRun:
    """One recording to be made; `settle_s` of waiting with the drive on come before it."""

    kind: Kind
    frequency_hz: float | None = None
    amplitude_v: float | None = None
    started_s: float = 0.0
    role: Role = "fit"
    duration_s: float = 2.0
    settle_s: float = 4.0


@dataclass(frozen=True)
class RecordedRun:
    """A run's signals, shape (samples,): pressures in Pa, drive in V, as the converter gave them.

    `velocity` is the true velocity at the flame in m/s at the frames' instants; it is for tests
    of the rig and goes into no file.
    """

    name: str
    plan: PlannedRun
    p1: FloatArray
    p2: FloatArray
    drive: FloatArray
    velocity: FloatArray


@dataclass(frozen=True)
class SimulatedCampaign:
    """What a campaign folder holds, as arrays."""

    title: str
    sample_rate_hz: float
    positions_m: tuple[float, float]
    volts_per_pa: tuple[float, float]
    full_scale_v: float
    bits: int
    density_kg_m3: float
    sound_speed_m_s: float
    declared_modes: int
    runs: tuple[RecordedRun, ...]


def _cornered(config: RigConfig) -> bool:
    return config.plant.characteristic.preform in ("play", "dead_zone")


def _steps_per_frame(config: RigConfig) -> int:
    rate = (CORNERED if _cornered(config) else 1) * STEP_RATE_HZ
    m = max(1, int(np.ceil(rate / config.sample_rate_hz)))
    delay = config.plant.flame.delay_s
    if delay > 0:
        m = max(m, int(np.ceil(1.0 / (delay * config.sample_rate_hz) - 1e-9)))
    return m


def _drive(run: PlannedRun, rate_hz: float, first: int, count: int) -> FloatArray:
    """The generator's volts at `count` instants from index `first` (0: the recording's start)."""
    if run.frequency_hz is None or not run.amplitude_v:
        return np.zeros(count)
    whole = run.frequency_hz.is_integer() and rate_hz.is_integer()
    # Whole hertz repeat every second, so one second of sine is enough.
    index = np.arange(min(count, round(rate_hz)) if whole else count)
    # Reduced to one period first: a phase of thousands of cycles would cost digits.
    cycles = np.mod((first + index) * run.frequency_hz / rate_hz, 1.0)
    return np.resize(run.amplitude_v * np.sin(2 * np.pi * cycles), count)


def settle_time(config: RigConfig, run: PlannedRun) -> float | None:
    """Seconds until the response at the forcing stops changing; None: it never does.

    For a forced run this is entrainment: while another line is there, the coefficients of
    successive seconds differ. Turbulence and modulation are left out.
    """
    plant = replace(config.plant, lit=run.kind != "cold")
    m = _steps_per_frame(config)
    rate = config.sample_rate_hz * m
    steps = round(rate)
    step_s = 1 / (config.true_rate_hz * m)
    simulation = Simulation(propagator(plant, config.microphones_m, step_s))
    path = DrivePath(plant.actuator, 2 * rate)
    frequency = run.frequency_hz or 1.0
    t = np.arange(round(config.sample_rate_hz)) / config.sample_rate_hz
    k = np.arange(1, 4)[:, None]
    basis = np.exp(-2j * np.pi * k * frequency * t) * (2 / t.size)
    previous, last_force = np.zeros(3, dtype=complex), 0.0
    for second in range(MOST_SECONDS):
        volts = path.process(_drive(run, 2 * rate, second * 2 * steps + 1, 2 * steps))
        drive = np.concatenate([[last_force], volts])
        last_force = float(volts[-1])
        y = simulation.run(drive, m)[:, 0]
        found = basis @ y
        size = float(np.linalg.norm(found))
        if not np.isfinite(size):
            return None
        if second and np.linalg.norm(found - previous) <= SETTLED * size:
            return float(second + 1)
        previous = found
    return None


def simulate_run(
    config: RigConfig, run: PlannedRun, seed: Sequence[int], name: str = "run"
) -> RecordedRun:
    """One recording of the rig as it is at `run.started_s`."""
    plant = drifted(config.plant, config.drifts, run.started_s, seed[0])
    plant = replace(plant, lit=run.kind != "cold")
    m = _steps_per_frame(config)
    rate = config.sample_rate_hz * m
    rng = np.random.default_rng([*seed, 7])
    frames = round(run.duration_s * config.sample_rate_hz)
    lead, recorded = LEAD_FRAMES * m, (frames + LEAD_FRAMES) * m
    before = max(lead, round(run.settle_s * rate))

    gain = 1.0 + config.scatter.gain_rms * float(rng.standard_normal())
    phase = config.scatter.phase_rms_rad * float(abs(rng.standard_normal()))
    actuator = plant.actuator
    actuator = replace(actuator, delay_s=actuator.delay_s + phase / (2 * np.pi * 170.0))
    first = -2 * (before + lead)  # half steps before the recording's first frame
    volts = _drive(run, 2 * rate, first, 2 * (before + recorded) + 1)
    force = DrivePath(actuator, 2 * rate).process(gain * volts)

    steps = before + recorded
    noise = modulation = EMPTY
    if plant.turbulence.level_v:
        source = ColouredNoise(rng, plant.turbulence.corner_hz, rate)
        noise = plant.turbulence.level_v * source.take(steps)
    if config.modulation.rms:
        source = ColouredNoise(rng, config.modulation.corner_hz, rate)
        modulation = 1.0 + config.modulation.rms * source.take(steps)

    if config.amplifier_noise_v:
        force = force + config.amplifier_noise_v * rng.standard_normal(force.size)
    step_s = 1 / (config.true_rate_hz * m)
    simulation = Simulation(propagator(plant, config.microphones_m, step_s))
    start = rng.uniform(0, 0.01) if run.kind == "free" else 0.0  # the free phase is anybody's
    skip = int(start * rate)
    if skip:
        simulation.run(np.zeros(2 * skip + 1), skip, noise[:skip], modulation[:skip])
    simulation.run(force[: 2 * before + 1], before, noise[:before], modulation[:before])
    out = simulation.run(force[2 * before :], 1, noise[before:], modulation[before:])
    chain = Chain(config, m, [*seed, 8])
    samples = chain.process(out[:, 2:], volts[2 * before : -1 : 2])[LEAD_FRAMES:]
    sensitivity = np.array([microphone.volts_per_pa for microphone in config.microphones])
    pressure = samples[:, :2] / sensitivity
    velocity = out[::m, 0][LEAD_FRAMES:]
    return RecordedRun(name, run, pressure[:, 0], pressure[:, 1], samples[:, 2], velocity)


def simulate_campaign(
    config: RigConfig,
    plan: Sequence[PlannedRun],
    seed: int = 0,
    title: str = "simulated campaign",
    declared_modes: int = 2,
    workers: int = 1,
) -> SimulatedCampaign:
    """All runs of `plan`, in its order; `seed` is of every random number.

    `workers` threads share the runs; the result does not depend on their number.
    """

    def one(index: int) -> RecordedRun:
        run = plan[index]
        label = run.kind if run.frequency_hz is None else f"{run.frequency_hz:g}Hz"
        prefix = "cold_" if run.kind == "cold" and run.frequency_hz is not None else ""
        return simulate_run(config, run, [seed, index], f"{index:02d}_{prefix}{label}")

    with ThreadPoolExecutor(workers) as pool:
        runs = list(pool.map(one, range(len(plan))))
    first, second = config.microphones
    return SimulatedCampaign(
        title=title,
        sample_rate_hz=config.sample_rate_hz,
        positions_m=(first.position_m, second.position_m),
        volts_per_pa=(first.volts_per_pa, second.volts_per_pa),
        full_scale_v=config.converter.full_scale_v,
        bits=config.converter.bits,
        density_kg_m3=config.plant.density_kg_m3,
        sound_speed_m_s=config.plant.sound_speed_m_s,
        declared_modes=declared_modes,
        runs=tuple(runs),
    )


def lock_in_volts(config: RigConfig, cycle: FreeCycle, frequency_hz: float) -> float:
    """A first guess of the drive that entrains: |Δω| = F/(2 A) for the first mode's amplitude A
    (Adler), of a plain speaker."""
    plant = config.plant
    mode = plant.modes[0]
    amplitude = cycle.velocity_m_s / abs(mode.velocity * plant.velocity_scale)
    detuning = 2 * np.pi * abs(frequency_hz - cycle.frequency_hz)
    return float(2 * detuning * amplitude / abs(mode.psi_speaker * plant.actuator.gain))


def _condition(
    config: RigConfig, cycle: FreeCycle, frequency_hz: float, excess: float, most_v: float
) -> PlannedRun | None:
    """A forced run at `excess` times the boundary, raised until it locks; None beyond `most_v`."""
    volts = excess * max(
        lock_in_volts(config, cycle, frequency_hz),
        0.2 * lock_in_volts(config, cycle, cycle.frequency_hz * 1.02),
    )
    for _ in range(6):
        volts = float(np.round(min(volts, most_v), 3))
        run = PlannedRun("forced", frequency_hz, volts)
        settled = settle_time(config, run)
        if settled is not None:
            return replace(run, settle_s=settled)
        if volts >= most_v:
            return None
        volts *= 1.6
    return None


def plan_campaign(
    config: RigConfig,
    seed: int = 0,
    forced: int = 8,
    validation: int = 3,
    cold: int = 0,
    spread: float = 0.07,
    most_v: float = 5.0,
    duration_s: float = 2.0,
) -> tuple[PlannedRun, ...]:
    """One free run, `forced` entrained ones to fit on, `validation` more, `cold` with flame off.

    Frequencies are whole hertz within ±`spread` of the free cycle's; started in random order. The
    free run comes first in the list, the validation runs last. With corners in the characteristic,
    frequencies are left out whose period is a whole number of steps, or nearly: every period meets
    a corner at the same place of a step, an error of 2e-5 at 160 Hz.

    Raises
    ------
    ValueError
        When the rig has no limit cycle, or too few conditions can be entrained below `most_v`.
    """
    rng = np.random.default_rng([seed, 0x91A7])
    cycle = free_cycle(config.plant)
    if not cycle.exists:
        raise ValueError("the rig has no limit cycle: there is nothing to entrain")
    f0 = cycle.frequency_hz
    whole = np.arange(np.ceil(f0 * (1 - spread)), np.floor(f0 * (1 + spread)) + 1)
    whole = whole[np.abs(whole - f0) > 0.4]
    if _cornered(config):
        steps = round(config.sample_rate_hz * _steps_per_frame(config))
        whole = whole[whole / np.gcd(whole.astype(int), steps) >= PLACES]
    order = rng.permutation(whole)
    found: list[PlannedRun] = []
    for attempt in range(3 * (forced + validation)):
        frequency = float(order[attempt % order.size])
        condition = _condition(config, cycle, frequency, float(rng.uniform(1.3, 3.0)), most_v)
        if condition is not None:
            found.append(replace(condition, duration_s=duration_s))
        if len(found) == forced + validation:
            break
    else:
        raise ValueError(
            f"only {len(found)} of {forced + validation} conditions lock below most_v={most_v}"
        )
    free = PlannedRun("free", duration_s=duration_s, settle_s=8.0)
    runs = [free, *found[:forced]]
    runs += [
        PlannedRun("cold", float(f), min(2.0, most_v), duration_s=duration_s, settle_s=3.0)
        for f in rng.choice(whole, size=cold, replace=False)
    ]
    runs += [replace(run, role="validation") for run in found[forced:]]
    starts = SLOT_S * rng.permutation(len(runs))
    return tuple(
        replace(run, started_s=float(start)) for run, start in zip(runs, starts, strict=True)
    )


def write_campaign(campaign: SimulatedCampaign, folder: Path) -> Path:
    """Write the folder of ``campaign-folder/1``; int16 up to 16 bits, float32 beyond.

    Returns `folder`. Nothing in it tells an effect from its absence.
    """
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    full = campaign.full_scale_v
    lines = [
        'format = "campaign-folder/1"',
        f'title = "{campaign.title}"',
        f"sample_rate_hz = {campaign.sample_rate_hz!r}",
        "",
        "[medium]",
        f"density_kg_m3 = {campaign.density_kg_m3!r}",
        f"sound_speed_m_s = {campaign.sound_speed_m_s!r}",
        "",
        "[declared_model]",
        f"modes = {campaign.declared_modes}",
        'flame = "first_order_lowpass"',
        'nonlinearity = "polynomial"',
        "nonlinearity_degree = 3",
    ]
    for i, (place, volts) in enumerate(
        zip(campaign.positions_m, campaign.volts_per_pa, strict=True), start=1
    ):
        lines += _channel(f"p{i}", "pressure", "Pa", volts, full)
        lines.append(f"position_m = {place!r}")
    lines += _channel("drive", "voltage", "V", 1.0, full)
    for run in campaign.runs:
        file = f"runs/{run.name}.wav"
        lines += ["", "[[runs]]", f'file = "{file}"', f'kind = "{run.plan.kind}"']
        if run.plan.frequency_hz is not None:
            lines.append(f"frequency_hz = {run.plan.frequency_hz!r}")
            lines.append(f"amplitude_v = {run.plan.amplitude_v!r}")
        lines.append(f"started_s = {run.plan.started_s!r}")
        if run.plan.role == "validation":
            lines.append('role = "validation"')
        wavfile.write(folder / file, round(campaign.sample_rate_hz), _recording(campaign, run))
    (folder / "campaign.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def _channel(name: str, quantity: str, unit: str, volts: float, full: float) -> list[str]:
    return [
        "",
        "[[channels]]",
        f'name = "{name}"',
        f'quantity = "{quantity}"',
        f'unit = "{unit}"',
        f"volts_per_unit = {volts!r}",
        f"full_scale_v = {full!r}",
    ]


def _recording(campaign: SimulatedCampaign, run: RecordedRun) -> np.ndarray:
    """(samples, 3) in the file's number type; full scale is `full_scale_v` volts."""
    volts = [run.p1 * campaign.volts_per_pa[0], run.p2 * campaign.volts_per_pa[1], run.drive]
    relative = np.column_stack(volts) / campaign.full_scale_v
    if campaign.bits <= 16:
        return np.clip(np.round(relative * 32768), -32768, 32767).astype(np.int16)
    return relative.astype(np.float32)
