"""Looking after a run store: recovery after a crash, verification, quarantine, export, retention.

`recover` is quick and belongs at every start: it salvages runs whose writer was killed, indexes
finished files that the catalogue does not know, and marks campaigns that nobody runs any more.
`verify` reads everything and compares checksums. Both name what the catalogue or a journal knows
and the disk has not. Nothing is ever deleted because it looks broken: what cannot be read goes to
`quarantine/`, under a name that tells where it came from; what another version wrote stays.
"""

import hashlib
import json
import os
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from daq.errors import CorruptFile, OtherVersion, StoreError, UnknownItem, unwritable
from daq.journal import read_journal
from daq.locks import is_locked, unless_locked
from daq.records import RunSummary
from daq.store import RunStore, read_card, write_json
from daq.store_catalogue import RunQuery
from daq.store_file import open_run, read_header, read_summary
from daq.store_writer import RunWriter, software_version

SLICE_FRAMES = 1 << 18
Kind = Literal[
    "salvaged",
    "indexed",
    "interrupted",
    "quarantined",
    "checksum",
    "unreadable",
    "missing",
    "other version",
]


@dataclass(frozen=True)
class Finding:
    """Something that was not as it should be: what, which file, and the detail."""

    kind: Kind
    path: Path
    detail: str


def recover(store: RunStore) -> list[Finding]:
    """Put a store in order after whatever happened; campaigns that are running are left alone."""
    found = _missing_campaigns(store)
    for folder in store.folders():
        with unless_locked(folder / "journal.jsonl") as free:
            if free:
                found += _recover_folder(store, folder)
    return found


def _recover_folder(store: RunStore, folder: Path) -> list[Finding]:
    try:
        card = read_card(folder / "campaign.json")
    except StoreError as error:
        return [Finding("unreadable", folder, str(error))]
    if card.status == "importing":
        return []  # `import_folder` replaces it when it is asked again
    found = salvage(store, card.id) + _missing_runs(store, card.id)
    if card.status == "running":
        store.set_status(card.id, status="interrupted")
        found.append(Finding("interrupted", folder, "nobody runs this campaign any more"))
    return found


def salvage(store: RunStore, campaign: str) -> list[Finding]:
    """Keep what a campaign's interrupted recordings hold, and index what the catalogue lacks.

    For whoever holds the campaign's lock.
    """
    folder = store.campaign_dir(campaign) / "runs"
    for renamed in sorted(folder.glob(".*.h5.partial.salvaging")):
        _undo_salvage(renamed)
    found = [_salvage(store, campaign, partial) for partial in sorted(folder.glob(".*.h5.partial"))]
    return found + _index(store, campaign, folder)


def verify(
    store: RunStore,
    campaign: str | None = None,
    progress: Callable[[float, str], None] = lambda share, name: None,
) -> list[Finding]:
    """Read every run file and compare its samples with the checksum of its recording."""
    folders = [store.campaign_dir(campaign)] if campaign else list(store.folders())
    found = [] if campaign else _missing_campaigns(store)
    for number, folder in enumerate(folders):
        progress(number / len(folders), folder.name)
        paths = sorted((folder / "runs").glob("*.h5"))
        try:
            read_card(folder / "campaign.json")
        except StoreError as error:
            if paths or not isinstance(error, UnknownItem):
                found.append(Finding("unreadable", folder, str(error)))
        for path in paths:
            try:
                expected, actual = checksums(path)
            except CorruptFile as error:
                found.append(Finding("unreadable", path, str(error)))
                continue
            if expected != actual:
                found.append(
                    Finding("checksum", path, f"recorded {expected[:12]}…, file has {actual[:12]}…")
                )
        found += _missing_runs(store, folder.name)
    return found


def _missing_campaigns(store: RunStore) -> list[Finding]:
    there = {folder.name for folder in store.folders()}
    return [
        Finding("missing", store.campaigns_dir / row.id, "in the catalogue, but its folder is gone")
        for row in store.campaigns(limit=1_000_000)
        if row.id not in there
    ]


def _missing_runs(store: RunStore, campaign: str) -> list[Finding]:
    """Runs that the catalogue or the journal knows and that are neither there nor set aside."""
    folder = store.campaigns_dir / campaign
    known = dict.fromkeys(_indexed(store, campaign), "in the catalogue, but its file is gone")
    found: list[Finding] = []
    try:
        lines = read_journal(folder / "journal.jsonl")
    except CorruptFile as error:
        lines = []
        found.append(Finding("unreadable", folder / "journal.jsonl", str(error)))
    for line in lines:
        if line["kind"] == "recorded":
            known.setdefault(line["data"]["run"], "in the journal, but its file is gone")
    for name, detail in sorted(known.items()):
        path = folder / "runs" / f"{name}.h5"
        if not path.exists() and not _set_aside(store, path):
            found.append(Finding("missing", path, detail))
    return found


def _set_aside(store: RunStore, path: Path) -> bool:
    """Whether the quarantine has a file from there."""
    notes = store.quarantine_dir.glob(f"{_quarantine_name(path)}*.json")
    return any(json.loads(note.read_text("utf-8"))["from"] == str(path) for note in notes)


def checksums(path: Path) -> tuple[str, str]:
    """The checksum that a run file states, and the one that its samples have."""
    digest = hashlib.sha256()
    with open_run(path) as file:
        read_header(file)
        samples = file["entry/data/samples"]
        try:
            for start in range(0, samples.shape[0], SLICE_FRAMES):
                digest.update(samples[start : start + SLICE_FRAMES])
        except OSError as error:
            raise CorruptFile(f"{path}: its samples cannot be read ({error})") from error
        return str(file["entry"].attrs["sha256"]), digest.hexdigest()


def quarantine(store: RunStore, path: Path, reason: str) -> Finding:
    """Move a damaged file out of its campaign, with a note beside it."""
    stem = _quarantine_name(path)
    target, number = store.quarantine_dir / stem, 2
    while target.exists():
        target, number = store.quarantine_dir / f"{stem}.{number}", number + 1
    try:
        store.quarantine_dir.mkdir(exist_ok=True)
        write_json(target.with_name(target.name + ".json"), {"from": str(path), "reason": reason})
        os.replace(path, target)
    except OSError as error:
        raise unwritable(target, error) from error
    return Finding("quarantined", target, reason)


def _quarantine_name(path: Path) -> str:
    return f"{path.parent.parent.name}--{path.name.removeprefix('.')}"


@dataclass(frozen=True)
class Export:
    """A zip that was written, and what `verify` finds wrong with the campaign in it."""

    path: Path
    problems: list[str]


def export_campaign(store: RunStore, campaign: str, target: Path) -> Export:
    """A campaign as one zip: its files as they are, and `manifest.json` with their checksums and
    what `verify` finds wrong with them."""
    folder = store.campaign_dir(campaign)
    found = verify(store, campaign)
    problems = [f"{one.kind}: {one.path.name}: {one.detail}" for one in found]
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name[0] != ".")
    manifest = {
        "format": "entrain-export/1",
        "campaign": campaign,
        "software_version": software_version(),
        "problems": problems,
        "files": {
            path.relative_to(folder).as_posix(): {
                "sha256": _file_sha256(path),
                "bytes": path.stat().st_size,
            }
            for path in files
        },
    }
    partial = target.with_name(f".{target.name}.partial")
    try:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr(f"{campaign}/manifest.json", json.dumps(manifest, indent=1))
            for path in files:
                archive.write(path, f"{campaign}/{path.relative_to(folder).as_posix()}")
        os.replace(partial, target)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise unwritable(target, error) from error
    return Export(target, problems)


def retire(store: RunStore, campaign: str, archive: Path) -> Path:
    """Export a campaign, check the archive against its manifest, then remove the campaign."""
    folder = store.campaign_dir(campaign)
    if is_locked(folder / "journal.jsonl"):
        raise StoreError(f"campaign {campaign!r} is running; stop it first")
    made = export_campaign(store, campaign, archive).path
    problems = check_export(made)
    if problems:
        raise StoreError(f"{made}: {'; '.join(problems)}; the campaign stays where it is")
    shutil.rmtree(folder)
    store.catalogue.forget(campaign)
    return made


def check_export(archive: Path) -> list[str]:
    """What in an exported zip does not agree with its manifest."""
    problems: list[str] = []
    with zipfile.ZipFile(archive) as file:
        names = file.namelist()
        campaign = names[0].partition("/")[0]
        manifest = json.loads(file.read(f"{campaign}/manifest.json"))
        for name, expected in manifest["files"].items():
            with file.open(f"{campaign}/{name}") as member:
                if hashlib.file_digest(member, "sha256").hexdigest() != expected["sha256"]:  # type: ignore[arg-type]
                    problems.append(f"{name} differs from the manifest")
    return problems


def _salvage(store: RunStore, campaign: str, partial: Path) -> Finding:
    """The valid frames of a run whose writer died, as a finished file marked ``interrupted``."""
    target = partial.with_name(partial.name.removeprefix(".").removesuffix(".partial"))
    if target.exists():
        return quarantine(store, partial, "a finished run of that name exists")
    renamed = partial.with_name(partial.name + ".salvaging")
    os.replace(partial, renamed)
    try:
        summary = _copied(renamed, target, campaign)
    except OtherVersion as error:
        os.replace(renamed, partial)
        return Finding("other version", partial, str(error))
    except (CorruptFile, OSError, KeyError, RuntimeError) as error:
        os.replace(renamed, partial)
        return quarantine(store, partial, f"unreadable after a crash ({error})")
    renamed.unlink()
    store.add_run(summary)
    return Finding("salvaged", target, summary.exit_reason)


def _copied(source: Path, target: Path, campaign: str) -> RunSummary:
    with open_run(source, live=True) as file:
        header = read_header(file)
        samples = file["entry/data/samples"]
        valid = min(int(file["entry/quality/n_valid"][()]), samples.shape[0])
        writer = RunWriter(target, header, campaign)
        try:
            for start in range(0, valid, SLICE_FRAMES):
                stop = min(valid, start + SLICE_FRAMES)
                writer.append(samples[start:stop], patient=True)
        except BaseException:
            writer.discard()
            raise
        return writer.finish("interrupted", f"{valid} frames salvaged after the writer died")


def _undo_salvage(renamed: Path) -> None:
    """A recovery was itself killed: go back to the state before it, or finish it."""
    partial = renamed.with_name(renamed.name.removesuffix(".salvaging"))
    target = partial.with_name(partial.name.removeprefix(".").removesuffix(".partial"))
    if target.exists():
        renamed.unlink()
    else:
        os.replace(renamed, partial)


def _index(store: RunStore, campaign: str, folder: Path) -> list[Finding]:
    known = _indexed(store, campaign)
    found: list[Finding] = []
    for path in sorted(folder.glob("*.h5")):
        if path.stem in known:
            continue
        try:
            store.add_run(read_summary(path, campaign))
            found.append(Finding("indexed", path, "finished, but not in the catalogue"))
        except OtherVersion as error:
            found.append(Finding("other version", path, str(error)))
        except CorruptFile as error:
            found.append(quarantine(store, path, str(error)))
    return found


def _indexed(store: RunStore, campaign: str) -> set[str]:
    """The names of a campaign's runs in the catalogue."""
    return {run.name for run in store.runs(RunQuery(campaign=campaign), limit=1_000_000)}


def _file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
