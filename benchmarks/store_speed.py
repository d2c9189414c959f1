"""Speed of the run store, in one run: ``python benchmarks/store_speed.py [FOLDER]``.

* Opening a recorded campaign folder (read, checked, stored as HDF5, loaded for analysis), beside
  what one would write by hand (``scipy.io.wavfile`` file by file, scaled to units, nothing checked
  or kept) and beside reading the files' bytes.
* Listing pages of 100 out of 100 000 runs, first, last and filtered, beside a Python list of the
  same records filtered and sorted by hand.

Processor seconds, the best of several.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.io import wavfile

from daq.importers import open_campaign
from daq.records import RunSummary
from daq.store import RunStore
from daq.store_catalogue import RunQuery
from identify.load import load_campaign

HERE = Path(__file__).resolve().parent.parent
RUNS = 100_000
PAGES = {
    "first": (RunQuery(), None),
    "last": (RunQuery(), "c0998/050-forced"),
    "by rig and frequency": (RunQuery(rig="rig3", min_frequency_hz=170.0), "c0500/000-forced"),
    "by date": (RunQuery(since="2026-01-05", until="2026-01-06"), None),
}


def best(act: Callable[[], object], repeats: int = 5) -> float:
    """Least processor seconds of several calls."""
    least = float("inf")
    for _ in range(repeats):
        begin = time.process_time()
        act()
        least = min(least, time.process_time() - begin)
    return least


def opened(folder: Path) -> None:
    """A campaign into an empty store, and out of it again."""
    with tempfile.TemporaryDirectory() as root:
        load_campaign(open_campaign(folder, RunStore(Path(root))))


def by_hand(folder: Path) -> float:
    """The same recordings as floats."""
    total = 0.0
    for file in sorted(folder.glob("runs/*.wav")):
        _, samples = wavfile.read(file)
        total += float((samples * (10.0 / 2**15)).astype(np.float64)[-1, 0])
    return total


def summaries() -> list[RunSummary]:
    """What 100 000 runs of 1000 campaigns on five rigs would be listed as."""
    return [
        RunSummary(
            f"c{i // 100:04d}", f"{i % 100:03d}-forced", "forced", "fit", 160.0 + i % 40, 1.0, 0.0,
            f"2026-01-{1 + i % 28:02d}", f"rig{i % 5}", 1e4, 20_000, "success", "", "0" * 64, 1,
        )
        for i in range(RUNS)
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=HERE / "tests/data/b-flame-delay")
    folder = parser.parse_args().folder
    ours, theirs = best(lambda: opened(folder)), best(lambda: by_hand(folder))
    limit = best(lambda: [f.read_bytes() for f in folder.glob("runs/*.wav")])
    print(f"open {folder.name}: {ours:.3f} s; wavfile {theirs:.3f} s; bytes {limit:.4f} s")

    rows = summaries()
    with tempfile.TemporaryDirectory() as root:
        store = RunStore(Path(root))
        store.catalogue.add_runs(rows)
        for name, (query, after) in PAGES.items():
            page = best(partial(store.runs, query, after=after, limit=100))
            print(f"page of 100 of {RUNS}, {name}: {1e3 * page:.2f} ms")
    plain = best(
        lambda: sorted((r for r in rows if r.rig == "rig3"), key=lambda r: r.campaign)[:100]
    )
    print(f"a Python list filtered and sorted by hand: {1e3 * plain:.2f} ms")


if __name__ == "__main__":
    main()
