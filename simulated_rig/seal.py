"""An effect drawn from a seed and kept from everybody until it is revealed."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from simulated_rig.config import RigConfig
from simulated_rig.effects import EFFECTS, Effect

# Those that every campaign of the declared two-mode kind can show: drawn for `seal`.
SEALED: tuple[str, ...] = (
    "flame_delay",
    "actuator_dynamics/resonance",
    "actuator_dynamics/voice_coil",
    "acoustic_mode",
    "channel_mismatch/skew",
    "channel_mismatch/gain",
    "parameter_drift/frequency",
)


class SealedEffect:
    """Knows what it did to the rig; says so only when asked to `reveal`."""

    def __init__(self, effects: Sequence[Effect]) -> None:
        self.__effects = tuple(effects)

    def apply(self, config: RigConfig) -> RigConfig:
        """The rig with the effects in it."""
        for effect in self.__effects:
            config = effect.apply(config)
        return config

    def reveal(self) -> dict[str, object]:
        """The truth: `effect`, `location`, `parameters` of the first, and `all` of them."""
        told = [
            {
                "effect": e.name,
                "variant": e.variant,
                "location": e.location,
                "parameters": e.parameters(),
            }
            for e in self.__effects
        ]
        if not told:
            return {"effect": None, "location": None, "parameters": {}, "all": []}
        return {**told[0], "all": told}

    def write_key(self, path: Path) -> Path:
        """Write what `reveal` tells as JSON (``answer-key/1``), apart from the campaign; `path`.

        Raises
        ------
        ValueError
            When `path` lies in a campaign's folder: whoever reads the campaign would read the key.
        """
        for folder in path.resolve().parents:
            if any((folder / name).exists() for name in ("campaign.toml", "campaign.json")):
                raise ValueError(f"path={str(path)!r} is in the campaign {folder}: put it apart")
        key = {"format": "answer-key/1", **self.reveal()}
        path.write_text(json.dumps(key, indent=2) + "\n", encoding="utf-8")
        return path

    def __repr__(self) -> str:
        return "SealedEffect(...)"


def seal(
    seed: int, among: Sequence[str] = SEALED, count: int = 1, size: float | None = None
) -> SealedEffect:
    """Draw `count` different effects from `seed`.

    `size` 0…1 fixes how gross they are; left out, it is drawn from the clearly visible upper half.

    Raises
    ------
    ValueError
        For a key in `among` that is not in `EFFECTS`.
    """
    unknown = [key for key in among if key not in EFFECTS]
    if unknown:
        raise ValueError(f"among={unknown!r} are not among the effects {sorted(EFFECTS)}")
    rng = np.random.default_rng([seed, 0x5EA1])
    keys = rng.choice(np.array(among), size=count, replace=False)
    at = [float(rng.uniform(0.5, 0.9)) if size is None else size for _ in keys]
    return SealedEffect([EFFECTS[str(k)].draw(rng, s) for k, s in zip(keys, at, strict=True)])
