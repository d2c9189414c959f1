"""What runs in an analysis's own process: import, identification, diagnosis, store upkeep."""

from pathlib import Path
from typing import Any

from daq.importers import import_folder, import_recordings
from daq.journal import read_journal
from daq.service import LONGEST_SEARCH_S
from daq.service.curves import comparisons, curves
from daq.service.jobs import Link
from daq.service.unpack import unpack
from daq.service.words import read_unforced, recording_options
from daq.store import RunStore
from daq.store_upkeep import export_campaign, verify
from identify.load import load_campaign
from identify.record import Campaign
from identify.report import write_html


def bring_in(link: Link, upload: str, name: str, store: str) -> dict[str, Any]:
    """Unpack an uploaded campaign folder and import it; the upload is removed either way."""
    archive = Path(upload)
    try:
        link.progress(0.1, "unpacking")
        with unpack(archive, name) as folder:
            link.progress(0.3, "reading recordings")
            target = RunStore(Path(store))
            try:
                card = import_folder(folder, target)
                runs = target.campaign_runs(card.id)
            finally:
                target.close()
    finally:
        archive.unlink(missing_ok=True)
    return {"campaign": card.id, "title": card.title, "runs": len(runs)}


def bring_in_recording(
    link: Link, upload: str, store: str, title: str, **options: Any
) -> dict[str, Any]:
    """Import one uploaded recording; the upload is removed either way."""
    path = Path(upload)
    try:
        link.progress(0.2, "reading the recording")
        target = RunStore(Path(store))
        try:
            card = import_recordings([path], recording_options(**options), target, title)
        finally:
            target.close()
    finally:
        path.unlink(missing_ok=True)
    return {"campaign": card.id, "title": card.title, "runs": 1}


def identification(link: Link, campaign: str, store: str, report: str) -> dict[str, Any]:
    """Fit the declared model; returns the answer (identification/1) and what the page draws."""
    from identify.identification import identify

    recorded, target = _open(campaign, store)
    try:
        found = identify(recorded, progress=link.progress)
    finally:
        target.close()
    write_html(_place(report), found, recorded, steps_in(target.campaign_dir(campaign)))
    details = {"runs": comparisons(found.assessment), "curves": curves(found.assessment)}
    return {"answer": found.to_json(), "details": details}


def diagnosis(link: Link, campaign: str, store: str, report: str) -> dict[str, Any]:
    """Trace what the model lacks; returns the answer (diagnosis/1) and what the page draws."""
    from identify.diagnosis import diagnose

    recorded, target = _open(campaign, store)
    try:
        found = diagnose(recorded, progress=link.progress, within_s=LONGEST_SEARCH_S)
        target.set_status(campaign, verdict=found.verdict)
    finally:
        target.close()
    write_html(_place(report), found, recorded, steps_in(target.campaign_dir(campaign)))
    details = {
        "before": comparisons(found.before),
        "after": comparisons(found.after),
        "curves": curves(found.after),
    }
    return {"answer": found.to_json(), "details": details}


def _open(campaign: str, store: str) -> tuple[Campaign, RunStore]:
    target = RunStore(Path(store))
    return load_campaign(target.campaign_dir(campaign)), target


def _place(file: str) -> Path:
    path = Path(file)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def steps_in(folder: Path) -> list[dict[str, Any]]:
    """The controller's outcomes from a campaign's journal, for the report; empty if imported."""
    return [
        {
            "frequency_hz": line["data"]["frequency_hz"],
            "amplitude_v": line["data"]["amplitude_v"] or 0.0,
            # the journal has the line's level against its free one; the report how far it fell
            "suppression_db": _fallen(line["data"]["suppression_db"]),
            "entrained": line["data"]["status"] == "entrained",
        }
        for line in read_journal(folder / "journal.jsonl")
        if line["kind"] in ("recorded", "not_entrained") and line["data"]["kind"] == "forced"
    ]


def _fallen(level_db: float | None) -> float | None:
    return None if level_db is None else -level_db


def characterisation(
    link: Link, upload: str, names: list[str], rate_hz: float | None, signal: str | None
) -> dict[str, Any]:
    """Characterise an uploaded recording; the upload is removed either way."""
    from identify.characterise import characterise_recording

    path = Path(upload)
    try:
        link.progress(0.1, "reading the recording")
        recording = read_unforced(path, names, rate_hz)
        link.progress(0.3, "characterising")
        return {"answer": characterise_recording(recording, signal).to_json()}
    finally:
        path.unlink(missing_ok=True)


def verification(link: Link, store: str, campaign: str | None) -> dict[str, Any]:
    """Compare every run, or a campaign's, with the checksum of its recording."""
    target = RunStore(Path(store))
    try:
        count = 1 if campaign else sum(1 for _ in target.folders())
        findings = verify(target, campaign, link.progress)
    finally:
        target.close()
    rows = [
        {"kind": f.kind, "file": f.path.relative_to(target.root).as_posix(), "detail": f.detail}
        for f in findings
    ]
    return {"campaigns": count, "findings": rows}


def export(link: Link, store: str, campaign: str, archive: str) -> dict[str, Any]:
    """Write a campaign as one zip with a manifest of checksums."""
    target = RunStore(Path(store))
    try:
        made = export_campaign(target, campaign, _place(archive))
    finally:
        target.close()
    return {"campaign": campaign, "bytes": made.path.stat().st_size, "problems": made.problems}
