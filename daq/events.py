"""What a campaign tells, what it is told, and what it comes to."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from daq.lockin import FreeCycle
from daq.schedule import Outcome


@runtime_checkable
class SelfDescribing(Protocol):
    """A rig that has something to say in each run's notes (a decimation filter, say)."""

    def run_notes(self) -> dict[str, Any]: ...


@runtime_checkable
class FlameSwitch(Protocol):
    """A rig whose flame can be put out and lit again."""

    def flame_off(self) -> None: ...

    def flame_on(self) -> None: ...


@dataclass(frozen=True)
class Event:
    """Something that happened; `data` is plain and goes into the journal as it is.

    kinds: ``started`` ``operating_point`` ``free`` ``law`` ``condition`` ``window`` ``entrained``
    ``recorded`` ``not_entrained`` ``skipped`` ``suspended`` ``remark`` ``review`` ``failed``
    ``finished``.
    ``window`` comes with every look of the controller (and is not journalled): ``frequency_hz``,
    ``drive_v``, ``amplitude``, ``suppression_db``, ``phase_deg``, ``phase``, ``threshold_v``.
    """

    kind: str
    time_s: float
    index: int | None = None
    data: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Review:
    """What a look at the data so far says; `enough` ends the campaign."""

    data: dict[str, Any]
    enough: bool = False


@dataclass(frozen=True)
class CampaignResult:
    """What a campaign came to; `status` is ``complete`` or ``stopped``."""

    id: str
    directory: Path
    status: str
    reason: str
    free: FreeCycle | None
    outcomes: tuple[Outcome, ...]
    rig_seconds: float


OnEvent = Callable[[Event], None]
Control = Callable[[], None]
Reviewer = Callable[[Path, Outcome], Review | None]
