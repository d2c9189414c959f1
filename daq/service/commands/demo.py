"""`entrain demo`: from a simulated rig to the verdict, and only then the sealed truth."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from daq.service import LONGEST_SEARCH_S
from daq.service.commands.analysis import ProcessesOption, progress_bar, show_diagnosis
from daq.service.commands.common import folder_to_be, number, out, write_json


def demo(
    seed: Annotated[int, typer.Option(min=0, help="Draws the effect, and all noise.")] = 0,
    folder: Annotated[
        Path,
        typer.Option(
            "--out", help="Where runs, report.html and diagnosis.json go.", callback=folder_to_be
        ),
    ] = Path("entrain-demo"),
    processes: ProcessesOption = 0,
) -> None:
    """Entrain a simulated rig, find what its declared model lacks, then open the sealed truth."""
    started = time.monotonic()
    out.print(
        f"A simulated tube combustor carries something that the declared model lacks "
        f"(seed {seed}); what it is stays sealed until the verdict.",
        markup=False,
    )
    from daq.plan import default_plan
    from daq.service import demo as pipeline
    from daq.service.commands.rig import CampaignView
    from identify.diagnosis import diagnose
    from identify.executor import executor

    with CampaignView(default_plan(cold=False)) as view:
        recorded = pipeline.record(seed, folder, view.tell)
    campaign = pipeline.load(recorded)
    out.print(f"stored {len(campaign.runs)} runs in {recorded.result.directory}", markup=False)
    with executor(processes) as workers, progress_bar(quiet=False) as tell:
        found = diagnose(campaign, progress=tell, executor=workers, within_s=LONGEST_SEARCH_S)
    show_diagnosis(found)
    truth = recorded.sealed.reveal()
    show_truth(truth)
    write_json(folder / "diagnosis.json", found.to_json())
    recorded.sealed.write_key(folder / "answer-key.json")
    path = pipeline.report(folder, recorded, campaign, found, truth)
    seconds = time.monotonic() - started
    out.print(f"wrote {path} and {folder / 'diagnosis.json'} ({seconds:.0f} s)", markup=False)


def show_truth(truth: dict[str, Any]) -> None:
    """Print what was sealed."""
    told = ", ".join(
        f"{name} = {number(p['value'], 6)} {p['unit']}" for name, p in truth["parameters"].items()
    )
    out.print(f"sealed truth: {truth['effect']} at {truth['location']}: {told}", markup=False)
