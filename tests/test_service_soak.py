"""What an hour of requests, events and clients leaves in the service's memory: next to nothing."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MOST_BYTES = 30e6


def test_an_hour_of_work_leaves_less_than_thirty_megabytes(tmp_path: Path) -> None:
    """In a process of its own: here, coverage and what other tests left behind would be counted."""
    told = subprocess.run(
        [sys.executable, "-m", "tests.service_soak", str(tmp_path)],
        check=True,
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    an_hour = float(told.stdout)
    print(f"{an_hour / 1e6:.1f} MB an hour")
    assert an_hour < MOST_BYTES
