"""A model declared in TOML: what the loop is made of, without a line of code.

    format = "model/1"
    modes = 2

    [flame]                      # order: first-order low-passes in series; delay: of its own
    order = 1
    delay = true

    [nonlinearity]               # polynomial (degree), lagrange (nodes, in m), saturation, linear
    form = "polynomial"
    degree = 3

    [actuator]                   # elements: further pieces at that place of the loop, «name:form»
    elements = ["actuator_dynamics:resonance"]

    [sensor]
    elements = ["channel_mismatch:gain"]

Every table may be left out; `[forward]`, `[flame]`, `[nonlinearity]` and `[experiment]` take
elements too. Elements are the effects of `identify.effects`: what a diagnosis can find lacking can
be declared from the start.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from identify.effect import Effect
from identify.effects import CATALOGUE
from identify.record import DeclaredModel
from identify.structure import NONLINEARITIES, Structure

FORMAT = "model/1"
PLACES = ("forward", "flame", "nonlinearity", "actuator", "sensor", "experiment")
_OWN = {"flame": ("order", "delay"), "nonlinearity": ("form", "degree", "nodes")}
_FLAMES = {0: "none", 1: "first_order_lowpass", 2: "second_order_lowpass"}


class ModelError(ValueError):
    """A declared model cannot be understood: names file, key, value and what is required."""


def read_model(path: Path | str) -> Structure:
    """The structure that a TOML file declares.

    Raises
    ------
    ModelError : no such file, not TOML, an unknown key, or a value that does not fit.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "model.toml"
    ...     _ = file.write_text('format = "model/1"\\nmodes = 1\\n[flame]\\ndelay = true\\n')
    ...     read_model(file).parameters.names[-4:]
    ('flame.pole_hz', 'flame.delay_s', 'nonlinearity.c2', 'nonlinearity.c3')
    """
    file = Path(path)
    try:
        content = tomllib.loads(file.read_text("utf-8-sig"))
    except OSError as error:
        raise ModelError(f"{file}: cannot be read ({error.strerror}); give a model file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ModelError(f"{file}: not TOML: {error}") from error
    try:
        return structure_of(content)
    except ValueError as error:
        raise ModelError(f"{file}: {error}") from error


def structure_of(content: Mapping[str, Any]) -> Structure:
    """The structure of a parsed declaration; raises ValueError naming key, value, requirement."""
    if content.get("format") != FORMAT:
        raise ValueError(f"format={content.get('format')!r} is not {FORMAT!r}")
    _known("", content, ("format", "modes", *PLACES))
    tables = {place: _table(content, place) for place in PLACES}
    for place, table in tables.items():
        _known(f"{place}.", table, (*_OWN.get(place, ()), "elements"))
    flame, shape = tables["flame"], tables["nonlinearity"]
    form = shape.get("form", "polynomial")
    if form not in NONLINEARITIES:
        raise ValueError(f"nonlinearity.form={form!r} is not one of {list(NONLINEARITIES)}")
    for key, owner in (("degree", "polynomial"), ("nodes", "lagrange")):
        if key in shape and form != owner:
            raise ValueError(
                f"nonlinearity.{key}={shape[key]!r} belongs to form = {owner!r}, not {form!r}: "
                f"leave it out"
            )
    modes = _integer("modes", content.get("modes", 2), 1)
    elements = tuple(e for place in PLACES for e in _elements(place, tables[place], modes))
    names = [p.name for e in elements for p in e.parameters]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(
            f"elements {[e.key for e in elements]} share parameters {twice}: declare one of them"
        )
    return Structure(
        mode_count=modes,
        flame_order=_integer("flame.order", flame.get("order", 1), 0),
        flame_delay=_boolean("flame.delay", flame.get("delay", False)),
        nonlinearity=form,
        degree=_integer("nonlinearity.degree", shape.get("degree", 3), 1),
        nodes=_nodes(shape.get("nodes", [])) if form == "lagrange" else (),
        effects=elements,
    )


def described(structure: Structure) -> DeclaredModel:
    """The same in the words of a campaign's declared model, for results and reports."""
    word = _FLAMES.get(structure.flame_order, "first_order_lowpass")
    options: dict[str, Any] = {}
    if structure.flame_order not in _FLAMES:
        options["flame_order"] = structure.flame_order
    if structure.nodes:
        options["nodes"] = list(structure.nodes)
    if structure.effects:
        options["elements"] = [e.key for e in structure.effects]
    return DeclaredModel(
        modes=structure.mode_count,
        flame=f"{word}_with_delay" if structure.flame_delay else word,
        nonlinearity=structure.nonlinearity,
        nonlinearity_degree=structure.degree,
        options=options,
    )


def _known(before: str, table: Mapping[str, Any], keys: tuple[str, ...]) -> None:
    unknown = [k for k in table if k not in keys]
    if unknown:
        raise ValueError(
            f"unknown key {before}{unknown[0]}={table[unknown[0]]!r}; known are {list(keys)}"
        )


def _table(content: Mapping[str, Any], place: str) -> Mapping[str, Any]:
    table = content.get(place, {})
    if not isinstance(table, Mapping):
        raise ValueError(f"{place}={table!r} is not a table; write it under [{place}]")
    return table


def _elements(place: str, table: Mapping[str, Any], modes: int) -> list[Effect]:
    keys = table.get("elements", [])
    here = [e for e in CATALOGUE if e.location == place and e.mode_count in (None, modes)]
    if not isinstance(keys, list):
        raise ValueError(f"{place}.elements={keys!r} is not a list of «name:form»")
    found = []
    for key in keys:
        fitting = [e for e in here if key in (e.key, e.name)]
        if not fitting:
            raise ValueError(f"{place}.elements: {key!r} is not one of {[e.key for e in here]}")
        found.append(fitting[0])
    return found


def _integer(key: str, value: Any, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{key}={value!r} is not an integer >= {least}")
    return value


def _boolean(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{key}={value!r} is not true or false")
    return value


def _nodes(value: Any) -> tuple[float, ...]:
    good = isinstance(value, list) and all(
        isinstance(x, (int, float)) and not isinstance(x, bool) and x != 0 for x in value
    )
    if not good or len(set(value)) < 2 or len(set(value)) < len(value):
        raise ValueError(
            f"nonlinearity.nodes={value!r} are not at least two different numbers other than zero "
            "(flame inputs in m, Eq. 3.22)"
        )
    return tuple(float(x) for x in value)
