"""The shapes that travel: requests and answers of the API, with examples.

Requests refuse unknown keys. Times are RFC 3339 in UTC, numbers SI with the unit in the name.
"""

import json
from datetime import UTC, datetime, timedelta
from typing import Any, Generic, Literal, TypeVar

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, model_validator

from daq.service.keys import Scope

Item = TypeVar("Item")
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Request(BaseModel):
    """What a client sends: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid")


class Answer(BaseModel):
    """What the service sends."""


class Page(Answer, Generic[Item]):
    """One page of a list; `next` is the `after` of the following page, null at the end."""

    items: list[Item]
    next: str | None = None


class Problem(Answer):
    """RFC 9457 problem details."""

    type: str = Field(examples=["/problems/scope"])
    title: str = Field(examples=["Not allowed"])
    status: int = Field(examples=[403])
    detail: str = Field(examples=["this needs a key of scope 'control'"])
    request: str | None = Field(default=None, examples=["9f86d081884c"])


class Health(Answer):
    """Whether the service is fit for work."""

    status: Literal["ok", "closing"] = Field(examples=["ok"])
    time: str = Field(examples=["2026-01-31T12:00:00.000Z"])
    uptime_s: float = Field(examples=[12.5])
    key_needed: bool = Field(examples=[False])


class Version(Answer):
    """What runs here."""

    name: Literal["entrain"] = "entrain"
    version: str = Field(examples=["0.1.0"])
    api: Literal["v1"] = "v1"
    python: str = Field(examples=["3.11.2"])


class Identity(Answer):
    """Who the key belongs to."""

    name: str = Field(examples=["control room"])
    scopes: list[str] = Field(examples=[["read", "control"]])


class Rig(Answer):
    """A configured rig and how it stands."""

    name: str = Field(examples=["simulated"])
    driver: str = Field(examples=["simulated"])
    state: Literal["idle", "running", "paused", "stopped"] = Field(examples=["idle"])
    stopped_by: str | None = Field(default=None, description="Who pressed the emergency stop")
    holder: str | None = Field(default=None, description="Who has control")
    job: str | None = Field(default=None, description="The job that runs on it")
    queued: int = Field(default=0, description="Campaigns that wait for it")
    removable: bool = Field(default=False, description="Added at run time, not configured")


class LockRequest(Request):
    """Ask for control."""

    takeover: bool = Field(default=False, description="Take it from whoever has it")


class Lock(Answer):
    """Control of a rig; send `token` as `X-Control-Token` with every command."""

    rig: str = Field(examples=["simulated"])
    holder: str = Field(examples=["control room"])
    token: str = Field(examples=["Zx3k0d9c0aW1x2"])
    seconds_left: float = Field(examples=[60.0])


class Stopped(Answer):
    """What the emergency stop reached."""

    rigs: list[str] = Field(examples=[["simulated"]])
    was_running: list[str] = Field(examples=[[]])
    confirmed: dict[str, bool] = Field(
        description="For each rig that ran: whether its silence is confirmed already"
    )


class JobSummary(Answer):
    """A job without its log and result."""

    id: str = Field(examples=["3f2a9c01d4e5"])
    kind: str = Field(examples=["diagnosis"])
    title: str = Field(examples=["Diagnose a-clean"])
    lane: str = Field(examples=["analysis"])
    owner: str = Field(examples=["control room"])
    about: dict[str, Any] = Field(examples=[{"campaign": "a-clean"}])
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"]
    progress: float = Field(examples=[0.4])
    message: str = Field(examples=["refitting with flame_delay"])
    hold: Literal["pausing", "paused"] | None = Field(
        default=None, description="A campaign that was told to pause: until its next window, since"
    )
    created: str = Field(examples=["2026-01-31T12:00:00.000Z"])
    started: str | None = None
    finished: str | None = None
    error: str | None = None


class Ticket(Answer):
    """A one-time pass for a live stream, valid for half a minute."""

    ticket: str = Field(examples=["bX9..."])
    expires_s: float = Field(examples=[30.0])


class Campaign(Answer):
    """One line of the list of campaigns."""

    id: str = Field(examples=["a-clean-62eb5f012e"])
    title: str = Field(examples=["tube combustor"])
    rig: str = Field(examples=["simulated"])
    created_at: str = Field(examples=["2026-01-31T12:00:00.000Z"])
    status: str = Field(examples=["complete"])
    verdict: str | None = Field(default=None, examples=["traced"])


class Run(Answer):
    """One line of the list of runs."""

    id: str = Field(examples=["a-clean-62eb5f012e/000-free"])
    campaign: str
    name: str = Field(examples=["000-free"])
    kind: str = Field(examples=["free"])
    role: str = Field(examples=["fit"])
    frequency_hz: float | None = None
    amplitude_v: float | None = None
    started_s: float
    started_at: str
    rig: str
    sample_rate_hz: float = Field(examples=[10000.0])
    samples: int = Field(examples=[20000])
    exit_status: str = Field(examples=["success"])
    exit_reason: str
    sha256: str
    bytes: int


class CampaignDetail(Campaign):
    """A campaign with its card and all its runs."""

    medium: dict[str, float]
    declared_model: dict[str, Any]
    source: str
    notes: dict[str, Any]
    runs: list[Run]


class Slice(Answer):
    """Frames of a run, in each channel's unit."""

    start: int
    stop: int
    sample_rate_hz: float
    channels: dict[str, list[float]]
    units: dict[str, str]


class Band(Answer):
    """Smallest and largest value in each bin."""

    min: list[float]
    max: list[float]


class Envelope(Answer):
    """A run, decimated for drawing without losing a peak."""

    start: int
    stop: int
    frames_per_bin: int
    sample_rate_hz: float
    time_s: list[float]
    channels: dict[str, Band]
    units: dict[str, str]


class Spectrum(Answer):
    """Amplitude spectrum of a run's channels."""

    start: int
    stop: int
    resolution_hz: float
    frequency_hz: list[float]
    channels: dict[str, list[float]]
    units: dict[str, str]
    forcing_hz: float | None


PLAN_EXAMPLE = {
    "title": "around the limit cycle",
    "record_s": 2.0,
    "conditions": [
        {"offset": -0.03, "over_threshold": 1.5},
        {"offset": 0.02, "over_threshold": 2.0, "role": "validation"},
    ],
}


class CampaignRequest(Request):
    """Start (or rehearse) a campaign: a rig and a plan (`campaign-plan/1`; `{}`: the default)."""

    rig: str = Field(max_length=100, examples=["simulated"])
    plan: dict[str, Any] = Field(default_factory=dict, examples=[PLAN_EXAMPLE])
    free_frequency_hz: float | None = Field(
        default=None, gt=0, description="Where relative frequencies shall be shown; dry run only"
    )


class PlannedCondition(Answer):
    """One condition of a dry run."""

    index: int
    kind: str = Field(examples=["forced"])
    role: str = Field(examples=["fit"])
    frequency_hz: float | None
    offset: float | None
    amplitude_v: float | None
    over_threshold: float | None
    seconds: float
    problem: str | None
    operating_point: dict[str, float] | None = None


class ExpectedPrecision(Answer):
    """What a plan is expected to leave of a parameter's standard error."""

    name: str = Field(examples=["mode1.frequency_hz"])
    value: float
    stderr: float
    expected_stderr: float
    unit: str


class DryRun(Answer):
    """What a campaign would do."""

    title: str
    conditions: list[PlannedCondition]
    runs: int
    rig_seconds: float
    limit_v: float
    frequency_range_hz: list[float]
    free_frequency_hz: float | None
    problems: list[str]
    expected_precision: list[ExpectedPrecision] = Field(
        default_factory=list, description="Of plans with a design, or that continue a campaign"
    )


class WatchRequest(Request):
    """Show a rig without driving it."""

    seconds: float = Field(default=30.0, gt=0, le=3600)


class SimulatedRigRequest(Request):
    """A new simulated rig. `effects`: parameters by effect, or "sealed" for one kept secret."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]{0,60}$", examples=["delayed flame"])
    preset: str = Field(default="thesis-two-mode", max_length=100)
    seed: int = Field(default=0, ge=0, le=2**31)
    effects: dict[str, dict[str, float]] | Literal["sealed"] | None = Field(
        default=None, examples=[{"flame_delay": {"delay_s": 4e-4}}]
    )
    noise_db: float | None = Field(default=None, ge=0, le=140)
    sample_rate_hz: float = Field(default=10_000.0, ge=1000, le=200_000)
    clock: Literal["virtual", "realtime"] = "virtual"
    max_amplitude_v: float | None = Field(default=None, gt=0, le=1000)


class RigOptions(Answer):
    """What simulated rigs can be made of."""

    presets: list[str]
    effects: dict[str, dict[str, Any]]


class Truth(Answer):
    """What a sealed rig carried; asking is written to the audit trail."""

    effect: str | None
    location: str | None
    parameters: dict[str, Any]


class NextExperimentRequest(Request):
    """Where to measure what a diagnosis proposes."""

    rig: str = Field(max_length=100, examples=["simulated"])


class CloseLoopBudget(Request):
    """How far a closed loop may go."""

    rounds: int = Field(default=4, ge=1, le=50, description="Campaigns", examples=[4])
    rig_minutes: float = Field(default=60.0, gt=0, le=1e5, description="Rig time", examples=[60])


class CloseLoopRequest(CloseLoopBudget):
    """Close the loop on a rig, beginning with a plan (`campaign-plan/1`; `{}`: the default)."""

    rig: str = Field(max_length=100, examples=["simulated"])
    plan: dict[str, Any] = Field(default_factory=dict, examples=[PLAN_EXAMPLE])


class CalibrationUpload(Request):
    """A calibration, `calibration/1`; its files fit as they are."""

    format: Literal["calibration/1"] = "calibration/1"
    subject: str = Field(
        min_length=1,
        max_length=100,
        description="Serial number of the microphone, or the channel's name",
        examples=["SN4711"],
    )
    method: Literal["pistonphone", "exchange", "skew", "response"] = Field(examples=["pistonphone"])
    value: float = Field(allow_inf_nan=False, examples=[0.0498])
    uncertainty: float = Field(ge=0, allow_inf_nan=False, examples=[0.011])
    unit: str = Field(max_length=20, examples=["V/Pa"])
    at: AwareDatetime | None = Field(default=None, description="RFC 3339; absent: now")
    reference: str = Field(default="", max_length=500, examples=["calibrator 4231, certificate 9"])
    valid_days: float = Field(default=365.0, gt=0, le=1e5)
    data: dict[str, Any] = Field(default_factory=dict, description="Curves and circumstances")

    @model_validator(mode="after")
    def _plain(self) -> "CalibrationUpload":
        if self.at is not None and not EPOCH <= self.at <= datetime.now(UTC) + timedelta(days=1):
            raise ValueError(f"at={self.at} is not a time since {EPOCH.year} that has been")
        # Raises where the values are no JSON, or the text is none that a file can hold.
        content = self.model_dump(mode="python", exclude={"at"})
        json.dumps(content, allow_nan=False, ensure_ascii=False).encode()
        return self


class Calibration(Answer):
    """A calibration on file; the newest of a subject and method is in force."""

    id: str = Field(examples=["sn4711-pistonphone-2026-01-31T120000Z"])
    format: Literal["calibration/1"] = "calibration/1"
    subject: str = Field(examples=["SN4711"])
    method: str = Field(examples=["pistonphone"])
    value: float = Field(examples=[0.0498])
    uncertainty: float = Field(examples=[0.011])
    unit: str = Field(examples=["V/Pa"])
    at: str = Field(examples=["2026-01-31T12:00:00Z"])
    reference: str
    valid_days: float
    stale: bool = Field(description="Older than `valid_days`")
    data: dict[str, Any]


class ChannelCalibration(Answer):
    """What a campaign would use for one channel if it began now."""

    channel: str = Field(examples=["p1"])
    volts_per_unit: float = Field(examples=[0.0498])
    unit: str = Field(examples=["Pa"])
    skew_s: float = Field(examples=[0.0])
    in_force: dict[str, str] = Field(
        description="Ids of the calibrations used, by method; without one the nominal value holds",
        examples=[{"pistonphone": "sn4711-pistonphone-2026-01-31T120000Z"}],
    )


class RigCalibration(Answer):
    """The calibrations that apply to a rig's channels, and what is missing or stale."""

    channels: list[ChannelCalibration]
    remarks: list[str] = Field(examples=[["p2: no calibration of 'p2', nominal value used"]])


class KeyRequest(Request):
    """A new API key."""

    name: str = Field(min_length=1, max_length=100, examples=["control room"])
    scopes: list[Scope] = Field(min_length=1, max_length=4, examples=[["read", "control"]])
    expires_days: float | None = Field(
        default=365.0, gt=0, le=36_500, description="null: never", examples=[30]
    )


class Key(Answer):
    """An API key without its secret."""

    id: str = Field(examples=["9f86d081"])
    name: str = Field(examples=["control room"])
    scopes: list[str] = Field(examples=[["read", "control"]])
    created: str
    expires: str | None
    state: Literal["active", "expired", "revoked"]


class NewKey(Key):
    """A key with its text, shown this once."""

    key: str = Field(examples=["ent_9f86d081_..."])


class Device(Answer):
    """A device, or a family that cannot be searched (`missing` says what to install)."""

    family: str = Field(examples=["sound card"])
    name: str = Field(examples=["HDA Intel PCH: ALC257"])
    address: str = ""
    capabilities: dict[str, str] = Field(default_factory=dict)
    missing: str | None = None
