"""The whole loop on a simulated rig that carries an effect which the declared model lacks.

The effect is drawn from a seed and sealed: the rig has it in its physics, and nothing downstream
(campaign, store, identification, report) gets to see it. Only when the verdict stands is the seal
opened, so that anybody can compare.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.campaign import CampaignResult, Event, run_campaign
from daq.plan import default_plan
from daq.service.analysis_work import steps_in
from daq.store import RunStore
from identify.load import load_campaign
from identify.record import Campaign
from identify.results import Diagnosis
from simulated_rig import SealedEffect, build_rig, seal


@dataclass(frozen=True)
class Recorded:
    """A campaign on the demonstration's rig; `sealed` stays shut until the verdict is out."""

    result: CampaignResult
    sealed: SealedEffect


def record(
    seed: int, folder: Path, on_event: Callable[[Event], None], preset: str = "thesis-two-mode"
) -> Recorded:
    """Run the default campaign, on a rig with the effect that `seed` draws, into `folder`."""
    sealed = seal(seed)
    store = RunStore(folder / "store")
    try:
        with build_rig(preset, seed=seed, effects=sealed) as rig:
            plan = default_plan(f"demonstration, seed {seed}", cold=False)
            return Recorded(run_campaign(rig, plan, store, on_event), sealed)
    finally:
        store.close()


def load(recorded: Recorded) -> Campaign:
    """The recordings as identification sees them."""
    return load_campaign(recorded.result.directory)


def report(
    folder: Path, recorded: Recorded, campaign: Campaign, found: Diagnosis, truth: dict[str, Any]
) -> Path:
    """Write the HTML report with the controller's steps and, at its end, the sealed truth."""
    from identify.report import write_html

    steps = steps_in(recorded.result.directory)
    return write_html(folder / "report.html", found, campaign, steps, truth)
