"""Workers of a diagnosis: in order, with their errors, and gone with the process they work for."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from identify.executor import executor

PATIENCE_S = 20.0
KILLED = """
import time
from identify.executor import executor
if __name__ == "__main__":
    with executor(2) as run:
        list(run.map(abs, [-1, -2]))
        print(*run.pool._processes, flush=True)
        time.sleep(600)
"""


def half(x: int) -> float:
    if x < 0:
        raise ValueError(f"x = {x}: not negative")
    return x / 2


def test_workers_keep_the_order_and_pass_errors_on() -> None:
    with executor(2) as run:
        assert list(run.map(half, range(7))) == [x / 2 for x in range(7)]
        with pytest.raises(ValueError, match="x = -1"):
            list(run.map(half, [1, -1]))


def gone(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return True
    return state == "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc: who is alive")
def test_workers_do_not_outlive_a_killed_process(tmp_path: Path) -> None:
    """A diagnosis that is killed cannot tell its workers to end."""
    script = tmp_path / "killed.py"
    script.write_text(KILLED)
    main = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    assert main.stdout is not None
    workers = [int(word) for word in main.stdout.readline().split()]
    assert workers
    assert not any(gone(pid) for pid in workers)
    main.kill()
    main.wait()
    main.stdout.close()
    until = time.monotonic() + PATIENCE_S
    while not all(gone(pid) for pid in workers) and time.monotonic() < until:
        time.sleep(0.05)
    assert all(gone(pid) for pid in workers)
