"""The entrainment controller: a pure function from what was measured to what to do next.

    state, command = begin(task, free)
    while command is not final:
        ... carry the command out, measure ...
        state, command = step(state, measurement)

``approach``: raise the drive until the limit cycle's own line has dropped by the criterion.
Strategy *predict* computes the drive from the forced line's amplitude by the Stuart–Landau law
(`daq.tongue`), goes there at once and verifies; a prediction that fails twice falls back to
*step*, the thesis's way: raise, wait, look, raise. ``settle``: hold until neither a second line
nor a change of the forced one stands out of the noise, then record. Nothing here reads a clock
or a device; the thin loop is `daq.conduct`.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

from daq.coupling import (
    Coupling,
    Point,
    decay_of,
    from_drift,
    from_forced_line,
    when_suppressed,
)
from daq.lockin import FreeCycle, Measurement
from daq.tongue import Law

Strategy = Literal["predict", "step"]
Outcome = Literal[
    "entrained",
    "not_entrained",
    "beating",
    "another_mode",
    "subharmonic",
    "overload",
    "timeout",
]

UNKNOWN = Law()
WEAK = 0.15  # relative level below which a free line's decay is linear
# Error of ln level in the first window at a drive, where not only the slowest part dies, and of
# windows shorter than a turn of the free line, whose level depends on its phase.
UNSURE = 0.3
RISE = 1.5  # of the free line: it was not dying before; less is noise
OFF_TARGET = 0.05  # relative error of the wanted multiple of the threshold that is worth a word
CLEAR = 5  # standard errors that a falling line must stand out by for its rate to be read


@dataclass(frozen=True)
class Settings:
    """How to entrain. Times in seconds, amplitudes in volts at the drive.

    `criterion_db`: how far the free line must fall. `margin`: least multiple of the predicted
    threshold to drive at. `settle`: relative size below which a second line no longer matters.
    `step_v` and `dwell_s`: the stepping strategy's. `limit_v`: never beyond.
    """

    limit_v: float
    criterion_db: float = 20.0
    strategy: Strategy = "predict"
    margin: float = 1.25
    probe_v: float = 0.05
    step_v: float = 0.05
    dwell_s: float = 0.5
    settle: float = 2e-4
    min_window_s: float = 0.2
    max_window_s: float = 1.0
    max_windows: int = 120
    max_settle_windows: int = 40
    slew_v_per_s: float = 20.0


@dataclass(frozen=True)
class Task:
    """One condition to reach: a frequency, and an absolute drive or a multiple of the threshold."""

    frequency_hz: float
    amplitude_v: float | None = None
    over_threshold: float = 1.5


@dataclass(frozen=True)
class Command:
    """What to do next: drive at `amplitude_v`, let `wait_s` pass, measure `window_s`.

    `kind` ``record`` and ``give_up`` are final; `outcome` then says how the condition stands.
    """

    kind: Literal["measure", "record", "give_up"]
    amplitude_v: float
    wait_s: float = 0.0
    window_s: float = 0.0
    outcome: Outcome = "entrained"
    reason: str = ""

    @property
    def final(self) -> bool:
        return self.kind != "measure"


@dataclass(frozen=True)
class State:
    """What the controller knows while it works on one condition.

    `coupling` is κ as last estimated, `hint` what a condition nearby handed on; `law` are ν and B.
    `level` is the free line's amplitude in the window before at the same drive (None just after a
    change), `fall` its course there: time, ln of the level and the standard error of that.
    `failures` counts predictions that did not hold.
    """

    task: Task
    free: FreeCycle
    settings: Settings
    phase: Literal["approach", "settle"] = "approach"
    amplitude_v: float = 0.0
    coupling: Coupling | None = None
    hint: Coupling | None = None
    law: Law = UNKNOWN
    fall: tuple[Point, ...] = ()
    level: float | None = None
    failures: int = 0
    windows: int = 0
    settle_windows: int = 0
    aimed: bool = False
    threshold_v: float | None = None
    threshold_sigma_v: float | None = None
    last: Measurement | None = None
    last_drive_v: float = 0.0  # the drive that `last` was measured at

    @property
    def detuning_rad_s(self) -> float:
        """Δω = ω0 − ω."""
        return 2 * math.pi * (self.free.frequency_hz - self.task.frequency_hz)


def begin(
    task: Task,
    free: FreeCycle,
    settings: Settings,
    *,
    coupling_hint: Coupling | None = None,
    law: Law | None = None,
    amplitude_v: float = 0.0,
) -> tuple[State, Command]:
    """The first command: the wanted drive, the predicted one, or a probe.

    `coupling_hint` is κ from a condition nearby, `amplitude_v` the drive at which the output is.
    """
    hint = coupling_hint and coupling_hint.at(task.frequency_hz)
    state = State(
        task,
        free,
        settings,
        amplitude_v=amplitude_v,
        coupling=hint,
        hint=hint,
        law=law or UNKNOWN,
    )
    if task.amplitude_v is not None:
        return _drive(state, task.amplitude_v)
    if settings.strategy == "step":
        return _drive(state, settings.step_v)
    predicted = predicted_threshold(state)
    if predicted is None:
        return _drive(state, settings.probe_v)
    return _drive(state, _wanted(state, predicted))


def step(state: State, seen: Measurement) -> tuple[State, Command]:
    """What to do after a window; the old state is not changed."""
    state = replace(state, windows=state.windows + 1, last=seen, last_drive_v=state.amplitude_v)
    state = _learn(state, seen)
    if seen.overload:
        return state, _end(state, "overload", "a channel reached its converter's full scale")
    if state.windows >= state.settings.max_windows:
        return state, _end(state, "timeout", f"not settled after {state.windows} windows")
    met = is_entrained(state, seen)
    if state.phase == "settle" and met:
        return _settle(state, seen)
    if met:
        return _entrained(state, seen)
    state = replace(state, phase="approach", settle_windows=0)
    return _approach(state, seen)


def is_entrained(state: State, seen: Measurement) -> bool:
    """The free line is below the criterion, two standard errors included; the phase stays; and no
    line elsewhere has come up instead."""
    allowed = allowed_level(state)
    level = seen.free_amplitude + 2 * seen.free_sigma
    bounded = seen.phase_span_rad < math.pi / 2 and seen.amplitude > level
    return bounded and level <= allowed and seen.other_amplitude <= allowed


def allowed_level(state: State) -> float:
    """The amplitude that the criterion leaves to any line but the forcing's own."""
    return state.free.amplitude * 10 ** (-state.settings.criterion_db / 20)


def predicted_threshold(state: State) -> float | None:
    """The drive at the edge of the tongue, from κ, ν and B; None while κ is unknown."""
    if state.coupling is None:
        return None
    return state.law.threshold(state.detuning_rad_s) / state.coupling.per_s_per_v


def threshold_sigma(state: State) -> float | None:
    """Relative standard error of `predicted_threshold`: κ's, and through the law those of ν and of
    the free frequency, which counts next to the limit cycle."""
    if state.coupling is None:
        return None
    law, detuning = state.law, state.detuning_rad_s
    edge = law.threshold(detuning)
    moved = law.threshold(detuning + 2 * math.pi * state.free.frequency_sigma_hz)
    other = law.faster(1 + min(law.growth_rate_relative_sigma, 1.0)).threshold(detuning)
    return math.hypot(state.coupling.sigma, moved / edge - 1, other / edge - 1)


def _learn(state: State, seen: Measurement) -> State:
    """κ from what this window shows of both lines, beside what is known from a neighbour."""
    if seen.amplitude <= 3 * seen.free_sigma or state.amplitude_v <= 0:
        return state
    state = replace(state, fall=_fallen(state, seen))
    return replace(state, coupling=_coupling(state, seen))


def _coupling(state: State, seen: Measurement) -> Coupling:
    law, detuning, frequency = state.law, state.detuning_rad_s, state.task.frequency_hz
    forced = seen.amplitude / state.free.amplitude
    free = min(seen.free_amplitude / state.free.amplitude, 1.0)
    if law.near(detuning) and free > 0.3 and abs(seen.drift_rad_s) > 0.1 * abs(detuning):
        found = from_drift(law, state.amplitude_v, seen.drift_rad_s, detuning, frequency)
        if found is not None:
            return found.joined(state.hint)
    if free < WEAK:
        decay = decay_of(state.fall)
        settled = when_suppressed(
            law, state.amplitude_v, forced, detuning, decay, state.hint, frequency
        )
        if settled is not None:
            return settled
    direct = from_forced_line(law, state.amplitude_v, forced, free, detuning, frequency)
    return direct.joined(state.hint)


def _fallen(state: State, seen: Measurement) -> tuple[Point, ...]:
    """The course of the free line, with this window where it is weak, and clear of the noise."""
    level = seen.free_amplitude
    weak = seen.free_sigma < level / CLEAR and level < WEAK * state.free.amplitude
    if not weak or seen.change > 0.05:
        return state.fall
    slow = abs(state.detuning_rad_s) * seen.window_s < 0.95 * 2 * math.pi
    doubt = UNSURE if slow or state.level is None else 0.0
    here = (seen.time_s, math.log(level), seen.free_sigma / level + 0.02 + doubt)
    rise = here[1] - state.fall[-1][1] if state.fall else math.inf
    if rise > math.log(RISE):
        return (here,)
    return (*state.fall, here) if rise < 0 else state.fall


def _approach(state: State, seen: Measurement) -> tuple[State, Command]:
    settings = state.settings
    level = seen.free_amplitude
    falling = state.level is not None and level < 0.9 * state.level
    if falling or (state.level is None and settings.strategy == "predict" and _enough(state)):
        return _hold(replace(state, level=level))
    if state.task.amplitude_v is not None:
        if state.level is None:
            return _hold(replace(state, level=level))
        return state, _end(state, *_name(state, seen))
    if state.amplitude_v >= settings.limit_v * (1 - 1e-9):
        if state.level is None:
            return _hold(replace(state, level=level))
        return state, _end(state, *_name(state, seen))
    if settings.strategy == "step" or state.failures >= 2:
        return _drive(state, state.amplitude_v + _stride(state))
    predicted = predicted_threshold(state)
    if predicted is None:
        return _drive(state, 2 * state.amplitude_v)
    if _enough(state):
        return _drive(replace(state, failures=state.failures + 1), 1.25 * state.amplitude_v)
    return _drive(state, max(_wanted(state, predicted), 1.1 * state.amplitude_v))


def _entrained(state: State, seen: Measurement) -> tuple[State, Command]:
    """The criterion is met: note the threshold, move to the wanted drive once, then settle."""
    found = predicted_threshold(state)
    state = _noted(state)
    if state.task.amplitude_v is None and not state.aimed and found is not None:
        state = replace(state, aimed=True)
        wanted = min(_wanted(state, found), state.settings.limit_v)
        if abs(wanted / state.amplitude_v - 1) > 0.1:
            return _drive(state, wanted)
    return _settle(replace(state, phase="settle"), seen)


def _noted(state: State) -> State:
    """With the threshold as now known."""
    found, sigma = predicted_threshold(state), threshold_sigma(state)
    if found is None or sigma is None:
        return state
    return replace(state, threshold_v=found, threshold_sigma_v=sigma * found)


def _settle(state: State, seen: Measurement) -> tuple[State, Command]:
    """Hold until what turns or changes beside the forced line is noise."""
    tolerance = state.settings.settle * seen.amplitude
    # A falling line inflates its own standard error, so it counts as noise only once it has
    # stopped falling.
    stays = state.level is not None and seen.free_amplitude > 0.7 * state.level
    quiet = seen.free_amplitude <= tolerance or (
        stays and seen.free_amplitude <= 4 * seen.free_sigma
    )
    steady = seen.change * seen.amplitude <= max(4 * seen.free_sigma, tolerance)
    state = replace(
        _noted(state), settle_windows=state.settle_windows + 1, level=seen.free_amplitude
    )
    restless = not (quiet and steady)
    if restless and state.settle_windows < state.settings.max_settle_windows:
        return _hold(state)
    said = [*(["noise or drift did not settle"] if restless else []), *off_target(state)]
    return state, Command("record", state.amplitude_v, reason="; ".join(said))


def off_target(state: State) -> list[str]:
    """What there is to say of a drive that is not the multiple of the threshold that was asked for:
    it was set by what was known then, or is all that the output may give."""
    aimed = state.settings.strategy == "predict" and state.task.amplitude_v is None
    if not aimed or state.threshold_v is None:
        return []
    asked = max(state.task.over_threshold, state.settings.margin)
    found = state.amplitude_v / state.threshold_v
    if abs(found / asked - 1) <= OFF_TARGET:
        return []
    limit = " (the output's limit)" if state.amplitude_v >= state.settings.limit_v else ""
    return [
        f"the drive of {state.amplitude_v:.3g} V{limit} is {found:.3g} times the threshold as now "
        f"known; {asked:.3g} were asked for"
    ]


def _enough(state: State) -> bool:
    """The drive is where the law says that the free line dies."""
    predicted = predicted_threshold(state)
    return predicted is not None and state.amplitude_v >= 1.1 * predicted


def _wanted(state: State, predicted: float) -> float:
    return max(state.task.over_threshold, state.settings.margin) * predicted


def _stride(state: State) -> float:
    return max(state.settings.step_v, 0.1 * state.amplitude_v if state.failures >= 2 else 0.0)


def _drive(state: State, amplitude_v: float) -> tuple[State, Command]:
    """Change the drive; levels seen before no longer count."""
    settings = state.settings
    amplitude = min(amplitude_v, settings.limit_v)
    wait = abs(amplitude - state.amplitude_v) / settings.slew_v_per_s + 0.02
    if settings.strategy == "step":
        wait += settings.dwell_s
    state = replace(state, amplitude_v=amplitude, level=None, fall=())
    return state, Command("measure", amplitude, wait, window_of(state))


def _hold(state: State) -> tuple[State, Command]:
    return state, Command("measure", state.amplitude_v, 0.0, window_of(state))


def window_of(state: State) -> float:
    """Long enough for one beat of the free line against the forcing, within the bounds set."""
    beat = 2 * math.pi / max(abs(state.detuning_rad_s), 1e-9)
    return min(max(beat, state.settings.min_window_s), state.settings.max_window_s)


def _end(state: State, outcome: Outcome, reason: str) -> Command:
    return Command("give_up", 0.0, outcome=outcome, reason=reason)


def _name(state: State, seen: Measurement) -> tuple[Outcome, str]:
    """What kind of failure it is."""
    if seen.other_amplitude > allowed_level(state) >= seen.free_amplitude:
        return _name_other(state, seen)
    level = state.free.suppression_db(seen.free_amplitude)
    offset = seen.free_offset_hz + state.task.frequency_hz
    where = (
        f"at {state.amplitude_v:.3g} V the line at {offset:.2f} Hz is {level:+.1f} dB "
        f"to the free level, not {-state.settings.criterion_db:+.1f} dB"
    )
    if seen.amplitude > 0.3 * seen.free_amplitude:
        return "beating", f"{where}: two lines beat (quasi-periodic)"
    return "not_entrained", where


def _name_other(state: State, seen: Measurement) -> tuple[Outcome, str]:
    """The limit cycle is suppressed, but something else sounds."""
    level = state.free.suppression_db(seen.other_amplitude)
    what = (
        f"at {state.amplitude_v:.3g} V the limit cycle is suppressed, but a line at "
        f"{seen.other_hz:.2f} Hz stands {level:+.1f} dB to the free level"
    )
    ratio = seen.other_hz / state.task.frequency_hz
    for parts in (2, 3):
        if abs(ratio * parts - round(ratio * parts)) * state.task.frequency_hz < 2 / seen.window_s:
            return "subharmonic", f"{what}: {round(ratio * parts)}/{parts} of the forcing"
    return "another_mode", what
