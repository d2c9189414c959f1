"""`entrain effects`: what a diagnosis can find, from the candidates themselves."""

from itertools import groupby
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.errors import InputError
from daq.service.commands.common import JsonOption, indented, write_json

if TYPE_CHECKING:
    from identify.effect import Effect


def effects(
    name: Annotated[str | None, typer.Argument(help="Only the effect of that name.")] = None,
    json_: JsonOption = None,
) -> None:
    """List what a diagnosis can find: effects, their forms, places and physical parameters."""
    from identify.effects import CANDIDATES

    names = list(dict.fromkeys(e.name for e in CANDIDATES))
    if name is not None and name not in names:
        raise InputError(f"name={name!r} is no effect: one of {', '.join(names)} is required")
    found = [_facts(e) for e in CANDIDATES if name in (None, e.name)]
    write_json(json_, {"effects": found})
    if str(json_) != "-":
        order = list(dict.fromkeys(f["effect"] for f in found))
        together = sorted(found, key=lambda f: order.index(f["effect"]))
        for (effect, location), forms in groupby(together, lambda f: (f["effect"], f["location"])):
            indented(f"{effect}  ({location})", 0, "bold")
            for about, alike in groupby(forms, lambda f: f["about"]):
                named, parameters = _joined(list(alike))
                indented(named, 2)
                indented(about, 6)
                indented(parameters, 6, "dim")


def _facts(effect: "Effect") -> dict[str, Any]:
    return {
        "effect": effect.name,
        "form": effect.form,
        "location": effect.location,
        "about": " ".join(effect.about.replace("`", "").split()),
        "parameters": [
            {"name": q.name.partition(".")[2], "unit": q.unit, "range": [q.lower, q.upper]}
            for q in effect.parameters
        ],
    }


def _joined(forms: list[dict[str, Any]]) -> tuple[str, str]:
    """The forms that one class has, and the parameters that any of them has, with the ranges in
    which they are plausible."""
    parameters = dict.fromkeys(_shown(q) for f in forms for q in f["parameters"])
    return ", ".join(dict.fromkeys(f["form"] for f in forms)), "; ".join(parameters)


def _shown(parameter: dict[str, Any]) -> str:
    low, high = parameter["range"]
    unit = "" if parameter["unit"] == "1" else f" {parameter['unit']}"
    held = f"{low:g} to {high:g}" if isfinite(high) else f"≥ {low:g}" if isfinite(low) else "any"
    return f"{parameter['name']}: {held}{unit}"
