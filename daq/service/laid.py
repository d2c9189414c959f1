"""Options laid over a configured rig's for one campaign: a simulated rig's seed, or its seal.

They stand in the notes of the campaign's card, so that whoever takes it up again, at the terminal
or over REST, goes on with the same plant.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from daq.errors import InputError
from daq.service.rigs import RigEntry
from daq.store import RunStore

RIG_OPTIONS = "rig_options"  # in a card's notes


def noted(options: Mapping[str, Any]) -> dict[str, Any]:
    """The notes of a card whose campaign begins with these options."""
    return {RIG_OPTIONS: dict(options)}


def over(rig: RigEntry, laid: Mapping[str, Any]) -> RigEntry:
    """The configured rig with these options laid over its own."""
    return replace(rig, options={**rig.options, **laid})


def laid_over(
    rig: RigEntry, given: Mapping[str, Any], store: RunStore, begun: str | None
) -> dict[str, Any]:
    """The options to lay over the configured rig's: those `given`, or, to go on with the campaign
    (or loop) `begun`, those that it began with.

    Raises `InputError` where what is given would make another rig of the one that it began with.
    """
    card = None if begun is None else store.card(begun)
    if card is not None and card.rig not in ("", rig.name):
        raise InputError(
            f"rig={rig.name!r}: {begun!r} began on rig {card.rig!r}, and one analysis needs "
            "one rig: leave --rig out, or begin anew"
        )
    if card is None or RIG_OPTIONS not in card.notes:
        return dict(given)
    kept = dict(card.notes[RIG_OPTIONS])
    began = over(rig, kept).options
    for key, value in given.items():
        if began.get(key) != value:
            raise InputError(
                f"{key}={value!r}: {begun!r} began with {began.get(key, 'the default')!r}, and "
                "one analysis needs one rig: leave --seed and --sealed out, or begin anew"
            )
    return kept
