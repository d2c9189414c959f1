"""Kills a campaign at random moments and goes on with it, again and again: `kill -9`, for real.

    python -m tests.daq_kill --kills 200

A child process (forked, so that it starts at once) recovers the store and runs or resumes a small
campaign on the simulated rig; the parent kills it after a random time. After every kill each
finished run must be readable, with the checksum of its recording, and as it was before (by size
and date after each kill, by checksum in the end); a campaign that is complete must have every item
of its plan exactly once. Prints a JSON summary.
"""

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

from daq.campaign import expand, finished_items, run_campaign
from daq.journal import read_journal
from daq.plan import Condition, Plan
from daq.store import RunStore
from daq.store_upkeep import checksums, recover
from simulated_rig.build import build_rig
from simulated_rig.rig import SimulatedRig

PLAN = Plan(
    title="killed",
    conditions=(
        Condition(frequency_hz=167.0, over_threshold=1.6),
        Condition(frequency_hz=173.0, over_threshold=1.6),
        Condition(offset=-0.03, over_threshold=2.0, role="validation"),
    ),
    record_s=0.25,
)


def run_child(root: Path, campaign: str, rig: SimulatedRig) -> None:
    """What a user's process does after a crash: recover, go on."""
    store = RunStore(root)
    recover(store)
    resume = (store.campaigns_dir / campaign / "campaign.json").exists()
    run_campaign(
        rig,
        PLAN,
        store,
        campaign=campaign if resume else None,
        campaign_id="" if resume else campaign,
    )
    store.close()


Seen = dict[Path, tuple[int, int, str]]


def finished_files(root: Path, known: Seen) -> dict[str, str]:
    """Every finished run file and its checksum; raises when one is damaged.

    A file that has neither size nor time of change other than in `known` is not read again.
    """
    found = {}
    for path in sorted((root / "campaigns").glob("*/runs/*.h5")):
        about = path.stat()
        size, changed, actual = known.get(path, (-1, -1, ""))
        if (about.st_size, about.st_mtime_ns) == (size, changed):
            found[str(path.relative_to(root))] = actual
            continue
        stated, actual = checksums(path)
        if stated != actual:
            raise AssertionError(f"{path}: checksum {actual}, recorded {stated}")
        found[str(path.relative_to(root))] = actual
        known[path] = (about.st_size, about.st_mtime_ns, actual)
    return found


def check_complete(store: RunStore, campaign: str) -> None:
    """Every item once, and nothing besides what was interrupted."""
    runs = store.campaign_runs(campaign)
    lines = read_journal(store.campaign_dir(campaign) / "journal.jsonl")
    done = finished_items(lines, runs)
    indices = [item.index for item in expand(PLAN)]
    good = sorted(int(run.name[:3]) for run in runs if run.exit_status == "success")
    if sorted(done) != indices or good != indices:
        raise AssertionError(f"{campaign}: items {sorted(done)}, runs {good}, plan {indices}")
    if {run.exit_status for run in runs} - {"success", "interrupted", "failed"}:
        raise AssertionError(f"{campaign}: {runs}")


def main(kills: int, seed: int, longest_s: float, root: Path) -> dict[str, int]:
    """The loop; returns how often what happened."""
    rng = random.Random(seed)
    rig = build_rig(seed=seed)
    before: dict[str, str] = {}
    known: Seen = {}
    counts = {"kills": 0, "completed": 0, "runs": 0, "interrupted_runs": 0}
    number = 0
    while counts["kills"] < kills or counts["completed"] == 0:
        campaign = f"c{number:03d}"
        child = os.fork()
        if child == 0:
            try:
                run_child(root, campaign, rig)
                os._exit(0)
            except BaseException as error:
                print(f"child failed: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
                os._exit(1)
        status = _wait(child, rng.uniform(0.0, longest_s) if counts["kills"] < kills else 60.0)
        files = finished_files(root, known)
        if not before.items() <= files.items():
            raise AssertionError("a finished run changed or vanished")
        before = files
        if status is None:
            counts["kills"] += 1
        elif status == 0:
            counts["completed"] += 1
            store = RunStore(root)
            check_complete(store, campaign)
            store.close()
            number += 1
        else:
            raise AssertionError(f"the campaign failed with status {status}")
    if finished_files(root, {}) != before:
        raise AssertionError("a finished run changed under its old date")
    store = RunStore(root)
    if store.rebuild():
        raise AssertionError("the catalogue could not be rebuilt")
    statuses = [run.exit_status for run in store.runs(limit=100_000)]
    store.close()
    counts["runs"] = len(statuses)
    counts["interrupted_runs"] = statuses.count("interrupted")
    return counts


def _wait(child: int, seconds: float) -> int | None:
    """Exit status of a child that ended by itself in time; None after killing it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--longest-s", type=float, default=1.5)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = main(arguments.kills, arguments.seed, arguments.longest_s, Path(folder))
    print(json.dumps(result))
