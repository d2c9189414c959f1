"""The run store: a folder of campaigns, each a folder of run files, and an index over them.

    STORE/
      catalogue.sqlite            an index (WAL); `RunStore.rebuild` makes it anew from the files
      campaigns/ID/campaign.json  the campaign's card: title, rig, medium, declared model, verdict
      campaigns/ID/journal.jsonl  what a campaign did, line by line (`daq.journal`)
      campaigns/ID/runs/NAME.h5   one run each (`daq.store_file` documents the layout)
      calibrations/*.json         what channels' volts mean (`daq.calibration`)
      quarantine/                 files that could not be read, kept and named

The files are the truth. `ID` is ``<date>-<slug of the title>`` for campaigns recorded here and
``<slug>-<digest of the contents>`` for imported folders, so that importing twice finds the first.
"""

import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daq.errors import CorruptFile, StoreError, UnknownItem, unwritable
from daq.records import CampaignCard, RunHeader, RunSummary
from daq.store_catalogue import CampaignRow, Catalogue, RunQuery
from daq.store_file import read_summary
from daq.store_writer import RunWriter

CARD_FORMAT = "campaign/1"


def utc_now() -> str:
    """The calendar's time, ISO 8601 in UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def slug(text: str) -> str:
    """A short name that is safe as a folder's, from any text."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:48] or "campaign"


class RunStore:
    """A run store at a folder, made when it is not there."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root).expanduser().resolve()
        try:
            self.campaigns_dir.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StoreError(f"{self.root}: cannot be made into a run store ({error})") from error
        self.catalogue = Catalogue(self.root / "catalogue.sqlite")

    @property
    def campaigns_dir(self) -> Path:
        return self.root / "campaigns"

    @property
    def quarantine_dir(self) -> Path:
        return self.root / "quarantine"

    def close(self) -> None:
        """Close the catalogue; harmless twice."""
        self.catalogue.close()

    # campaigns

    def create_campaign(
        self,
        title: str,
        *,
        id: str = "",
        documents: Mapping[str, Mapping[str, Any]] | None = None,
        **card: Any,
    ) -> CampaignCard:
        """Make a campaign's folder and card; `card` holds further `CampaignCard` fields.

        `documents` (file name to content) are written before the card, so that a campaign that
        has a card has them too, whenever the power fails.
        """
        created_at = utc_now()
        stem = id or f"{created_at[:19].replace(':', '')}-{slug(title)}"
        try:
            folder = self._named(stem) if id else self._unnamed(stem)
            (folder / "runs").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise unwritable(self.root, error) from error
        for name, content in (documents or {}).items():
            write_json(folder / name, content)
        made = CampaignCard(id=folder.name, title=title, created_at=created_at, **card)
        self.save_card(made)
        return made

    def _named(self, id: str) -> Path:
        """The folder of that name, which has no campaign yet."""
        folder = self.campaigns_dir / id
        if (folder / "campaign.json").exists():
            raise StoreError(f"campaign {id!r} exists in {self.root}")
        return folder

    def _unnamed(self, stem: str) -> Path:
        """A folder of its own, whoever else makes one of that name at the same time."""
        folder, attempt = self.campaigns_dir / stem, 1
        while True:
            try:
                folder.mkdir(parents=True)
                return folder
            except FileExistsError:
                attempt += 1
                folder = self.campaigns_dir / f"{stem}-{attempt}"

    def save_card(self, card: CampaignCard) -> None:
        """Write a card (atomically) and index it."""
        path = self.campaigns_dir / card.id / "campaign.json"
        write_json(path, {"format": CARD_FORMAT, **asdict(card)})
        self.catalogue.add_campaigns([_row(card)])

    def card(self, campaign: str) -> CampaignCard:
        """A campaign's card; raises `UnknownItem`."""
        return read_card(self.campaign_dir(campaign) / "campaign.json")

    def campaign_dir(self, campaign: str) -> Path:
        """A campaign's folder; raises `UnknownItem`."""
        path = self.campaigns_dir / campaign
        if not campaign or Path(campaign).name != campaign or not (path / "campaign.json").exists():
            raise UnknownItem(
                f"no campaign {campaign!r} in {self.root}; `entrain campaign list` shows them"
            )
        return path

    def set_status(
        self, campaign: str, *, status: str | None = None, verdict: str | None = None
    ) -> None:
        """Note how a campaign stands, or what its diagnosis said."""
        changes = {"status": status, "verdict": verdict}
        given = {name: value for name, value in changes.items() if value is not None}
        self.save_card(replace(self.card(campaign), **given))  # type: ignore[arg-type]

    def campaigns(
        self, *, after: str | None = None, limit: int = 100, verdict: str | None = None
    ) -> list[CampaignRow]:
        """A page of campaigns."""
        return self.catalogue.campaigns(after=after, limit=limit, verdict=verdict)

    # runs

    def write_run(self, campaign: str, header: RunHeader, *, durable: bool = True) -> RunWriter:
        """Begin a run; pass what its `finish` returns to `add_run`."""
        path = self.campaign_dir(campaign) / "runs" / f"{header.name}.h5"
        return RunWriter(path, header, campaign, durable=durable)

    def add_run(self, summary: RunSummary) -> None:
        """Index a finished run."""
        self.catalogue.add_runs([summary])

    def run_path(self, run: str) -> Path:
        """The file of a run named ``campaign/name``; raises `UnknownItem`."""
        campaign, _, name = run.partition("/")
        path = self.campaign_dir(campaign) / "runs" / f"{name}.h5"
        if not name or "/" in name or not path.exists():
            raise UnknownItem(f"no run {name!r} in campaign {campaign!r}")
        return path

    def runs(
        self, query: RunQuery | None = None, *, after: str | None = None, limit: int = 100
    ) -> list[RunSummary]:
        """A page of runs, ordered by id."""
        return self.catalogue.runs(query, after=after, limit=limit)

    def campaign_runs(self, campaign: str) -> list[RunSummary]:
        """All runs of a campaign, from the files."""
        folder = self.campaign_dir(campaign) / "runs"
        return [read_summary(path, campaign) for path in sorted(folder.glob("*.h5"))]

    # upkeep

    def rebuild(self) -> list[str]:
        """Make the catalogue anew from the files; returns what could not be read.

        A folder without card and runs is a campaign that was interrupted before it began.
        """
        problems: list[str] = []
        self.catalogue.clear()
        for folder in self.folders():
            paths = sorted((folder / "runs").glob("*.h5"))
            try:
                card = read_card(folder / "campaign.json")
            except StoreError as error:
                if paths or not isinstance(error, UnknownItem):
                    problems.append(str(error))
                continue
            summaries = []
            for path in paths:
                try:
                    summaries.append(read_summary(path, card.id))
                except CorruptFile as error:
                    problems.append(str(error))
            self.catalogue.add_campaigns([_row(card)])
            self.catalogue.add_runs(summaries)
        return problems

    def folders(self) -> Iterator[Path]:
        """Every campaign's folder, ordered by id."""
        return iter(sorted(path for path in self.campaigns_dir.iterdir() if path.is_dir()))


def read_card(path: Path) -> CampaignCard:
    """A campaign's card from its file; raises `UnknownItem` or `CorruptFile`."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except FileNotFoundError as error:
        raise UnknownItem(f"{path}: no such campaign") from error
    except (OSError, ValueError) as error:
        raise CorruptFile(f"{path}: not a readable campaign card ({error})") from error
    known = {field.name for field in fields(CampaignCard)}
    if not isinstance(content, dict) or content.get("format") != CARD_FORMAT:
        raise CorruptFile(f"{path}: format is not {CARD_FORMAT!r}")
    try:
        return CampaignCard(**{key: content[key] for key in known if key in content})
    except TypeError as error:
        raise CorruptFile(f"{path}: {error}") from error


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file as a whole or not at all."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("w", encoding="utf-8") as file:
            json.dump(content, file, indent=1, ensure_ascii=False)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise unwritable(path, error) from error


def _row(card: CampaignCard) -> CampaignRow:
    return CampaignRow(card.id, card.title, card.rig, card.created_at, card.status, card.verdict)
