"""Carries a campaign's items out, one after the other, and survives what befalls them.

What ends an item early is an `Interruption` (`daq.supervise`): a skip leaves it out, a pause or a
limit repeats it when all is well again, a stop or a lost limit cycle ends the campaign, which can
be resumed. Everything else (a device that is gone, a full disk) goes up to the caller, with the
output silenced and the journal telling why.
"""

import contextlib
import math
from dataclasses import asdict
from typing import Any

from daq.calibration.book import CalibrationBook
from daq.calibration.skew import tolerable_skew
from daq.conduct import Columns, entrain, find_columns, find_release, look, measure_law
from daq.continued import begins_at_s
from daq.coupling import Coupling
from daq.entrain import Command, Settings, State, Task
from daq.errors import CampaignError, DaqError
from daq.events import (
    CampaignResult,
    Control,
    Event,
    FlameSwitch,
    OnEvent,
    Reviewer,
)
from daq.journal import Journal, read_journal
from daq.lockin import HARMONICS, FreeCycle, Measurement, free_cycle
from daq.plan import Condition, Plan, integer_bin, record_seconds
from daq.recorder import Recorder
from daq.records import RunSummary
from daq.schedule import Item, Outcome, elapsed, expand, finished_items, first_free
from daq.store import RunStore
from daq.supervise import (
    InterlockTripped,
    LimitCycleLost,
    LimitExceeded,
    Paused,
    SkipRequested,
    StopRequested,
    Supervisor,
    end_asked,
)
from daq.tongue import Law
from daq.two_microphones import validity
from daq.vigil import Vigil
from drivers.errors import InterlockOpen, SettingError
from drivers.protocols import DuplexRig, Operable
from drivers.types import Tone

INTERRUPTIONS = 20  # repeats of one item after pauses and limits, before it is left out
IGNITION_S = 3.0
FREE_LOOKS = 30  # seconds in which the limit cycle must come to stand


class Runner:
    """One campaign on its way: what must be remembered from item to item."""

    def __init__(
        self,
        rig: DuplexRig,
        plan: Plan,
        store: RunStore,
        campaign: str,
        journal: Journal,
        on_event: OnEvent | None,
        control: Control | None,
        review: Reviewer | None,
    ) -> None:
        self.rig = rig
        self.plan = plan
        self.store = store
        self.campaign = campaign
        self.journal = journal
        self.on_event = on_event
        self.control = control
        self.review = review
        self.before = read_journal(journal.path)
        self.begun_s = rig.clock.now()
        gone = elapsed(self.before) or begins_at_s(plan, store.card(campaign), store)
        self.started_s = self.begun_s - gone
        supervisor = Supervisor(plan.limits, list(rig.channels))
        self.vigil = Vigil(rig, supervisor, plan.interlock, control)
        self.acquisition = self.vigil.acquisition
        self.columns: Columns = find_columns(self.acquisition, plan.control_channel)
        book = CalibrationBook(store.root / "calibrations")
        self.calibration = book.apply(list(rig.channels))
        self.recorder = Recorder(
            self.acquisition,
            store,
            campaign,
            self.calibration,
            self.started_s,
            self.settings().limit_v,
            self.checkpoint,
        )
        self.free: FreeCycle | None = None
        self.reference = first_free(self.before)
        self.law: Law | None = None
        self.couplings: dict[int, Coupling] = {}  # κ by the side of the tongue
        self.point: int | None = None  # the operating point at which the rig is
        self.point_notes: dict[str, Any] = {}
        self.dead_points: dict[int, str] = {}  # those without a limit cycle, and what was seen
        self.drive_v = 0.0
        self.outcomes: list[Outcome] = []

    # the course of things

    def run(self) -> CampaignResult:
        """All items that are not done yet."""
        items = expand(self.plan)
        done = finished_items(self.before, self.store.campaign_runs(self.campaign))
        self.outcomes = list(done.values())
        started = {
            "items": len(items),
            "done": sorted(done),
            "rig": self.rig.name,
            "calibration": self.calibration[2],
        }
        self.emit("started", None, started)
        self.rig.start()
        status, reason = "complete", ""
        try:
            for item in items:
                if item.index not in done and self.perform(item):
                    reason = "the wanted precision is reached"
                    break
        except (StopRequested, LimitExceeded, InterlockTripped, LimitCycleLost) as stop:
            status, reason = "stopped", str(stop) or "stopped on request"
        except InterlockOpen:
            # an emergency stop that people gave can fall between two windows
            asked = None if self.control is None else end_asked(self.control)
            if asked is None:
                raise
            status, reason = "stopped", asked
        finally:
            self.rig.stop()
        self.emit("finished", None, {"status": status, "reason": reason})
        self.store.set_status(self.campaign, status=status)
        return CampaignResult(
            id=self.campaign,
            directory=self.store.campaign_dir(self.campaign),
            status=status,
            reason=reason,
            free=self.free,
            outcomes=tuple(sorted(self.outcomes, key=lambda outcome: outcome.index)),
            rig_seconds=self.rig.clock.now() - self.begun_s,
        )

    def give_way(self, error: BaseException) -> None:
        """Note why the campaign broke off; never hides `error` behind another."""
        self.rig.silence()
        with contextlib.suppress(DaqError):
            reason = f"{type(error).__name__}: {error}"
            if isinstance(error, KeyboardInterrupt):
                reason = "interrupted at the keyboard"
            self.emit("failed", None, {"reason": reason})
        with contextlib.suppress(DaqError):
            self.store.set_status(self.campaign, status="failed")

    def perform(self, item: Item) -> bool:
        """One item, whatever becomes of it; whether the campaign has seen enough."""
        outcome = None
        for _ in range(INTERRUPTIONS):
            try:
                self.checkpoint()
                outcome = self.attempt(item)
                break
            except SkipRequested:
                outcome = Outcome(item.index, item.kind, "skipped", "on request")
                self.quiet()
                break
            except Paused:
                self.suspended(item, "paused")
                self.quiet()
            except LimitCycleLost as lost:
                if item.point is None:
                    raise
                self.dead_points[item.point] = str(lost)
                outcome = Outcome(item.index, item.kind, "limit_cycle_lost", str(lost))
                self.quiet()
                break
            except LimitExceeded as exceeded:
                self.suspended(item, str(exceeded))
                self.vigil.until_clear(exceeded)
                self.free = None  # the next attempt looks at the limit cycle anew
            except (InterlockTripped, InterlockOpen) as opened:
                if reason := self.vigil.tripped():
                    self.suspended(item, reason)
                self.vigil.until_closed(opened)
                self.free = None
        if outcome is None:
            reason = f"interrupted {INTERRUPTIONS} times"
            outcome = Outcome(item.index, item.kind, "skipped", reason)
        return self.conclude(outcome)

    def conclude(self, outcome: Outcome) -> bool:
        """Journal an outcome, show it to the reviewer."""
        self.outcomes.append(outcome)
        kind = "recorded" if outcome.run is not None else "not_entrained"
        if outcome.status == "skipped":
            kind = "skipped"
        self.emit(kind, outcome.index, asdict(outcome))
        if self.review is None or not outcome.good:
            return False
        self.quiet()  # a fit may take long; the speaker does not wait for it
        found = self.review(self.store.campaign_dir(self.campaign), outcome)
        self.acquisition.catch_up(self.rig.clock.now())  # what was sampled meanwhile is old
        if found is None:
            return False
        self.emit("review", outcome.index, found.data)
        return found.enough

    def attempt(self, item: Item) -> Outcome:
        """One try at an item."""
        if item.point is not None:
            if item.point in self.dead_points:
                raise LimitCycleLost(self.dead_points[item.point])
            self.go_to_point(item.point)
        if item.kind == "free":
            return self.free_run(item)
        if item.condition is None:
            raise CampaignError(f"item {item.index}: a {item.kind} run needs a condition")
        task = self.task(item.condition)
        if item.kind == "cold":
            return self.cold_run(item, task)
        return self.forced_run(item, item.condition, task)

    def go_to_point(self, index: int) -> None:
        """Set an operating point and wait; what was known of the limit cycle is of another one."""
        if index == self.point or not isinstance(self.rig, Operable):
            return
        self.quiet()
        self.point = None  # until it is reached: an interruption on the way starts anew
        wanted = self.plan.operating_points[index]
        reached = dict(self.rig.operate(wanted.set))
        self.free, self.law, self.couplings = None, None, {}
        self.reference = first_free(self.before, index)
        end = self.rig.clock.now() + wanted.settle_s
        while (left := end - self.rig.clock.now()) > 0:
            self.checkpoint()
            self.acquisition.read_seconds(max(min(left, 0.5), 0.01))
        self.point = index
        self.point_notes = {"point": index, "name": wanted.name, **reached}
        self.emit("operating_point", None, self.point_notes)

    # the kinds of items

    def free_run(self, item: Item) -> Outcome:
        """Silence, the limit cycle's own frequency, a recording."""
        free = self.measure_free()
        run = self.record(item, None, 0.0, {"free": asdict(free)})
        return Outcome(item.index, "free", run.exit_status, run.exit_reason, run.name)

    def forced_run(self, item: Item, condition: Condition, task: Task) -> Outcome:
        """Entrain, record; a condition that cannot be entrained is an outcome like any other."""
        free = self.current_free()
        law = self.current_law()
        side = 1 if task.frequency_hz > free.frequency_hz else -1
        self.emit("condition", item.index, {**asdict(task), "role": condition.role})
        try:
            state, command = entrain(
                self.acquisition,
                self.columns,
                task,
                free,
                self.settings(),
                coupling_hint=self.couplings.get(side, self.couplings.get(-side)),
                law=law,
                amplitude_v=self.drive_v,
                watch=lambda state, seen: self.watch(item.index, state, seen),
            )
        except SettingError as error:
            self.quiet()
            return Outcome(
                item.index, "forced", "refused", str(error), frequency_hz=task.frequency_hz
            )
        if state.coupling is not None and state.threshold_v is not None:
            self.couplings[side] = state.coupling
        if command.kind == "give_up":
            self.quiet()
            return _outcome(item, state, command.outcome, command.reason)
        return self.record_forced(item, state, command)

    def record_forced(self, item: Item, state: State, command: Command) -> Outcome:
        """The entrained condition, with what the controller found in the run's notes."""
        self.drive_v = command.amplitude_v
        seen = _seen(state)
        notes = {
            "threshold_v": state.threshold_v,
            "threshold_sigma_v": state.threshold_sigma_v,
            "suppression_db": seen["suppression_db"],
            "forced_amplitude": seen["amplitude"],
            "forced_phase_deg": seen["phase_deg"],
            "windows": state.windows,
            "remark": command.reason,
        }
        self.emit("entrained", item.index, seen)
        if command.reason:
            self.emit("remark", item.index, {"reason": command.reason})
        run = self.record(item, state.task.frequency_hz, command.amplitude_v, notes)
        status = "entrained" if run.exit_status == "success" else run.exit_status
        release = None
        if self.plan.hysteresis:
            release = find_release(self.acquisition, self.columns, state)
            self.quiet()
        return _outcome(item, state, status, run.exit_reason, run.name, release)

    def cold_run(self, item: Item, task: Task) -> Outcome:
        """Flame off, drive on: the acoustics and the speaker alone."""
        if not isinstance(self.rig, FlameSwitch):
            return Outcome(item.index, "cold", "skipped", "this rig cannot put its flame out")
        limit = self.settings().limit_v
        amplitude = min(task.amplitude_v or limit / 4, limit)
        self.emit("condition", item.index, {**asdict(task), "cold": True})
        self.rig.flame_off()
        try:
            self.rig.drive(Tone(task.frequency_hz, amplitude))
            self.drive_v = amplitude
            self.settle_cold(task.frequency_hz)
            run = self.record(item, task.frequency_hz, amplitude, {})
        finally:
            self.rig.silence()
            self.rig.flame_on()
        self.quiet()
        self.acquisition.catch_up(self.rig.clock.now() + IGNITION_S)
        return Outcome(
            index=item.index,
            kind="cold",
            status=run.exit_status,
            reason=run.exit_reason,
            run=run.name,
            frequency_hz=task.frequency_hz,
            amplitude_v=amplitude,
        )

    def settle_cold(self, frequency_hz: float) -> None:
        """Wait until the forced line of a driven, stable rig changes no more."""
        settings = self.settings()
        for _ in range(settings.max_settle_windows):
            seen = look(self.acquisition, self.columns, frequency_hz, 0.25)
            self.checkpoint()
            tolerance = max(4 * seen.free_sigma, settings.settle * seen.amplitude)
            if seen.change * seen.amplitude <= tolerance and seen.free_amplitude <= tolerance:
                return

    # the limit cycle

    def measure_free(self) -> FreeCycle:
        """Silence the drive and wait until the limit cycle stands.

        Raises `CampaignError` when there is none to begin with, `LimitCycleLost` when it is gone,
        `StopRequested` when it has drifted farther than the plan allows.
        """
        self.quiet()
        previous: FreeCycle | None = None
        for _ in range(FREE_LOOKS):
            self.checkpoint()
            stretch = self.acquisition.read_seconds(1.0)
            found = free_cycle(
                self.columns.pressure_of(stretch),
                self.rig.sample_rate_hz,
                low_hz=self.plan.low_hz,
                high_hz=self.plan.high_hz,
            )
            if found.amplitude > 3 * found.noise and _steady(found, previous):
                break
            previous = found
        else:
            self.no_limit_cycle(found)
        first_look = self.free is None
        self.free = found
        self.reference = self.reference or found
        self.emit("free", None, asdict(found))
        if first_look:
            self.remark(found)
        self.require_no_drift(found)
        return found

    def no_limit_cycle(self, found: FreeCycle) -> None:
        """Say so: at the start an error, later an outcome."""
        message = (
            f"rig {self.rig.name!r} shows no steady limit cycle between {self.plan.low_hz:g} and "
            f"{self.plan.high_hz:g} Hz within {FREE_LOOKS} s (strongest line "
            f"{found.frequency_hz:.2f} Hz, {found.amplitude:.3g}, noise {found.noise:.3g})"
        )
        if self.reference is not None or self.point is not None:
            raise LimitCycleLost(f"limit cycle lost: {message}")
        raise CampaignError(
            f"{message}: light it, change the operating point, or widen low_hz and high_hz"
        )

    def require_no_drift(self, found: FreeCycle) -> None:
        """The watch-dog on the free frequency."""
        if self.reference is None or self.plan.max_drift is None:
            return
        drift = found.frequency_hz / self.reference.frequency_hz - 1
        if abs(drift) > self.plan.max_drift:
            raise StopRequested(
                f"the free frequency drifted by {100 * drift:+.2f} % to {found.frequency_hz:.2f} "
                f"Hz, more than the {100 * self.plan.max_drift:g} % allowed"
            )

    def current_free(self) -> FreeCycle:
        """The limit cycle as last measured."""
        return self.free if self.free is not None else self.measure_free()

    def current_law(self) -> Law | None:
        """ν and B, measured once, before the first forced condition that is to be predicted."""
        if self.law is None and self.plan.strategy == "predict":
            free = self.current_free()
            self.quiet()
            self.law = measure_law(self.acquisition, self.columns, free, self.settings()) or Law()
            self.emit("law", None, asdict(self.law))
        return self.law

    def record(
        self, item: Item, frequency_hz: float | None, amplitude_v: float, notes: dict[str, Any]
    ) -> RunSummary:
        """A recording, with the operating point it was made at."""
        here = {"operating_point": self.point_notes} if self.point_notes else {}
        return self.recorder.record(
            item, frequency_hz, amplitude_v, self.record_s, {**here, **notes}
        )

    # interruptions

    def checkpoint(self) -> None:
        """Where pause, skip and stop take effect.

        `control` may have blocked meanwhile (a pause): then the drive was silenced, and what the
        device has buffered is old. Both make the item start anew.
        """
        if self.control is None:
            return
        self.control()
        if self.drive_v > 0 and self.rig.status().output_v < 0.5 * self.drive_v:
            self.acquisition.catch_up(self.rig.clock.now())
            raise Paused

    def suspended(self, item: Item, reason: str) -> None:
        """Silent, and known to be."""
        self.rig.silence()
        self.drive_v = 0.0
        self.emit("suspended", item.index, {"kind": item.kind, "reason": reason})

    # small things

    def task(self, condition: Condition) -> Task:
        """A condition in hertz: the integer bin nearest to what is meant."""
        anchor = self.reference or self.current_free()
        frequency, _ = integer_bin(
            condition.target_hz(anchor.frequency_hz), self.rig.sample_rate_hz, self.record_s
        )
        return Task(frequency, condition.amplitude_v, condition.over_threshold or 1.5)

    @property
    def record_s(self) -> float:
        """The plan's, or what its precision needs at the noise of the first free run."""
        if self.reference is None:
            return self.plan.record_s
        first = self.reference
        return record_seconds(self.plan, first.amplitude, first.noise, self.rig.sample_rate_hz)

    def remark(self, found: FreeCycle) -> None:
        """What about this rig will cost precision, said once, before anything is recorded."""
        pressures = [
            (channel, skew)
            for channel, skew in zip(self.calibration[0], self.calibration[1], strict=True)
            if channel.quantity == "pressure" and channel.position_m is not None
        ]
        if len(pressures) < 2:
            return
        (first, early), (second, late) = pressures[:2]
        places = (first.position_m or 0.0, second.position_m or 0.0)
        speed = self.plan.medium.get("sound_speed_m_s", 343.0)
        said = [validity(*places, found.frequency_hz, HARMONICS, speed).remark]
        skew = abs(late - early)
        tolerable = tolerable_skew(abs(places[1] - places[0]), speed)
        if skew > tolerable:
            said.append(
                f"{second.name} is sampled {skew * 1e6:.1f} µs off {first.name}: more than the "
                f"{tolerable * 1e6:.1f} µs that cost 1 % of the velocity; corrected at analysis"
            )
        for text in (*self.calibration[2], *said):
            if text:
                self.emit("remark", None, {"reason": text})

    def settings(self) -> Settings:
        """The controller's settings for this rig: its limits, or narrower ones of the plan."""
        limits = self.rig.limits
        return Settings(
            limit_v=min(self.plan.limit_v or limits.max_amplitude_v, limits.max_amplitude_v),
            criterion_db=self.plan.criterion_db,
            strategy=self.plan.strategy,
            probe_v=self.plan.probe_v,
            step_v=self.plan.step_v,
            slew_v_per_s=limits.max_slew_v_per_s,
        )

    def quiet(self) -> None:
        """Drive off, and the ramp's time gone by."""
        self.rig.silence()
        self.drive_v = 0.0
        self.acquisition.catch_up(self.rig.clock.now() + self.rig.limits.silence_ramp_s + 0.03)

    def watch(self, index: int, state: State, seen: Measurement) -> None:
        """Show a window; `seen` is the state's last."""
        self.drive_v = state.last_drive_v
        wanted = {"frequency_hz": seen.frequency_hz, "criterion_db": self.plan.criterion_db}
        self.emit("window", index, {**_seen(state), **wanted})
        self.checkpoint()

    def emit(self, kind: str, index: int | None, data: dict[str, Any]) -> None:
        """To the journal (windows excepted) and to whoever listens."""
        now = self.rig.clock.now() - self.started_s
        if kind != "window":
            self.journal.write(kind, {"time_s": now, "index": index, "data": data})
        if self.on_event is not None:
            self.on_event(Event(kind, now, index, data))


def _steady(found: FreeCycle, previous: FreeCycle | None) -> bool:
    if previous is None:
        return False
    same_size = abs(found.amplitude / previous.amplitude - 1) < 0.01 + 4 * found.amplitude_sigma
    return same_size and abs(found.frequency_hz - previous.frequency_hz) < 0.2


def _seen(state: State) -> dict[str, Any]:
    """The last window in plain numbers."""
    seen = state.last
    if seen is None:
        raise CampaignError(f"nothing was measured at {state.task.frequency_hz:g} Hz")
    return {
        "drive_v": state.last_drive_v,
        "amplitude": seen.amplitude,
        "suppression_db": state.free.suppression_db(seen.free_amplitude),
        "phase_deg": math.degrees(math.atan2(seen.forced.imag, seen.forced.real)),
        "phase": state.phase,
        "threshold_v": state.threshold_v,
        "threshold_sigma_v": state.threshold_sigma_v,
    }


def _outcome(
    item: Item,
    state: State,
    status: str,
    reason: str,
    run: str | None = None,
    release_v: float | None = None,
) -> Outcome:
    return Outcome(
        index=item.index,
        kind=item.kind,
        status=status,
        reason=reason,
        run=run,
        frequency_hz=state.task.frequency_hz,
        amplitude_v=state.amplitude_v,
        threshold_v=state.threshold_v,
        threshold_sigma_v=state.threshold_sigma_v,
        suppression_db=_seen(state)["suppression_db"],
        release_v=release_v,
    )
