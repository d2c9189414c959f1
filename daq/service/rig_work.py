"""What runs in a rig's own process: campaigns, and watching without driving.

The emergency stop and the service's end reach this process on the command thread and go straight
to the driver; pause, resume, skip and stop take effect at the campaign's next window.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from daq.campaign import (
    CampaignResult,
    Event,
    Reviewer,
    SkipRequested,
    StopRequested,
    expand,
    load_plan,
    run_campaign,
)
from daq.plan import Plan, parse_plan
from daq.service.jobs import Cancelled, Link
from daq.service.laid import laid_over, noted, over
from daq.service.observed import observe
from daq.service.rigs import RigEntry, open_rig
from daq.store import RunStore
from drivers.protocols import DuplexRig, EmergencyStop


class Helm:
    """What the service has asked for, and the campaign's way to heed it."""

    def __init__(self, link: Link, rig: DuplexRig) -> None:
        self._rig = rig
        self._link = link
        self._paused = threading.Event()
        self._skip = threading.Event()
        self._end: str | None = None
        self._turned = threading.Event()
        link.on("pause", self._on_pause)
        link.on("resume", self._on_resume)
        link.on("skip", self._on_skip)
        link.on("stop", self._on_stop)
        link.on("emergency_stop", self._on_emergency_stop)
        link.on("lost", self._on_lost)

    def heed(self) -> None:
        """Block while paused; raise `StopRequested` or `SkipRequested` when asked for."""
        if self._paused.is_set() and self._end is None:
            self._rig.silence()
            # Also a pause that is taken back at once must be seen: by the silence.
            self._rig.clock.sleep(self._rig.limits.silence_ramp_s + 0.05)
            self._link.log("paused: the speaker is silent")
            self._link.hold("paused")
            while self._paused.is_set() and self._end is None and not self._skip.is_set():
                self._turned.wait(0.2)
                self._turned.clear()
            self._link.hold(None)
            self._link.log("the pause is over")
        if self._end is not None:
            raise StopRequested(self._end)
        if self._skip.is_set():
            self._skip.clear()
            raise SkipRequested

    def _on_pause(self, body: dict[str, Any]) -> None:
        self._paused.set()
        self._link.hold("pausing")

    def _on_resume(self, body: dict[str, Any]) -> None:
        self._paused.clear()
        self._link.hold(None)
        self._turned.set()

    def _on_skip(self, body: dict[str, Any]) -> None:
        self._skip.set()
        self._turned.set()

    def _on_stop(self, body: dict[str, Any]) -> None:
        self._end = str(body.get("reason") or "stopped on request")
        self._rig.silence()
        self._turned.set()

    def _on_emergency_stop(self, body: dict[str, Any]) -> None:
        reason = f"emergency stop by {body.get('who', 'unknown')}"
        if isinstance(self._rig, EmergencyStop):
            self._rig.emergency_stop(reason)
        else:
            self._rig.silence()
        self._end = reason
        self._turned.set()

    def _on_lost(self, body: dict[str, Any]) -> None:
        self._rig.silence()
        self._end = "the service is gone"
        self._turned.set()

    @property
    def ended(self) -> str | None:
        return self._end


def campaign(
    link: Link,
    rig: dict[str, Any],
    store: str,
    plan: dict[str, Any],
    campaign_id: str = "",
    resume: bool = False,
) -> dict[str, Any]:
    """Run (or go on with) a campaign on `rig`; returns what it came to, raises where it was
    stopped."""
    runs = RunStore(Path(store))
    with contextlib.closing(runs):
        wanted = _plan(plan, runs, campaign_id if resume else None, link.progress)
        entry = RigEntry(**rig)
        laid = laid_over(entry, {}, runs, campaign_id if resume else None)
        device = open_rig(over(entry, laid))
        with observe(device, link.event) as watched:
            helm = Helm(link, device)
            teller = _Teller(link, wanted)
            result = run_campaign(
                watched,
                wanted,
                runs,
                teller.tell,
                control=helm.heed,
                review=reviewer_of(wanted),
                campaign=campaign_id if resume else None,
                campaign_id="" if resume else campaign_id,
                notes=noted(laid),
            )
    if result.status == "stopped":
        raise Cancelled(result.reason, summary(result))
    return summary(result)


def reviewer_of(plan: Plan) -> Reviewer | None:
    """The plan's online fit; loads identification only where there is one."""
    if plan.online is None:
        return None
    from daq.service.online import reviewer

    return reviewer(plan)


def _plan(
    plan: dict[str, Any],
    runs: RunStore,
    campaign: str | None,
    progress: Callable[[float, str], None],
) -> Plan:
    if campaign is not None:
        return load_plan(runs.campaign_dir(campaign) / "plan.json")
    wanted = parse_plan(plan)
    if wanted.design is None:
        return wanted
    from daq.service.designing import resolved

    # Before the rig is opened: a fit takes a while.
    return resolved(wanted, runs, lambda share, text: progress(0.0, f"design: {text}"))


def summary(result: CampaignResult) -> dict[str, Any]:
    """A campaign's result as plain data."""
    return {
        "campaign": result.id,
        "status": result.status,
        "reason": result.reason,
        "free": asdict(result.free) if result.free else None,
        "outcomes": [asdict(outcome) for outcome in result.outcomes],
        "rig_seconds": result.rig_seconds,
    }


class _Teller:
    """Passes a campaign's events on, with progress in conditions done."""

    def __init__(self, link: Link, plan: Plan) -> None:
        self._link = link
        self._total = max(1, len(expand(plan)))
        self._done = 0

    def tell(self, event: Event) -> None:
        data = {"kind": event.kind, "index": event.index, "time_s": event.time_s}
        self._link.event("campaign", {**data, "data": event.data}, None)
        if event.kind == "started":
            self._done = len(event.data.get("done", ()))
        if event.kind in ("recorded", "not_entrained", "skipped"):
            self._done += 1
        if event.kind == "window":
            return
        text = describe(event)
        self._link.progress(self._done / self._total, text)
        self._link.log(text)


def describe(event: Event) -> str:
    """One line for people."""
    data = event.data
    where = "" if event.index is None else f"condition {event.index}: "
    if data.get("kind") in ("free", "cold"):  # kinds of runs; all others are forced
        where = f"{data['kind']} run: "
    if event.kind == "free":
        return f"free run: {data['frequency_hz']:.2f} Hz, amplitude {data['amplitude']:.4g} Pa"
    if event.kind == "review":
        return f"{where}{_reviewed(data)}"
    if event.kind == "operating_point":
        reached = ", ".join(
            f"{key} {value:.4g}" for key, value in data.items() if key not in ("point", "name")
        )
        return f"operating point {data['point']} {data['name']}".rstrip() + f": {reached}"
    if event.kind == "condition":
        return f"{where}going to {data['frequency_hz']:.2f} Hz"
    if event.kind == "entrained":
        return (
            f"{where}entrained with {data['drive_v']:.3g} V, "
            f"limit cycle {data['suppression_db']:.1f} dB"
        )
    if event.kind in ("recorded", "not_entrained", "skipped"):
        reason = f" ({data['reason']})" if data.get("reason") else ""
        good = data["status"] in ("success", "entrained")
        return f"{where}{'recorded' if good else data['status'].replace('_', ' ')}{reason}"
    if event.kind == "suspended" and data["reason"] == "paused":
        return f"{where}from its beginning, after the pause"
    if event.kind == "law":
        return (
            f"the limit cycle grows at {data['growth_rate_per_s']:.3g} 1/s and turns "
            f"{data['twist_per_s']:.3g} rad/s faster when small: thresholds are predicted from "
            "these"
        )
    reason = f": {data['reason']}" if data.get("reason") else ""
    return f"{where}{event.kind}{reason}"


def _reviewed(data: dict[str, Any]) -> str:
    """What the fit so far leaves open: the least known parameter, or the least known wanted one."""
    if not data.get("converged") or "relative_error" not in data:
        return f"fit after {data.get('runs', 0)} runs: {data.get('reason') or 'not converged'}"
    errors = data["missing"] or data["relative_error"]
    name = max(errors, key=lambda key: errors[key] if errors[key] is not None else float("inf"))
    worst = "undetermined" if errors[name] is None else f"± {100 * errors[name]:.2g} %"
    missing = f", {len(data['missing'])} not precise enough" if data["missing"] else ""
    return (
        f"fit after {data['runs']} runs: χ²/dof {data['chi2_per_dof']:.3g}, "
        f"least known {name} {worst}{missing}"
    )


def watch(link: Link, rig: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Show a rig for `seconds` without driving it."""
    device = open_rig(RigEntry(**rig))
    helm_over = time.monotonic() + seconds
    with observe(device, link.event) as watched:
        helm = Helm(link, device)
        watched.start()
        frames = max(1, round(0.05 * watched.sample_rate_hz))
        while helm.ended is None and (left := helm_over - time.monotonic()) > 0:
            started = time.monotonic()
            watched.read(frames)
            link.progress(1 - left / seconds, "watching")
            # A rig with a virtual clock must not run ahead of those who watch.
            time.sleep(max(0.0, 0.05 - (time.monotonic() - started)))
        status = watched.status()
        watched.stop()
    return {"frames": status.frames, "lost_frames": status.lost_frames, "ended": helm.ended}
