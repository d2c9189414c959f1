"""The thin loop around the controller: drive, wait, measure, decide, until it is decided."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from daq.acquire import Acquisition, Stretch
from daq.coupling import Coupling
from daq.entrain import (
    Command,
    Settings,
    State,
    Task,
    begin,
    is_entrained,
    step,
    window_of,
)
from daq.errors import CampaignError
from daq.lockin import FloatArray, FreeCycle, Measurement, baseband, measure
from daq.tongue import Law, law_from_relaxation
from drivers.types import Tone

Watch = Callable[[State, Measurement], None]

# The disturbance that shows the growth rate: how far off the free frequency, how long, how long
# the speaker then needs to fall silent, and how long the return is watched.
DISTURB = 1.015
DISTURB_S = 0.2
SPEAKER_DECAY_S = 0.02
GLANCE_S = 0.1  # into that return, which tells whether the disturbance was large enough
RELAX_S = 0.7
SHOWS = 0.12  # least departure of 1/|z|² from 1 worth watching; WANTED is aimed at
WANTED = 0.3
MOST_AT_ONCE = 5.0  # times the disturbance before


@dataclass(frozen=True)
class Columns:
    """Which columns the controller looks at: a pressure channel, and the drive where recorded."""

    pressure: int
    drive: int | None
    pressure_scale: float  # Pa per volt
    drive_scale: float = 1.0

    def pressure_of(self, stretch: Stretch) -> FloatArray:
        """The control channel in its unit."""
        return stretch.samples[:, self.pressure] * self.pressure_scale

    def drive_of(self, stretch: Stretch) -> FloatArray | None:
        """The drive in volts; None where it is not recorded."""
        return None if self.drive is None else stretch.samples[:, self.drive] * self.drive_scale


def find_columns(acquisition: Acquisition, pressure: str | None = None) -> Columns:
    """The named (or first) pressure channel and the drive; raises `CampaignError`."""
    channels = list(acquisition.rig.channels)
    candidates = [
        index
        for index, channel in enumerate(channels)
        if channel.quantity == "pressure" and pressure in (None, channel.name)
    ]
    if not candidates:
        raise CampaignError(
            f"rig {acquisition.rig.name!r} has no pressure channel {pressure or ''}".rstrip()
        )
    drives = [index for index, channel in enumerate(channels) if channel.name == "drive"]
    drive = drives[0] if drives else None
    return Columns(
        pressure=candidates[0],
        drive=drive,
        pressure_scale=1.0 / channels[candidates[0]].volts_per_unit,
        drive_scale=1.0 if drive is None else 1.0 / channels[drive].volts_per_unit,
    )


def look(
    acquisition: Acquisition, columns: Columns, frequency_hz: float, seconds: float
) -> Measurement:
    """Measure for `seconds` as things are."""
    stretch = acquisition.read_seconds(max(seconds, 6.0 / frequency_hz))
    return measure(
        columns.pressure_of(stretch),
        acquisition.rig.sample_rate_hz,
        frequency_hz,
        time_s=stretch.end_s,
        drive=columns.drive_of(stretch),
        overload=stretch.overload,
    )


def entrain(
    acquisition: Acquisition,
    columns: Columns,
    task: Task,
    free: FreeCycle,
    settings: Settings,
    *,
    coupling_hint: Coupling | None = None,
    law: Law | None = None,
    amplitude_v: float = 0.0,
    watch: Watch | None = None,
) -> tuple[State, Command]:
    """Bring the rig to `task`; returns the last state and the final command.

    The output keeps the last tone when the outcome is ``record``, and is silenced otherwise.
    `watch` sees every window, and may raise to break off. See `daq.entrain.begin`.
    """
    state, command = begin(
        task,
        free,
        settings,
        coupling_hint=coupling_hint,
        law=law,
        amplitude_v=amplitude_v,
    )
    while not command.final:
        acquisition.rig.drive(Tone(task.frequency_hz, command.amplitude_v))
        if command.wait_s > 0:
            acquisition.catch_up(acquisition.rig.clock.now() + command.wait_s)
        seen = look(acquisition, columns, task.frequency_hz, command.window_s)
        state, command = step(state, seen)
        if watch is not None:
            watch(state, seen)
    if command.kind == "give_up":
        acquisition.rig.silence()
    return state, command


def measure_law(
    acquisition: Acquisition, columns: Columns, free: FreeCycle, settings: Settings
) -> Law | None:
    """ν and B of the free cycle: disturb it briefly, let go, watch it return.

    The disturbance starts at the probe's drive and grows until it shows; it is a little off the
    free frequency, so that its phase cannot stay where it does nothing. None when the limit drive
    disturbs too little beside the noise.
    """
    rig = acquisition.rig
    amplitude = min(settings.probe_v, settings.limit_v)
    while True:
        rig.drive(Tone(DISTURB * free.frequency_hz, amplitude))
        acquisition.catch_up(rig.clock.now() + amplitude / settings.slew_v_per_s + DISTURB_S)
        rig.silence()
        acquisition.catch_up(rig.clock.now() + rig.limits.silence_ramp_s + SPEAKER_DECAY_S)
        pressure = columns.pressure_of(acquisition.read_seconds(GLANCE_S))
        z, _, _ = baseband(pressure, rig.sample_rate_hz, free.frequency_hz)
        departure = abs((free.amplitude / float(np.mean(np.abs(z[:3])))) ** 2 - 1)
        last = amplitude >= settings.limit_v
        law = None
        if departure > SHOWS or last:
            rest = columns.pressure_of(acquisition.read_seconds(RELAX_S - GLANCE_S))
            z, step_s, _ = baseband(
                np.concatenate([pressure, rest]), rig.sample_rate_hz, free.frequency_hz
            )
            law = law_from_relaxation(z, step_s, free.amplitude)
        if last or (law is not None and law.growth_rate_relative_sigma < 0.1):
            return law
        growth = min(max(WANTED / max(departure, 1e-3), 2.0), MOST_AT_ONCE)
        amplitude = min(growth * amplitude, settings.limit_v)


def find_release(
    acquisition: Acquisition, columns: Columns, state: State, *, ratio: float = 0.95
) -> float | None:
    """The drive at which an entrained limit cycle comes free again, on the way down.

    Lowers the drive by `ratio` a step, two windows each (the free line must have time to grow),
    down to a tenth. None when it never came free. The output is silent afterwards.
    """
    amplitude, released = state.amplitude_v, None
    while released is None and amplitude > 0.1 * state.amplitude_v:
        amplitude *= ratio
        acquisition.rig.drive(Tone(state.task.frequency_hz, amplitude))
        levels = [
            look(acquisition, columns, state.task.frequency_hz, window_of(state)) for _ in range(2)
        ]
        grows = levels[1].free_amplitude > 1.5 * levels[0].free_amplitude
        if grows or not is_entrained(state, levels[1]):
            released = amplitude
    acquisition.rig.silence()
    return released
