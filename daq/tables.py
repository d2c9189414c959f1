"""The base of every table in a plan: unknown keys, other types and NaN are refused."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

MAX_TITLE = 200
#: What people call something: one line of text.
Title = Annotated[str, Field(max_length=MAX_TITLE, pattern=r"^[^\x00-\x1f\x7f]*$")]


class Table(BaseModel):
    """A table of a plan, in TOML or JSON."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
