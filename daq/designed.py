"""`[design]`: conditions that are not listed but chosen, for what they are expected to tell.

A design needs to know the rig: `campaign` is a recorded one, whose fit says what is known already.
Aim ``precision`` takes the D-optimal conditions on the declared model (the plan's own table, else
the campaign's); ``discrimination`` those that tell rivals apart: `rivals`, by the names that a
diagnosis uses (``declared`` is the model as declared), or, where none are named, those that a
diagnosis of the campaign leaves. The choice is identification's work, so that the service makes
it (`daq.service.designing`) before a campaign begins; the plan that is run, and kept, holds the
conditions.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from daq.tables import Table

Aim = Literal["precision", "discrimination"]


@dataclass(frozen=True)
class Design:
    """What to choose conditions for; `model` is the plan's declared model where it has one."""

    campaign: str
    aim: Aim = "precision"
    rivals: tuple[str, ...] = ()
    runs: int = 10
    minutes: float | None = None
    model: dict[str, Any] | None = None


class DesignTable(Table):
    """A design on the wire."""

    campaign: str = Field(min_length=1, max_length=200, description="A campaign of the run store")
    aim: Aim = "precision"
    rivals: list[Annotated[str, Field(min_length=1, max_length=100)]] = Field(
        default_factory=list, max_length=6
    )
    runs: int = Field(default=10, ge=1, le=100, description="At most so many conditions")
    minutes: float | None = Field(default=None, gt=0, description="At most so much rig time")

    @model_validator(mode="after")
    def _fitting(self) -> "DesignTable":
        if self.rivals and self.aim != "discrimination":
            raise ValueError("rivals belong to aim = 'discrimination'")
        if len(self.rivals) == 1:
            raise ValueError("name at least two rivals, or none: a diagnosis then finds them")
        if len(set(self.rivals)) < len(self.rivals):
            raise ValueError("rivals are named twice")
        return self

    def design(self, model: dict[str, Any] | None) -> Design:
        """As the service uses it."""
        given = self.model_dump()
        return Design(**{**given, "rivals": tuple(given["rivals"])}, model=model)
