"""Short questions about rigs, asked in a process aside: limits, options, what was sealed."""

from dataclasses import asdict, dataclass, field, fields
from typing import Any

from daq.service.rigs import RigEntry, open_rig
from drivers.protocols import operating_ranges
from drivers.types import Channel, OutputLimits
from simulated_rig import EFFECTS, PRESETS, make_effect, seal


@dataclass(frozen=True)
class RigFacts:
    """What a rig is, without running it."""

    channels: tuple[Channel, ...]
    sample_rate_hz: float
    limits: OutputLimits
    operating: dict[str, tuple[float, float]] = field(default_factory=dict)


def facts(entry: RigEntry) -> RigFacts:
    """Open the rig, look, close it; raises what `open_rig` raises."""
    with open_rig(entry) as rig:
        return RigFacts(
            tuple(rig.channels), rig.sample_rate_hz, rig.limits, dict(operating_ranges(rig))
        )


def simulated_options() -> dict[str, Any]:
    """Presets and effects that simulated rigs can be made of."""
    return {
        "presets": list(PRESETS),
        "effects": {
            key: {
                "location": effect.location,
                "about": " ".join((effect.__doc__ or "").split()),
                "parameters": {f.name: dict(f.metadata) for f in fields(effect)},
            }
            for key, effect in EFFECTS.items()
        },
    }


def truth(options: dict[str, Any]) -> dict[str, Any]:
    """The effect that a simulated rig of these options carries."""
    effects = options.get("effects")
    if effects == "sealed":
        return dict(seal(int(options.get("seed", 0))).reveal())
    if not effects:
        return {"effect": None, "location": None, "parameters": {}}
    key, parameters = next(iter(effects.items()))
    made = make_effect(key, parameters)
    return {"effect": made.name, "location": made.location, "parameters": made.parameters()}


def shown(found: RigFacts) -> dict[str, Any]:
    """Facts as plain data."""
    return asdict(found)


def devices() -> list[dict[str, Any]]:
    """What `drivers.discovery.discover` finds, as plain data."""
    from drivers.discovery import discover

    return [asdict(device) for device in discover()]
