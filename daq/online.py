"""`[online]`: the fit is updated while a campaign goes on, and may end it early.

After each condition that brought a usable run the declared model is fitted anew by the service
(`daq.service.online`), in silence, and shown as a ``review`` event, journalled. `relative_error`
(of every parameter) or `wanted` (of some, by name) is the precision that is enough; without either
the fit is only shown.
"""

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from daq.tables import Table


@dataclass(frozen=True)
class Online:
    """What is enough: standard errors relative to the values; `after_runs` forced runs at least,
    and a look after every `every` runs."""

    relative_error: float | None = None
    wanted: dict[str, float] = field(default_factory=dict)
    after_runs: int = 5
    every: int = 1


class OnlineTable(Table):
    """The same on the wire."""

    relative_error: float | None = Field(default=None, ge=1e-6)
    wanted: dict[str, Annotated[float, Field(ge=1e-6)]] = Field(
        default_factory=dict, max_length=100
    )
    after_runs: int = Field(default=5, ge=1, le=10_000)
    every: int = Field(default=1, ge=1, le=1000)

    def online(self) -> Online:
        """As the service uses it."""
        return Online(**self.model_dump())
