"""The base of every table in a plan: unknown keys and NaN are refused."""

from pydantic import BaseModel, ConfigDict


class Table(BaseModel):
    """A table of a plan, in TOML or JSON."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
