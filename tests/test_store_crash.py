"""Crashes, full disks, damaged files: what is left, and that it is said."""

import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from daq.campaign import run_campaign
from daq.errors import StoreError, UnknownItem
from daq.importers import import_folder
from daq.journal import Journal
from daq.plan import Plan
from daq.records import RunSummary
from daq.store import RunStore
from daq.store_catalogue import RunQuery
from daq.store_file import open_run
from daq.store_upkeep import (
    check_export,
    checksums,
    export_campaign,
    quarantine,
    recover,
    retire,
    verify,
)
from daq.store_writer import partial_path
from simulated_rig.build import build_rig
from tests.daq_folders import write_folder
from tests.small_disk import small_disk

ROOT = Path(__file__).parent.parent


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path / "store")


@pytest.mark.skipif(sys.platform == "win32", reason="kill -9 and fork are POSIX's")
def test_killed_campaigns_lose_and_repeat_nothing() -> None:
    """Four kills here; `python -m tests.daq_kill --kills 200` is the long version."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.daq_kill", "--kills", "4", "--seed", "5"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    counts = json.loads(done.stdout)
    assert counts["kills"] == 4
    assert counts["completed"] >= 1


WRITER = """
    import sys, time
    import numpy as np
    from daq.records import RunHeader
    from daq.store import RunStore
    from drivers.types import Channel
    store = RunStore(sys.argv[1])
    card = store.create_campaign("killed", id="killed")
    header = RunHeader("000-free", "free", 1000.0, (Channel("p1", "pressure", "Pa"),))
    writer = store.write_run(card.id, header)
    for block in range(5):
        writer.append(np.full((100, 1), float(block)))
    while writer.queued_bytes:
        time.sleep(0.001)
    time.sleep(0.2)  # let the flush that follows the last write happen
    print("ready", flush=True)
    time.sleep(60)
"""


def test_a_killed_recording_is_salvaged(store: RunStore) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(WRITER), str(store.root)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
    )
    assert child.stdout is not None
    assert child.stdout.readline() == b"ready\n"
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    child.stdout.close()
    found = recover(store)
    assert [(finding.kind, finding.path.name) for finding in found] == [("salvaged", "000-free.h5")]
    (run,) = store.runs()
    assert (run.exit_status, run.samples) == ("interrupted", 500)
    with open_run(store.run_path(run.id)) as file:
        np.testing.assert_array_equal(
            file["entry/data/samples"][:, 0], np.repeat(np.arange(5.0), 100)
        )
    assert recover(store) == []


FULL = """
    import resource, signal, sys
    from daq.campaign import run_campaign
    from daq.errors import StoreError
    from daq.plan import Condition, Plan
    from daq.store import RunStore
    from simulated_rig.build import build_rig
    rig = build_rig(seed=1)
    store = RunStore(sys.argv[1])
    plan = Plan(conditions=(Condition(frequency_hz=166.0),), record_s=2.0)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (330_000, resource.RLIM_INFINITY))
    try:
        run_campaign(rig, plan, store, campaign_id="full")
    except StoreError as error:
        print(type(error).__name__, error, rig.status().output_v, flush=True)
"""


def assert_recorded(path: Path) -> None:
    """A salvaged run holds frames, and none that were never written."""
    with open_run(path) as file:
        samples = file["entry/data/samples"][()]
    assert len(samples) >= 1000
    assert np.all(np.any(samples != 0, axis=1))


def test_a_recording_leaves_room_to_say_that_the_disk_is_full(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk") as place:
        store = RunStore(place / "store")
        plan = Plan(record_s=10.0, free_runs=3)
        with build_rig(seed=1) as rig, pytest.raises(StoreError, match="the disk is full"):
            run_campaign(rig, plan, store, campaign_id="full")
        assert store.card("full").status == "failed"
        assert [run.exit_status for run in store.runs()] == ["success"]
        subprocess.run(["mount", "-o", "remount,size=9m", str(place)], check=True)
        with build_rig(seed=1) as rig:
            result = run_campaign(rig, plan, store, campaign="full")
        assert [outcome.status for outcome in result.outcomes] == ["success"] * 3
        (kept,) = (run for run in store.runs() if run.exit_status == "interrupted")
        assert_recorded(store.run_path(kept.id))
        assert verify(store) == []
        store.close()


def test_a_full_disk_ends_in_an_error_and_the_campaign_can_go_on(store: RunStore) -> None:
    """A limit on the size of files stands for the full disk: writes fail just the same."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FULL), str(store.root)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stdout.startswith("StoreError"), done.stderr
    assert "000-free.h5" in done.stdout
    assert "(File too large); what was recorded" in done.stdout  # a few words, not HDF5's ten lines
    assert done.stdout.rstrip().endswith("0.0")  # the output is silent
    assert done.stderr == ""
    assert store.card("full").status == "failed"
    (found,) = recover(store)
    assert found.kind == "salvaged"
    assert_recorded(found.path)
    with build_rig(seed=1) as rig:
        result = run_campaign(rig, Plan(), store, campaign="full")
    assert [outcome.status for outcome in result.outcomes] == ["success", "entrained"]
    assert verify(store) == []


def test_damaged_files_are_found_named_and_set_aside(tmp_path: Path, store: RunStore) -> None:
    card = import_folder(write_folder(tmp_path / "small"), store)
    assert verify(store) == []
    flipped = store.run_path(f"{card.id}/001-f166")
    with open_run(flipped) as file:
        offset = file["entry/data/samples"].id.get_chunk_info(0).byte_offset
    content = bytearray(flipped.read_bytes())
    content[offset + 1000] ^= 1
    flipped.write_bytes(content)
    truncated = store.run_path(f"{card.id}/002-f172")
    truncated.write_bytes(truncated.read_bytes()[:3000])
    found = verify(store)
    assert [(finding.kind, finding.path.name) for finding in found] == [
        ("checksum", "001-f166.h5"),
        ("unreadable", "002-f172.h5"),
    ]
    moved = quarantine(store, truncated, found[1].detail)
    assert moved.path.parent == store.quarantine_dir
    assert card.id in moved.path.name
    assert not truncated.exists()
    assert [finding.kind for finding in verify(store)] == ["checksum"]


def test_recovery_indexes_and_quarantines(tmp_path: Path, store: RunStore) -> None:
    card = import_folder(write_folder(tmp_path / "small"), store)
    store.catalogue.forget(card.id)
    store.set_status(card.id, status="running")
    runs = store.campaign_dir(card.id) / "runs"
    (runs / "009-torn.h5").write_bytes(b"nothing of use")
    (runs / ".010-torn.h5.partial").write_bytes(b"nothing of use")
    kinds = sorted(finding.kind for finding in recover(store))
    assert kinds == ["indexed"] * 4 + ["interrupted"] + ["quarantined"] * 2
    assert len(store.runs()) == 4
    assert len(list(store.quarantine_dir.glob("*torn*.json"))) == 2
    assert recover(store) == []


def test_what_is_gone_is_named(tmp_path: Path, store: RunStore) -> None:
    card = import_folder(write_folder(tmp_path / "small"), store)
    with Journal(store.campaign_dir(card.id) / "journal.jsonl") as journal:
        journal.write("recorded", {"time_s": 0.0, "index": 7, "data": {"run": "007-free"}})
    store.run_path(f"{card.id}/001-f166").unlink()
    gone = store.create_campaign("gone", id="gone")
    shutil.rmtree(store.campaign_dir(gone.id))
    expected = [("missing", "gone"), ("missing", "001-f166.h5"), ("missing", "007-free.h5")]
    for look in (verify, recover):
        assert [(finding.kind, finding.path.name) for finding in look(store)] == expected
    made = export_campaign(store, card.id, tmp_path / "c.zip")
    assert [line.split(":")[0] for line in made.problems] == ["missing"] * 2
    with zipfile.ZipFile(tmp_path / "c.zip") as archive:
        manifest = json.loads(archive.read(f"{card.id}/manifest.json"))
    assert manifest["problems"] == made.problems


@pytest.mark.parametrize("content", ["{", '{"format": "campaign/9"}'])
def test_a_card_that_cannot_be_read_is_found(tmp_path: Path, store: RunStore, content: str) -> None:
    card = import_folder(write_folder(tmp_path / "small"), store)
    (store.campaign_dir(card.id) / "campaign.json").write_text(content, "utf-8")
    assert [finding.kind for finding in verify(store)] == ["unreadable"]


def test_what_another_version_wrote_stays_where_it_is(tmp_path: Path, store: RunStore) -> None:
    card = import_folder(write_folder(tmp_path / "small"), store)
    newer = store.run_path(f"{card.id}/001-f166")
    with h5py.File(newer, "r+") as file:
        file.attrs["format"] = "entrain-run/2"
    store.catalogue.forget(card.id)
    shutil.copy(newer, partial_path(newer.with_name("009-free.h5")))
    said = {finding.path: finding for finding in recover(store) if finding.kind != "indexed"}
    assert set(said) == {newer, partial_path(newer.with_name("009-free.h5"))}
    assert {finding.kind for finding in said.values()} == {"other version"}
    assert all("entrain-run/2" in finding.detail for finding in said.values())
    assert newer.exists()


def test_a_running_campaign_is_left_alone(store: RunStore) -> None:
    card = store.create_campaign("busy", status="running")
    folder = store.campaign_dir(card.id)
    partial = partial_path(folder / "runs" / "000-free.h5")
    partial.write_bytes(b"growing")
    with Journal(folder / "journal.jsonl"):
        assert recover(store) == []
        with pytest.raises(StoreError, match="another process runs this campaign"):
            Journal(folder / "journal.jsonl")
        with pytest.raises(StoreError, match="is running"):
            retire(store, card.id, store.root / "x.zip")
    assert [finding.kind for finding in recover(store)] == ["quarantined", "interrupted"]


def test_export_has_a_manifest_and_retirement_checks_it(tmp_path: Path, store: RunStore) -> None:
    card = import_folder(write_folder(tmp_path / "small"), store)
    made = export_campaign(store, card.id, tmp_path / "c.zip")
    assert (made.problems, check_export(made.path)) == ([], [])
    with zipfile.ZipFile(made.path) as archive:
        manifest = json.loads(archive.read(f"{card.id}/manifest.json"))
        assert set(manifest["files"]) >= {"campaign.json", "runs/001-f166.h5"}
        archive.extractall(tmp_path / "out")
    stated, actual = checksums(tmp_path / "out" / card.id / "runs/001-f166.h5")
    assert stated == actual
    assert retire(store, card.id, tmp_path / "d.zip").exists()
    with pytest.raises(UnknownItem):
        store.campaign_dir(card.id)
    assert store.runs() == []


def test_a_hundred_thousand_runs_are_listed_by_the_page(store: RunStore) -> None:
    """Any page, also the last and with a filter; how fast: ``benchmarks/store_speed.py``."""
    store.catalogue.add_runs(
        RunSummary(
            f"c{i // 100:04d}", f"{i % 100:03d}-forced", "forced", "fit", 160.0 + i % 40, 1.0, 0.0,
            f"2026-01-{1 + i % 28:02d}", f"rig{i % 5}", 1e4, 20_000, "success", "", "0" * 64, 1,
        )
        for i in range(100_000)
    )  # fmt: skip
    for query, after in (
        (RunQuery(), None),
        (RunQuery(), "c0998/050-forced"),
        (RunQuery(rig="rig3", min_frequency_hz=170.0), "c0500/000-forced"),
        (RunQuery(since="2026-01-05", until="2026-01-06"), None),
    ):
        page = store.runs(query, after=after, limit=100)
        assert len(page) == 100
        assert after is None or all(f"{r.campaign}/{r.name}" > after for r in page)
