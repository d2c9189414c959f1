"""Candidate effects: what a declared model may lack, one file a location of the loop.

`CATALOGUE` lists every form of every effect in the order of `formats.md`. To add one, subclass
`identify.effect.Effect` (parameters, starting values, and the one hook that it changes) and
append it to the list of its file.
"""

from identify.effect import Effect
from identify.effects import actuator, experiment, flame, forward, nonlinearity, sensor
from identify.effects.scatter import SCATTERS

CATALOGUE: tuple[Effect, ...] = (
    *forward.EFFECTS,
    *flame.EFFECTS,
    *nonlinearity.EFFECTS,
    *actuator.EFFECTS,
    *sensor.EFFECTS,
    *experiment.EFFECTS,
)

#: All that a diagnosis considers: the catalogue, and what has a spread instead of values.
CANDIDATES: tuple[Effect, ...] = (*CATALOGUE, *SCATTERS)

NAMES: tuple[str, ...] = tuple(dict.fromkeys(e.name for e in CATALOGUE))


def by_key(key: str) -> Effect:
    """The effect of that key, ``name`` or ``name:form``.

    Raises
    ------
    KeyError : no effect has that name or form; the message lists those there are.
    """
    for effect in CATALOGUE:
        if key in (effect.key, effect.name):
            return effect
    raise KeyError(f"effect={key!r} is not one of {[e.key for e in CATALOGUE]}")


__all__ = ["CANDIDATES", "CATALOGUE", "NAMES", "by_key"]
