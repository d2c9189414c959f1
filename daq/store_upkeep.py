"""Looking after a run store: recovery after a crash, verification, quarantine, export, retention.

`recover` is quick and belongs at every start: it salvages runs whose writer was killed, indexes
finished files that the catalogue does not know, and marks campaigns that nobody runs any more.
`verify` reads everything and compares checksums. Nothing is ever deleted because it looks broken:
what cannot be read goes to `quarantine/`, under a name that tells where it came from.
"""

import hashlib
import json
import os
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from daq.errors import CorruptFile, StoreError
from daq.locks import is_locked
from daq.store import RunStore, read_card
from daq.store_catalogue import RunQuery
from daq.store_file import open_run, read_header, read_summary
from daq.store_writer import RunWriter, software_version

SLICE_FRAMES = 1 << 18
Kind = Literal["salvaged", "indexed", "interrupted", "quarantined", "checksum", "unreadable"]


@dataclass(frozen=True)
class Finding:
    """Something that was not as it should be: what, which file, and the detail."""

    kind: Kind
    path: Path
    detail: str


def recover(store: RunStore) -> list[Finding]:
    """Put a store in order after whatever happened; campaigns that are running are left alone."""
    found: list[Finding] = []
    for folder in store.folders():
        if is_locked(folder / "journal.jsonl"):
            continue
        try:
            card = read_card(folder / "campaign.json")
        except StoreError as error:
            found.append(Finding("unreadable", folder, str(error)))
            continue
        if card.status == "importing":
            continue  # `import_folder` replaces it when it is asked again
        for renamed in sorted((folder / "runs").glob(".*.h5.partial.salvaging")):
            _undo_salvage(renamed)
        for partial in sorted((folder / "runs").glob(".*.h5.partial")):
            found.append(_salvage(store, card.id, partial))
        found += _index(store, card.id, folder / "runs")
        if card.status == "running":
            store.set_status(card.id, status="interrupted")
            found.append(Finding("interrupted", folder, "nobody runs this campaign any more"))
    return found


def verify(store: RunStore, campaign: str | None = None) -> list[Finding]:
    """Read every run file and compare its samples with the checksum of its recording."""
    folders = [store.campaign_dir(campaign)] if campaign else list(store.folders())
    found: list[Finding] = []
    for folder in folders:
        for path in sorted((folder / "runs").glob("*.h5")):
            try:
                expected, actual = checksums(path)
            except CorruptFile as error:
                found.append(Finding("unreadable", path, str(error)))
                continue
            if expected != actual:
                found.append(
                    Finding("checksum", path, f"recorded {expected[:12]}…, file has {actual[:12]}…")
                )
    return found


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
    store.quarantine_dir.mkdir(exist_ok=True)
    stem = f"{path.parent.parent.name}--{path.name.removeprefix('.')}"
    target, number = store.quarantine_dir / stem, 2
    while target.exists():
        target, number = store.quarantine_dir / f"{stem}.{number}", number + 1
    os.replace(path, target)
    note = {"from": str(path), "reason": reason}
    target.with_name(target.name + ".json").write_text(json.dumps(note, indent=1), "utf-8")
    return Finding("quarantined", target, reason)


def export_campaign(store: RunStore, campaign: str, target: Path) -> Path:
    """A campaign as one zip: its files as they are, and `manifest.json` with their checksums."""
    folder = store.campaign_dir(campaign)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name[0] != ".")
    manifest = {
        "format": "entrain-export/1",
        "campaign": campaign,
        "software_version": software_version(),
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
        raise StoreError(f"{target}: cannot be written ({error})") from error
    return target


def retire(store: RunStore, campaign: str, archive: Path) -> Path:
    """Export a campaign, check the archive against its manifest, then remove the campaign."""
    folder = store.campaign_dir(campaign)
    if is_locked(folder / "journal.jsonl"):
        raise StoreError(f"campaign {campaign!r} is running; stop it first")
    made = export_campaign(store, campaign, archive)
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
    try:
        with open_run(partial, live=True) as file:
            header = read_header(file)
            samples = file["entry/data/samples"]
            valid = min(int(file["entry/quality/n_valid"][()]), samples.shape[0])
            target = partial.with_name(partial.name.removeprefix(".").removesuffix(".partial"))
            if target.exists():
                return quarantine(store, partial, "a finished run of that name exists")
            renamed = partial.with_name(partial.name + ".salvaging")
            os.replace(partial, renamed)
            writer = RunWriter(target, header, campaign)
            for start in range(0, valid, SLICE_FRAMES):
                stop = min(valid, start + SLICE_FRAMES)
                writer.append(samples[start:stop], patient=True)
            detail = f"{valid} frames salvaged after the writer died"
            summary = writer.finish("interrupted", detail)
    except (CorruptFile, OSError, KeyError, RuntimeError) as error:
        return quarantine(store, partial, f"unreadable after a crash ({error})")
    renamed.unlink()
    store.add_run(summary)
    return Finding("salvaged", target, detail)


def _undo_salvage(renamed: Path) -> None:
    """A recovery was itself killed: go back to the state before it, or finish it."""
    partial = renamed.with_name(renamed.name.removesuffix(".salvaging"))
    target = partial.with_name(partial.name.removeprefix(".").removesuffix(".partial"))
    if target.exists():
        renamed.unlink()
    else:
        os.replace(renamed, partial)


def _index(store: RunStore, campaign: str, folder: Path) -> list[Finding]:
    known = {run.name for run in store.runs(RunQuery(campaign=campaign), limit=1_000_000)}
    found: list[Finding] = []
    for path in sorted(folder.glob("*.h5")):
        if path.stem in known:
            continue
        try:
            store.add_run(read_summary(path, campaign))
            found.append(Finding("indexed", path, "finished, but not in the catalogue"))
        except CorruptFile as error:
            found.append(quarantine(store, path, str(error)))
    return found


def _file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
