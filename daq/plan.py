"""What a campaign shall do: conditions, recordings, safety margins; as data, TOML or JSON.

Frequencies are absolute, or relative to the measured limit cycle; amplitudes are absolute (V), or
multiples of the threshold that the controller finds. Before a run, every frequency is moved to the
nearest one with a whole number of periods in the record (an integer bin: the thesis's advice), so
that no line leaks.
"""

import math
import random
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    PositiveFloat,
    ValidationError,
    model_validator,
)

from daq.designed import Design, DesignTable
from daq.documents import read_document
from daq.entrain import Strategy
from daq.errors import InputError
from daq.importers.folder import DeclaredModelTable, MediumTable, explain
from daq.online import Online, OnlineTable
from daq.operating import OperatingPoint, OperatingPointTable
from daq.records import Role
from daq.supervise import InterlockRule, Limit
from daq.tables import Table, Title

Order = Literal["listed", "random"]
MAX_RECORD_S = 60.0


@dataclass(frozen=True)
class Condition:
    """One frequency at one amplitude.

    Give `frequency_hz`, or `offset` relative to the free frequency (−0.02: 2 % below); and
    `amplitude_v`, or `over_threshold`, a multiple of the smallest drive that entrains.
    """

    frequency_hz: float | None = None
    offset: float | None = None
    amplitude_v: float | None = None
    over_threshold: float | None = None
    role: Role = "fit"

    def target_hz(self, free_hz: float) -> float:
        """The frequency meant, around a limit cycle at `free_hz`."""
        return self.frequency_hz if self.frequency_hz else free_hz * (1 + (self.offset or 0.0))


@dataclass(frozen=True)
class Plan:
    """A campaign, before it runs.

    `cold` conditions are recorded with the flame off, where the rig can do that. `record_s` is
    the length of a recording; `precision`, the wanted relative standard error of the forced
    line's amplitude, may make it longer, up to `MAX_RECORD_S`. `order`
    ``random`` shuffles the conditions by `seed`, so that drift does not pose as frequency
    dependence; `reference_every` n puts a free run after every n conditions. `hysteresis`: after
    each recording, lower the drive until the limit cycle comes free. `limits` are watched during
    the whole campaign, `interlock` says what follows when one opens, `max_drift` bounds the
    relative change of the free frequency. `limit_v` None: the rig's own limit. `control_channel`:
    the pressure channel that the controller looks at; None: the first. `continues`: a campaign of
    the same store and rig that this one adds to; analyses read both (`daq.continued`).
    `operating_points`: everything is done at each, one after the other (`daq.operating`).
    `design`: what the conditions were chosen for (`daq.designed`); a plan with a design and no
    conditions cannot run yet. `online`: a fit after each condition (`daq.online`).
    """

    title: str = "campaign"
    conditions: tuple[Condition, ...] = ()
    free_runs: int = 1
    cold: tuple[Condition, ...] = ()
    record_s: float = 2.0
    precision: float | None = None
    criterion_db: float = 20.0
    strategy: Strategy = "predict"
    order: Order = "listed"
    seed: int = 0
    reference_every: int = 0
    hysteresis: bool = False
    limits: tuple[Limit, ...] = ()
    interlock: InterlockRule = field(default_factory=InterlockRule)
    max_drift: float | None = None
    control_channel: str | None = None
    continues: str | None = None
    limit_v: float | None = None
    probe_v: float = 0.05
    step_v: float = 0.05
    low_hz: float = 50.0
    high_hz: float = 1000.0
    operating_points: tuple[OperatingPoint, ...] = ()
    design: Design | None = None
    online: Online | None = None
    medium: dict[str, float] = field(default_factory=dict)
    declared_model: dict[str, Any] = field(default_factory=dict)


def default_plan(title: str = "campaign", *, cold: bool = True) -> Plan:
    """Ten conditions over ±6 % at three amplitudes above threshold, three for validation."""
    offsets = (-0.055, -0.04, -0.026, -0.014, 0.008, 0.018, 0.03, 0.043, 0.056, -0.02)
    factors = (1.3, 2.0, 3.0)
    fit = [
        Condition(offset=offset, over_threshold=factors[index % 3])
        for index, offset in enumerate(offsets)
    ]
    check = [
        Condition(offset=offset, over_threshold=factor, role="validation")
        for offset, factor in ((-0.033, 2.5), (0.024, 1.6), (0.036, 2.5))
    ]
    frozen = tuple(Condition(offset=offset, amplitude_v=1.0) for offset in (-0.05, 0.0, 0.05))
    return Plan(title, (*fit, *check), cold=frozen if cold else ())


def integer_bin(frequency_hz: float, sample_rate_hz: float, record_s: float) -> tuple[float, int]:
    """The nearest frequency with a whole number of periods in a record, and its frames.

    Examples
    --------
    >>> integer_bin(171.3, 10_000.0, 2.0)
    (171.5, 20000)
    """
    frames = round(record_s * sample_rate_hz)
    periods = max(1, round(frequency_hz * frames / sample_rate_hz))
    return periods * sample_rate_hz / frames, frames


def record_seconds(plan: Plan, amplitude: float, noise: float, sample_rate_hz: float) -> float:
    """How long to record for the plan's precision.

    White noise of rms σ in n samples leaves the amplitude of a line uncertain by σ sqrt(2/n), so
    n = 2 (σ / (precision · amplitude))². Rounded up to tenths of a second, which keeps the bins on
    a grid that people can read.
    """
    if plan.precision is None or amplitude <= 0:
        return plan.record_s
    needed = 2 * (noise / (plan.precision * amplitude)) ** 2 / sample_rate_hz
    return min(max(plan.record_s, math.ceil(10 * needed) / 10), max(MAX_RECORD_S, plan.record_s))


class ConditionModel(Table):
    """A condition on the wire."""

    frequency_hz: float | None = Field(default=None, gt=0)
    offset: float | None = Field(default=None, gt=-0.9, lt=10)
    amplitude_v: float | None = Field(default=None, gt=0)
    over_threshold: float | None = Field(default=None, gt=1, le=100)
    role: Role = "fit"

    @model_validator(mode="after")
    def _one_of_each(self) -> "ConditionModel":
        if (self.frequency_hz is None) == (self.offset is None):
            raise ValueError("give frequency_hz or offset, one of them")
        if self.amplitude_v is not None and self.over_threshold is not None:
            raise ValueError("give amplitude_v or over_threshold, not both")
        return self

    def condition(self) -> Condition:
        """As the campaign uses it."""
        return Condition(**self.model_dump())


class GridModel(Table):
    """Every frequency at every amplitude, `repeats` times.

    Frequencies: `frequencies_hz`, `offsets`, or a `span` of offsets and `count`. A share of the
    conditions, drawn by the plan's seed, is kept for validation.
    """

    frequencies_hz: list[PositiveFloat] = Field(default_factory=list)
    offsets: list[float] = Field(default_factory=list)
    span: Annotated[tuple[float, float], Field(strict=False)] | None = None
    count: int = Field(default=7, ge=2, le=1000)
    over_threshold: list[Annotated[float, Field(gt=1, le=100)]] = Field(default_factory=list)
    amplitudes_v: list[PositiveFloat] = Field(default_factory=list)
    repeats: int = Field(default=1, ge=1, le=100)
    validation_share: float = Field(default=0.25, ge=0, le=0.9)

    @model_validator(mode="after")
    def _one_of_each(self) -> "GridModel":
        given = [bool(self.frequencies_hz), bool(self.offsets), self.span is not None]
        if sum(given) != 1:
            raise ValueError("give frequencies_hz, offsets or span, one of them")
        if bool(self.over_threshold) == bool(self.amplitudes_v):
            raise ValueError("give over_threshold or amplitudes_v, one of them")
        return self

    def conditions(self, seed: int) -> list[Condition]:
        """The grid's points, validation ones marked."""
        places: list[dict[str, float]] = [{"frequency_hz": f} for f in self.frequencies_hz]
        offsets = list(self.offsets)
        if self.span is not None:
            low, high = self.span
            step = (high - low) / (self.count - 1)
            offsets = [round(low + step * i, 9) for i in range(self.count)]
        places += [{"offset": offset} for offset in offsets]
        sizes: list[dict[str, float]] = [{"over_threshold": f} for f in self.over_threshold]
        sizes += [{"amplitude_v": v} for v in self.amplitudes_v]
        points = [{**place, **size} for place in places for size in sizes]
        kept = set(random.Random(seed).sample(range(len(points)), self._kept(len(points))))
        return [
            Condition(**point, role="validation" if index in kept else "fit")
            for index, point in enumerate(points)
            for _ in range(self.repeats)
        ]

    def _kept(self, points: int) -> int:
        return min(points - 1, round(self.validation_share * points))


class LimitModel(Table):
    """A limit on a channel, on the wire; see `daq.supervise.Limit`."""

    channel: str = Field(min_length=1)
    high: float | None = None
    low: float | None = None
    statistic: Literal["peak", "mean"] = "peak"
    action: Literal["suspend", "end"] = "suspend"
    hysteresis: float = Field(default=0.05, ge=0, lt=1)
    clear_s: float = Field(default=2.0, gt=0)
    wait_s: float = Field(default=600.0, gt=0)

    @model_validator(mode="after")
    def _bounded(self) -> "LimitModel":
        if self.high is None and self.low is None:
            raise ValueError("give high, low or both")
        if self.high is not None and self.low is not None and self.high <= self.low:
            raise ValueError(f"high={self.high:g} is not above low={self.low:g}")
        if self.statistic == "peak" and self.high is not None and self.high <= 0:
            raise ValueError(f"high={self.high:g} is not above zero, which no peak is below")
        return self


class InterlockTable(Table):
    """What follows when an interlock opens, on the wire; see `daq.supervise.InterlockRule`."""

    action: Literal["suspend", "end"] = "suspend"
    clear_s: float = Field(default=5.0, gt=0)
    wait_s: float = Field(default=600.0, gt=0)


class PlanModel(Table):
    """A plan on the wire: TOML files and the REST body have these keys."""

    format: Literal["campaign-plan/1"] = "campaign-plan/1"
    title: Title = "campaign"
    conditions: list[ConditionModel] = Field(default_factory=list, max_length=10_000)
    grid: GridModel | None = None
    free_runs: int = Field(default=1, ge=1, le=1000)
    cold: list[ConditionModel] = Field(default_factory=list, max_length=10_000)
    record_s: float = Field(default=2.0, ge=0.01, le=3600)
    precision: float | None = Field(default=None, ge=1e-6, lt=1)
    criterion_db: float = Field(default=20.0, ge=3, le=80)
    strategy: Strategy = "predict"
    order: Order = "listed"
    seed: int = 0
    reference_every: int = Field(default=0, ge=0)
    hysteresis: bool = False
    limits: list[LimitModel] = Field(default_factory=list, max_length=100)
    interlock: InterlockTable = InterlockTable()
    max_drift: float | None = Field(default=None, gt=0)
    control_channel: str | None = None
    continues: str | None = Field(default=None, max_length=200)
    limit_v: float | None = Field(default=None, gt=0)
    probe_v: float = Field(default=0.05, gt=0)
    step_v: float = Field(default=0.05, gt=0)
    low_hz: float = Field(default=50.0, gt=0)
    high_hz: float = Field(default=1000.0, gt=0)
    operating_points: list[OperatingPointTable] = Field(default_factory=list, max_length=1000)
    design: DesignTable | None = None
    online: OnlineTable | None = None
    medium: MediumTable = MediumTable()
    declared_model: DeclaredModelTable = DeclaredModelTable()

    @model_validator(mode="after")
    def _listed_or_designed(self) -> "PlanModel":
        if self.design is not None and {"conditions", "grid", "cold"} & self.model_fields_set:
            raise ValueError("a design chooses the conditions: leave conditions, grid and cold out")
        if self.design is not None and self.operating_points:
            raise ValueError("a design holds at one operating point: leave operating_points out")
        names = [point.name for point in self.operating_points if point.name]
        if double := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"operating_points: two of the name {double[0]!r}")
        if self.low_hz >= self.high_hz:
            raise ValueError(f"low_hz={self.low_hz:g} is not below high_hz={self.high_hz:g}")
        return self

    def plan(self) -> Plan:
        """As the campaign uses it; where neither conditions, grid nor design are given (an empty
        list is), the default plan's conditions."""
        tables = {"format", "conditions", "grid", "cold", "limits", "interlock"}
        tables |= {"operating_points", "design", "online"}
        given = self.model_fields_set
        chosen = bool({"conditions", "grid", "design"} & given)
        listed = [item.condition() for item in self.conditions]
        listed += self.grid.conditions(self.seed) if self.grid else []
        usual = default_plan()
        cold = tuple(item.condition() for item in self.cold)
        model = self.declared_model.model_dump() if "declared_model" in given else None
        return Plan(
            **self.model_dump(exclude=tables),
            conditions=tuple(listed) if chosen else usual.conditions,
            cold=cold if chosen or "cold" in given else usual.cold,
            limits=tuple(Limit(**item.model_dump()) for item in self.limits),
            interlock=InterlockRule(**self.interlock.model_dump()),
            operating_points=tuple(item.point() for item in self.operating_points),
            design=self.design.design(model) if self.design else None,
            online=self.online.online() if self.online else None,
        )


def parse_plan(content: dict[str, Any], where: str = "plan") -> Plan:
    """A plan from plain data; raises `InputError` naming the key."""
    try:
        return PlanModel.model_validate(content).plan()
    except ValidationError as error:
        raise InputError(f"{where}: {explain(error)}") from error


def read_plan(path: Path) -> Plan:
    """A plan from a `.toml` or `.json` file, or a diagnosis's `next_experiment` from its JSON.

    Raises `InputError`.
    """
    content = read_document(path)
    if content.get("format") == "diagnosis/1":
        proposed = (content.get("next_experiment") or {}).get("plan")
        if not isinstance(proposed, dict):
            raise InputError(f"{path}: this diagnosis proposes no next experiment")
        content = proposed
    return parse_plan(content, str(path))
